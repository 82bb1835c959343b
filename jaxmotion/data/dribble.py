"""A synthetic ball beside recorded locomotion: dribbled, or lying.

No recordings of people with a ball are to be had freely, but those of people who walk
and run are. Where a foot swings low, there might have been a ball; between two such
places it rolls as a ball does (`rolling`), and a chain of them is a dribble. The person
is as recorded and knows nothing of the ball: what is learned from this is how feet and
ball go together in place and time, not how a person runs after a ball. Beside other
clips a ball lies, far away or in front of the feet.

A touch is a frame in which a foot swings low, and the place of a ball on the ground in
front of its toe. Elsewhere a ball keeps clear of the legs and within reach. A chain
grows from touch to touch. Of the touches that follow within the time allowed, those are
kept to which the ball can roll without meeting a leg and toward which the foot can push
it. One of them is taken at random; where no way leads on, another one is tried, and the
longest chain is kept.

Touches are labeled by a rule of distance as in SMGDiff, but only about the frame in
which the ball is pushed.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxmotion.data import selection
from jaxmotion.data.ball_clips import BallClips, ball_clips
from jaxmotion.data.clips import Clips, take_clips
from jaxmotion.data.rolling import (
    TOUCH_MARGIN,
    Body,
    bodies,
    end_velocities,
    leg_distances,
    roll,
)
from jaxmotion.motion.facing import hip_facing

# Frames on either side of a touch in which a leg may come nearer.
_NEAR = 2
# Dead ends after which a chain that did not get longer is taken as it is.
_PATIENCE = 60
# Places that are tried for a ball that lies.
_TRIES = 32


def _require(holds: bool | np.bool_, settings: "Dribble", name: str, rule: str) -> None:
    if not holds:
        raise ValueError(f"{name} is {getattr(settings, name)}, expected it {rule}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Dribble:
    """How a ball is dribbled; meters, seconds.

    Attributes:
      radius: Radius of the ball.
      deceleration: Deceleration of the rolling ball, meters per second squared.
      thickness: Thickness of foot and shank about their bones: how high a standing toe
        joint is above the ground, and how far from it the ball's surface is when they
        touch.
      min_toe_speed: Least speed of a touching toe on the ground plane.
      gap: Shortest and longest time between touches.
      min_push: Least change of the ball's velocity along that of the toe.
      cone: Largest angle between that change and the toe's velocity, radians.
      restitution: Most that a ball bounces off a foot: the speed at which it leaves the
        toe, as part of the speed at which the toe came near.
      give: How much nearer than its thickness a leg may come to the ball from two
        frames before a touch to two frames after it.
      reach: Largest distance of ball and root on the ground plane.
      wait: Longest time that a ball lies before its first touch.

    A value out of its range raises a `ValueError` that names it.
    """

    radius: float = 0.11
    deceleration: float = 0.8
    thickness: float = 0.03
    max_height: float = 0.2
    min_toe_speed: float = 0.5
    gap: tuple[float, float] = (0.3, 1.2)
    max_speed: float = 8.0
    min_push: float = 0.3
    cone: float = np.pi / 3
    restitution: float = 0.6
    give: float = 0.02
    reach: float = 2.0
    wait: float = 1.0
    min_frames: int = 60

    def __post_init__(self):
        for name in ("radius", "deceleration", "max_speed", "reach", "min_frames"):
            _require(getattr(self, name) > 0, self, name, "positive")
        for name in ("min_push", "restitution", "wait", "min_toe_speed"):
            _require(getattr(self, name) >= 0, self, name, "0 or more")
        # A foot farther away would not count as touching.
        allowed = 0 <= self.thickness <= TOUCH_MARGIN
        _require(allowed, self, "thickness", f"in 0..{TOUCH_MARGIN}")
        _require(0 <= self.give <= self.thickness, self, "give", "in 0..thickness")
        _require(0 < self.cone < np.pi / 2, self, "cone", "between 0 and pi / 2")
        _require(0 < self.gap[0] <= self.gap[1], self, "gap", "positive and in order")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Touches:
    """Possible touches of one clip, in the order of their frames.

    Attributes:
      foot: Which of the feet touches.
      place: Place of the ball's center on the ground plane, meters.
      direction: Direction of the toe's velocity on the ground plane.
      speed: Speed of the toe on the ground plane, meters per second.
    """

    frame: Int[np.ndarray, "touches"]
    foot: Int[np.ndarray, "touches"]
    place: Float[np.ndarray, "touches 2"]
    direction: Float[np.ndarray, "touches 2"]
    speed: Float[np.ndarray, "touches"]


def possible_touches(body: Body, settings: Dribble) -> Touches:
    """Frames in which a foot could touch a ball, and where that would be."""
    speed = np.linalg.norm(body.velocity, axis=-1)
    direction = body.velocity / np.maximum(speed, 1e-9)[..., None]
    ahead = np.sum((body.toes[..., ::2] - body.root[:, None]) * direction, axis=-1)
    height = body.toes[..., 1] - body.ground
    # As far from the toe as foot and ball are thick, but on the ground.
    square = (settings.radius + settings.thickness) ** 2
    square = square - (height - settings.radius) ** 2
    fits = ~body.standing & (speed >= settings.min_toe_speed) & (ahead > 0)
    fits &= (height <= settings.max_height) & (square > 0)
    away = np.sqrt(np.maximum(square, 0.0))[..., None] * direction
    place = body.toes[..., ::2] + away
    near = np.ones(fits.shape[0], bool)
    fits &= is_free(body, place.swapaxes(0, 1), slice(None), near, settings).T
    frame, foot = np.nonzero(fits)
    return Touches(
        frame=frame,
        foot=foot,
        place=place[fits],
        direction=direction[fits],
        speed=speed[fits],
    )


def is_free(
    body: Body,
    place: Float[np.ndarray, "*batch frames 2"],
    frames: slice,
    near: Bool[np.ndarray, "*other frames"],
    settings: Dribble,
) -> Bool[np.ndarray, "*batch frames"]:
    """Whether a ball on the ground is clear of the legs and within reach of the root.

    The place is its center's, meters. Where `near`, a touch is so close in time that a
    leg may come nearer.
    """
    height = np.full(place.shape[:-1], body.ground + settings.radius)
    ball = np.stack([place[..., 0], height, place[..., 1]], axis=-1)
    least = settings.radius + settings.thickness - np.where(near, settings.give, 0.0)
    away = np.linalg.norm(place - body.root[frames], axis=-1)
    free = leg_distances(ball, body.legs[frames]) >= least
    return free & (away <= settings.reach)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Segment:
    """A ball beside some frames of a clip, from its rest to its last touch.

    Attributes:
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
    """Touches to which the touch `now` can send the ball, and its velocity there.

    It came to this one with the velocity `arrive`, meters per second.
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
    found, way, seconds, comes = found[keep], way[keep], seconds[keep], comes[keep]
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
    """Touches one after the other, as many as chance finds, the first one at least.

    Those from which no way leads on are added to `tried`.
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
    """Stretches of a clip beside which a ball can be dribbled, in order, if any."""
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


