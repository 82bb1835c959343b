"""A short name for the exact values of arrays: which weights judged, which clips."""

import hashlib

import jax
import numpy as np

from jaxmotion.typing import Params

_DIGITS = 12


def fingerprint(params: Params) -> str:
    """Names arrays by their content: other values, another name.

    The same for any order of the dicts' entries, and for device and host arrays; other
    if one bit of one number, a shape, a type or a name differs.

    Args:
      params: Nested dict of arrays.

    Returns:
      The first 12 hexadecimal digits of the SHA-256 of names, types, shapes and bytes.
    """
    named = {
        "/".join(str(k.key) for k in keys): np.asarray(leaf)
        for keys, leaf in jax.tree_util.tree_leaves_with_path(params)
    }
    digest = hashlib.sha256()
    for name in sorted(named):
        array = named[name]
        # The shape says how many bytes follow, so parts cannot be read otherwise.
        digest.update(f"{name}\0{array.dtype.name}\0{array.shape}\0".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()[:_DIGITS]
