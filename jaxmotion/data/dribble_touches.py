"""Where a foot of a recorded person could touch a ball, and where a ball may be.

A touch is a frame in which a foot swings low, and the place of a ball on the ground in
front of its toe. Elsewhere a ball keeps clear of the legs and within reach.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxmotion.data.rolling import TOUCH_MARGIN, Body, leg_distances


def _require(holds: bool | np.bool_, settings: "Dribble", name: str, rule: str) -> None:
    if not holds:
        raise ValueError(f"{name} is {getattr(settings, name)}, expected it {rule}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Dribble:
    """How a ball is dribbled; meters, seconds.

    Attributes:
      radius: Of the ball.
      deceleration: Of the rolling ball, meters per second squared.
      thickness: Of foot and shank about their bones: how high a standing toe joint is
        above the ground, and how far from it the ball's surface is when they touch.
      max_height: Of a touching toe above the ground.
      min_toe_speed: Of a touching toe on the ground plane.
      gap: Shortest and longest time between touches.
      max_speed: Of the ball.
      min_push: Least change of the ball's velocity along that of the toe.
      cone: Largest angle between that change and the toe's velocity, radians.
      restitution: Most that a ball bounces off a foot: the speed at which it leaves the
        toe, as part of the speed at which the toe came near.
      give: How much nearer than its thickness a leg may come to the ball from two
        frames before a touch to two frames after it.
      reach: Largest distance of ball and root on the ground plane.
      wait: Longest time that a ball lies before its first touch.
      min_frames: Of a segment.

    Raises:
      ValueError: if a value is out of its range; names it.
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
      frame: Of each touch.
      foot: Which of the feet touches.
      place: Of the ball's center on the ground plane, meters.
      direction: Of the toe's velocity on the ground plane.
      speed: Of the toe on the ground plane, meters per second.
    """

    frame: Int[np.ndarray, "touches"]
    foot: Int[np.ndarray, "touches"]
    place: Float[np.ndarray, "touches 2"]
    direction: Float[np.ndarray, "touches 2"]
    speed: Float[np.ndarray, "touches"]


def possible_touches(body: Body, settings: Dribble) -> Touches:
    """Frames in which a foot could touch a ball, and where that would be.

    Args:
      body: The clip.
      settings: What counts as a touch.

    Returns:
      The touches.
    """
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

    Args:
      body: The clip.
      place: Of the ball's center on the ground plane, meters.
      frames: Of the clip.
      near: Whether a touch is so near in time that a leg may come nearer.
      settings: What is clear and what is near.

    Returns:
      Whether it is, frame by frame.
    """
    height = np.full(place.shape[:-1], body.ground + settings.radius)
    ball = np.stack([place[..., 0], height, place[..., 1]], axis=-1)
    least = settings.radius + settings.thickness - np.where(near, settings.give, 0.0)
    away = np.linalg.norm(place - body.root[frames], axis=-1)
    free = leg_distances(ball, body.legs[frames]) >= least
    return free & (away <= settings.reach)
