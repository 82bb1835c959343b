"""Stretches of recorded takes labeled by what the person does in them, by rule.

Takes whose style says what happens in them are cut about the moments in which it does:
"jump" where the root rises or falls fast, "push" where a hand is raised before the
body; a take of style "crouch" is that throughout. In takes of style "neutral",
stretches are told apart by how fast the person goes, how far he turns and whether he
leaves the ground:

    stand  hardly moves, hardly turns
    turn   stays where he is, turns far, faces steadily before and after
    walk   goes on all the time, a foot always on the ground
    jog    goes on all the time, leaves the ground with every step
    run    the same, faster

What fits no rule, such as stopping, is left out.
"""

import dataclasses
from collections.abc import Callable, Iterator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxmotion.data import selection
from jaxmotion.data.clips import Clips, all_joints
from jaxmotion.motion.facing import hip_facing

FIELD = "action"
ACTIONS = ("walk", "jog", "run", "turn", "crouch", "jump", "push", "stand")

# Speeds are means over so long, seconds, which takes the steps out of them.
_SMOOTH = 0.5
# Starts that are tried lie so far apart, seconds.
_STRIDE = 0.1
# A joint on the ground is not higher above its lowest, meters.
_LOW = 0.03


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Take:
    """What is measured of a clip, frame by frame."""

    speed: Float[np.ndarray, "frames"]
    yaw: Float[np.ndarray, "frames"]
    turn_rate: Float[np.ndarray, "frames"]
    airborne: Bool[np.ndarray, "frames"]
    leaps: Bool[np.ndarray, "frames"]
    reaches: Bool[np.ndarray, "frames"]
    fps: float


