"""Whether a long rollout is still a living character.

Two ways to fail: it *diverges* (numbers that no body shows) or it *freezes* (the limbs
stop although it is told to move). Both are yes or no, with stated bounds, for frames
and for whole rollouts.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxmotion.motion.spring import Scalar


@functools.partial(jax.jit, static_argnames=("fps",))
def diverged_frames(
    positions: Float[Array, "*batch frames joints 3"],
    *,
    fps: float,
    min_root: Scalar,
    max_root: Scalar,
    max_speed: Scalar = 20.0,
) -> Bool[Array, "*batch frames"]:
    """Which frames are outside what a body can show.

    A number is not finite, the root is outside its heights, or a joint came there from
    the frame before faster than the bound. World positions, meters, joint 0 the root;
    heights are in meters, the largest speed of any joint in meters per second.
    """
    finite = jnp.all(jnp.isfinite(positions), axis=(-2, -1))
    height = positions[..., 0, 1]
    inside = (height >= min_root) & (height <= max_root)
    step = jnp.diff(positions, axis=-3) * fps
    slow = jnp.all(jnp.sum(step**2, axis=-1) <= max_speed**2, axis=-1)
    # Nothing comes before the first frame.
    slow = jnp.concatenate([jnp.ones((*slow.shape[:-1], 1), bool), slow], axis=-1)
    return ~(finite & inside & slow)


@functools.partial(jax.jit, static_argnames=("fps",))
def has_diverged(
    positions: Float[Array, "*batch frames joints 3"],
    *,
    fps: float,
    min_root: Scalar,
    max_root: Scalar,
    max_speed: Scalar = 20.0,
) -> Bool[Array, "*batch"]:
    """Whether any frame is outside what a body can show; see `diverged_frames`."""
    found = diverged_frames(
        positions, fps=fps, min_root=min_root, max_root=max_root, max_speed=max_speed
    )
    return jnp.any(found, axis=-1)


@functools.partial(jax.jit, static_argnames=("fps", "seconds"))
def frozen_frames(
    positions: Float[Array, "*batch frames joints 3"],
    wanted_velocity: Float[Array, "*batch frames 2"],
    *,
    fps: float,
    seconds: float = 2.0,
    min_speed: Scalar = 0.05,
    commanded: Scalar = 0.3,
) -> Bool[Array, "*batch frames"]:
    """Which frames lie in a window of time in which the limbs stand though told to go.

    Time is cut into windows of `seconds`. A window is frozen, in all its frames, if the
    joints' mean speed relative to the root is below `min_speed` while the slowest
    velocity wanted in it is above `commanded`: a statue is frozen whether it stands or
    glides. After the last whole window no frame is. World positions, meters, joint 0
    the root; speeds and the velocity (x, z) asked for in each frame are in meters per
    second.
    """
    length = round(seconds * fps)
    if length < 1:
        raise ValueError(f"windows of {seconds} s at {fps} fps have no frame")
    limbs = positions[..., 1:, :] - positions[..., :1, :]
    speed = jnp.linalg.norm(jnp.diff(limbs, axis=-3), axis=-1).mean(-1) * fps
    windows = speed.shape[-1] // length

    def cut(x: Array) -> Array:
        return x[..., : windows * length].reshape(*x.shape[:-1], windows, length)

    wanted = jnp.linalg.norm(wanted_velocity[..., :-1, :], axis=-1)
    still = cut(speed).mean(-1) < min_speed
    frozen = still & (cut(wanted).min(-1) > commanded)
    rest = positions.shape[-3] - windows * length
    frames = jnp.repeat(frozen, length, axis=-1)
    return jnp.pad(frames, [(0, 0)] * (frames.ndim - 1) + [(0, rest)])


@functools.partial(jax.jit, static_argnames=("fps", "seconds"))
def is_frozen(
    positions: Float[Array, "*batch frames joints 3"],
    wanted_velocity: Float[Array, "*batch frames 2"],
    *,
    fps: float,
    seconds: float = 2.0,
    min_speed: Scalar = 0.05,
    commanded: Scalar = 0.3,
) -> Bool[Array, "*batch"]:
    """Whether any window of `frozen_frames` is frozen; never if there is none."""
    found = frozen_frames(
        positions,
        wanted_velocity,
        fps=fps,
        seconds=seconds,
        min_speed=min_speed,
        commanded=commanded,
    )
    return jnp.any(found, axis=-1)
