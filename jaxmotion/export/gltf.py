"""A motion as binary glTF: a skinned mannequin, its joints, and their animation.

The container is a JSON chunk and one chunk of bytes; writing it needs no package.
Meters, y up, facing +z; the zero pose is the T-pose, standing on the ground.

Source: glTF 2.0 specification (Khronos), sections 3 and 4.4.
"""

import dataclasses
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from jaxmotion import files
from jaxmotion.motion.anatomy import as_t_pose, zero_pose
from jaxmotion.motion.rotation import matrix_from_rot6d, quaternion_from_matrix
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.viz import mannequin
from jaxmotion.viz.mannequin import Mannequin

_FLOAT, _UINT, _USHORT = 5126, 5125, 5123
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_VERTICES, _FACES = 34962, 34963


class _Buffer:
    """Collects arrays; each is a view and an accessor."""

    def __init__(self) -> None:
        self.bytes = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(
        self, values: np.ndarray, *, target: int | None = None, range_: bool = False
    ) -> int:
        """Index of the accessor of an array [n] or [n, components]."""
        kinds = {"f": ("<f4", _FLOAT), "i": ("<u4", _UINT), "u": ("<u2", _USHORT)}
        dtype, kind = kinds[values.dtype.kind]
        packed = np.ascontiguousarray(values, dtype)
        view = {"buffer": 0, "byteOffset": len(self.bytes), "byteLength": packed.nbytes}
        self.views.append(view if target is None else view | {"target": target})
        self.bytes += packed.tobytes() + b"\0" * (-packed.nbytes % 4)
        flat = packed.reshape(len(packed), -1)
        accessor = {
            "bufferView": len(self.views) - 1,
            "componentType": kind,
            "count": len(packed),
            "type": _KINDS[flat.shape[1]],
        }
        if range_:
            accessor |= {"min": flat.min(0).tolist(), "max": flat.max(0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def _linear(color: str) -> list[float]:
    """A color of the web as glTF has them."""
    parts = np.array([int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(parts < 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return [*linear.round(5).tolist(), 1.0]


def _primitives(
    body: Mannequin, buffer: _Buffer, colors: list[int]
) -> list[dict[str, Any]]:
    """The faces of each color."""
    found = []
    for material, color in enumerate(colors):
        mine = np.flatnonzero(body.materials == color)
        number = np.zeros(len(body.vertices), int)
        number[mine] = np.arange(len(mine))
        faces = body.faces[body.materials[body.faces[:, 0]] == color]
        attributes = {
            "POSITION": buffer.add(body.vertices[mine], target=_VERTICES, range_=True),
            "NORMAL": buffer.add(body.normals[mine], target=_VERTICES),
            "JOINTS_0": buffer.add(body.joints[mine], target=_VERTICES),
            "WEIGHTS_0": buffer.add(body.weights[mine], target=_VERTICES),
        }
        indices = buffer.add(number[faces].ravel(), target=_FACES)
        found.append(
            {"attributes": attributes, "indices": indices, "material": material}
        )
    return found


def _animation(motion: Motion, buffer: _Buffer) -> dict[str, Any]:
    """A track per joint's rotation, and one of the root's position."""
    matrices = matrix_from_rot6d(motion.joint_rotation)
    turns = np.array(quaternion_from_matrix(matrices), float)[..., [1, 2, 3, 0]]
    # Neighbors on the same side, or players turn the long way round.
    flips = np.sum(turns[1:] * turns[:-1], axis=-1) < 0
    turns[1:] *= np.where(np.cumsum(flips, axis=0) % 2, -1.0, 1.0)[..., None]
    times = buffer.add(np.arange(len(turns)) / motion.fps, range_=True)
    tracks = [("rotation", j, turns[:, j]) for j in range(turns.shape[1])]
    tracks.append(("translation", 0, np.asarray(motion.root_position, float)))
    samplers, channels = [], []
    for number, (path, joint, values) in enumerate(tracks):
        samplers.append({"input": times, "output": buffer.add(values)})
        target = {"node": joint, "path": path}
        channels.append({"sampler": number, "target": target})
    return {"name": "motion", "samplers": samplers, "channels": channels}


def to_glb(skeleton: Skeleton, motion: Motion) -> bytes:
    """A motion of one character as the bytes of a .glb file.

    Joints are nodes 0, 1, ... by their names; all rotations are against the T-pose.
    """
    for name in ("root_position", "joint_rotation"):
        finite = np.isfinite(np.asarray(getattr(motion, name))).reshape(
            len(motion.root_position), -1
        )
        if not finite.all():
            frame = int((~finite.all(axis=1)).argmax())
            raise ValueError(f"frame {frame} of {name} is not finite")
    # In the T-pose first: the body is made there.
    skeleton, motion = as_t_pose(skeleton, motion)
    places, offsets = zero_pose(skeleton), np.array(skeleton.offsets, float)
    count = len(places)
    still = np.broadcast_to(np.eye(3), (count, 3, 3))
    body = mannequin.describe(skeleton)
    offsets[0] = [0.0, -float(body.skin(places, still)[0][:, 1].min()), 0.0]
    # For who knows no skins the mesh stands, too.
    lift = np.array([0.0, -float(body.vertices[:, 1].min()), 0.0])
    body = dataclasses.replace(
        body,
        vertices=(body.vertices + lift).astype(np.float32),
        bind_position=body.bind_position + lift,
    )
    buffer, colors = _Buffer(), np.unique(body.materials).tolist()
    primitives = _primitives(body, buffer, colors)
    # Column by column; the translation is the last one.
    inverse = np.tile(np.eye(4), (count, 1, 1))
    inverse[:, :, :3] = np.swapaxes(body.inverse_bind, 1, 2)
    bind = buffer.add(inverse.reshape(count, 16))
    nodes = []
    for joint, name in enumerate(skeleton.names):
        children = [j for j, up in enumerate(skeleton.parents) if up == joint]
        node = {"name": name, "translation": offsets[joint].tolist()}
        nodes.append(node | ({"children": children} if children else {}))
    nodes.append({"name": "body", "mesh": 0, "skin": 0})
    content = {
        "asset": {"version": "2.0", "generator": "jaxmotion"},
        "scene": 0,
        "scenes": [{"nodes": [0, count]}],
        "nodes": nodes,
        "meshes": [{"name": "body", "primitives": primitives}],
        "skins": [
            {"joints": list(range(count)), "skeleton": 0, "inverseBindMatrices": bind}
        ],
        "materials": [
            {
                "pbrMetallicRoughness": {
                    "baseColorFactor": _linear(body.palette[color]),
                    "metallicFactor": 0.0,
                    "roughnessFactor": 0.8,
                }
            }
            for color in colors
        ],
        "animations": [_animation(motion, buffer)],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.bytes)}],
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(buffer.bytes), b"BIN\0") + bytes(buffer.bytes)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def save_glb(path: str | Path, skeleton: Skeleton, motion: Motion) -> None:
    """Writes `to_glb`; `ValueError` if a frame is not finite."""
    content = to_glb(skeleton, motion)
    with files.replacing(path) as file:
        file.write(content)
