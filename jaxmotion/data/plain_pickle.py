"""Numbers out of a pickle file, without running what the file says.

A pickle is a program: it names functions and has them called. Data sets published as
pickles need only those that rebuild NumPy arrays, so every other name is refused before
it is looked up. Files of Python 2 and 3 and of NumPy 1 and 2 are read.
"""

import io
import pickle
from typing import Any

import numpy as np


def _encode(text: str, encoding: str) -> bytes:
    """Bytes that an old pickle protocol wrote as text; for that encoding alone."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"bytes encoded as {encoding!r}, not 'latin1'")
    return text.encode("latin1")


# NumPy's own functions, taken from what it would write, which spares private imports.
_RECONSTRUCT = np.empty(0).__reduce__()[0]
_SCALAR = np.float64(0).__reduce__()[0]
_FROM_BUFFER = np.empty(1).__reduce_ex__(5)[0]
_ALLOWED = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("_codecs", "encode"): _encode,
}
for _core in ("numpy.core", "numpy._core"):  # NumPy 1 and NumPy 2
    _ALLOWED |= {
        (f"{_core}.multiarray", "_reconstruct"): _RECONSTRUCT,
        (f"{_core}.multiarray", "scalar"): _SCALAR,
        (f"{_core}.numeric", "_frombuffer"): _FROM_BUFFER,
    }


class _Refused(Exception):
    """A name outside the list."""


class _PlainUnpickler(pickle.Unpickler):
    """Knows NumPy's arrays, types and numbers, and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        """What the file calls by that name, from the list above."""
        if (module, name) not in _ALLOWED:
            raise _Refused(f"{module}.{name}")
        return _ALLOWED[module, name]


def read_plain_pickle(data: bytes, *, name: str) -> Any:
    """Content of a pickle that holds only plain values and NumPy arrays.

    Plain values are None, numbers, text, bytes, and lists, tuples, sets and
    dictionaries of them. Text of Python 2 is taken as Latin-1. A `ValueError` names a
    file that is damaged, or names anything beyond NumPy arrays; it is not run.
    """
    try:
        return _PlainUnpickler(io.BytesIO(data), encoding="latin1").load()
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