def dribble_clips(
    clips: Clips, *, skill: str, settings: Dribble, seed: int
) -> BallClips:
    """Stretches of clips beside which a ball is dribbled, with the label "skill".

    Each is from the ball's rest (or its first touch) to its last touch and is named
    "<clip>@<first frame>+<frames>". Each clip has its own random numbers, so that
    further clips after it change nothing.

    `ValueError` if no clip has such a stretch, clips have a field "skill" or no speed.
    """
    people = bodies(clips, thickness=settings.thickness)
    found = [
        (number, segment)
        for number, body in enumerate(people)
        for segment in find_segments(
            body, settings, np.random.default_rng([seed, number])
        )
    ]
    if not found:
        raise ValueError(
            f"no stretch of {settings.min_frames} frames to dribble in "
            f"{clips.num_clips} clips"
        )
    position = [_on_ground(s.ball, people[n], settings.radius) for n, s in found]
    touch = [_touches(people[n], s, settings.radius) for n, s in found]
    spans = [(number, segment.start, len(segment.ball)) for number, segment in found]
    return ball_clips(
        _labeled(selection.cut(clips, spans), skill, seed),
        np.concatenate(position),
        np.concatenate(touch),
        joints=clips.skeleton.feet,
        radius=settings.radius,
    )


def _on_ground(
    place: Float[np.ndarray, "frames 2"], body: Body, radius: float
) -> Float[np.ndarray, "frames 3"]:
    return np.insert(place, 1, body.ground + radius, axis=-1)


def _touches(
    body: Body, segment: Segment, radius: float
) -> Bool[np.ndarray, "frames feet"]:
    """Which feet touch: near enough, and at most a frame away from a push."""
    frames = len(segment.ball)
    about = segment.touch_frames[:, None] + np.array([-1, 0, 1])
    feet = np.broadcast_to(segment.touch_feet[:, None], about.shape)
    inside = (about >= 0) & (about < frames)
    pushed = np.zeros((frames, body.toes.shape[1]), bool)
    pushed[about[inside], feet[inside]] = True
    toes = body.toes[segment.start : segment.start + frames]
    ball = _on_ground(segment.ball, body, radius)[:, None]
    return pushed & (np.linalg.norm(toes - ball, axis=-1) <= radius + TOUCH_MARGIN)


