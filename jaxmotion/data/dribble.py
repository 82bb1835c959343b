"""A synthetic ball beside recorded locomotion: dribbled, or lying.

No recordings of people with a ball are to be had freely, but those of people who walk
and run are. Where a foot swings low, there might have been a ball; between two such
places it rolls as a ball does (`rolling`), and a chain of them is a dribble
(`dribble_search`). The person is as recorded and knows nothing of the ball: what is
learned from this is how feet and ball go together in place and time, not how a person
runs after a ball. Beside other clips a ball lies, far away or in front of the feet.

Touches are labeled by a rule of distance as in SMGDiff, but only about the frame in
which the ball is pushed.
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxmotion.data import selection
from jaxmotion.data.ball_clips import BallClips, ball_clips
from jaxmotion.data.clips import Clips, take_clips
from jaxmotion.data.dribble_search import Segment, find_segments
from jaxmotion.data.dribble_touches import Dribble
from jaxmotion.data.rolling import TOUCH_MARGIN, Body, bodies, leg_distances
from jaxmotion.motion.facing import hip_facing

# Places that are tried for a ball that lies.
_TRIES = 32


def dribble_clips(
    clips: Clips, *, skill: str, settings: Dribble, seed: int
) -> BallClips:
    """Stretches of clips beside which a ball is dribbled.

    Each clip has its own random numbers, so that further clips behind it change
    nothing.

    Args:
      clips: Locomotion.
      skill: Label of all stretches in a new field "skill".
      settings: What a ball may do.
      seed: Of the choice among possible touches.

    Returns:
      The stretches, each from the ball's rest (or its first touch) to its last touch,
      named "<clip>@<first frame>+<frames>".

    Raises:
      ValueError: if no clip has such a stretch, the clips have a field "skill", or are
        too short to have a speed.
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
    return ball_clips(
        _labeled(_stretches(clips, found), skill, seed),
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


def _clip_name(clips: Clips, number: int) -> str:
    return clips.clip_names[number] if clips.clip_names else f"clip {number}"


def _stretches(clips: Clips, found: list[tuple[int, Segment]]) -> Clips:
    """The frames of the segments, each as one clip."""
    owner = np.array([number for number, _ in found])
    first = np.asarray(clips.offsets)[owner] + [s.start for _, s in found]
    lengths = np.array([len(s.ball) for _, s in found])
    frames = np.concatenate(
        [np.arange(a, a + n) for a, n in zip(first, lengths, strict=True)]
    )
    return dataclasses.replace(
        clips,
        root_position=jnp.asarray(np.asarray(clips.root_position)[frames]),
        joint_rotation=jnp.asarray(np.asarray(clips.joint_rotation)[frames]),
        offsets=jnp.asarray(np.cumsum([0, *lengths]), jnp.int32),
        labels={
            field: jnp.asarray(np.asarray(values)[owner])
            for field, values in clips.labels.items()
        },
        clip_names=tuple(
            f"{_clip_name(clips, n)}@{s.start}+{len(s.ball)}" for n, s in found
        ),
    )


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
    """Clips beside which a ball lies.

    From the root's farthest place in a random direction the ball lies that much
    farther, so that it is never nearer than that to the root. Clips whose legs go
    through wherever it might lie are left out.

    Args:
      clips: Any motion.
      skill: Label of all clips in a new field "skill".
      distance: Least and largest distance of the ball from where the root comes
        nearest to it on the ground plane, meters. (2.5, 5) is a ball off which the
        person is; (0.4, 0.8) one in front of the feet.
      seed: Of the places; each clip has its own random numbers.
      angle: Largest angle between the clip's mean facing and the ball's direction,
        radians; pi for anywhere.
      travel: Clips whose root goes farther from its mean place are left out, meters.
      radius: Of the ball, meters.
      thickness: Of foot and shank about their bones, meters.

    Returns:
      The clips, whole, without any touch.

    Raises:
      ValueError: if no clip is left, the clips have a field "skill", or the distances
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
    """Puts several sets of clips with a ball behind each other.

    Args:
      parts: Sets with the same skeleton, label fields and rate, joints and ball; the
        names of labels, skills among them, are merged.

    Returns:
      One set.

    Raises:
      ValueError: if there is no part, or they differ in any of that.
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
