"""Arrays out of the files that authors publish weights in; nothing in a file is run.

Read are PyTorch's archives (also of TorchScript), its format before version 1.6, ONNX
and safetensors. PyTorch's files are pickles, which are programs that name functions and
have them called. Here only dictionaries and tensors are built; every other name stands
for a `Record`, which keeps what it was given and does nothing. Of ONNX, whose files are
protocol buffers, the initializers and the nodes that use them are read.

An array is read when it is asked for, so what nobody needs (an optimizer's state, the
image tower of CLIP) costs nothing.
"""

import collections
import dataclasses
import io
import json
import math
import os
import pickle
import struct
import zipfile
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from jaxmotion.files import open_regular

# PyTorch's storages, the types of safetensors and ONNX -> NumPy's; bfloat16 is the
# upper half of a float32.
_BFLOAT16 = "bfloat16"
_MAX_NAMES = 1_000_000
_TORCH = {
    "FloatStorage": "<f4",
    "DoubleStorage": "<f8",
    "HalfStorage": "<f2",
    "BFloat16Storage": _BFLOAT16,
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "i1",
    "ByteStorage": "u1",
    "BoolStorage": "?",
}
_SAFETENSORS = {
    "F32": "<f4",
    "F64": "<f8",
    "F16": "<f2",
    "BF16": _BFLOAT16,
    "I64": "<i8",
    "I32": "<i4",
    "I16": "<i2",
    "I8": "i1",
    "U8": "u1",
    "BOOL": "?",
}
_ONNX = {1: "<f4", 10: "<f2", 11: "<f8", 16: _BFLOAT16, 6: "<i4", 7: "<i8"}

_LEGACY = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19."  # a pickled magic number


@dataclasses.dataclass(frozen=True, eq=False)
class Stored:
    """An array of a file; `read` raises `ValueError` if that is damaged."""

    shape: tuple[int, ...]
    read: Callable[[], np.ndarray]


class Record:
    """Stands for an object of a pickle: its state, and no behavior."""

    state: Any = None  # an object may be made without its __init__

    def __init__(self, *args: Any, **kwargs: Any):
        del args, kwargs

    def __setstate__(self, state: Any) -> None:
        """Keeps it."""
        self.state = state

    def append(self, item: Any) -> None:
        """Ignores it, as all that a list or dictionary of an unknown class gets."""

    extend = append

    def __setitem__(self, key: Any, value: Any) -> None:
        """Ignores it."""


def read_weights(path: str | os.PathLike) -> dict[str, Any]:
    """What a file of PyTorch (recognized by its content), .safetensors or .onnx holds.

    Dictionaries within dictionaries, with `Stored` arrays, plain values, and records
    for what is neither; objects with attributes are dictionaries of them. For the flat
    formats one dictionary of arrays.

    A `ValueError` names a file that is truncated, damaged or of another format.
    """
    path = os.fspath(path)
    if not os.path.exists(path):
        raise FileNotFoundError(f"no weights file {path!r}")
    with open_regular(path) as file:
        start = file.read(len(_LEGACY))
    if path.endswith(".onnx"):
        read, what = _read_onnx, "ONNX"
    elif path.endswith(".safetensors"):
        read, what = _read_safetensors, "safetensors"
    elif start == _LEGACY:
        read, what = _read_legacy, "PyTorch's"
    else:
        read, what = _read_archive, "PyTorch's"
    try:
        content = _plain(read(path), path)[0]
    # Damaged bytes make unpickler, zipfile and NumPy raise almost anything.
    except Exception as error:
        said = str(error).splitlines() or [type(error).__name__]
        raise ValueError(
            f"{path}: no {what} file of weights, or a damaged one ({said[0]})"
        ) from error
    if not isinstance(content, dict):
        raise ValueError(
            f"{path}: should hold arrays by name, found {type(content).__name__}"
        )
    return content


def arrays(content: dict[str, Any]) -> dict[str, Stored]:
    """All arrays of nested dictionaries by dotted names, as in a state dict."""
    found = {}
    for name, value in content.items():
        if isinstance(value, Stored):
            found[name] = value
        elif isinstance(value, dict):
            found |= {f"{name}.{key}": x for key, x in arrays(value).items()}
    return found


def _plain(
    value: Any, path: str, name: str = "", seen: dict[int, Any] | None = None
) -> tuple[Any, int]:
    """Records with named attributes as dictionaries, and how many values they name.

    A cycle ends in None. A dictionary that many share is refused where it has more
    names than any file of weights: 40 small ones, each twice in the next, have 2^40.
    """
    seen = {} if seen is None else seen
    if isinstance(value, Stored):
        return Stored(value.shape, lambda: _read(value, path, name)), 1
    if isinstance(value, Record) and isinstance(value.state, dict):
        value = value.state
    if not isinstance(value, dict):
        return value, 1
    if id(value) not in seen:
        seen[id(value)] = None, 1
        parts = {str(key): _plain(x, path, str(key), seen) for key, x in value.items()}
        count = 1 + sum(count for _, count in parts.values())
        if count > _MAX_NAMES:
            raise ValueError(f"more than {_MAX_NAMES} names")
        seen[id(value)] = {key: x for key, (x, _) in parts.items()}, count
    return seen[id(value)]


