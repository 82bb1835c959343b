"""The tiny walker with a ball: pushed ahead at each swing, or lying out of reach."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from jaxmotion.data import selection
from jaxmotion.data.ball_clips import BallClips, ball_clips
from jaxmotion.motion.ball import Scene
from tests import tiny

RADIUS = 0.11


def dribbled(data, *, ahead: float = 0.4, bounce: float = 0.1) -> np.ndarray:
    """Places of a ball that swings back and forth before the root."""
    root = np.asarray(data.root_position, np.float64)
    step = np.gradient(root[:, ::2], axis=0)
    facing = step / np.maximum(np.linalg.norm(step, axis=-1, keepdims=True), 1e-9)
    wave = ahead + bounce * np.abs(np.sin(0.3 * np.arange(len(root))))
    place = root[:, ::2] + wave[:, None] * facing
    return np.stack([place[:, 0], np.full(len(root), RADIUS), place[:, 1]], axis=-1)


def touches(frames: int) -> np.ndarray:
    """The left toe touches in two frames of ten."""
    return (np.arange(frames) % 10 < 2)[:, None] & np.array([True, False])


def scene(frames: int = 40, **how) -> Scene:
    """One walk with its ball."""
    motion = tiny.walk(frames, **how)
    return Scene(
        motion=motion,
        ball=jnp.asarray(dribbled(motion), jnp.float32),
        touch=jnp.asarray(touches(frames), jnp.float32),
    )


def clips(num_frames: int = 80) -> BallClips:
    """Eight recordings: four of dribbling, four with the ball thirty meters away."""
    both = selection.concatenate([tiny.clips(num_frames), tiny.clips(num_frames)])
    far = np.repeat([0, 1], both.num_clips // 2)
    both = dataclasses.replace(
        both,
        labels={"skill": jnp.asarray(far, jnp.int32)},
        label_names=(("skill", ("dribble", "off_ball")),),
        clip_names=tuple(f"take{i}@0+{num_frames}" for i in range(both.num_clips)),
    )
    owner = np.repeat(far, np.diff(np.asarray(both.offsets)))
    place = dribbled(both)
    place[owner == 1] += [0.0, 0.0, 30.0]
    touch = touches(len(place)) & (owner == 0)[:, None]
    return ball_clips(both, place, touch, joints=both.skeleton.feet, radius=RADIUS)
