"""Motions from BVH files and back; `bvh_text` reads and writes the files.

A joint's local transform in a frame is a translation and a rotation. Position channels
replace the OFFSET, component by component (some sets give every joint six channels,
and then OFFSET is only the pose of the first frame). The rotation is the product of
the axis rotations in the order of the rotation channels, column vectors: channels
Z, X, Y mean R = Rz Rx Ry.
"""

import dataclasses
import decimal
import math
from collections.abc import Collection

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxmotion.data.bvh_text import Bvh, BvhError
from jaxmotion.motion.skeleton import MAX_METERS, Motion, Skeleton

_CUSTOMARY = (24, 25, 30, 48, 50, 60, 72, 90, 100, 120, 144, 200, 240)


def _axis_rotation(
    axis: str, radians: Float[np.ndarray, "*batch"]
) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation about a coordinate axis, right-handed."""
    cosine, sine = np.cos(radians), np.sin(radians)
    first = "XYZ".index(axis)
    i, j = (first + 1) % 3, (first + 2) % 3
    matrix = np.zeros((*radians.shape, 3, 3))
    matrix[..., first, first] = 1.0
    matrix[..., i, i], matrix[..., i, j] = cosine, -sine
    matrix[..., j, i], matrix[..., j, j] = sine, cosine
    return matrix


def bvh_transforms(
    bvh: Bvh,
) -> tuple[
    Float[np.ndarray, "frames joints 3"], Float[np.ndarray, "frames joints 3 3"]
]:
    """Parent-local positions and rotations of all joints in all frames, both float64.

    Positions are in the file's units; position channels replace OFFSET.
    """
    shape = (bvh.num_frames, bvh.num_joints)
    positions = np.broadcast_to(bvh.offsets, (*shape, 3)).copy()
    rotations = np.broadcast_to(np.eye(3), (*shape, 3, 3)).copy()
    first = np.cumsum([0] + [len(channels) for channels in bvh.channels])
    # Joints with the same channels are converted together: one call for most files.
    for channels in sorted(set(bvh.channels)):
        joints = [j for j, own in enumerate(bvh.channels) if own == channels]
        matrix = None
        for slot, channel in enumerate(channels):
            values = bvh.values[:, first[joints] + slot]
            axis = channel[0]
            if channel.endswith("position"):
                positions[:, joints, "XYZ".index(axis)] = values
                continue
            turn = _axis_rotation(axis, np.deg2rad(values))
            matrix = turn if matrix is None else matrix @ turn
        if matrix is not None:
            rotations[:, joints] = matrix
    return positions, rotations


def _subtree(bvh: Bvh, root: int) -> list[int]:
    """The joint and everything below it, in file order."""
    inside = [False] * bvh.num_joints
    for joint, parent in enumerate(bvh.parents):
        inside[joint] = joint == root or (parent >= 0 and inside[parent])
    return [joint for joint, is_inside in enumerate(inside) if is_inside]


def without_joints(bvh: Bvh, names: Collection[str]) -> Bvh:
    """The file's content without some joints, never the root, and all below them.

    `BvhError` for an unknown name or the root's.
    """
    dropped = {_require_joint(bvh, name) for name in names}
    if 0 in dropped:
        raise BvhError(f"{bvh.name}: the root {bvh.names[0]!r} cannot be dropped")
    keep: list[int] = []
    for joint, parent in enumerate(bvh.parents):
        if joint not in dropped and (parent < 0 or parent in keep):
            keep.append(joint)
    first = np.cumsum([0] + [len(channels) for channels in bvh.channels])
    columns = [c for joint in keep for c in range(first[joint], first[joint + 1])]
    return dataclasses.replace(
        bvh,
        names=tuple(bvh.names[joint] for joint in keep),
        parents=(-1, *(keep.index(bvh.parents[joint]) for joint in keep[1:])),
        offsets=bvh.offsets[keep],
        channels=tuple(bvh.channels[joint] for joint in keep),
        end_sites=tuple(bvh.end_sites[joint] for joint in keep),
        values=bvh.values[:, columns],
    )


def _require_joint(bvh: Bvh, name: str) -> int:
    """Index of a joint by name."""
    if name not in bvh.names:
        raise BvhError(
            f"{bvh.name}: unknown joint {name!r}: the file has {', '.join(bvh.names)}"
        )
    return bvh.names.index(name)


def _world(parents, positions, rotations, joint: int) -> tuple[np.ndarray, np.ndarray]:
    """World position and rotation of one joint in all frames."""
    position, turn = positions[:, joint], rotations[:, joint]
    while (joint := parents[joint]) >= 0:
        above = rotations[:, joint]
        position = positions[:, joint] + np.einsum("fij,fj->fi", above, position)
        turn = above @ turn
    return position, turn


def motion_from_bvh(
    bvh: Bvh,
    *,
    root: str | None = None,
    scale: float = 0.01,
    feet: tuple[str, ...] = (),
    tolerance: float = 1e-3,
) -> tuple[Skeleton, Motion]:
    """Skeleton and motion of a parsed file.

    World coordinates stay as published (nothing is centered, turned or put on the
    floor). Joints outside the subtree of `root` are dropped; the motion of its
    ancestors is composed into it. A bone that has position channels gets their mean.

    Args:
      bvh: A parsed file, y up.
      root: Name of the joint that becomes joint 0; by default the file's ROOT.
      scale: Meters per unit of the file; 0.01 for centimeters.
      feet: Names of the joints whose contact counts, left before right.
      tolerance: Largest change of a bone's offset within the clip, meters.

    Raises:
      BvhError: for an unknown joint name, a bone whose length changes, or a position
        beyond `MAX_METERS`.
    """
    top = 0 if root is None else _require_joint(bvh, root)
    positions, rotations = bvh_transforms(bvh)
    inside = np.abs(positions) * scale <= MAX_METERS
    if not inside.all():
        frame, joint, axis = np.argwhere(~inside)[0].tolist()
        raise BvhError(
            f"{bvh.name}: {bvh.names[joint]!r} is {positions[frame, joint, axis]:g} "
            f"from its parent along {'xyz'[axis]} in frame {frame} (OFFSET or position "
            f"channels), expected less than {MAX_METERS / scale:g}"
        )
    position, turn = _world(bvh.parents, positions, rotations, top)
    joints = _subtree(bvh, top)
    index = {joint: i for i, joint in enumerate(joints)}
    for name in feet:
        if _require_joint(bvh, name) not in index:
            raise BvhError(f"{bvh.name}: foot joint {name!r} is not below {root!r}")
    offsets = positions[:, joints].mean(axis=0) * scale
    offsets[0] = 0.0
    change = np.abs(positions[:, joints] * scale - offsets).max(axis=(0, 2))
    change[0] = 0.0
    if change.max() > tolerance:
        worst = int(change.argmax())
        raise BvhError(
            f"{bvh.name}: the bone to {bvh.names[joints[worst]]!r} changes by "
            f"{change[worst]:.4g} m within the clip, more than {tolerance:g} m"
        )
    local = rotations[:, joints]
    local[:, 0] = turn
    skeleton = Skeleton(
        offsets=jnp.asarray(offsets, jnp.float32),
        parents=(-1, *(index[bvh.parents[joint]] for joint in joints[1:])),
        names=tuple(bvh.names[joint] for joint in joints),
        feet=tuple(index[bvh.names.index(name)] for name in feet),
    )
    columns = np.concatenate([local[..., 0], local[..., 1]], axis=-1)
    motion = Motion(
        root_position=jnp.asarray(position * scale, jnp.float32),
        joint_rotation=jnp.asarray(columns, jnp.float32),
        fps=frame_rate(bvh.frame_time, bvh.frame_decimals),
    )
    return skeleton, motion


def frame_rate(frame_time: float, decimals: int | None = None) -> float:
    """Frames per second, freed of the rounding of a written frame time in seconds.

    It was written with so many decimals; None for the shortest that tell it.

    Files write 1/30 s as 0.033333, 0.0333 or 0.033. A rate is meant when it alone of
    the customary ones, or of all whole ones, rounds or is cut to the written decimals;
    or the nearest whole one within 0.05 %, half of what separates 30 from 29.97.
    """
    rate = 1.0 / frame_time
    error = abs(rate - round(rate)) / rate
    if decimals is None:
        decimals = -int(decimal.Decimal(repr(frame_time)).as_tuple().exponent)
    unit = 10.0**-decimals
    least = math.ceil(1.0 / (frame_time + unit))
    most = math.floor(1.0 / max(frame_time - unit / 2, unit / 2))
    customary = [one for one in _CUSTOMARY if least <= one <= most]
    if error < 1e-9:
        return float(round(rate))
    if len(customary) == 1:
        return float(customary[0])
    if least == most:
        return float(least)
    if error < 5e-4:
        return float(round(rate))
    return rate


def _zyx_degrees(
    matrix: Float[np.ndarray, "*batch 3 3"],
) -> Float[np.ndarray, "*batch 3"]:
    """Angles (z, y, x) with matrix = Rz Ry Rx; x is zero where y is a quarter turn."""
    m = matrix
    cosine = np.hypot(m[..., 0, 0], m[..., 1, 0])
    is_locked = cosine < 1e-7
    y = np.arctan2(-m[..., 2, 0], cosine)
    z = np.where(
        is_locked,
        np.arctan2(-m[..., 0, 1], m[..., 1, 1]),
        np.arctan2(m[..., 1, 0], m[..., 0, 0]),
    )
    x = np.where(is_locked, 0.0, np.arctan2(m[..., 2, 1], m[..., 2, 2]))
    return np.rad2deg(np.stack([z, y, x], axis=-1))


def _matrices(motion: Motion) -> Float[np.ndarray, "frames joints 3 3"]:
    """Rotation matrices of a motion in float64, orthonormal again."""
    columns = np.asarray(motion.joint_rotation, np.float64)
    x, y = columns[..., :3], columns[..., 3:]
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    y = y - np.sum(x * y, axis=-1, keepdims=True) * x
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def bvh_from_motion(
    skeleton: Skeleton, motion: Motion, *, scale: float = 100.0, name: str = "bvh"
) -> Bvh:
    """A motion as BVH content: six channels on the root, ZYX rotations elsewhere.

    The motion is of that skeleton, without batch axes; `scale` is in units of the file
    per meter; the name is for messages. `ValueError` if it has batch axes, no frames,
    another number of joints, or a value that is not finite.
    """
    shape = motion.joint_rotation.shape
    if len(shape) != 3 or shape[0] == 0 or shape[1] != skeleton.num_joints:
        raise ValueError(
            f"joint_rotation has shape {shape}, expected frames, "
            f"{skeleton.num_joints} joints, 6"
        )
    angles = _zyx_degrees(_matrices(motion)).reshape(shape[0], -1)
    root = np.asarray(motion.root_position, np.float64) * scale
    values = np.concatenate([root, angles], axis=-1)
    if not np.isfinite(values).all():
        frame = int(np.argwhere(~np.isfinite(values))[0, 0])
        raise ValueError(f"{name}: frame {frame} of the motion is not finite")
    turns = ("Zrotation", "Yrotation", "Xrotation")
    offsets = np.asarray(skeleton.offsets, np.float64) * scale
    offsets[0] = 0.0
    is_leaf = [joint not in skeleton.parents for joint in range(skeleton.num_joints)]
    return Bvh(
        names=skeleton.names,
        parents=skeleton.parents,
        offsets=offsets,
        channels=(
            ("Xposition", "Yposition", "Zposition", *turns),
            *([turns] * (skeleton.num_joints - 1)),
        ),
        # Readers insist on an End Site in every leaf.
        end_sites=tuple(((0.0, 0.0, 0.0),) if leaf else () for leaf in is_leaf),
        values=values,
        frame_time=1.0 / motion.fps,
        name=name,
    )
