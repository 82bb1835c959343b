"""A character's body as the pages read it: one file of JSON and arrays.

The file is the length of the JSON as uint32, the JSON, and the arrays, little-endian,
each beginning at a multiple of four bytes; the JSON names them under "arrays", with
their type, shape and offset from the JSON's end. `viz/web/body.js` reads it.
"""

import json
import struct
from typing import Any

import numpy as np

from jaxmotion.motion.anatomy import zero_pose
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.viz import body as bodies


def pack(about: dict[str, Any], arrays: dict[str, np.ndarray]) -> bytes:
    """The file's content.

    Args:
      about: What the JSON says besides, without a key "arrays".
      arrays: By name: float32, int32, uint32, uint16, uint8, int8 or bool.
    """
    places, data = {}, bytearray()
    for name, values in arrays.items():
        data += b"\0" * (-len(data) % 4)
        places[name] = {
            "dtype": str(values.dtype),
            "shape": list(values.shape),
            "offset": len(data),
        }
        data += np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes()
    text = json.dumps(about | {"arrays": places}, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<I", len(text)) + text + bytes(data)


def body_arrays(skeleton: Skeleton) -> dict[str, np.ndarray]:
    """The skinned mesh of a skeleton.

    Returns:
      positions [V, 3] float32 in the bind pose, meters; normals [V, 4] int8 (127 is 1);
      joints, weights [V, 4] uint8 (255 is 1); colors [V, 4] uint8, sRGB; faces [3 T]
      uint32; inverse [J, 12] float32, rows of the joints' inverse bind transforms.
    """
    places = zero_pose(skeleton)
    count = len(places)
    still = np.broadcast_to(np.eye(3), (count, 3, 3))
    body = bodies.describe(skeleton)
    ends = body.ends(places, still)
    shapes = [bodies.capsule_mesh(e, r) for e, r in zip(ends, body.radii, strict=True)]
    starts = np.cumsum([0, *(len(shape[0]) for shape in shapes)])
    joints = np.zeros((starts[-1], 4), np.uint8)
    joints[:, 0] = np.concatenate(
        [body.joints[s][shape[2]] for s, shape in enumerate(shapes)]
    )
    weights = np.zeros_like(joints)
    weights[:, 0] = 255
    colors = np.concatenate(
        [
            np.tile(rgba(color), (len(shape[0]), 1))
            for color, shape in zip(body.colors, shapes, strict=True)
        ]
    )
    normals = np.concatenate([shape[1] for shape in shapes])
    faces = [shape[3] + start for shape, start in zip(shapes, starts, strict=False)]
    inverse = np.concatenate([still, -places[..., None]], axis=-1)
    return {
        "positions": np.concatenate([shape[0] for shape in shapes]).astype(np.float32),
        "normals": bytes_of(normals),
        "joints": joints,
        "weights": weights,
        "colors": colors,
        "faces": np.concatenate(faces).ravel().astype(np.uint32),
        "inverse": inverse.reshape(count, 12).astype(np.float32),
    }


def bytes_of(normals: np.ndarray) -> np.ndarray:
    """Unit vectors [V, 3] as int8 [V, 4], of which the last is 0."""
    return np.pad(np.round(127 * normals), ((0, 0), (0, 1))).astype(np.int8)


def rgba(color: str) -> np.ndarray:
    """A color such as "#2878c8" as four bytes."""
    return np.array([*bytes.fromhex(color[1:]), 255], np.uint8)


def skeleton_json(skeleton: Skeleton) -> dict[str, Any]:
    """What the pages need of a skeleton; offsets in meters."""
    return {
        "names": list(skeleton.names),
        "parents": list(skeleton.parents),
        "offsets": np.round(np.asarray(skeleton.offsets, float), 5).tolist(),
    }
