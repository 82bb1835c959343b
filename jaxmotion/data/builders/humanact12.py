"""HumanAct12 as SMPL poses: humanact12poses.pkl, as ACTOR and its followers use it.

The file is a pickled dictionary of lists, one entry a clip: "poses" (rotation vectors
of the 24 SMPL joints, [frames, 72]), "joints3D" (their positions, [frames, 24, 3],
meters) and "y" (the action's number). It is read without running it. There are no bone
vectors; those stored here are fitted: in the frame of its parent p, joint j lies at

    offset[j] = mean over all frames of R_global[p]^T (p_j - p_p),

one skeleton for all clips, although the people recorded differ.

The file states neither a rate nor its axes. 20 frames per second is what HumanML3D
takes these recordings for, which it includes as they are. The axes stay as published.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxmotion.data.builders import base, smpl
from jaxmotion.data.plain_pickle import read_plain_pickle
from jaxmotion.motion.skeleton import Skeleton

ACTIONS = (
    "warm_up",
    "walk",
    "run",
    "jump",
    "drink",
    "lift_dumbbell",
    "sit",
    "eat",
    "turn_steering_wheel",
    "phone",
    "boxing",
    "throw",
)
_FPS = 20.0
_FILE = "humanact12poses.pkl"


class Humanact12(base.MotionBuilder):
    """Twelve everyday actions, 1191 short clips."""

    MANUAL_DOWNLOAD_INSTRUCTIONS = f"Put {_FILE}, or a zip with it, into the folder."
    LABELS = ("action",)
    LABEL_NAMES = {"action": ACTIONS}
    SOURCE = "HumanAct12, SMPL poses (research; terms of its publishers)"
    HOMEPAGE = "https://github.com/Mathux/ACTOR"

    def _generate_examples(self, folder: Path) -> Iterator[tuple[str, dict]]:
        path, data = next(base.read_files(folder, (_FILE,)))
        poses, joints, actions = read_clips(path, data)
        skeleton = fit_skeleton(poses, joints)
        rows = zip(poses, joints, actions, strict=True)
        for number, (pose, position, action) in enumerate(rows):
            motion = base.motion_from_matrices(
                position[:, 0], smpl.matrices(pose), fps=_FPS
            )
            # The order of the file, which is that of its numbers.
            name = f"clip{number:04d}_{action}"
            yield base.example(name, skeleton, motion, {"action": action})


def _clip_array(where: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Finite float64 numbers of one clip, [frames, *shape]."""
    array = np.asarray(value)
    if array.dtype.kind != "f" or array.shape[1:] != shape or array.shape[0] < 1:
        sizes = ", ".join(map(str, shape))
        raise ValueError(
            f"{where}: expected numbers of shape (frames, {sizes}), found shape "
            f"{array.shape} of {array.dtype}"
        )
    if not np.isfinite(array).all():
        frame = int(np.argwhere(~np.isfinite(array))[0, 0])
        raise ValueError(f"{where}: frame {frame} is not finite")
    return array.astype(np.float64)


def read_clips(
    path: str, data: bytes
) -> tuple[list[np.ndarray], list[np.ndarray], list[str]]:
    """Rotation vectors [frames, 72], positions [frames, 24, 3] and action of each clip.

    Positions are in meters. A `ValueError` names the field and the clip that are wrong,
    or says that the file is no plain pickle.
    """
    content = read_plain_pickle(data, name=path)
    if not isinstance(content, dict):
        raise ValueError(
            f"{path}: expected a dictionary, found {type(content).__name__}"
        )
    fields = []
    for field in ("poses", "joints3D", "y"):
        if field not in content:
            raise ValueError(
                f"{path}: no field {field!r}; it has {', '.join(map(str, content))}"
            )
        if not isinstance(content[field], list | tuple | np.ndarray):
            raise ValueError(f"{path}: field {field!r} should list one entry a clip")
        fields.append(list(content[field]))
    poses, joints, numbers = fields
    if not poses or not len(poses) == len(joints) == len(numbers):
        raise ValueError(
            f"{path}: {len(poses)} poses, {len(joints)} joints3D and {len(numbers)} y, "
            "expected as many of each"
        )
    poses = [_clip_array(f"{path}: poses[{i}]", x, (72,)) for i, x in enumerate(poses)]
    joints = [
        _clip_array(f"{path}: joints3D[{i}]", x, (24, 3)) for i, x in enumerate(joints)
    ]
    actions = []
    for i, (pose, position, number) in enumerate(
        zip(poses, joints, numbers, strict=True)
    ):
        if len(pose) != len(position):
            raise ValueError(
                f"{path}: clip {i} has {len(pose)} frames of poses and "
                f"{len(position)} of joints3D"
            )
        known = isinstance(number, int | np.integer) and 0 <= number < len(ACTIONS)
        if not known:
            raise ValueError(f"{path}: y[{i}] is {number!r}, expected 0..11")
        actions.append(ACTIONS[int(number)])
    return poses, joints, actions


def fit_skeleton(
    poses: list[Float[np.ndarray, "_ 72"]], joints: list[Float[np.ndarray, "_ 24 3"]]
) -> Skeleton:
    """SMPL's joints with bone vectors that fit rotation vectors and positions (meters).

    Its feet are SMPL's foot joints.
    """
    position = np.concatenate(joints)
    local = smpl.matrices(np.concatenate(poses))
    world = [local[:, 0]]
    offsets = np.zeros((24, 3))
    for joint, parent in enumerate(smpl.PARENTS[1:], start=1):
        bone = position[:, joint] - position[:, parent]
        # The parent's inverse turns the bone into the parent's frame.
        offsets[joint] = np.einsum("fba,fb->fa", world[parent], bone).mean(0)
        world.append(world[parent] @ local[:, joint])
    return Skeleton(
        offsets=jnp.asarray(offsets, jnp.float32),
        parents=smpl.PARENTS,
        names=smpl.JOINTS,
        feet=(smpl.JOINTS.index("left_foot"), smpl.JOINTS.index("right_foot")),
    )
