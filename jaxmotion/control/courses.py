"""Fixed sequences of commands, so that rollouts of different models compare.

A course is a cycle of segments: for some seconds, travel in one direction (and in some
courses look in another). Directions are turned in steps, never continuously: the lazy
trigger re-plans whenever the command changes.

* "straight": along +z, and nothing else.
* "stand": at rest, facing +z, whatever the speed.
* "forward": faces where it travels; straight stretches, turns by 45 and 90 degrees to
  both sides, and a full circle in twelve steps of half a second.
* "strafe": moves into the eight directions with a fixed facing, then turns slowly on
  the way, as the published commands of CAMDM do (55 s there).
* "stop_and_go": travels, stands, travels on.
* "figure_eight": one circle to either side, in steps of half a second.
* "turn_around": travels, turns by 180 degrees at once, travels back.
* "reversals": the same every one and a half seconds, hardly turned.
* "turn_on_the_spot": stands and turns by 90 degrees every two seconds, first to one
  side, then to the other.

Source: ours, "forward" and "strafe" after the commands of CAMDM's release (Chen et al.
2024).
"""

from collections.abc import Callable, Sequence
from typing import Literal

import jax
import numpy as np

from jaxmotion.motion.trajectory import Command

# Seconds, direction of travel and facing in degrees from +z toward +x, part of speed.
_Segment = tuple[float, float, float, float]


def _forward() -> list[_Segment]:
    segments: list[_Segment] = []
    heading = 0.0
    for turn in (0.0, 45.0, 45.0, -90.0, -45.0, 90.0):
        heading += turn
        segments.append((3.0, heading, heading, 1.0))
    for _ in range(12):
        heading += 30.0
        segments.append((0.5, heading, heading, 1.0))
    for turn in (-90.0, -45.0, 90.0):
        heading += turn
        segments.append((3.0, heading, heading, 1.0))
    return segments


def _strafe() -> list[_Segment]:
    eight = [(2.0, 45.0 * i, 0.0, 1.0) for i in (0, 1, 7, 2, 6, 4, 3, 5, 0)]
    turning = [(0.5, 15.0 * i, 15.0 * i, 1.0) for i in range(1, 25)]
    return eight + turning


def _stop_and_go() -> list[_Segment]:
    segments: list[_Segment] = []
    for heading in (0.0, 60.0, 0.0, -60.0):
        segments += [(3.0, heading, heading, 1.0), (2.0, heading, heading, 0.0)]
    return segments


def _straight() -> list[_Segment]:
    return [(1.0, 0.0, 0.0, 1.0)]


def _stand() -> list[_Segment]:
    return [(1.0, 0.0, 0.0, 0.0)]


def _figure_eight() -> list[_Segment]:
    turns = [24.0] * 15 + [-24.0] * 15
    headings = np.cumsum([0.0, *turns[:-1]]).tolist()
    return [(0.5, heading, heading, 1.0) for heading in headings]


def _turn_around() -> list[_Segment]:
    return [(4.0, 0.0, 0.0, 1.0), (4.0, 180.0, 180.0, 1.0)]


def _reversals() -> list[_Segment]:
    return [(1.5, 0.0, 0.0, 1.0), (1.5, 180.0, 180.0, 1.0)]


def _turn_on_the_spot() -> list[_Segment]:
    facings = (0.0, 90.0, 180.0, 270.0, 360.0, 270.0, 180.0, 90.0)
    return [(2.0, facing, facing, 0.0) for facing in facings]


Course = Literal[
    "straight",
    "stand",
    "forward",
    "strafe",
    "stop_and_go",
    "figure_eight",
    "turn_around",
    "reversals",
    "turn_on_the_spot",
]
COURSES: dict[Course, Callable[[], list[_Segment]]] = {
    "straight": _straight,
    "stand": _stand,
    "forward": _forward,
    "strafe": _strafe,
    "stop_and_go": _stop_and_go,
    "figure_eight": _figure_eight,
    "turn_around": _turn_around,
    "reversals": _reversals,
    "turn_on_the_spot": _turn_on_the_spot,
}


def _unit(degrees: np.ndarray) -> np.ndarray:
    angle = np.deg2rad(degrees)
    return np.stack([np.sin(angle), np.cos(angle)], axis=-1)


def course_commands(
    name: str, *, seconds: float, fps: float, speed: float, label: int
) -> Command:
    """Commands of a course, one per tick [ticks, ...]; a course that ends begins again.

    The character starts facing +z; the speed is in meters per second.

    Raises:
      ValueError: if there is no such course (names those there are), the length is
        less than a tick, or the speed or the label is negative.
    """
    if name not in COURSES:
        raise ValueError(f"unknown course {name!r}: there are {', '.join(COURSES)}")
    if not (np.isfinite(seconds * fps) and seconds * fps >= 1 and 0 <= speed < np.inf):
        raise ValueError(
            f"{seconds} s at {fps} ticks per second and {speed} m/s: expected a tick "
            "or more, and a speed that is not negative"
        )
    if label < 0:
        raise ValueError(f"label is {label}, expected 0 or more")
    cycle = [(*segment[:3], segment[3] * speed, label) for segment in COURSES[name]()]
    return segment_commands(cycle, seconds=seconds, fps=fps)


def course_batch(
    name: str,
    labels: Sequence[int] | np.ndarray,
    speeds: Sequence[float] | np.ndarray,
    *,
    seconds: float,
    fps: float,
) -> Command:
    """One course for each character, with its own label and at its own speed.

    Speeds are in meters per second, commands [characters, ticks, ...]. Raises what
    `course_commands` does.
    """
    told = [*zip(map(int, labels), map(float, speeds), strict=True)]
    each = {
        (label, speed): course_commands(
            name, seconds=seconds, fps=fps, speed=speed, label=label
        )
        for label, speed in dict.fromkeys(told)
    }
    # On the host: a program with an operand for each character compiles for minutes.
    rows = [each[pair] for pair in told]
    return jax.tree.map(lambda *x: jax.device_put(np.stack(x)), *rows)


def segment_commands(
    segments: Sequence[tuple[float, float, float, float, int]],
    *,
    seconds: float,
    fps: float,
) -> Command:
    """Commands of segments, one per tick [ticks, ...]; they begin again at their end.

    A segment is seconds, direction of travel and facing in degrees from +z toward +x,
    speed in m/s, and label. `ValueError` if the length is less than a tick.
    """
    if not (np.isfinite(seconds * fps) and seconds * fps >= 1):
        raise ValueError(
            f"{seconds} s at {fps} ticks per second: expected a tick or more"
        )
    table = np.array(segments)
    ticks = round(seconds * fps)
    ends = np.cumsum(table[:, 0])
    # Sums of seconds are a little off: a thousandth of a tick does not matter.
    time = (np.arange(ticks) + 1e-3) / fps % ends[-1]
    row = table[np.searchsorted(ends, time, side="right")]
    return Command(
        velocity=jax.device_put(np.float32(_unit(row[:, 1]) * row[:, 3:4])),
        facing=jax.device_put(np.float32(_unit(row[:, 2]))),
        label=jax.device_put(np.int32(row[:, 4])),
    )
