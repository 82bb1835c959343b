"""Inertialized seams: a new chunk starts where and as the displayed motion was.

Instead of cross-fading two animations, the difference between what was displayed and
the new target is faded out. A difference x with velocity v follows the quintic whose
value and first three derivatives vanish at t1,

    x(t) = (1 - s)^4 (x + (v t1 + 4 x) s),   s = t / t1 in [0, 1]              (1)

It is Bollo's A t^5 + B t^4 + C t^3 + a0 t^2 / 2 + v t + x with his choice of a0: a
quintic with a root of order four. Its last root lies in (0, t1) only if t1 exceeds
-5 x / v, so t1 = min(duration, -5 x / v) where that is positive: no overshoot.

Vectors (positions, rotation vectors) are split: along the difference (1) with that
clamp, across it (1) with x = 0. Bollo drops the part across, and the target's own
velocity; here both are kept, so that velocity is continuous.

Times of a chunk: the last displayed frame is t = 0 and frame i of the chunk is
t = (i + 1) / fps. Where the chunk would have been at t = 0 and before is extrapolated
from its first two frames, at their constant velocity.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Num

from jaxmotion.motion import rotation, rotation_vector
from jaxmotion.motion.rotation import product
from jaxmotion.motion.skeleton import Motion

Scalar = float | Num[Array, ""]
_TINY = 1e-12


@jax.jit
def quintic(
    x: Float[Array, "*#shape"],
    v: Float[Array, "*#shape"],
    t: Scalar | Float[Array, "*#shape"],
    *,
    duration: Scalar | Float[Array, "*#shape"],
) -> Float[Array, "*shape"]:
    """Offset of each number after a time: (1) of this module.

    Args:
      x: Offset at time zero, in any unit.
      v: Its velocity, units per second.
      t: Seconds since, not negative.
      duration: Seconds until the offset and its first three derivatives are zero;
        less where it would overshoot. Zero or less: the offset is zero.

    Source: Bollo 2018, as in the released code of CAMDM; in factored form.
    """
    # Where -5 x / v is positive, i.e. x and v have opposite signs.
    opposite = x * v < 0
    stop = jnp.where(opposite, -5.0 * x / jnp.where(opposite, v, 1.0), jnp.inf)
    end = jnp.minimum(duration, stop)
    is_over = end <= 0
    end = jnp.where(is_over, 1.0, end)
    s = jnp.where(is_over, 1.0, jnp.clip(t / end, 0.0, 1.0))
    return (1.0 - s) ** 4 * (x + (v * end + 4.0 * x) * s)


def _along_and_across(x: Array, v: Array) -> tuple[Array, Array, Array, Array]:
    """Length and unit vector of x, and the parts of v along and across it."""
    square = jnp.sum(x * x, axis=-1, keepdims=True)
    is_zero = square < _TINY
    length = jnp.where(is_zero, 0.0, jnp.sqrt(jnp.where(is_zero, 1.0, square)))
    unit = jnp.where(is_zero, 0.0, x / jnp.where(is_zero, 1.0, length))
    along = jnp.sum(v * unit, axis=-1, keepdims=True)
    return length, unit, along, v - along * unit


@jax.jit
def decay(
    x: Float[Array, "*batch n"],
    v: Float[Array, "*batch n"],
    t: Float[Array, " frames"],
    *,
    duration: Scalar,
) -> Float[Array, "*batch frames n"]:
    """Offset vectors at many times, the same in every coordinate system.

    Args:
      v: Velocities of the offsets x, units per second.
      t: Seconds since, not negative.
      duration: Of the quintic, seconds.

    Source: Bollo 2018.
    """
    length, unit, along, across = (y[..., None, :] for y in _along_and_across(x, v))
    t = t.reshape((1,) * (x.ndim - 1) + (-1, 1))
    zero = jnp.zeros_like(across)
    return quintic(length, along, t, duration=duration) * unit + quintic(
        zero, across, t, duration=duration
    )


def _position_seam(past: Array, chunk: Array, fps: float) -> tuple[Array, Array]:
    """Offset of the last displayed frame to the chunk, and its velocity."""
    step = chunk[..., 1, :] - chunk[..., 0, :]
    offset = past[..., -1, :] - (chunk[..., 0, :] - step)
    return offset, (past[..., -1, :] - past[..., -2, :] - step) * fps


def _rotation_seam(past: Array, chunk: Array, fps: float) -> tuple[Array, Array]:
    """As `_position_seam`, for rotation vectors of displayed times target inverse."""
    first, second = chunk[..., 0, :, :, :], chunk[..., 1, :, :, :]
    times_inverse = lambda a, b: product(a, jnp.swapaxes(b, -1, -2))  # noqa: E731
    back = times_inverse(first, second)
    before = product(back, first)
    of_last = times_inverse(past[..., -1, :, :, :], before)
    of_other = times_inverse(past[..., -2, :, :, :], product(back, before))
    now, earlier = map(rotation_vector.from_matrix, (of_last, of_other))
    return now, (now - rotation_vector.nearest(earlier, now)) * fps


@jax.jit
def inertialize(
    past: Motion,
    chunk: Motion,
    *,
    duration: Scalar = 0.2,
) -> Motion:
    """A chunk of motion that continues what was displayed, position and velocity.

    The difference at the seam is faded out of the root's position and of every joint's
    rotation, all frames at once. From `duration` on the chunk is unchanged.

    Args:
      chunk: The frames that follow, of the same skeleton.
      duration: Seconds until the chunk is displayed as it is.

    Raises:
      ValueError: if either has fewer than two frames, or their fps differ.

    Source: Bollo 2018; Chen et al. 2024 (CAMDM), released code. Differs: one offset per
      chunk, of continuous velocity. There it is solved anew in every tick for a target
      that counts as standing still, so it fades later; only the velocity along the
      difference is kept; and rotations that differ by less than 2 mrad jump.
    """
    for name, motion in (("past", past), ("chunk", chunk)):
        if motion.root_position.shape[-2] < 2:
            raise ValueError(f"{name} has 1 frame or none, expected 2 or more")
    if past.fps != chunk.fps:
        raise ValueError(f"past has {past.fps} fps, the chunk {chunk.fps}")
    frames = chunk.root_position.shape[-2]
    times = jnp.arange(1, frames + 1, dtype=chunk.root_position.dtype) / chunk.fps
    fade = functools.partial(decay, t=times, duration=duration)

    offset = fade(*_position_seam(past.root_position, chunk.root_position, chunk.fps))
    last_two = rotation.matrix_from_rot6d(past.joint_rotation[..., -2:, :, :])
    target = rotation.matrix_from_rot6d(chunk.joint_rotation)
    turn = fade(*_rotation_seam(last_two, target, chunk.fps))
    turn = rotation_vector.to_matrix(jnp.moveaxis(turn, -2, -3))
    # Frames beyond the end keep their very numbers, not Gram-Schmidt's copy of them.
    is_faded = (times < duration)[:, None, None]
    rot6d = rotation.rot6d_from_matrix(product(turn, target))
    return dataclasses.replace(
        chunk,
        root_position=chunk.root_position + offset,
        joint_rotation=jnp.where(is_faded, rot6d, chunk.joint_rotation),
    )
