"""What pictures, pages and files show: characters with bodies, their paths, a ball."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmotion.motion.anatomy import kinematics
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.viz import mannequin
from jaxmotion.viz.mannequin import Mannequin

# Characters that start nearer to each other than this are set apart, meters.
_OVERLAP, _APART = 0.4, 1.6
# So many characters are small in a picture: fewer vertices do.
_CROWD = 4


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ball:
    """A ball beside a motion, or one beside each of many.

    Attributes:
      position: World position of its center, meters.
      touch: Which of the joints touch it; None if that is not known, or for many.
      joints: Joints that may touch it.
      radius: Meters.
    """

    position: Float[np.ndarray, "*characters frames 3"]
    touch: Bool[np.ndarray, "frames touching"] | None = None
    joints: tuple[int, ...] = ()
    radius: float = 0.11

    def touching(self, frame: int) -> list[int]:
        """Joints that touch it."""
        if self.touch is None:
            return []
        return [self.joints[i] for i in np.flatnonzero(self.touch[frame])]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stage:
    """Characters of one skeleton over time.

    Attributes:
      motion: [characters, frames, ...].
      positions, rotations: Of the joints in the world.
      ghost: A pose per frame that is drawn pale, such as where a plan ends; None for
        none.
      wanted: Commanded ground paths (x, z), meters; None for none.
      ball: A ball of each character, or None.
    """

    skeleton: Skeleton
    body: Mannequin
    motion: Motion
    positions: Float[np.ndarray, "characters frames joints 3"]
    rotations: Float[np.ndarray, "characters frames joints 3 3"]
    ghost: Motion | None
    wanted: Float[np.ndarray, "characters frames 2"] | None
    ball: Ball | None

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.motion.fps

    @property
    def walked(self) -> Float[np.ndarray, "characters frames 2"]:
        """Ground paths of the roots, meters."""
        return self.positions[:, :, 0, ::2]

    @functools.cached_property
    def ghost_pose(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Positions and rotations of the ghosts' joints; None without."""
        return None if self.ghost is None else kinematics(self.skeleton, self.ghost)

    @functools.cached_property
    def outline(self) -> Float[np.ndarray, "characters frames points 3"]:
        """Points between which all bodies and ghosts are, world, meters."""
        poses = [(self.positions, self.rotations)]
        poses += [] if self.ghost_pose is None else [self.ghost_pose]
        some = self.body.outline
        return np.concatenate([self.body.skin(*pose, only=some)[0] for pose in poses])


