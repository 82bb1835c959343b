"""Fixed sequences of commands, so that rollouts of different models compare.

A preset is a cycle of segments: for some seconds, travel in one direction (and in some
presets look in another). Directions are turned in steps, never continuously: the lazy
trigger re-plans whenever the command changes.

* "forward": faces where it travels; straight stretches, turns by 45 and 90 degrees to
  both sides, and a full circle in twelve steps of half a second.
* "strafe": moves into the eight directions with a fixed facing, then turns slowly on
  the way, as the published preset of CAMDM does (55 s there).
* "stop_and_go": travels, stands, travels on.

Source: ours, after the preset of CAMDM's release (Chen et al. 2024).
"""

from collections.abc import Sequence

import jax.numpy as jnp
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


PRESETS = {"forward": _forward, "strafe": _strafe, "stop_and_go": _stop_and_go}


def _unit(degrees: np.ndarray) -> np.ndarray:
    angle = np.deg2rad(degrees)
    return np.stack([np.sin(angle), np.cos(angle)], axis=-1)


def preset_commands(
    name: str, *, seconds: float, fps: float, speed: float, label: int
) -> Command:
    """Commands of a preset, one a tick; a preset that ends begins again.

    Args:
      name: One of `PRESETS`.
      seconds: Length.
      fps: Ticks per second.
      speed: Meters per second.
      label: Style.

    Returns:
      Commands [ticks, ...], for a character that starts facing +z.

    Raises:
      ValueError: if there is no such preset (names those there are), the length is not
        that of a tick at least, or the speed or the label is negative.
    """
    if name not in PRESETS:
        raise ValueError(f"unknown preset {name!r}: there are {', '.join(PRESETS)}")
    if not (np.isfinite(seconds * fps) and seconds * fps >= 1 and speed >= 0):
        raise ValueError(
            f"{seconds} s at {fps} ticks per second and {speed} m/s: expected a tick "
            "or more, and a speed that is not negative"
        )
    if label < 0:
        raise ValueError(f"label is {label}, expected 0 or more")
    cycle = [(*segment[:3], segment[3] * speed, label) for segment in PRESETS[name]()]
    return segment_commands(cycle, seconds=seconds, fps=fps)


def segment_commands(
    segments: Sequence[tuple[float, float, float, float, int]],
    *,
    seconds: float,
    fps: float,
) -> Command:
    """Commands of segments, one per tick; they begin again at their end.

    Args:
      segments: Seconds, direction of travel and facing in degrees from +z toward +x,
        speed in m/s, label.
      seconds: Length of the result.
      fps: Ticks per second.

    Returns:
      Commands [ticks, ...].
    """
    table = np.array(segments)
    ticks = round(seconds * fps)
    ends = np.cumsum(table[:, 0])
    time = np.arange(ticks) / fps % ends[-1]
    row = table[np.searchsorted(ends, time, side="right")]
    return Command(
        velocity=jnp.asarray(_unit(row[:, 1]) * row[:, 3:4], dtype=jnp.float32),
        facing=jnp.asarray(_unit(row[:, 2]), dtype=jnp.float32),
        label=jnp.asarray(row[:, 4], jnp.int32),
    )
