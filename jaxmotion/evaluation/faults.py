"""Faults planted into recordings, for which a metric should say that they are worse."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.motion.skeleton import Motion
from jaxmotion.typing import Key


def other(number: int) -> Int[Array, " {number}"]:
    """The other of two, of an even number."""
    return jnp.arange(number) ^ 1


def planted(key: Key, motion: Motion) -> dict[str, Motion]:
    """An even number of windows [windows, frames, ...] with a fault each, by name.

    "Of another window" is of the other of two, 0 and 1, 2 and 3, and so on.
    """
    joints, root = motion.joint_rotation, motion.root_position
    number, frames = root.shape[:2]

    def taken(which: Array) -> Motion:
        return _with(motion, joints[:, which], root[:, which])

    noise = jax.random.normal(key, joints.shape, joints.dtype)

    def shaken(size: float) -> Motion:
        return _with(motion, joints + size * noise, root)

    first = root[:, :1]
    longer = first + (root - first) * jnp.array([[[1.3, 1.0, 1.3]]])
    return {
        "limbs stand still": _with(
            motion, jnp.broadcast_to(joints[:, :1], joints.shape), root
        ),
        "limbs of another window": _with(motion, joints[other(number)], root),
        "backwards": taken(jnp.arange(frames)[::-1]),
        "half as fast": taken(jnp.arange(frames) // 2),
        "paths 1.3 times as long: feet slide": _with(motion, joints, longer),
        "rotations shaken by .02": shaken(0.02),
        "rotations shaken by .1": shaken(0.1),
        "10 cm into the ground": _with(motion, joints, root.at[..., 1].add(-0.1)),
    }


def _with(
    motion: Motion,
    joints: Float[Array, "windows frames joints 6"],
    root: Float[Array, "windows frames 3"],
) -> Motion:
    return dataclasses.replace(motion, joint_rotation=joints, root_position=root)
