"""A ball beside a person: its features relative to the root, and how it moves.

Within reach r of the root h the ball's place b is described by

    w = 1 - |b_ground - h_ground| / r,    b' = w (b - h)                        (1)

so that a ball that is far away fades out of the features. The inverse b = b' / w + h
is singular at distance r and wrong beyond; here w is kept in 0..1, and the smaller it
is, the more the ball moves on with its velocity from where it was in the frame before.

Source: SMGDiff, section 3, eq. 1-2.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.motion import ground
from jaxmotion.motion.skeleton import Motion
from jaxmotion.motion.spring import Scalar
from jaxmotion.motion.trajectory import PlanarFrame

_TINY = 1e-12
# Least w whose quotient counts, and the least that is trusted wholly: a ball 1.8 m and
# 1.4 m away at reach 2 m. A network's w of a ball that is far away is some hundredths,
# and its quotient anywhere about the root.
MIN_CONTROL, FULL_CONTROL = 0.1, 0.3
# A quotient so far from where the velocity leads (meters) is trusted wholly, twice as
# far not at all: a ball does not jump, and a network's does where w is wrong.
_JUMP = 0.5
NUM_FEATURES = 7


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """A person and a ball over some frames.

    Attributes:
      ball: Position of the ball's center in the same frame, meters.
      touch: Which joints touch the ball; 0 or 1, or a model's guess between.
    """

    motion: Motion
    ball: Float[Array, "*batch frames 3"]
    touch: Float[Array, "*batch frames touching"]


@jax.jit
def control_weight(
    ball: Float[Array, "*batch 3"], root: Float[Array, "*batch 3"], *, reach: Scalar
) -> Float[Array, "*batch"]:
    """How much the person controls the ball: w of (1), in 0..1 (the clamp is ours).

    World positions and the reach, on the ground, are in meters.
    """
    square = jnp.sum((ball - root)[..., ::2] ** 2, axis=-1)
    # A ball right at the root has a distance without gradient.
    distance = jnp.where(square < _TINY, 0.0, jnp.sqrt(jnp.maximum(square, _TINY)))
    return jnp.clip(1.0 - distance / reach, 0.0, 1.0)


@jax.jit
def ball_velocities(
    ball: Float[Array, "*batch frames 3"], fps: Scalar
) -> Float[Array, "*batch frames 3"]:
    """Velocity, meters per second, with which the ball (meters) arrived in each frame.

    The first frame's is that of the second; `ValueError` for fewer than two frames.
    """
    _check_frames(ball, 2)
    step = jnp.diff(ball, axis=-2) * fps
    return jnp.concatenate([step[..., :1, :], step], axis=-2)


@jax.jit
def ball_accelerations(
    ball: Float[Array, "*batch frames 3"], fps: Scalar
) -> Float[Array, "*batch frames 3"]:
    """Second difference of the ball's position about each frame, m/s^2.

    Positions are in meters. Zero in the first and the last frame, which have no
    neighbor; `ValueError` for fewer than three frames.

    Source: SMGDiff, eq. 10.
    """
    _check_frames(ball, 3)
    change = jnp.diff(ball, n=2, axis=-2) * fps**2
    return jnp.pad(change, [(0, 0)] * (ball.ndim - 2) + [(1, 1), (0, 0)])


@functools.partial(jax.jit, static_argnames=("num_frames",))
def rolled(
    ball: Float[Array, "frames 3"],
    fps: Scalar,
    *,
    num_frames: int,
    deceleration: Scalar,
) -> Float[Array, "{num_frames} 3"]:
    """Where a ball (meters) comes that nobody touches, in the frames after those given.

    It goes on as it came between the last two, slows down evenly (m/s^2) to rest, and
    stays at its height. `ValueError` for fewer than two frames.
    """
    came = ball_velocities(ball, fps)[-1, ::2]
    # That was the speed half a frame ago.
    speed = jnp.sqrt(jnp.sum(came**2) + _TINY) - 0.5 * deceleration / fps
    times = jnp.arange(1, num_frames + 1, dtype=ball.dtype) / fps
    times = jnp.clip(times, 0.0, jnp.maximum(speed, 0.0) / deceleration)
    way = speed * times - 0.5 * deceleration * times**2
    place = jnp.repeat(ball[-1:], num_frames, axis=0)
    return place.at[:, ::2].add(way[:, None] * ground.unit(came)[None])


def _check_frames(ball: Array, least: int) -> None:
    if ball.shape[-2] < least:
        raise ValueError(
            f"{ball.shape[-2]} frames of a ball, expected at least {least}"
        )


@jax.jit
def encode_ball(
    ball: Float[Array, "*batch frames 3"],
    velocity: Float[Array, "*batch frames 3"],
    root: Float[Array, "*batch frames 3"],
    *,
    reach: Scalar,
) -> Float[Array, "*batch frames 7"]:
    """Features of a ball: (1), relative to the root.

    Weighted place relative to the root 3, velocity 3, weight 1; in meters and meters
    per second. Control ends at the reach, meters on the ground.

    Source: SMGDiff, eq. 1-2.
    """
    weight = control_weight(ball, root, reach=reach)[..., None]
    return jnp.concatenate([weight * (ball - root), velocity, weight], axis=-1)


def place_ball(
    features: Float[Array, "*batch frames 7"],
    root: Float[Array, "*batch frames 3"],
    *,
    least_weight: float = MIN_CONTROL,
) -> Float[Array, "*batch frames 3"]:
    """Where each frame by itself says that the ball is: b of (1), meters.

    Features may come from a network; weights below the least are taken to be this, and
    the place is wrong where the true one is below. The root is in meters.

    Source: SMGDiff, eq. 2; the clamp is ours.
    """
    place, weight = features[..., :3], features[..., 6:]
    return place / jnp.clip(weight, least_weight, 1.0) + root


@jax.jit
def decode_ball(
    features: Float[Array, "*batch frames 7"],
    root: Float[Array, "*batch frames 3"],
    start: Float[Array, "*batch 3"],
    fps: Scalar,
) -> Float[Array, "*batch frames 3"]:
    """Positions of the ball, meters: inverse of `encode_ball`, finite for any features.

    A weight of 0.3 and more is trusted wholly, one of 0.1 not at all: there the ball
    goes on with its velocity channel from where it was in the frame before (before the
    first at `start`, meters), and between it is in between. A place within 0.5 m of
    where the velocity leads is trusted too, one 1 m away is not. Features of a ball
    that moves as they say come back exactly.

    Source: SMGDiff, eq. 2, made safe.
    """
    _, velocity, weight = jnp.split(features, [3, 6], axis=-1)
    trust = (weight - MIN_CONTROL) / (FULL_CONTROL - MIN_CONTROL)
    trust = jnp.clip(trust, 0.0, 1.0)

    def move(before: Array, frame: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        trust, direct, velocity = frame
        moved = before + velocity / fps
        gap = direct - moved
        square = jnp.sum(gap * gap, axis=-1, keepdims=True)
        # Only beyond the jump is the distance looked at: at 0 it has no gradient.
        distance = jnp.sqrt(jnp.maximum(square, _JUMP**2))
        now = moved + trust * jnp.clip(2.0 - distance / _JUMP, 0.0, 1.0) * gap
        return now, now

    frames = (trust, place_ball(features, root), velocity)
    _, found = jax.lax.scan(
        move, start, jax.tree.map(lambda x: jnp.moveaxis(x, -2, 0), frames)
    )
    return jnp.moveaxis(found, 0, -2)


@functools.partial(jax.jit, static_argnames=("out",))
def move_points(
    points: Float[Array, "*batch frames 3"], frame: PlanarFrame, *, out: bool
) -> Float[Array, "*batch frames 3"]:
    """Points (meters) in a ground frame, one for all, or `out` of it; heights stay."""
    facing = jnp.broadcast_to(frame.facing[..., None, :], points[..., ::2].shape)
    origin = frame.origin[..., None, :]
    if out:
        moved = ground.out_of_frame(points[..., ::2], facing) + origin
    else:
        moved = ground.into_frame(points[..., ::2] - origin, facing)
    return points.at[..., ::2].set(moved)
