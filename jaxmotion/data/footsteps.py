"""Where the feet of a generated walker are: steps on a path, exact stances.

The path of the body is known in advance, so a step can be aimed at where the body will
be. Feet alternate. A foot stands with its toe joint at one point of the ground,
exactly, until it swings along a smooth curve to its next point. While the body stands
still and faces as its feet do, nobody steps.
"""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np


@dataclasses.dataclass(frozen=True, kw_only=True)
class Footsteps:
    """Feet over time; left foot first.

    Attributes:
      toe: [F, 2, 3] toe joints, meters.
      yaw: [F, 2] direction of each foot, radians from +z toward +x.
      contact: [F, 2] whether the foot stands.
      swing: [F, 2] progress of the swing in 0..1; 0 while standing.
      phase: [F] stride phase, radians; pi more with every step.
    """

    toe: np.ndarray
    yaw: np.ndarray
    contact: np.ndarray
    swing: np.ndarray
    phase: np.ndarray


def wrap(angle: np.ndarray | float) -> np.ndarray | float:
    """The same angle in [-pi, pi), radians."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def smoothstep(s: np.ndarray | float) -> np.ndarray | float:
    """Rises over [0, 1] from 0 to 1 with no velocity or acceleration at either end."""
    return s**3 * (10 - 15 * s + 6 * s**2)


def _turned(yaw: float, x: float, z: float) -> np.ndarray:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * x + s * z, -s * x + c * z], axis=-1)


# More steps per second for each m/s sideways, and each rad/s.
_ASIDE_PACE, _TURN_PACE = 1.0, 0.3

# A foot on the ground: its toe (x, z), meters, and its direction, radians.
_Placed = tuple[np.ndarray, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Step:
    """One step of one foot; it stands at first, and again after `air` frames."""

    side: int
    start: _Placed
    goal: _Placed
    turn: float
    lift: float
    air: int
    length: int


def _home(
    path: np.ndarray,
    yaw: np.ndarray,
    pose: tuple[np.ndarray, float, float],
    frame: int,
    side: int,
) -> _Placed:
    """Where a foot stands beside the body; pose is widths, toe ahead and toe out."""
    width, toe_ahead, toe_out = pose
    frame = min(max(frame, 0), len(path) - 1)
    sign = 1.0 - 2.0 * side
    offset = _turned(yaw[frame], sign * width[frame] / 2, toe_ahead)
    return path[frame] + offset, yaw[frame] + sign * toe_out


def _is_off(foot: _Placed, home: _Placed) -> bool:
    """Whether a foot stands too far or too twisted from where it should."""
    away = np.linalg.norm(home[0] - foot[0])
    turned = abs(wrap(np.array(home[1] - foot[1])))
    return bool(away > 0.06 or turned > 0.35)


def _stand(
    feet: Footsteps, frame: int, at: list[_Placed], side: int, toe_height: float
) -> None:
    place, direction = at[side]
    feet.toe[frame, side] = [place[0], toe_height, place[1]]
    feet.yaw[frame, side] = direction


def _take(
    feet: Footsteps, now: int, step: _Step, at: list[_Placed], toe_height: float
) -> None:
    """Writes the frames of a step: one foot swings and lands, the other stands."""
    side, (start, start_yaw) = step.side, step.start
    landed = list(at)
    landed[side] = step.goal
    for i in range(min(step.length, len(feet.phase) - now)):
        frame = now + i
        _stand(feet, frame, at, 1 - side, toe_height)
        if i >= step.air:
            _stand(feet, frame, landed, side, toe_height)
            continue
        s = (i + 1) / (step.air + 1)
        e = smoothstep(np.array(s))
        place = start + e * (step.goal[0] - start)
        up = step.lift * (np.sin(np.pi * s) ** 2)
        feet.toe[frame, side] = [place[0], toe_height + up, place[1]]
        feet.yaw[frame, side] = start_yaw + step.turn * e
        feet.contact[frame, side] = False
        feet.swing[frame, side] = s


def _empty(frames: int) -> Footsteps:
    return Footsteps(
        toe=np.zeros((frames, 2, 3)),
        yaw=np.zeros((frames, 2)),
        contact=np.ones((frames, 2), bool),
        swing=np.zeros((frames, 2)),
        phase=np.zeros(frames),
    )


def _aim(
    home: Callable[[int, int], _Placed],
    now: int,
    side: int,
    start: _Placed,
    length: int,
    *,
    double_support: float,
    lift: float,
    jitter: float,
    generator: np.random.Generator,
) -> _Step:
    """The step that a foot takes now."""
    air = max(int(round(length * (1.0 - double_support))), 4)
    # The foot will carry the body from landing to its next lift-off; its home at the
    # middle of that time is where it should land.
    goal, goal_yaw = home(now + air + length // 2, side)
    goal = goal + generator.normal(0.0, jitter, 2)
    # Not wrapped: a foot turns the way that the body does, even if that is longer.
    return _Step(
        side=side,
        start=start,
        goal=(goal, goal_yaw),
        turn=goal_yaw - start[1],
        lift=lift * float(np.exp(generator.normal(0.0, 0.08))),
        air=air,
        length=length,
    )


def _walk(
    home: Callable[[int, int], _Placed],
    length_at: Callable[[int], int],
    aim: Callable[[int, int, _Placed, int], _Step],
    moving: np.ndarray,
    side: int,
    toe_height: float,
) -> Footsteps:
    """Steps on, or stands where neither the body moves nor a foot is off its home."""
    frames = len(moving)
    feet = _empty(frames)
    at = [home(0, 0), home(0, 1)]
    now, steps = 0, 0
    while now < frames:
        length = length_at(now)
        off = [_is_off(at[foot], home(now + 1, foot)) for foot in (0, 1)]
        if not (moving[min(now + length, frames - 1)] or off[side]):
            if off[1 - side]:
                side = 1 - side
                continue
            for foot in (0, 1):
                _stand(feet, now, at, foot, toe_height)
            feet.phase[now] = np.pi * steps
            now += 1
            continue
        step = aim(now, side, at[side], length)
        _take(feet, now, step, at, toe_height)
        # Right swings first in even phases, so that arms know which leg leads.
        part = np.arange(1, length + 1)[: frames - now] / length
        feet.phase[now : now + length] = np.pi * (steps + part)
        at[side], now, steps, side = step.goal, now + length, steps + 1, 1 - side
    return feet


def plan_footsteps(
    path: np.ndarray,
    yaw: np.ndarray,
    *,
    fps: float,
    cadence: float,
    cadence_slope: float,
    double_support: float,
    width: float,
    toe_ahead: float,
    toe_height: float,
    lift: float,
    toe_out: float,
    generator: np.random.Generator,
    jitter: float = 0.012,
) -> Footsteps:
    """Plans the steps of one walk.

    Args:
      path: [F, 2] ground position (x, z) of the body, meters.
      yaw: [F] its facing, radians.
      cadence: Steps per second at no speed.
      cadence_slope: More steps per second for each meter per second.
      double_support: Part of a step in which both feet stand.
      width: Between the feet, meters.
      toe_ahead: Distance of the toe ahead of the body when standing, meters.
      toe_height: Height of a standing toe joint, meters.
      lift: Height of a swinging toe, meters.
      toe_out: Outward turn of each foot, radians.
      jitter: Standard deviation of the landing points, meters.
    """
    velocity = np.gradient(path, axis=0) * fps
    speed = np.linalg.norm(velocity, axis=-1)
    aside = np.abs(velocity[:, 0] * np.cos(yaw) - velocity[:, 1] * np.sin(yaw))
    turning = np.abs(np.gradient(yaw)) * fps
    # Steps per second: quicker sideways and in turns, where a step reaches less far.
    pace = cadence + cadence_slope * speed + _ASIDE_PACE * aside + _TURN_PACE * turning
    # Sideways the feet are set so far apart that the one behind does not overtake.
    widths = np.maximum(width, aside / pace + 0.7 * width)
    home = functools.partial(_home, path, yaw, (widths, toe_ahead, toe_out))

    def length_at(now: int) -> int:
        # Someone about to set off already takes the steps of the speed to come.
        soon = now + int(0.5 * fps) + 1
        return max(int(round(fps / pace[now:soon].max())), 6)

    aim = functools.partial(
        _aim,
        home,
        double_support=double_support,
        lift=lift,
        jitter=jitter,
        generator=generator,
    )
    side = int(generator.integers(2))
    return _walk(home, length_at, aim, speed > 0.12, side, toe_height)
