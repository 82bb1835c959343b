"""A short name for the exact values of arrays: which weights, which clips."""

import hashlib
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

_DIGITS = 12


def _name(keys: tuple[Any, ...]) -> str:
    """Path of a leaf, the same for dicts, dataclasses and named tuples."""
    return "/".join(jax.tree_util.keystr((key,), simple=True) for key in keys)


def _named(tree: Any) -> dict[str, np.ndarray]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {_name(keys): np.asarray(leaf) for keys, leaf in leaves}


def _update(digest: Any, name: str, array: np.ndarray) -> None:
    # The shape says how many bytes follow, so parts cannot be read otherwise.
    digest.update(f"{name}\0{array.dtype.name}\0{array.shape}\0".encode())
    digest.update(array.tobytes())


def fingerprint(tree: Any) -> str:
    """Names arrays by their content: other values, another name.

    The first 12 hexadecimal digits of the SHA-256 of names, types, shapes and bytes:
    the same for any order of the dicts' entries, and for device and host arrays; other
    if one bit of one number, a shape, a type or a name differs.
    """
    named = _named(tree)
    digest = hashlib.sha256()
    for name in sorted(named):
        _update(digest, name, named[name])
    return digest.hexdigest()[:_DIGITS]


def checksums(tree: Any) -> dict[str, str]:
    """SHA-256 of each leaf's path, type, shape and bytes, by its path."""
    found = {}
    for name, array in _named(tree).items():
        digest = hashlib.sha256()
        _update(digest, name, array)
        found[name] = digest.hexdigest()
    return found


def json_checksum(value: Any) -> str:
    """SHA-256 of a JSON value, for any order of its fields."""
    text = json.dumps(value, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def file_fingerprint(path: str | Path) -> str:
    """Names a file by its bytes: 12 hexadecimal digits of their SHA-256."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:_DIGITS]
