"""Files of weights: what is in them, and bad ones, each told in one line."""

import json
import os
import pickle
import struct
import zipfile

import numpy as np
import pytest
from safetensors import numpy as safetensors

from jaxmotion.networks.weight_files import arrays, read_weights

ARRAYS = {
    "a.weight": np.arange(12, dtype=np.float32).reshape(3, 4),
    "a.bias": np.array([0.5, -2.0, 3.0], np.float16),
    "count": np.array(7),
}


def found_in(path):
    return {name: x.read() for name, x in arrays(read_weights(path)).items()}


def refused(path, message):
    """One line that names the file; also where only an array is damaged."""
    with pytest.raises(ValueError, match=message) as caught:
        found_in(path)
    assert "\n" not in str(caught.value)


def test_dictionaries_that_share_their_parts_are_walked_once(tmp_path):
    """Each of 60 holds the one before twice: 2^60 names in a kilobyte."""
    torch = pytest.importorskip("torch")
    content = {"x": torch.zeros(1)}
    for _ in range(60):
        content = {"a": content, "b": content}
    torch.save(content, tmp_path / "x.pt")
    refused(tmp_path / "x.pt", "x.pt.*more than 1000000 names")
    content = {"x": torch.ones(1)}
    torch.save({"a": content, "b": content}, tmp_path / "x.pt")
    assert set(found_in(tmp_path / "x.pt")) == {"a.x", "b.x"}


@pytest.fixture
def torch():
    return pytest.importorskip("torch")


def test_every_kind_of_number_and_view(torch, tmp_path):
    base = torch.arange(24.0)
    tensors = {
        str(kind).removeprefix("torch."): torch.tensor([0, 1, 3]).to(kind)
        for kind in (
            torch.float32,
            torch.float64,
            torch.float16,
            torch.bfloat16,
            torch.int64,
            torch.int32,
            torch.int16,
            torch.int8,
            torch.uint8,
            torch.bool,
        )
    }
    tensors |= {
        "turned": base.reshape(4, 6).T,
        "strided": base.reshape(2, 3, 4)[:, ::2, 1:],
        "none": torch.zeros(0, 3),
        "number": torch.tensor(2.5),
        "parameter": torch.nn.Parameter(base[3:5]),
    }
    path = tmp_path / "weights.pt"
    for is_new in (True, False):
        torch.save({"inner": tensors}, path, _use_new_zipfile_serialization=is_new)
        found = found_in(path)
        assert set(found) == {f"inner.{name}" for name in tensors}
        for name, tensor in tensors.items():
            wanted = tensor.detach()
            wanted = wanted.float() if wanted.dtype == torch.bfloat16 else wanted
            np.testing.assert_array_equal(found[f"inner.{name}"], wanted.numpy())
            assert found[f"inner.{name}"].shape == tensor.shape


def test_safetensors(tmp_path):
    path = tmp_path / "weights.safetensors"
    safetensors.save_file(ARRAYS, path, metadata={"format": "np"})
    found = found_in(path)
    assert set(found) == set(ARRAYS)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(found[name], array)


class Code:
    """Unpickling it would make a folder."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("is_new", [True, False])
def test_no_code_is_run(torch, tmp_path, is_new):
    path, made = tmp_path / "weights.pt", tmp_path / "made"
    content = {"code": Code(made), "x": torch.ones(2), "code 2": [Code(made)]}
    torch.save(content, path, _use_new_zipfile_serialization=is_new)
    np.testing.assert_array_equal(found_in(path)["x"], np.ones(2))
    assert not made.exists()


@pytest.mark.slow
@pytest.mark.parametrize("is_new", [True, False])
def test_truncated_files(torch, tmp_path, is_new):
    path = tmp_path / "weights.pt"
    tensors = {name: torch.from_numpy(np.array(x)) for name, x in ARRAYS.items()}
    torch.save(tensors, path, _use_new_zipfile_serialization=is_new)
    whole = path.read_bytes()
    assert set(found_in(path)) == set(ARRAYS)
    for stop in range(0, len(whole) - 1, 7):
        path.write_bytes(whole[:stop])
        refused(path, "weights.pt: no PyTorch's file of weights, or a damaged one")


def test_a_flipped_bit_of_an_archive_is_found(torch, tmp_path):
    path = tmp_path / "weights.pt"
    torch.save({"x": torch.full((40,), 1.25)}, path)
    data = bytearray(path.read_bytes())
    data[data.index(np.float32(1.25).tobytes() * 8)] ^= 1
    path.write_bytes(data)
    refused(path, r"weights.pt: x is damaged \(Bad CRC-32")


def rezip(path, change, compression=zipfile.ZIP_STORED):
    """The archive with members changed: name and bytes to bytes, or None."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in members.items():
            if (data := change(name, data)) is not None:
                archive.writestr(name, data)


