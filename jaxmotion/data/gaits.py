"""Manners of walking of the generated walker: numbers, by name."""

import dataclasses


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gait:
    """A manner of walking; angles in radians, lengths in meters.

    Attributes:
      max_speed: Meters per second.
      cadence: Steps per second at no speed.
      cadence_slope: More steps per second for each meter per second.
      double_support: Part of a step with both feet down.
      width: Between the feet.
      lift: Height of a swinging toe.
      toe_out: Outward turn of each foot.
      crouch: How much lower than upright the pelvis is.
      lean: Lean of the trunk, forward.
      head: Tilt of the head, forward.
      sway: Sway of the pelvis to the standing side.
      bounce: Up and down, twice a stride.
      twist: Twist of the pelvis with the leading leg; the chest goes against it.
      arm_swing: Forward and back.
      arm_forward: Forward turn of both upper arms.
      arm_out: Outward turn of both upper arms from hanging.
      elbow: Flexion.
    """

    max_speed: float = 1.6
    cadence: float = 1.2
    cadence_slope: float = 0.6
    double_support: float = 0.2
    width: float = 0.17
    lift: float = 0.07
    toe_out: float = 0.12
    crouch: float = 0.0
    lean: float = 0.04
    head: float = 0.0
    sway: float = 0.02
    bounce: float = 0.0
    twist: float = 0.1
    arm_swing: float = 0.4
    arm_forward: float = 0.0
    arm_out: float = 0.12
    elbow: float = 0.3


GAITS = {
    "neutral": Gait(),
    "elderly": Gait(
        max_speed=0.8,
        cadence=1.5,
        cadence_slope=0.5,
        double_support=0.35,
        lift=0.03,
        crouch=0.06,
        lean=0.5,
        head=-0.2,
        arm_swing=0.12,
        arm_forward=0.35,
        elbow=0.9,
        twist=0.04,
    ),
    "proud": Gait(
        lean=-0.12,
        head=-0.08,
        arm_swing=0.65,
        arm_out=0.3,
        elbow=0.15,
        lift=0.09,
        cadence=1.15,
        twist=0.18,
    ),
    "sneaky": Gait(
        max_speed=1.0,
        cadence=0.9,
        cadence_slope=0.5,
        crouch=0.2,
        lean=0.55,
        head=-0.4,
        lift=0.12,
        arm_swing=0.15,
        arm_forward=0.7,
        elbow=1.5,
        width=0.22,
    ),
    "march": Gait(
        cadence=1.5,
        cadence_slope=0.35,
        lift=0.3,
        arm_swing=0.9,
        elbow=0.1,
        lean=-0.02,
        arm_out=0.06,
        sway=0.01,
    ),
    "tired": Gait(
        max_speed=1.0,
        cadence=0.95,
        cadence_slope=0.5,
        double_support=0.3,
        lift=0.025,
        crouch=0.04,
        lean=0.28,
        head=0.5,
        arm_swing=0.2,
        arm_out=0.05,
        elbow=0.1,
        sway=0.05,
    ),
    "zombie": Gait(
        max_speed=1.0,
        cadence=0.9,
        cadence_slope=0.6,
        lift=0.04,
        lean=0.1,
        head=0.25,
        sway=0.08,
        arm_swing=0.05,
        arm_forward=1.45,
        arm_out=0.05,
        elbow=0.1,
        width=0.26,
    ),
    "bouncy": Gait(
        cadence=1.4,
        bounce=0.035,
        lift=0.12,
        arm_swing=0.55,
        elbow=1.2,
        arm_out=0.25,
        twist=0.2,
        lean=0.0,
        crouch=0.05,
    ),
}
