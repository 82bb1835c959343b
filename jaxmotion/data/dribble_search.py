"""Chains of touches of a ball beside a recorded person, found by chance.

A chain grows from touch to touch. Of the touches that follow within the time allowed,
those are kept to which the ball can roll without meeting a leg and toward which the
foot can push it. One of them is taken at random; where no way leads on, another one is
tried, and the longest chain is kept.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxmotion.data.dribble_touches import Dribble, Touches, is_free, possible_touches
from jaxmotion.data.rolling import Body, end_velocities, roll

# Frames on either side of a touch in which a leg may come nearer.
_NEAR = 2
# Dead ends after which a chain that did not get longer is taken as it is.
_PATIENCE = 60


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Segment:
    """A ball beside some frames of a clip, from its rest to its last touch.

    Attributes:
      start: First frame.
      ball: Its center on the ground plane, meters.
      touch_frames: Frames of the touches, counted from `start`.
      touch_feet: Which of the feet touches.
    """

    start: int
    ball: Float[np.ndarray, "frames 2"]
    touch_frames: Int[np.ndarray, "touches"]
    touch_feet: Int[np.ndarray, "touches"]


def _can_push(
    touches: Touches,
    now: int,
    leave: Float[np.ndarray, "ways 2"],
    arrive: Float[np.ndarray, "2"],
    settings: Dribble,
) -> Bool[np.ndarray, "ways"]:
    """Whether a foot can turn the velocity of arrival into those of leaving."""
    toe, speed = touches.direction[now], touches.speed[now]
    change = leave - arrive
    along = change @ toe
    push = along >= settings.min_push
    push &= along >= np.cos(settings.cone) * np.linalg.norm(change, axis=-1)
    bounce = settings.restitution * (speed - arrive @ toe)
    return push & (leave @ toe - speed <= bounce)


def next_touches(
    body: Body,
    touches: Touches,
    now: int,
    arrive: Float[np.ndarray, "2"],
    settings: Dribble,
) -> tuple[Int[np.ndarray, "ways"], Float[np.ndarray, "ways 2"]]:
    """Touches to which the ball can be sent by one touch.

    Args:
      body: The clip.
      touches: All of the clip.
      now: The touch that sends it.
      arrive: Velocity with which the ball came to it, meters per second.
      settings: What a ball may do.

    Returns:
      Those touches, and the velocity with which the ball comes to each.
    """
    first = int(touches.frame[now])
    shortest, longest = (first + seconds * body.fps for seconds in settings.gap)
    low = np.searchsorted(touches.frame, shortest - 1e-6)
    found = np.arange(low, np.searchsorted(touches.frame, longest + 1e-6))
    way = touches.place[found] - touches.place[now]
    seconds = (touches.frame[found] - first) / body.fps
    leave, comes = end_velocities(way, seconds, settings.deceleration)
    keep = np.linalg.norm(leave, axis=-1) <= settings.max_speed
    keep &= _can_push(touches, now, leave, arrive, settings)
    # A foot that is hardly faster than the ball cannot push it on.
    nears = touches.speed[found] - np.sum(comes * touches.direction[found], axis=-1)
    keep &= nears * (1 + settings.restitution) >= settings.min_push
    if not keep.any():
        return found[keep], comes[keep]
    found, way, seconds, comes = (x[keep] for x in (found, way, seconds, comes))
    frames = (touches.frame[found] - first)[:, None]
    count = np.arange(frames.max() + 1)
    times = np.minimum(count / body.fps, seconds[:, None])
    place = touches.place[now] + roll(way, seconds, settings.deceleration, times)
    near = (count <= _NEAR) | (count >= frames - _NEAR)
    free = is_free(body, place, slice(first, first + count.size), near, settings)
    good = np.all(free | (count > frames), axis=-1)
    return found[good], comes[good]


def find_chain(
    body: Body,
    touches: Touches,
    first: int,
    tried: set[int],
    settings: Dribble,
    generator: np.random.Generator,
) -> list[int]:
    """Touches one after the other, as many as chance finds.

    Args:
      body: The clip.
      touches: All of the clip.
      first: The touch to begin with.
      tried: Touches from which no way led on; those that are tried are added.
      settings: What a ball may do.
      generator: Of the order in which ways are tried.

    Returns:
      The touches, the first one at least.
    """

    def ways(now: int, arrive: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        found, comes = next_touches(body, touches, now, arrive, settings)
        order = generator.permutation(found.size)
        return iter([(int(found[i]), comes[i]) for i in order])

    tried.add(first)
    chain, open_ways = [first], [ways(first, np.zeros(2))]
    best, dead_ends = [first], 0
    while chain and dead_ends < _PATIENCE:
        step = next((way for way in open_ways[-1] if way[0] not in tried), None)
        if step is not None:
            tried.add(step[0])
            chain.append(step[0])
            open_ways.append(ways(*step))
            continue
        dead_ends += 1
        if touches.frame[chain[-1]] > touches.frame[best[-1]]:
            best, dead_ends = list(chain), 0
        chain.pop()
        open_ways.pop()
    return best


def _segment(
    body: Body, touches: Touches, chain: list[int], earliest: int, settings: Dribble
) -> Segment:
    """The ball of a chain, and its rest before that."""
    frame, place = touches.frame[chain], touches.place[chain]
    start = max(earliest, int(frame[0]) - round(settings.wait * body.fps))
    before = np.arange(start, frame[0])
    lies = np.broadcast_to(place[0], (before.size, 2))
    near = before >= frame[0] - _NEAR
    free = is_free(body, lies, slice(start, int(frame[0])), near, settings)
    # Not before the last frame in which a leg is where the ball lies.
    start += int(np.flatnonzero(~free).max(initial=-1)) + 1
    now = np.arange(start, frame[-1] + 1)
    last = np.maximum(np.searchsorted(frame, now, side="right") - 1, 0)
    # The last touch sends the ball nowhere.
    way = np.diff(place, axis=0, append=place[-1:])[last]
    seconds = np.diff(frame, append=frame[-1] + 1)[last] / body.fps
    times = np.maximum(now - frame[last], 0)[:, None] / body.fps
    return Segment(
        start=start,
        ball=place[last] + roll(way, seconds, settings.deceleration, times)[:, 0],
        touch_frames=frame - start,
        touch_feet=touches.foot[chain],
    )


def find_segments(
    body: Body, settings: Dribble, generator: np.random.Generator
) -> list[Segment]:
    """Stretches of a clip beside which a ball can be dribbled; they do not overlap.

    Args:
      body: The clip.
      settings: What a ball may do, and how long a stretch is.
      generator: Of everything.

    Returns:
      The segments in their order, perhaps none.
    """
    touches = possible_touches(body, settings)
    tried, earliest, found = set(), 0, []
    while True:
        left = np.setdiff1d(np.flatnonzero(touches.frame >= earliest), list(tried))
        if left.size == 0:
            return found
        soon = touches.frame[left[0]] + settings.gap[1] * body.fps
        first = int(generator.choice(left[touches.frame[left] <= soon]))
        chain = find_chain(body, touches, first, tried, settings, generator)
        segment = _segment(body, touches, chain, earliest, settings)
        if len(segment.ball) >= settings.min_frames:
            found.append(segment)
            earliest = segment.start + len(segment.ball)