def test_archives_that_lie(torch, tmp_path):
    path = tmp_path / "weights.pt"

    def saved(change, compression=zipfile.ZIP_STORED):
        torch.save({"x": torch.ones(300)}, path)
        rezip(path, change, compression)
        return path

    refused(saved(lambda _, x: x, zipfile.ZIP_DEFLATED), "is compressed")
    gone = lambda part: lambda name, x: None if part in name else x  # noqa: E731
    refused(saved(gone("data.pkl")), "no data.pkl in the archive")
    refused(saved(gone("data/0")), "no weights/data/0 in the archive")
    cut = lambda name, x: x[:-4] if "data/0" in name else x  # noqa: E731
    refused(saved(cut), "data/0 has 1196 bytes, expected 1200")
    big = lambda name, x: b"big" if "byteorder" in name else x  # noqa: E731
    refused(saved(big), "not little-endian")
    # The size of the tensor, 300, as a two-byte number: beyond its storage.
    number = lambda n: b"M" + struct.pack("<H", n)  # noqa: E731

    def beyond(name, x):
        head, _, tail = x.rpartition(number(300))
        return head + number(301) + tail if "data.pkl" in name else x

    refused(saved(beyond), r"a tensor of shape \(301,\) is not within its storage")


def test_other_files(tmp_path):
    path = tmp_path / "weights.pt"
    with pytest.raises(FileNotFoundError, match="no weights file"):
        read_weights(path)
    for data in (b"", b"<html>", pickle.dumps({"a": 1}), b"PK\x05\x06" + bytes(18)):
        path.write_bytes(data)
        refused(path, "no PyTorch's file of weights, or a damaged one")
    os.mkfifo(tmp_path / "pipe.pt")
    with pytest.raises(OSError, match="pipe or a device"):
        read_weights(tmp_path / "pipe.pt")


def test_bad_safetensors(tmp_path):
    path = tmp_path / "weights.safetensors"

    def written(header, numbers=b"12345678"):
        text = header if isinstance(header, bytes) else json.dumps(header).encode()
        path.write_bytes(struct.pack("<Q", len(text)) + text + numbers)
        return path

    entry = {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}
    assert found_in(written({"x": entry}))["x"].shape == (2,)
    for header in (b"{", b"[1]", {"x": 3}, {"x": {"dtype": "F32"}}):
        refused(written(header), "no safetensors file of weights")
    for change in (
        {"shape": [3]},
        {"shape": [2**62]},
        {"data_offsets": [0, 12]},
        {"shape": [4], "data_offsets": [0, 16]},
        {"data_offsets": [-8, 0]},
    ):
        refused(written({"x": entry | change}), "x is not within the file")
    path.write_bytes(struct.pack("<Q", 2**60) + b"{}")
    refused(path, f"a header of {2**60} bytes")
    path.write_bytes(b"123")
    refused(path, "no safetensors file of weights")


def field(number, value):
    """A field of a protocol buffer: a number, or bytes."""

    def varint(x):
        parts = []
        while x > 127:
            parts.append(x & 127 | 128)
            x >>= 7
        return bytes([*parts, x])

    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def onnx(path, tensor, *, graph=7):
    path.write_bytes(field(1, 8) + field(graph, field(5, tensor)))
    return path


def test_onnx_by_hand(tmp_path):
    path = tmp_path / "model.onnx"
    numbers = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
    named = field(8, b"x") + field(2, 1)
    sizes = field(1, 2) + field(1, 3)
    for shape, data in (
        (sizes, field(9, numbers.tobytes())),  # raw
        (sizes, field(4, numbers.tobytes())),  # packed
        (field(1, bytes([2, 3])), field(9, numbers.tobytes())),  # packed sizes
    ):
        found = found_in(onnx(path, named + shape + data))
        np.testing.assert_array_equal(found["x"], numbers)
    whole = onnx(path, named + sizes + field(9, numbers.tobytes())).read_bytes()
    for stop in range(3, len(whole)):
        path.write_bytes(whole[:stop])
        refused(path, "model.onnx: no ONNX file of weights, or a damaged one")
    refused(onnx(path, named + sizes + field(14, 1)), "x is in another file")
    refused(onnx(path, named, graph=8), "no graph")