def _read(stored: Stored, path: str, name: str) -> np.ndarray:
    try:
        return stored.read()
    except Exception as error:
        raise ValueError(f"{path}: {name} is damaged ({error})") from error


def _decoded(data: bytes, kind: str) -> np.ndarray:
    """Numbers of bytes; bfloat16 as float32."""
    if kind == _BFLOAT16:
        return (np.frombuffer(data, "<u2").astype("<u4") << 16).view("<f4")
    return np.frombuffer(data, kind)


def _itemsize(kind: str) -> int:
    return 2 if kind == _BFLOAT16 else np.dtype(kind).itemsize


# --- PyTorch ---


@dataclasses.dataclass(frozen=True)
class _Storage:
    """A run of numbers that tensors are views of."""

    numel: int
    read: Callable[[], np.ndarray]


def _tensor(storage: Any, offset: int, size: Any, stride: Any, *_: Any) -> Stored:
    """What a tensor is in a pickle."""
    size, stride = tuple(map(int, size)), tuple(map(int, stride))
    reach = sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    inside = min((offset, *size, *stride), default=0) >= 0 and (
        0 in size or offset + reach < storage.numel
    )
    if not inside or int(np.prod(size)) > storage.numel:
        raise ValueError(f"a tensor of shape {size} is not within its storage")

    def read() -> np.ndarray:
        data = storage.read()
        if data.size != storage.numel:
            raise ValueError(f"{data.size} numbers, expected {storage.numel}")
        steps = tuple(step * data.itemsize for step in stride)
        view = np.lib.stride_tricks.as_strided(data[offset:], size, steps)
        return np.ascontiguousarray(view).reshape(size)

    return Stored(size, read)


def _parameter(data: Any, *_: Any) -> Any:
    """What a parameter is in a pickle: its tensor."""
    return data


class _Unpickler(pickle.Unpickler):
    """Builds dictionaries and tensors; everything else is a record."""

    def __init__(self, file: Any, storage: Callable[[str, str, int], _Storage]):
        super().__init__(file, encoding="latin1")
        self._storage = storage

    def find_class(self, module: str, name: str) -> Any:
        known = {
            ("collections", "OrderedDict"): collections.OrderedDict,
            ("torch", "Size"): tuple,
            ("torch._utils", "_rebuild_tensor"): _tensor,
            ("torch._utils", "_rebuild_tensor_v2"): _tensor,
            ("torch._utils", "_rebuild_parameter"): _parameter,
        }
        if module in ("torch", "torch.storage", "torch.cuda") and name in _TORCH:
            return name
        # A class of its own, for a pickle may hang attributes on it.
        return known.get((module, name)) or type(name, (Record,), {})

    def persistent_load(self, pid: Any) -> _Storage:
        tag, kind, key, _, numel, *view = pid
        if tag != "storage" or kind not in _TORCH or any(view):
            raise ValueError(f"a storage {str(kind)!r} that is not known")
        return self._storage(_TORCH[kind], str(key), int(numel))


def _read_archive(path: str) -> Any:
    """PyTorch since 1.6, and TorchScript: an uncompressed zip."""
    with zipfile.ZipFile(path) as archive:
        members = {info.filename: info for info in archive.infolist()}
    roots = [x for x in members if x.endswith("/data.pkl") and x.count("/") == 1]
    if len(roots) != 1:
        raise ValueError("no data.pkl in the archive")
    root = roots[0].removesuffix("/data.pkl")

    def member(name: str, size: int | None = None) -> bytes:
        info = members[name]
        if info.compress_type != zipfile.ZIP_STORED:  # so it cannot blow up either
            raise ValueError(f"{name} is compressed, which PyTorch does not do")
        if size is not None and info.file_size != size:
            raise ValueError(f"{name} has {info.file_size} bytes, expected {size}")
        with zipfile.ZipFile(path) as archive:
            return archive.read(info)

    order = f"{root}/byteorder"
    if order in members and member(order) != b"little":
        raise ValueError("the numbers are not little-endian")

    def storage(kind: str, key: str, numel: int) -> _Storage:
        name = f"{root}/data/{key}"
        if name not in members:
            raise ValueError(f"no {name} in the archive")
        size = numel * _itemsize(kind)
        return _Storage(numel, lambda: _decoded(member(name, size), kind))

    return _Unpickler(io.BytesIO(member(roots[0])), storage).load()


