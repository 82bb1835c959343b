"""Numbers out of a pickle file, without running what the file says.

A pickle is a program: it names functions and has them called, with any arguments. Data
sets published as pickles need only those that rebuild NumPy arrays, so every other name
is refused before it is looked up. Nor are those NumPy's own, which trust what they get
(`numpy.ndarray` takes bytes for pointers to objects). Files of Python 2 and 3 and of
NumPy 1 and 2 are read.
"""

import dataclasses
import io
import math
import pickle
from typing import Any

import numpy as np


def _encode(text: str, encoding: str) -> bytes:
    """Bytes that an old pickle protocol wrote as text; for that encoding alone."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"bytes encoded as {encoding!r}, not 'latin1'")
    return text.encode("latin1")


@dataclasses.dataclass(init=False)
class _Type:
    """Stands for a `numpy.dtype` of numbers, text or objects; no key, like an array."""

    dtype: np.dtype

    def __init__(self, code: Any, align: Any = False, copy: Any = True):
        self.dtype = np.dtype(str(code))
        if self.dtype.kind not in "biufcSUO":
            raise pickle.UnpicklingError(f"an array of the type {code!r}")

    def __setstate__(self, state: tuple) -> None:
        version, order, *parts = state[:5]
        if version not in (3, 4) or any(part is not None for part in parts):
            raise pickle.UnpicklingError("a type that has parts")
        if order in ("<", ">"):
            self.dtype = self.dtype.newbyteorder(order)

    def values(self, raw: Any) -> np.ndarray:
        """[n], of bytes."""
        if self.dtype.hasobject:
            raise pickle.UnpicklingError("objects out of bytes")
        raw = raw.encode("latin1") if isinstance(raw, str) else raw  # of Python 2
        return np.frombuffer(raw, self.dtype)


@dataclasses.dataclass(init=False)
class _Array:
    """Stands for an array until the file is read; not hashable, as that is not."""

    array: np.ndarray

    def __init__(self, kind: Any, shape: Any, code: Any):
        self.array = np.zeros(0)

    def __setstate__(self, state: tuple) -> None:
        _, shape, kind, in_columns, raw = state
        if not isinstance(kind, _Type):
            raise pickle.UnpicklingError("an array without a type")
        if kind.dtype.hasobject:
            if not isinstance(raw, list) or len(raw) != math.prod(shape):
                raise pickle.UnpicklingError(f"objects of the shape {shape}")
            # One by one: lists among them are objects, too. In rows, however stored.
            values = np.empty(len(raw), object)
            for i, one in enumerate(raw):
                values[i] = one
            self.array = values.reshape(shape)
        else:
            values = kind.values(raw).copy()
            self.array = values.reshape(shape, order="F" if in_columns else "C")


def _scalar(kind: _Type, raw: Any) -> np.generic:
    (value,) = kind.values(raw)
    return value


def _from_buffer(raw: Any, kind: _Type, shape: Any, order: Any) -> np.ndarray:
    return kind.values(raw).reshape(shape, order=order)


# The class is only named, to be made by `_reconstruct`.
_ARRAYS = "numpy.ndarray"
_ALLOWED = {
    ("numpy", "ndarray"): _ARRAYS,
    ("numpy", "dtype"): _Type,
    ("_codecs", "encode"): _encode,
}
for _core in ("numpy.core", "numpy._core"):  # NumPy 1 and NumPy 2
    _ALLOWED |= {
        (f"{_core}.multiarray", "_reconstruct"): _Array,
        (f"{_core}.multiarray", "scalar"): _scalar,
        (f"{_core}.numeric", "_frombuffer"): _from_buffer,
    }


class _Refused(Exception):
    """A name outside the list."""


class _PlainUnpickler(pickle.Unpickler):
    """Knows NumPy's arrays, types and numbers, and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        """What the file calls by that name, from the list above."""
        if (module, name) not in _ALLOWED:
            raise _Refused(f"{module}.{name}")
        found = _ALLOWED[module, name]
        # A new one for each call: a file may set attributes of what it names.
        return (lambda *given: found(*given)) if callable(found) else found


def _plain(value: Any, seen: set[int]) -> Any:
    """With arrays and types in the places of what stands for them."""
    if isinstance(value, _Array):
        if value.array.dtype.hasobject and id(value) not in seen:
            seen.add(id(value))
            flat = value.array.reshape(-1)
            for i, one in enumerate(flat):
                flat[i] = _plain(one, seen)
        return value.array
    if isinstance(value, _Type):
        return value.dtype
    if callable(value):
        raise pickle.UnpicklingError("a function in place of a value")
    if isinstance(value, tuple):
        return tuple(_plain(one, seen) for one in value)
    if isinstance(value, (list, dict)) and id(value) not in seen:
        seen.add(id(value))
        items = enumerate(value) if isinstance(value, list) else value.items()
        for key, one in list(items):
            value[key] = _plain(one, seen)
    return value


def read_plain_pickle(data: bytes, *, name: str) -> Any:
    """Content of a pickle that holds only plain values and NumPy arrays.

    Plain values are None, numbers, text, bytes, and lists, tuples, sets and
    dictionaries of them. Text of Python 2 is taken as Latin-1. A `ValueError` names a
    file that is damaged, or names anything beyond NumPy arrays; it is not run.
    """
    try:
        return _plain(
            _PlainUnpickler(io.BytesIO(data), encoding="latin1").load(), set()
        )
    except _Refused as error:
        raise ValueError(
            f"{name}: the pickle asks for {error}, expected only numbers, text, "
            "containers and NumPy arrays; nothing of it was run"
        ) from None
    # Damaged bytes make the unpickler and NumPy raise almost anything.
    except Exception as error:
        raise ValueError(
            f"{name}: not a pickle, or a damaged one ({type(error).__name__}: {error})"
        ) from None
