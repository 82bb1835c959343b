"""Recorded turns and runs played faster, beside the recordings.

Who steers asks for more than a performer did: to turn around within a second, to sprint
on and on. Takes have few such frames, and a network that is trained longer on what they
have slides the more on what they lack. Played faster, a turn stays a turn: a foot that
stands stands at any pace, while speeds grow with the pace and accelerations with its
square. Walks are not hastened: whoever is told to go fast should run.
"""

import dataclasses

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxmotion.data import resample, selection
from jaxmotion.data.clips import Clips
from jaxmotion.motion import trajectory
from jaxmotion.motion.skeleton import Motion

# Factors, and what of a second around a frame makes it part of a turn (degrees, and m/s
# at most) or of a run (m/s at least).
TURNS, RUNS = (1.25, 1.5), (1.25,)
TURN, TURN_SPEED, RUN_SPEED = 60.0, 2.4, 2.3
# Seconds that are kept before and after, and those of the shortest stretch.
AROUND, SHORTEST = 1.0, 4.0


def _course(clips: Clips) -> tuple[Float[np.ndarray, "frames 2"], ...]:
    motion = Motion(
        root_position=clips.root_position,
        joint_rotation=clips.joint_rotation,
        fps=clips.fps,
    )
    found = jax.jit(trajectory.root_trajectory)(clips.skeleton, motion)
    return np.asarray(found.position), np.asarray(found.facing)


def _stretches(
    chosen: Bool[np.ndarray, " frames"], fps: float
) -> list[tuple[int, int]]:
    """First frame and length of stretches around the chosen frames of a clip."""
    reach = round(AROUND * fps)
    around = np.convolve(chosen, np.ones(2 * reach + 1), "same") > 0.5
    edges = np.flatnonzero(np.diff(np.concatenate([[0], around, [0]])))
    spans = [(int(a), int(b - a)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return [(start, n) for start, n in spans if n >= SHORTEST * fps]


def turns_and_runs(
    clips: Clips,
) -> tuple[list[tuple[int, int, int]], list[tuple[int, int, int]]]:
    """Stretches in which somebody turns, and in which somebody runs.

    Each is clip, first frame within it and number of frames. A stretch reaches a second
    beyond the frames that count: those within half a second of which the facing turns
    by 60 degrees, at less than 2.4 m/s, or which are faster than 2.3 m/s.
    """
    position, facing = _course(clips)
    offsets, half = np.asarray(clips.offsets), round(0.5 * clips.fps)
    turns, runs = [], []
    for clip, (begin, end) in enumerate(zip(offsets[:-1], offsets[1:], strict=True)):
        place, ahead = position[begin:end], facing[begin:end]
        frame = np.arange(end - begin)
        low, high = np.maximum(frame - half, 0), np.minimum(frame + half, frame[-1])
        heading = np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 1]))
        seconds = np.maximum(high - low, 1) / clips.fps
        turn = np.rad2deg(np.abs(heading[high] - heading[low])) / seconds
        speed = np.linalg.norm(place[high] - place[low], axis=-1) / seconds
        turning = (turn > TURN) & (speed < TURN_SPEED)
        for found, chosen in ((turns, turning), (runs, speed > RUN_SPEED)):
            found += [(clip, *span) for span in _stretches(chosen, clips.fps)]
    return turns, runs


def hastened(clips: Clips, fps: float) -> Clips | None:
    """Turns played 1.25 and 1.5 times as fast and runs 1.25 times; None without any.

    Clips are best as they were recorded, at a higher rate than `fps`, that of the
    result: frames between others are interpolated. Names are "<clip>@<first
    frame>+<frames>_x<factor>".
    """
    turns, runs = turns_and_runs(clips)
    parts = []
    for spans, factors in ((turns, TURNS), (runs, RUNS)):
        for factor in factors if spans else ():
            one = selection.cut(clips, spans)
            names = tuple(f"{name}_x{factor:g}" for name in one.clip_names)
            one = resample.resample_clips(one, fps / factor)
            parts.append(dataclasses.replace(one, fps=float(fps), clip_names=names))
    return selection.concatenate(parts) if parts else None
