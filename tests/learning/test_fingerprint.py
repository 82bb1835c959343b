"""Fingerprints: the same for the same values, another for one bit."""

import hashlib
import struct

import jax.numpy as jnp
import numpy as np

from jaxmotion.learning.fingerprint import fingerprint

PARAMS = {
    "out": {
        "bias": np.array([0.5, -2.0], np.float32),
        "kernel": np.arange(6, dtype=np.float32).reshape(2, 3),
    },
    "count": np.int32(7),
}


def test_it_is_the_hash_of_names_types_shapes_and_bytes():
    """A fixed rule, since files keep it: written out here once more."""
    text = b"count\0int32\0()\0" + struct.pack("<i", 7)
    text += b"out/bias\0float32\0(2,)\0" + struct.pack("<2f", 0.5, -2.0)
    text += b"out/kernel\0float32\0(2, 3)\0" + struct.pack("<6f", *range(6))
    assert fingerprint(PARAMS) == hashlib.sha256(text).hexdigest()[:12]


def test_order_of_entries_and_place_of_arrays_do_not_matter():
    out = PARAMS["out"]
    turned = {
        "count": jnp.int32(7),
        "out": {"kernel": jnp.asarray(out["kernel"]), "bias": out["bias"]},
    }
    assert list(turned) != list(PARAMS)
    assert fingerprint(turned) == fingerprint(PARAMS)
    columns = np.asfortranarray(out["kernel"])
    assert fingerprint({"kernel": columns}) == fingerprint({"kernel": out["kernel"]})


def test_every_bit_matters():
    array = np.array([1.0, 0.0], np.float32)
    found = {fingerprint({"a": array})}
    for bit in range(64):
        raw = bytearray(array.tobytes())
        raw[bit // 8] ^= 1 << bit % 8
        found.add(fingerprint({"a": np.frombuffer(bytes(raw), np.float32)}))
    assert len(found) == 65


def test_names_shapes_and_types_matter():
    zeros = np.zeros(4, np.float32)
    others = [
        {"a": zeros},
        {"b": zeros},
        {"a": {"b": zeros}},
        {"a": zeros.reshape(2, 2)},
        {"a": zeros.astype(np.int32)},
        {"a": zeros[:2], "b": zeros[:2]},
        {"a": zeros, "b": zeros[:0]},
    ]
    assert len({fingerprint(x) for x in others}) == len(others)