def _labeled(clips: Clips, skill: str, seed: int) -> Clips:
    """The same clips, all of one skill, with their ball among the sources."""
    if "skill" in clips.labels:
        raise ValueError("the clips have a label field 'skill' already")
    ball = f"synthetic ball (jaxmotion dribble synthesis, seed {seed})"
    return dataclasses.replace(
        clips,
        labels=clips.labels | {"skill": jnp.zeros(clips.num_clips, jnp.int32)},
        label_names=(*clips.label_names, ("skill", (skill,))),
        source="; ".join(filter(None, (clips.source, ball))),
    )


def resting_clips(
    clips: Clips,
    *,
    skill: str,
    distance: tuple[float, float],
    seed: int,
    angle: float = np.pi,
    travel: float = np.inf,
    radius: float = 0.11,
    thickness: float = 0.03,
) -> BallClips:
    """Whole clips beside which a ball lies that nobody touches, with the label "skill".

    From the root's farthest place in a random direction the ball lies that much
    farther, so that it is never nearer than that to the root. Clips whose legs go
    through wherever it might lie are left out.

    `distance` is the least and largest of the ball from where the root comes nearest to
    it on the ground, meters. (2.5, 5) is a ball off which the person is; (0.4, 0.8) one
    in front of the feet. At most `angle`, radians, lies between the clip's mean facing
    and the ball's direction; clips whose root goes farther than `travel`, meters, from
    its mean place are left out. Radius and thickness are as in `Dribble`; each clip has
    its own random numbers.

    `ValueError` if no clip is left, the clips have a field "skill", or the distances
    are not positive and in order.
    """
    if not 0 < distance[0] <= distance[1] < np.inf:
        raise ValueError(f"distance is {distance}, expected it positive and in order")
    people = bodies(clips, thickness=thickness)
    # Anywhere needs no facing, and so no hips.
    yaws = _mean_yaws(clips) if angle < np.pi else np.zeros(len(people))
    places = {}
    for number, body in enumerate(people):
        if np.linalg.norm(body.root - body.root.mean(axis=0), axis=-1).max() > travel:
            continue
        own = np.random.default_rng([seed, number])
        yaw = yaws[number] + own.uniform(-angle, angle, _TRIES)
        ball = _on_ground(
            _beyond(body, yaw, own.uniform(*distance, _TRIES)), body, radius
        )
        free = _room(body, ball) >= radius + thickness
        if free.any():
            places[number] = np.tile(ball[free.argmax()], (len(body.root), 1))
    if not places:
        raise ValueError(f"no place for a ball beside {clips.num_clips} clips")
    position = np.concatenate(list(places.values()))
    return ball_clips(
        _labeled(take_clips(clips, list(places)), skill, seed),
        position,
        np.zeros((len(position), len(clips.skeleton.feet)), bool),
        joints=clips.skeleton.feet,
        radius=radius,
    )


def _mean_yaws(clips: Clips) -> Float[np.ndarray, "clips"]:
    """Mean facing of each clip, radians from +z toward +x."""
    facing = np.asarray(hip_facing(clips.skeleton, clips.joint_rotation), np.float64)
    x, z = np.add.reduceat(facing, np.asarray(clips.offsets)[:-1], axis=0).T
    return np.arctan2(x, z)


def _beyond(
    body: Body, yaw: Float[np.ndarray, "tries"], distance: Float[np.ndarray, "tries"]
) -> Float[np.ndarray, "tries 2"]:
    """Places that far beyond the root's farthest place in each direction."""
    direction = np.stack([np.sin(yaw), np.cos(yaw)], axis=-1)
    farthest = body.root[np.argmax(body.root @ direction.T, axis=0)]
    return farthest + distance[:, None] * direction


def _room(body: Body, ball: Float[np.ndarray, "tries 3"]) -> Float[np.ndarray, "tries"]:
    """Least distance of the legs from each place in any frame."""
    every = np.broadcast_to(ball[:, None], (len(ball), len(body.root), 3))
    return leg_distances(every, body.legs).min(axis=-1)


def concatenate_ball_clips(parts: Sequence[BallClips]) -> BallClips:
    """Sets of clips with the same skeleton, label fields, rate, joints and ball as one.

    Label names, skills too, are merged. `ValueError` if sets differ, or for none.
    """
    clips = selection.concatenate([part.clips for part in parts])
    for field in ("joints", "radius"):
        values = {getattr(part, field) for part in parts}
        if len(values) > 1:
            raise ValueError(f"{field} of the parts differ: {sorted(values)}")
    return dataclasses.replace(
        parts[0],
        clips=clips,
        position=jnp.concatenate([part.position for part in parts]),
        touch=jnp.concatenate([part.touch for part in parts]),
    )
