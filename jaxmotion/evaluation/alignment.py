"""How well a motion goes and faces where it was told. Angles are in radians.

A walker's hips sway with every step. Where that is no fault, paths are compared over
`reach` frames to either side: a quarter of a second, so that half a second counts.
"""

import functools
import operator
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmotion.motion import ground
from jaxmotion.motion.spring import Scalar


class TrajectoryError(NamedTuple):
    """Mean angle of direction, and which part of the frames it could be taken of."""

    error: Float[Array, "*batch"]
    used: Float[Array, "*batch"]


@jax.jit
def trajectory_error(
    wanted_velocity: Float[Array, "*batch frames 2"],
    position: Float[Array, "*batch frames 2"],
    fps: Scalar,
    *,
    min_speed: Scalar = 0.1,
) -> TrajectoryError:
    """Mean absolute angle between the wanted and the actual direction of the root.

    In [0, pi] radians, zero where no frame remains. Frame f's actual velocity is the
    step from f to f + 1; it is compared with the velocity wanted at f. A direction
    means nothing at rest, so frames in which either speed is below `min_speed` are left
    out; the part that remains is returned.

    Velocities (x, z) and `min_speed` are in m/s, positions in meters. Raises
    `ValueError` for fewer than two frames.

    Source: Chen et al. 2024 (CAMDM), sec. 4.1, metric 5; wrapped.
    """
    if position.shape[-2] < 2:
        raise ValueError("1 frame or none, expected at least 2 to have a direction")
    actual = jnp.diff(position, axis=-2) * fps
    wanted = wanted_velocity[..., :-1, :]
    speed = jnp.minimum(
        jnp.linalg.norm(actual, axis=-1), jnp.linalg.norm(wanted, axis=-1)
    )
    is_used = speed >= min_speed
    angle = jnp.where(is_used, jnp.abs(ground.angle_from_to(wanted, actual)), 0.0)
    count = jnp.sum(is_used, axis=-1)
    return TrajectoryError(
        error=jnp.sum(angle, axis=-1) / jnp.maximum(count, 1),
        used=jnp.mean(is_used, axis=-1),
    )


@jax.jit
def orientation_error(
    wanted: Float[Array, "*batch frames 2"], actual: Float[Array, "*batch frames 2"]
) -> Float[Array, "*batch"]:
    """Mean angle between the wanted and the actual facing (x, z), in [0, pi] radians.

    Source: Chen et al. 2024 (CAMDM), sec. 4.1, metric 6; wrapped.
    """
    return jnp.mean(jnp.abs(ground.angle_from_to(wanted, actual)), axis=-1)


@jax.jit
def commanded_path(
    velocity: Float[Array, "*batch frames 2"], fps: Scalar
) -> Float[Array, "*batch frames 2"]:
    """Where a point is, meters, after each frame that starts at the origin and obeys.

    The velocity is wanted at the end of each frame (after the springs, in systems that
    have them), meters per second. The integral is trapezoidal, which is within a
    millimeter of the springs' own for half-lives from a quarter of a second.
    """
    ends = jnp.cumsum(velocity, axis=-2)
    return (ends - 0.5 * (velocity - velocity[..., :1, :])) / fps


@functools.partial(jax.jit, static_argnames=("reach",))
def path_offset(
    position: Float[Array, "*batch frames 2"],
    wanted: Float[Array, "*batch frames 2"],
    *,
    reach: int,
) -> Float[Array, "*batch frames 2"]:
    """Way, meters, from where a character should be by now to where its root (x, z) is.

    What lags behind is off its path as what strays to a side. The difference is
    averaged over `reach` frames to either side; the first and the last one stand for
    those outside.
    """
    gap = position - wanted
    frame, last = np.arange(gap.shape[-2]), gap.shape[-2] - 1
    around = [np.clip(frame + i, 0, last) for i in range(-reach, reach + 1)]
    return functools.reduce(operator.add, (gap[..., i, :] for i in around)) / len(
        around
    )


@functools.partial(jax.jit, static_argnames=("reach",))
def steady_speed(
    position: Float[Array, "*batch frames 2"], fps: Scalar, *, reach: int
) -> Float[Array, "*batch frames"]:
    """Speed of the root (x, z; meters) without its sway, meters per second.

    It is that from `reach` frames before to as many after; less at both ends of the
    path.
    """
    frame = np.arange(position.shape[-2])
    before = np.maximum(frame - reach, 0)
    after = np.minimum(frame + reach, frame[-1])
    way = jnp.linalg.norm(position[..., after, :] - position[..., before, :], axis=-1)
    seconds = np.maximum(after - before, 1) / fps
    return way / seconds.reshape((1,) * (way.ndim - 1) + (-1,))


@functools.partial(jax.jit, static_argnames=("length",))
def creep(
    position: Float[Array, "*batch frames 2"], *, length: int
) -> Float[Array, "*batch"]:
    """How far a character that should stand goes from its place within `length` frames.

    Largest distance, meters, of the root (x, z) from the first frame of a part of that
    length; mean over all whole parts, of which there must be one (`ValueError`).
    """
    parts = position.shape[-2] // length
    if parts < 1:
        raise ValueError(
            f"a path of {position.shape[-2]} frames, expected {length} or more"
        )
    lead = position.shape[:-2]
    part = position[..., : parts * length, :].reshape(*lead, parts, length, 2)
    away = jnp.linalg.norm(part - part[..., :1, :], axis=-1)
    return jnp.mean(jnp.max(away, axis=-1), axis=-1)


class Reaction(NamedTuple):
    """Seconds until commands were obeyed, the time they had if not; and whether."""

    seconds: Float[np.ndarray, "*batch commands"]
    obeyed: Bool[np.ndarray, "*batch commands"]


def reaction(
    reached: Bool[Array | np.ndarray, "*batch frames"],
    begins: Sequence[int],
    ends: Sequence[int],
    fps: float,
) -> Reaction:
    """Time from each new command until it is obeyed for the first time.

    Commands hold from their first frame to their (exclusive) end; `reached` says
    whether a frame does what they say.
    """
    reached = np.asarray(reached)
    lead, number = reached.shape[:-1], len(begins)
    seconds, obeyed = np.zeros((*lead, number)), np.zeros((*lead, number), bool)
    for i, (begin, end) in enumerate(zip(begins, ends, strict=True)):
        part = reached[..., begin:end]
        obeyed[..., i] = part.any(axis=-1)
        # The first frame shows the character a tick after the command.
        first = np.where(obeyed[..., i], part.argmax(axis=-1) + 1, end - begin)
        seconds[..., i] = first / fps
    return Reaction(seconds=seconds, obeyed=obeyed)
