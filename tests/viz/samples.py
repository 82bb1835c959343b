"""Figures that walk in a circle: one of four joints, and a person."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from jaxmotion.data import procedural, walker
from jaxmotion.data.gaits import GAITS
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.motion.trajectory import Command
from jaxmotion.viz import stage

PARENTS = (-1, 0, 1, 0)
NAMES = ("Hips", "Spine", "LeftHand", "RightFoot")
OFFSETS = ((0, 0, 0), (0, 0.5, 0), (0.4, 0, 0), (-0.1, -0.85, 0))
FPS = 30.0


def figure(names=NAMES, raised=0.0):
    """Hips, a spine to its end, a hand and a foot; the hand may be raised, meters."""
    offsets = np.array(OFFSETS, np.float32)
    offsets[2, 1] += raised
    return Skeleton(offsets=jnp.asarray(offsets), parents=PARENTS, names=names)


def circle(frames=12, radius=1.0, fps=FPS):
    """A motion of that figure, which sways, and the root's path [F, 2], meters."""
    angle = np.linspace(0, 1.5, frames)
    root = np.stack(
        [
            radius * np.sin(angle),
            0.9 + 0.02 * np.sin(7 * angle),
            radius * np.cos(angle),
        ],
        axis=-1,
    )
    lean = 0.3 * np.sin(9 * angle)
    columns = np.zeros((frames, 4, 6), np.float32)
    columns[..., 0] = columns[..., 4] = 1.0
    columns[:, 0, 4], columns[:, 0, 5] = np.cos(lean), np.sin(lean)
    motion = Motion(
        root_position=jnp.asarray(root, jnp.float32),
        joint_rotation=jnp.asarray(columns),
        fps=fps,
    )
    return motion, root[:, ::2]


def circle_stage(motion=None, skeleton=None, wanted=None, **changes):
    """A stage of the figure."""
    motion = circle()[0] if motion is None else motion
    motion = dataclasses.replace(motion, fps=changes.pop("fps", motion.fps))
    return stage.make_stage(skeleton or figure(), motion, wanted=wanted, **changes)


def person(seconds=4.0, speed=1.4, turn=1.2):
    """The generated walker on a curve of so many radians per second.

    A negative turn goes to the right; the motion begins at rest.
    """
    angle = turn * np.arange(int(seconds * FPS)) / FPS
    facing = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    commands = Command(
        velocity=jnp.asarray(speed * facing, jnp.float32),
        facing=jnp.asarray(facing, jnp.float32),
        label=jnp.zeros(len(angle), jnp.int32),
    )
    made = procedural.walk(commands, next(iter(GAITS.values())), fps=FPS)
    return walker.walker_skeleton(), made.motion