def make_stage(
    skeleton: Skeleton,
    motion: Motion,
    *,
    wanted: Array | np.ndarray | None = None,
    ghost: Motion | None = None,
    ball: Ball | None = None,
    sides: tuple[str, ...] | None = None,
    apart: float | None = None,
    body: Mannequin | None = None,
) -> Stage:
    """A stage of one character or of many.

    Args:
      motion: [frames, ...] or [characters, frames, ...], world.
      wanted: [frames, 2] or [characters, frames, 2] commanded paths (x, z), meters.
      ghost: As many poses as the motion has, drawn pale.
      sides: Left and right; see `mannequin.describe`.
      apart: Many characters are set so far apart, in a square, meters. None: where
        they would start within each other; 0: never.

    Raises:
      ValueError: if an array has a wrong shape or is not finite; names it.
    """
    motion = _characters(skeleton, motion, "motion")
    count, frames = motion.root_position.shape[:2]
    if not (np.isfinite(motion.fps) and motion.fps > 0 and count and frames):
        raise ValueError(
            f"{count} characters of {frames} frames at {motion.fps} fps, expected at "
            "least one frame and a positive rate"
        )
    if wanted is not None:
        wanted = np.asarray(wanted, float)
        wanted = wanted[None] if wanted.ndim == 2 else wanted
        if wanted.shape != (count, frames, 2):
            raise ValueError(
                f"wanted path is {wanted.shape}, expected {(count, frames, 2)}"
            )
        _check_finite("wanted path", wanted)
    if ghost is not None:
        ghost = _characters(skeleton, ghost, "ghost")
        if ghost.root_position.shape != motion.root_position.shape:
            raise ValueError(
                f"ghost is {ghost.root_position.shape[:2]} characters and frames, "
                f"expected {(count, frames)}"
            )
    place = _places(motion, apart)
    if ball is not None:
        at = np.asarray(ball.position, float)
        at = at[None] if at.ndim == 2 else at
        if at.shape != (count, frames, 3):
            raise ValueError(
                f"ball is {np.shape(ball.position)} beside {count} characters, "
                f"expected {(count, frames, 3)}"
            )
        _check_finite("ball", at)
        touches = (frames, len(ball.joints))
        if ball.touch is not None and (count, np.shape(ball.touch)) != (1, touches):
            raise ValueError(
                f"ball's touch is {np.shape(ball.touch)} beside {count} characters, "
                f"expected {touches} beside one"
            )
        ball = dataclasses.replace(ball, position=at + place[:, None])
    motion = _moved(motion, place)
    positions, rotations = kinematics(skeleton, motion)
    if body is None:
        detail = "fine" if count < _CROWD else "crowd"
        body = mannequin.describe(
            skeleton, sides, rotations=rotations[0], detail=detail
        )
    return Stage(
        skeleton=skeleton,
        body=body,
        motion=motion,
        positions=positions,
        rotations=rotations,
        ghost=None if ghost is None else _moved(ghost, place),
        wanted=None if wanted is None else wanted + place[:, None, ::2],
        ball=ball,
    )


def _characters(skeleton: Skeleton, motion: Motion, what: str) -> Motion:
    """The motion of one or many characters with a leading axis of them."""
    root = np.asarray(motion.root_position, np.float32)
    turns = np.asarray(motion.joint_rotation, np.float32)
    expected = (*root.shape[:-1], skeleton.num_joints, 6)
    if root.ndim not in (2, 3) or root.shape[-1] != 3 or turns.shape != expected:
        raise ValueError(
            f"{what} is {root.shape} and {turns.shape}, expected [frames, 3] and "
            f"[frames, {skeleton.num_joints}, 6], for many characters with an axis "
            "before"
        )
    if root.ndim == 2:
        root, turns = root[None], turns[None]
    _check_finite(what, root)
    _check_finite(what, turns)
    return dataclasses.replace(
        motion, root_position=jnp.asarray(root), joint_rotation=jnp.asarray(turns)
    )


def _check_finite(what: str, values: np.ndarray) -> None:
    """Raises for the first frame [characters, frames, ...] that is not finite."""
    finite = np.isfinite(values).all(axis=tuple(range(2, values.ndim)))
    if not finite.all():
        character, frame = np.argwhere(~finite)[0].tolist()
        which = "" if len(values) == 1 else f" of character {character}"
        raise ValueError(f"{what}: frame {frame}{which} is not finite")


def _places(motion: Motion, apart: float | None) -> np.ndarray:
    """By how much each character is moved [characters, 3], meters."""
    root = np.asarray(motion.root_position)
    count = len(root)
    if apart is None:
        away = np.linalg.norm(root[:, None, 0, ::2] - root[None, :, 0, ::2], axis=-1)
        crowded = count > 1 and (away + np.eye(count) * 9).min() < _OVERLAP
        apart = _APART if crowded else 0.0
    side = int(np.ceil(np.sqrt(count)))
    row, column = np.divmod(np.arange(count), side)
    place = apart * np.stack([column, 0 * row, row], axis=-1).astype(float)
    return place - place.mean(axis=0)


def _moved(motion: Motion, place: np.ndarray) -> Motion:
    root = jnp.asarray(motion.root_position + place[:, None], jnp.float32)
    return dataclasses.replace(motion, root_position=root)