def _read_legacy(path: str) -> Any:
    """PyTorch before 1.6: pickles one after another, then the numbers."""
    places: dict[str, tuple[int, int]] = {}
    sizes: dict[str, int] = {}

    def storage(kind: str, key: str, numel: int) -> _Storage:
        sizes[key] = numel * _itemsize(kind)

        def read() -> np.ndarray:
            place, size = places[key]
            with open(path, "rb") as file:
                file.seek(place)
                return _decoded(file.read(size), kind)

        return _Storage(numel, read)

    with open(path, "rb") as file:
        for _ in range(3):  # magic number, version, machine
            _Unpickler(file, storage).load()
        content = _Unpickler(file, storage).load()
        keys = _Unpickler(file, storage).load()
        place = file.tell()
    for key in keys:
        places[key] = place + 8, sizes[key]  # after the number of numbers
        place += 8 + sizes[key]
    if os.path.getsize(path) < place or set(places) != set(sizes):
        raise ValueError(f"{os.path.getsize(path)} bytes, expected {place}")
    return content


# --- safetensors: length of the header, header in JSON, numbers ---


def _read_safetensors(path: str) -> dict[str, Stored]:
    with open(path, "rb") as file:
        (length,) = struct.unpack("<Q", file.read(8))
        if length > os.path.getsize(path) - 8:
            raise ValueError(f"a header of {length} bytes")
        header = json.loads(file.read(length))
    header.pop("__metadata__", None)
    found = {}
    for name, entry in header.items():
        if entry["dtype"] in _SAFETENSORS:
            kind, shape = _SAFETENSORS[entry["dtype"]], tuple(entry["shape"])
            start, stop = entry["data_offsets"]
            size = math.prod(shape) * _itemsize(kind)
            whole = 8 + length + stop <= os.path.getsize(path)
            if not (0 <= start <= stop and stop - start == size and whole):
                raise ValueError(f"{name} is not within the file")
            place = 8 + length + start
            found[name] = Stored(shape, _reader(path, place, size, kind, shape))
    return found


def _reader(
    path: str, place: int, size: int, kind: str, shape: tuple[int, ...]
) -> Callable[[], np.ndarray]:
    def read() -> np.ndarray:
        with open(path, "rb") as file:
            file.seek(place)
            return _decoded(file.read(size), kind).reshape(shape)

    return read


# --- ONNX: protocol buffers ---


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """A number, and where the next field begins."""
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at


def _fields(data: memoryview) -> Iterator[tuple[int, Any]]:
    """Numbers and values of a message's fields."""
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        if tag & 7 == 0:
            value, at = _varint(data, at)
            yield tag >> 3, value
            continue
        size = {1: 8, 5: 4}.get(tag & 7)
        if size is None:
            size, at = _varint(data, at)
        if tag & 7 not in (1, 2, 5) or at + size > len(data):
            raise ValueError("a field is cut off")
        yield tag >> 3, data[at : at + size]
        at += size


def _message(data: memoryview) -> dict[int, list[Any]]:
    """Values of a message's fields by their numbers."""
    found = collections.defaultdict(list)
    for number, value in _fields(data):
        found[number].append(value)
    return found


def _onnx_tensor(data: memoryview) -> tuple[str, Stored | None]:
    """Name and array of a TensorProto; None for what is not numbers."""
    fields = _message(data)
    name = bytes(fields[8][0]).decode() if fields[8] else ""
    kind = _ONNX.get(fields[2][0]) if fields[2] else None
    if fields[13] or fields[14] == [1]:
        raise ValueError(f"{name} is in another file")
    if kind is None:
        return name, None
    shape: tuple[int, ...] = ()
    for size in fields[1]:
        at = 0
        while not isinstance(size, int) and at < len(size):  # packed
            number, at = _varint(size, at)
            shape += (number,)
        shape += (size,) if isinstance(size, int) else ()
    raw = b"".join(map(bytes, fields[9] or fields[4]))
    if math.prod(shape) * _itemsize(kind) != len(raw):
        return name, None  # small integers in fields of their own
    return name, Stored(shape, lambda: _decoded(raw, kind).reshape(shape))


def _read_onnx(path: str) -> dict[str, Stored]:
    """Initializers; the weight of a linear layer has lost its name, not its bias.

    An exporter stores it transposed as "onnx::MatMul_12", and equal arrays once, with
    an Identity for each other name.
    """
    with open(path, "rb") as file:
        graphs = _message(memoryview(file.read()))[7]
    if len(graphs) != 1:
        raise ValueError("no graph")
    graph = _message(graphs[0])
    found = {name: x for name, x in map(_onnx_tensor, graph[5]) if x is not None}
    products = {}
    for fields in map(_message, graph[1]):
        inputs, outputs = ([bytes(x).decode() for x in fields[i]] for i in (1, 2))
        operator = bytes(fields[4][0]).decode()
        if operator == "Identity" and inputs[0] in found:
            found[outputs[0]] = found[inputs[0]]
        if operator == "MatMul" and inputs[1] in found:
            products[outputs[0]] = found[inputs[1]]
        if operator == "Add":
            for bias, product in (inputs, inputs[::-1]):
                name = bias.removesuffix("bias") + "weight"
                if bias in found and product in products and name not in found:
                    found[name] = _transposed(products[product])
    return found


def _transposed(stored: Stored) -> Stored:
    return Stored(stored.shape[::-1], lambda: stored.read().T)
