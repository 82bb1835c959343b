"""A character's body as the pages read it: one file of JSON and arrays.

The file is the length of the JSON as uint32, the JSON, and the arrays, little-endian,
each beginning at a multiple of four bytes; the JSON names them under "arrays", with
their type, shape and offset from the JSON's end. `viz/web/body.js` reads it.
"""

import json
import struct
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxmotion.motion.skeleton import Skeleton, global_transforms
from jaxmotion.viz import mannequin

# Places of vertices in a meter, a power of two: bits that nobody sees would be sent.
PLACES = 8192


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


def body_arrays(
    skeleton: Skeleton, poses: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """The skinned mesh of a skeleton, and under "crowd." a plainer one.

    Args:
      poses: Some rotations [frames, joints, 6] as `Motion` has them, which tell how
        limbs are turned about themselves; see `mannequin.describe`.

    Returns:
      positions [V, 3] float32 in the bind pose, meters, in steps of an eighth of a
      millimeter; normals [V, 4] int8 (127 is 1);
      joints, weights [V, 4] uint8 (a vertex's weights sum to 255); colors [V, 4] uint8,
      sRGB; faces [3 T] uint16; inverse [J, 12] float32, rows of inverse bind
      transforms.

    Raises:
      ValueError: if there are more than 256 joints.
    """
    count = len(skeleton.parents)
    if count > 256:
        raise ValueError(f"{count} joints, expected at most 256 for the page")
    rotations = None if poses is None else world_turns(skeleton, poses)
    fine = mannequin.describe(skeleton, rotations=rotations)
    crowd = _mesh(mannequin.describe(skeleton, rotations=rotations, detail="crowd"))
    inverse = fine.inverse_bind.reshape(count, 12).astype(np.float32)
    plainer = {f"crowd.{name}": values for name, values in crowd.items()}
    return _mesh(fine) | {"inverse": inverse} | plainer


def world_turns(skeleton: Skeleton, poses: np.ndarray) -> np.ndarray:
    """World rotations [frames, J, 3, 3] of rotations [frames, J, 6] as `Motion` has."""
    root = jnp.zeros((len(poses), 3))
    return np.asarray(global_transforms(skeleton, root, jnp.asarray(poses))[1])


def _mesh(body: mannequin.Mannequin) -> dict[str, np.ndarray]:
    palette = np.stack([rgba(color) for color in body.palette])
    return {
        "positions": (np.round(PLACES * body.vertices) / PLACES).astype(np.float32),
        "normals": bytes_of(body.normals),
        "joints": body.joints.astype(np.uint8),
        "weights": whole(body.weights),
        "colors": palette[body.materials],
        "faces": body.faces.ravel().astype(np.uint16),
    }


def whole(weights: np.ndarray) -> np.ndarray:
    """Weights [V, 4] as bytes that sum to 255: the largest has what rounding leaves."""
    found = np.round(255 * weights).astype(int)
    found[:, 0] += 255 - found.sum(axis=-1)
    return found.astype(np.uint8)


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
