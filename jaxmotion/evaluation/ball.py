"""Figures of a person with a ball: who moves it, how near, and what passes through it.

World positions in meters, y up, the ball given by its center. What is a mean over
events or frames comes as a total and what to divide it by, so that clips are joined by
adding both.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxmotion.motion.ball import ball_accelerations
from jaxmotion.motion.spring import Scalar

_MILLIMETERS = 1000.0


class TouchEvents(NamedTuple):
    """Frames in which something moves the ball, and those with which a touch begins."""

    starts: Bool[Array, "*batch frames"]
    active: Bool[Array, "*batch frames"]


class Tally(NamedTuple):
    """A mean before the division: 0 of 0 where there was nothing to count."""

    total: Float[Array, "*batch"]
    count: Float[Array, "*batch"]


class TouchCount(NamedTuple):
    """How many touches there were, how many without a joint nearby, in what time."""

    touches: Float[Array, "*batch"]
    missed: Float[Array, "*batch"]
    minutes: Float[Array, "*batch"]


class Depth(NamedTuple):
    """Millimeters: mean over the frames, and that of the worst frame."""

    mean: Float[Array, "*batch"]
    largest: Float[Array, "*batch"]


@jax.jit
def touch_events(
    ball: Float[Array, "*batch frames 3"], fps: Scalar, *, threshold: Scalar
) -> TouchEvents:
    """When the ball is pushed: frames of large acceleration, neighbors as one event.

    The ground pushes too. A ball in flight accelerates by 9.8: below that threshold the
    flight and the kicks at its two ends are a single event. A bounce is one as well.
    The threshold is in m/s^2, exclusive; the paper's 2 is a second difference of 2.2 mm
    at 30 fps, which noise in a recording exceeds.

    Given are first frames of events, and all their frames: never the first or the last
    frame of the clip, which have no acceleration. Fewer than three frames:
    `ValueError`.

    Source: SMGDiff, eq. 10.
    """
    size = jnp.linalg.norm(ball_accelerations(ball, fps), axis=-1)
    active = size > threshold
    before = jnp.concatenate([active[..., :1], active[..., :-1]], axis=-1)
    return TouchEvents(starts=active & ~before, active=active)


@jax.jit
def foot_ball_distance(
    ball: Float[Array, "*batch frames 3"],
    joints: Float[Array, "*batch frames touching 3"],
    fps: Scalar,
    *,
    threshold: Scalar,
) -> Tally:
    """How near the nearest joint comes to the ball's center when the ball is pushed.

    Of each event of `touch_events` the smallest distance of any joint, over the event's
    frames and one frame on either side: meters, added over events, and the number of
    events. A touch by the surface of a foot leaves the ball's radius and half a foot.
    """
    starts, distances = _event_distances(ball, joints, fps, threshold)
    return Tally(
        total=jnp.sum(jnp.where(starts, distances, 0.0), axis=-1),
        count=jnp.sum(starts, axis=-1, dtype=ball.dtype),
    )


@jax.jit
def touch_count(
    ball: Float[Array, "*batch frames 3"],
    joints: Float[Array, "*batch frames touching 3"],
    fps: Scalar,
    *,
    threshold: Scalar,
    max_distance: Scalar,
) -> TouchCount:
    """Touches, and those in which the ball is pushed by nothing.

    An event of `touch_events` is missed if its distance, as in `foot_ball_distance`, is
    above `max_distance` (meters, inclusive: the ball's radius, half a foot, and a
    margin). The minutes are those of motion.
    """
    starts, distances = _event_distances(ball, joints, fps, threshold)
    touches = jnp.sum(starts, axis=-1, dtype=ball.dtype)
    # Written so that a joint that is nowhere (NaN) misses.
    missed = starts & ~(distances <= max_distance)
    return TouchCount(
        touches=touches,
        missed=jnp.sum(missed, axis=-1, dtype=ball.dtype),
        minutes=jnp.full_like(touches, ball.shape[-2]) / fps / 60.0,
    )


@jax.jit
def untouched_acceleration(
    ball: Float[Array, "*batch frames 3"],
    joints: Float[Array, "*batch frames touching 3"],
    fps: Scalar,
    *,
    max_distance: Scalar,
) -> Tally:
    """How much the ball accelerates while no joint is near it.

    The acceleration, m/s^2, is added over the frames in which, as in the frames before
    and after, every joint is farther than `max_distance` (meters, inclusive) from the
    center. A rolling ball is slowed by a few tenths, a flying one falls with 9.8:
    compare with real motions. Fewer than three frames: `ValueError`.
    """
    size = jnp.linalg.norm(ball_accelerations(ball, fps), axis=-1)[..., 1:-1]
    is_free = _least_nearby(_nearest(ball, joints))[..., 1:-1] > max_distance
    return Tally(
        total=jnp.sum(jnp.where(is_free, size, 0.0), axis=-1),
        count=jnp.sum(is_free, axis=-1, dtype=ball.dtype),
    )


@jax.jit
def ground_penetration(
    ball: Float[Array, "*batch frames 3"], *, radius: Scalar, ground: Scalar = 0.0
) -> Depth:
    """How deep the ball's lowest point lies below the ground, millimeters.

    Mean over all frames, and largest; not negative. Arguments are in meters.
    """
    return _depth(radius + ground - ball[..., 1])


@jax.jit
def joint_penetration(
    ball: Float[Array, "*batch frames 3"],
    joints: Float[Array, "*batch frames touching 3"],
    *,
    radius: Scalar,
) -> Depth:
    """How deep the deepest joint (world) lies inside the ball, millimeters.

    Mean over all frames, and largest; not negative. Arguments are in meters. Joints lie
    inside the limbs, hence zero here does not yet keep their surface out.
    """
    return _depth(radius - _nearest(ball, joints))


def _depth(meters: Float[Array, "*batch frames"]) -> Depth:
    depth = _MILLIMETERS * jnp.maximum(meters, 0.0)
    return Depth(mean=jnp.mean(depth, axis=-1), largest=jnp.max(depth, axis=-1))


def _nearest(ball: Array, joints: Array) -> Float[Array, "*batch frames"]:
    """Distance of the nearest joint to the ball's center, meters."""
    return jnp.min(jnp.linalg.norm(joints - ball[..., None, :], axis=-1), axis=-1)


def _least_nearby(values: Float[Array, "*batch frames"]) -> Array:
    """The least of each frame and its neighbors."""
    none = jnp.full_like(values[..., :1], jnp.inf)
    padded = jnp.concatenate([none, values, none], axis=-1)
    sides = jnp.minimum(padded[..., :-2], padded[..., 2:])
    return jnp.minimum(values, sides)


def _event_distances(
    ball: Array, joints: Array, fps: Scalar, threshold: Scalar
) -> tuple[Bool[Array, "*batch frames"], Float[Array, "*batch frames"]]:
    """Where events start, and in these frames the smallest distance of the event.

    The widening by a frame is done before events are told apart, since two of them may
    share the frame between.
    """
    events = touch_events(ball, fps, threshold=threshold)
    nearby = _least_nearby(_nearest(ball, joints))

    def back(after: Array, frame: tuple[Array, Array]) -> tuple[Array, Array]:
        active, distance = frame
        least = jnp.where(active, jnp.minimum(distance, after), jnp.inf)
        return least, least

    frames = jnp.moveaxis(events.active, -1, 0), jnp.moveaxis(nearby, -1, 0)
    none = jnp.full_like(nearby[..., 0], jnp.inf)
    _, least = jax.lax.scan(back, none, frames, reverse=True)
    return events.starts, jnp.moveaxis(least, 0, -1)
