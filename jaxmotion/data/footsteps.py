"""Where the feet of a generated walker are: steps on a path, exact stances.

The path of the body is known in advance, so a step can be aimed at where the body will
be. Feet alternate. A foot stands with its toe joint at one point of the ground, exactly,
until it swings along a smooth curve to its next point. While the body stands still and
faces as its feet do, nobody steps.
"""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True, kw_only=True)
class Footsteps:
    """Feet over time; left foot first.

    Attributes:
      toe: [F, 2, 3] toe joints, metres.
      yaw: [F, 2] direction of each foot, radians from +z towards +x.
      contact: [F, 2] whether the foot stands.
      swing: [F, 2] progress of the swing in 0..1; 0 while standing.
      phase: [F] stride phase, radians; pi more with every step.
    """

    toe: np.ndarray
    yaw: np.ndarray
    contact: np.ndarray
    swing: np.ndarray
    phase: np.ndarray


def wrap(angle: np.ndarray) -> np.ndarray:
    """The same angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def smoothstep(s: np.ndarray) -> np.ndarray:
    """Rises from 0 to 1 with no velocity or acceleration at either end."""
    return s**3 * (10 - 15 * s + 6 * s**2)


def _turned(yaw: np.ndarray, x: float, z: float) -> np.ndarray:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * x + s * z, -s * x + c * z], axis=-1)


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
      path: [F, 2] ground position (x, z) of the body, metres.
      yaw: [F] its facing, radians.
      fps: Frames a second.
      cadence: Steps a second at no speed.
      cadence_slope: More steps a second for each metre a second.
      double_support: Part of a step in which both feet stand.
      width: Between the feet, metres.
      toe_ahead: Of the body when standing, metres.
      toe_height: Of a standing toe joint, metres.
      lift: Of a swinging toe, metres.
      toe_out: Of each foot, radians.
      generator: Of the small variations.
      jitter: Standard deviation of the landing points, metres.

    Returns:
      The feet in every frame.
    """
    frames = len(path)
    speed = np.linalg.norm(np.gradient(path, axis=0), axis=-1) * fps
    sides = np.array([1.0, -1.0])

    def home(frame: int, side: int) -> tuple[np.ndarray, float]:
        frame = min(max(frame, 0), frames - 1)
        offset = _turned(yaw[frame], sides[side] * width / 2, toe_ahead)
        return path[frame] + offset, yaw[frame] + sides[side] * toe_out

    toe = np.zeros((frames, 2, 3))
    foot_yaw, swing = np.zeros((frames, 2)), np.zeros((frames, 2))
    contact = np.ones((frames, 2), bool)
    phase = np.zeros(frames)
    at = [home(0, 0), home(0, 1)]
    now, side, steps = 0, int(generator.integers(2)), 0
    while now < frames:
        # Someone about to set off already takes the steps of the speed to come.
        soon = min(now + int(0.5 * fps), frames - 1)
        pace = cadence + cadence_slope * max(speed[now], speed[soon])
        length = max(int(round(fps / pace)), 6)
        target, heading = home(now + 1, side)
        away = np.linalg.norm(target - at[side][0])
        moving = speed[min(now + length, frames - 1)] > 0.12
        turned = abs(wrap(np.array(heading - at[side][1])))
        if not (moving or away > 0.06 or turned > 0.35):
            other, other_heading = home(now + 1, 1 - side)
            if (
                np.linalg.norm(other - at[1 - side][0]) > 0.06
                or abs(wrap(np.array(other_heading - at[1 - side][1]))) > 0.35
            ):
                side = 1 - side
                continue
            for foot in (0, 1):
                toe[now, foot] = [at[foot][0][0], toe_height, at[foot][0][1]]
                foot_yaw[now, foot] = at[foot][1]
            phase[now] = np.pi * steps
            now += 1
            continue
        air = max(int(round(length * (1.0 - double_support))), 4)
        # The foot will carry the body from landing to its next lift-off; its home at
        # the middle of that time is where it should land.
        goal, goal_yaw = home(now + air + length // 2, side)
        goal = goal + generator.normal(0.0, jitter, 2)
        height = lift * float(np.exp(generator.normal(0.0, 0.08)))
        start, start_yaw = at[side]
        turn = float(wrap(np.array(goal_yaw - start_yaw)))
        for i in range(length):
            frame = now + i
            if frame >= frames:
                break
            s = min((i + 1) / (air + 1), 1.0)
            done = i >= air
            e = smoothstep(np.array(s))
            place = goal if done else start + e * (goal - start)
            up = 0.0 if done else height * (np.sin(np.pi * s) ** 2)
            toe[frame, side] = [place[0], toe_height + up, place[1]]
            foot_yaw[frame, side] = start_yaw + turn * (1.0 if done else e)
            contact[frame, side] = done
            swing[frame, side] = 0.0 if done else s
            stood = at[1 - side]
            toe[frame, 1 - side] = [stood[0][0], toe_height, stood[0][1]]
            foot_yaw[frame, 1 - side] = stood[1]
            # Right swings first in even phases, so that arms know which leg leads.
            phase[frame] = np.pi * (steps + (i + 1) / length)
        at[side] = (goal, start_yaw + turn)
        now += length
        steps += 1
        side = 1 - side
    return Footsteps(toe=toe, yaw=foot_yaw, contact=contact, swing=swing, phase=phase)