def _smooth(x: np.ndarray, frames: int) -> np.ndarray:
    """Means over so many frames; ends count as if they went on."""
    padded = np.pad(x, (frames // 2, frames - 1 - frames // 2), mode="edge")
    return np.convolve(padded, np.ones(frames) / frames, mode="valid")


def _measure(clips: Clips) -> list[_Take]:
    joints, fps = all_joints(clips), clips.fps
    forward = np.asarray(hip_facing(clips.skeleton, clips.joint_rotation), np.float64)
    window = max(round(_SMOOTH * fps), 1)
    rate = lambda x: np.gradient(x, axis=0) * fps  # noqa: E731

    def take(joints: np.ndarray, forward: np.ndarray) -> _Take:
        root, lowest = joints[:, 0], joints[..., 1].min(axis=-1)
        yaw = np.unwrap(np.arctan2(forward[:, 0], forward[:, 1]))
        arm = joints - root[:, None]
        ahead = np.einsum("fjx,fx->fj", arm[..., ::2], forward)
        speed = _smooth(np.linalg.norm(rate(root[:, ::2]), axis=-1), window)
        # Above the root, so that no knee counts; arms that swing do not either.
        raised = ((ahead > 0.25) & (arm[..., 1] > 0.25)).any(axis=-1)
        return _Take(
            speed=speed,
            yaw=yaw,
            turn_rate=_smooth(rate(yaw), window),
            airborne=lowest > np.quantile(lowest, 0.2) + _LOW,
            leaps=np.abs(rate(root[:, 1])) > 1.2,
            reaches=raised & (speed < 1.0),
            fps=fps,
        )

    offsets = np.asarray(clips.offsets)
    pairs = zip(offsets[:-1], offsets[1:], strict=True)
    return [take(joints[a:b], forward[a:b]) for a, b in pairs]


def _gait(take: _Take, part: slice) -> str | None:
    """Label of a stretch of neutral locomotion; None if no rule holds."""
    speed, turned = take.speed[part], np.degrees(np.ptp(take.yaw[part]))
    mean, flight = speed.mean(), take.airborne[part].mean()
    if speed.max() < 0.3 and turned < 30:
        return "stand"
    if mean < 0.35:
        ends = np.degrees(np.abs(take.turn_rate[part][[0, -1]]))
        return "turn" if turned > 75 and ends.max() < 40 else None
    if mean < 1.8 and speed.min() > 0.5 and flight < 0.02:
        return "walk"
    if flight < 0.08:
        return None
    if mean > 2.1 and speed.min() > 1.3:
        return "run"
    return "jog" if mean < 2.1 and speed.min() > 1.0 else None


def _told_apart(
    take: _Take, lengths: list[int], label: Callable[[_Take, slice], str | None]
) -> Iterator[tuple[int, int, str]]:
    """Stretches one after the other, the longest that a rule holds for."""
    start, stride = 0, max(round(_STRIDE * take.fps), 1)
    while start + lengths[-1] <= len(take.speed):
        for length in lengths:
            part = slice(start, start + length)
            if part.stop <= len(take.speed) and (found := label(take, part)):
                yield start, length, found
                start = part.stop
                break
        else:
            start += stride


def _about(
    moments: Bool[np.ndarray, "frames"], longest: int, shortest: int
) -> Iterator[tuple[int, int]]:
    """Stretches about moments, which lie in their middle where there is room."""
    edges = np.flatnonzero(np.diff(np.r_[False, moments, False].astype(int)))
    end = 0
    for first, after in zip(edges[::2], edges[1::2], strict=True):
        middle = (first + after) // 2
        start = max(middle - longest // 2, end)
        stop = min(start + longest, len(moments))
        if first >= end and stop - start >= shortest and stop - after >= shortest // 3:
            yield int(start), int(stop - start)
            end = stop


def _even(frames: int, longest: int, shortest: int) -> Iterator[tuple[int, int]]:
    """As few stretches of about equal length as a clip falls into."""
    if frames >= shortest:
        edges = np.linspace(0, frames, -(-frames // longest) + 1).round().astype(int)
        yield from zip(edges[:-1].tolist(), np.diff(edges).tolist(), strict=True)


def _stretches(
    take: _Take, style: str, longest: int, shortest: int
) -> Iterator[tuple[int, int, str]]:
    if style == "neutral":
        lengths = sorted({longest, (longest + shortest) // 2, shortest}, reverse=True)
        yield from _told_apart(take, lengths, _gait)
    elif style in ("jump", "push"):
        moments = take.leaps if style == "jump" else take.reaches
        for start, length in _about(moments, longest, shortest):
            yield start, length, style
    elif style == "crouch":
        for start, length in _even(len(take.speed), longest, shortest):
            yield start, length, style


def cut_actions(clips: Clips, *, longest: float = 4.0, shortest: float = 3.0) -> Clips:
    """Stretches of takes with what is done in them in a new label field "action".

    They do not overlap, and are named "<clip>@<first frame>+<frames>".

    Takes of other styles than "neutral", "crouch", "jump" or "push" (field "style") are
    left out; lengths are in seconds. `ValueError` without that field, with one named
    "action", or if no stretch has an action.
    """
    if FIELD in clips.labels:
        raise ValueError(f"the clips have a label field {FIELD!r} already")
    styles = np.array(clips.names("style"))[np.asarray(clips.labels["style"])]
    frames = [max(round(seconds * clips.fps), 2) for seconds in (longest, shortest)]
    found, words = [], []
    for number, (take, style) in enumerate(zip(_measure(clips), styles, strict=True)):
        for start, length, word in _stretches(take, style, *frames):
            found.append((number, start, length))
            words.append(word)
    if not found:
        raise ValueError(
            f"no stretch of {shortest:g} s has an action in {clips.num_clips} clips of "
            f"styles {', '.join(sorted(set(styles.tolist())))}"
        )
    cut = selection.cut(clips, found)
    used = tuple(word for word in ACTIONS if word in words)
    numbers = jnp.asarray([used.index(word) for word in words], jnp.int32)
    return dataclasses.replace(
        cut,
        labels=cut.labels | {FIELD: numbers},
        label_names=(*cut.label_names, (FIELD, used)),
    )
