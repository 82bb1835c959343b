"""Figures that walk in a circle: one of four joints, and a person."""

import jax.numpy as jnp
import numpy as np

from jaxmotion.data import procedural, walker
from jaxmotion.data.gaits import GAITS
from jaxmotion.motion.trajectory import Command
from tests import tiny

PARENTS = (-1, 0, 1, 0)
NAMES = ("Hips", "Spine", "LeftHand", "RightFoot")
FPS = 30.0


def circle(frames=12, radius=1.0):
    """Positions [F, 4, 3] and the root's path [F, 2], meters."""
    angle = np.linspace(0, 1.5, frames)
    root = np.stack(
        [
            radius * np.sin(angle),
            0.9 + 0.02 * np.sin(7 * angle),
            radius * np.cos(angle),
        ],
        axis=-1,
    )
    skeleton = np.array([[0, 0, 0], [0, 0.5, 0], [0.4, 0.5, 0], [-0.1, -0.85, 0]])
    swing = np.sin(9 * angle)[:, None, None] * np.array([[0, 0, 0.3]])
    positions = root[:, None] + skeleton + swing * (np.arange(4) == 3)[:, None]
    return positions, root[:, ::2]


def person(seconds=4.0, speed=1.4, turn=1.2):
    """The generated walker on a curve of so many radians per second: positions, bones.

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
    skeleton = walker.walker_skeleton()
    return np.asarray(tiny.positions(skeleton, made.motion), float), skeleton
