"""A ball that rolls on flat ground beside recorded legs.

Between two touches the ball rolls straight on and slows down evenly, as rolling
friction does:

    x(t) = v t - a t^2 / 2    until it stops at t = v / a                         (1)

It has to be `d` meters away after `t` seconds. It arrives rolling, with v = d / t +
a t / 2 at the start and v - a t >= 0 at the end, if d >= a t^2 / 2. Otherwise it stops
there early, with v = sqrt(2 a d), and lies.

All of this is host code in float64.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxmotion.data.clips import Clips, all_joints
from jaxmotion.motion.contact import foot_contacts
from jaxmotion.motion.skeleton import Skeleton

# Ball and legs that touch are this far apart at most, bone to ball: SMGDiff's rule is a
# ball's radius and 5 cm.
TOUCH_MARGIN = 0.05


def start_speed(
    distance: Float[np.ndarray, "*batch"],
    seconds: Float[np.ndarray, "*batch"],
    deceleration: float,
) -> Float[np.ndarray, "*batch"]:
    """Speed, meters per second, with which a ball has to leave to be somewhere in time.

    It rolls the distance (meters) in at most the (positive) seconds; the deceleration
    is positive, meters per second squared.
    """
    rolls = distance / seconds + deceleration * seconds / 2
    stops = np.sqrt(2 * deceleration * distance)
    return np.where(distance >= deceleration * seconds**2 / 2, rolls, stops)


def roll(
    displacement: Float[np.ndarray, "*batch 2"],
    seconds: Float[np.ndarray, "*batch"],
    deceleration: float,
    times: Float[np.ndarray, "*batch times"],
) -> Float[np.ndarray, "*batch times 2"]:
    """Where a ball is, meters on the ground, on its way to a place: (1).

    The displacement is from its start to that place; it arrives after `seconds`,
    positive, or stops there before. The deceleration is positive, m/s^2; times are in
    0..seconds.
    """
    distance = np.linalg.norm(displacement, axis=-1)
    speed = start_speed(distance, seconds, deceleration)[..., None]
    moving = np.minimum(times, speed / deceleration)
    way = speed * moving - deceleration * moving**2 / 2
    part = way / np.where(distance > 0, distance, 1.0)[..., None]
    return displacement[..., None, :] * part[..., None]


def end_velocities(
    displacement: Float[np.ndarray, "*batch 2"],
    seconds: Float[np.ndarray, "*batch"],
    deceleration: float,
) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch 2"]]:
    """Velocities, m/s, of a ball that leaves, and of one that has arrived.

    The second is zero where the ball stopped on the way. Arguments as of `roll`.
    """
    distance = np.linalg.norm(displacement, axis=-1)
    speed = start_speed(distance, seconds, deceleration)
    direction = displacement / np.where(distance > 0, distance, 1.0)[..., None]
    arrives = np.maximum(speed - deceleration * seconds, 0.0)
    return speed[..., None] * direction, arrives[..., None] * direction


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """What a ball meets of one clip; meters, meters per second.

    Attributes:
      ground: Height of the ground.
      root: On the ground plane (x, z).
      toes: The skeleton's feet.
      velocity: Velocity of the toes, on the ground plane.
      standing: Which of them stand.
      legs: Both ends of the bones from toe to ankle and from ankle to knee.
    """

    ground: float
    root: Float[np.ndarray, "frames 2"]
    toes: Float[np.ndarray, "frames feet 3"]
    velocity: Float[np.ndarray, "frames feet 2"]
    standing: Bool[np.ndarray, "frames feet"]
    legs: Float[np.ndarray, "frames bones 2 3"]
    fps: float


def bodies(clips: Clips, *, thickness: float) -> list[Body]:
    """What a ball meets of each clip.

    A standing toe is the thickness, meters, above the ground. `ValueError` if a clip
    has one frame, or the skeleton no feet.
    """
    skeleton, offsets = clips.skeleton, np.asarray(clips.offsets)
    if not skeleton.feet:
        raise ValueError("field 'feet' of the skeleton is empty, expected the toes")
    if np.diff(offsets).min() < 2:
        short = int(np.diff(offsets).argmin())
        name = clips.clip_names[short] if clips.clip_names else f"clip {short}"
        raise ValueError(f"{name} has one frame, expected at least 2")
    joints = all_joints(clips)
    # All clips at once: one at a time would compile for every length.
    toes = jnp.asarray(joints[:, list(skeleton.feet)], jnp.float32)
    standing = np.array(foot_contacts(toes, clips.fps))
    # The last frame of a clip has no next one.
    standing[offsets[1:] - 1] = standing[offsets[1:] - 2]
    return [
        _body(skeleton, joints[a:b], standing[a:b], clips.fps, thickness)
        for a, b in zip(offsets[:-1], offsets[1:], strict=True)
    ]


def _body(
    skeleton: Skeleton,
    joints: np.ndarray,
    standing: np.ndarray,
    fps: float,
    thickness: float,
) -> Body:
    feet, parents = np.array(skeleton.feet), np.maximum(skeleton.parents, 0)
    ankles = parents[feet]
    ends = [(feet, ankles), (ankles, parents[ankles])]
    toes = joints[:, feet]
    return Body(
        ground=ground_height(toes[..., 1], standing) - thickness,
        root=joints[:, 0, ::2],
        toes=toes,
        velocity=np.gradient(toes[..., ::2], axis=0) * fps,
        standing=standing,
        legs=np.concatenate(
            [np.stack([joints[:, a], joints[:, b]], axis=2) for a, b in ends], axis=1
        ),
        fps=fps,
    )


def ground_height(
    heights: Float[np.ndarray, "frames feet"], standing: Bool[np.ndarray, "frames feet"]
) -> float:
    """Height at which toes stand, meters: few of those that stand are lower.

    The fifth percentile: a lowest foot that no outlier pulls down. Where none stands,
    all count.
    """
    return float(np.percentile(heights[standing] if standing.any() else heights, 5))


def leg_distances(
    ball: Float[np.ndarray, "*batch frames 3"],
    legs: Float[np.ndarray, "frames bones 2 3"],
) -> Float[np.ndarray, "*batch frames"]:
    """Distance, meters, from the ball's center to the legs' nearest bone."""
    start, along = legs[:, :, 0], legs[:, :, 1] - legs[:, :, 0]
    square = np.maximum(np.sum(along**2, axis=-1), 1e-12)
    away = ball[..., None, :] - start
    part = np.clip(np.einsum("...i,...i", away, along) / square, 0.0, 1.0)
    away -= part[..., None] * along
    return np.sqrt(np.einsum("...i,...i", away, away).min(axis=-1))
