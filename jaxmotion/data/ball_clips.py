"""Clips of a person with a ball: where the ball is, and which joints touch it.

The ball's arrays lie beside those of `Clips`, frame by frame. On disk they are further
fields of the same npz file, so that whatever reads clips reads the person as well.
"""

import dataclasses
import os
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmotion import files
from jaxmotion.data import clips_io
from jaxmotion.data.clips import Clips, take_clips
from jaxmotion.motion.ball import Scene
from jaxmotion.motion.skeleton import MAX_METERS, Motion

_FIELDS = {
    "ball_position": ("f", 2),
    "ball_touch": ("b", 2),
    "ball_joints": ("i", 1),
    "ball_radius": ("f", 0),
}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class BallClips:
    """Clips with a ball.

    Attributes:
      clips: The person.
      position: World position of the ball's center in every frame, meters, y up.
      touch: Which of `joints` touch the ball in every frame.
      joints: Joints that may touch the ball (feet, or hands).
      radius: Radius of the ball, meters.
    """

    clips: Clips
    position: Float[Array, "frames 3"]
    touch: Bool[Array, "frames touching"]
    joints: tuple[int, ...] = jax.tree.static()
    radius: float = jax.tree.static(default=0.11)


def ball_clips(
    clips: Clips,
    position: Float[np.ndarray, "_ _"],
    touch: Bool[np.ndarray, "_ _"],
    *,
    joints: Sequence[int],
    radius: float,
) -> BallClips:
    """Puts a ball beside clips: its center in every frame (world, meters), and touches.

    Shapes are checked here, since they may come from a file: [frames, 3], [frames,
    touching]. `ValueError` if the frames differ in number, a position is not finite, a
    joint does not exist, or the radius is not positive.
    """
    frames, joints = clips.num_frames, tuple(int(joint) for joint in joints)
    expected = {"ball_position": (frames, 3), "ball_touch": (frames, len(joints))}
    for (name, shape), found in zip(expected.items(), (position, touch), strict=True):
        if found.shape != shape:
            raise ValueError(
                f"field {name!r} has shape {found.shape}, expected {shape}"
            )
    inside = np.abs(position) <= MAX_METERS
    if not inside.all():
        frame = int(np.argwhere(~inside)[0, 0])
        raise ValueError(
            f"field 'ball_position' of frame {frame} is {position[frame].tolist()}, "
            f"expected numbers within {MAX_METERS:g} m"
        )
    if not joints or not all(0 <= j < clips.skeleton.num_joints for j in joints):
        raise ValueError(
            f"field 'ball_joints' is {joints}, expected joints in "
            f"0..{clips.skeleton.num_joints - 1}"
        )
    if not 0 < radius <= 10:
        raise ValueError(f"field 'ball_radius' is {radius}, expected 0 < radius <= 10")
    return BallClips(
        clips=clips,
        position=jnp.asarray(position, jnp.float32),
        touch=jnp.asarray(touch, bool),
        joints=joints,
        radius=float(radius),
    )


def save_ball_clips(path: str | os.PathLike, data: BallClips) -> None:
    """Writes clips with a ball (.npz); the file has its name only when it is whole."""
    more = {
        "ball_position": np.asarray(data.position, np.float32),
        "ball_touch": np.asarray(data.touch, bool),
        "ball_joints": np.array(data.joints, np.int64),
        "ball_radius": np.array(float(data.radius)),
    }
    files.write_arrays(path, clips_io.to_fields(data.clips) | more)


def load_ball_clips(path: str | os.PathLike) -> BallClips:
    """Reads what `save_ball_clips` wrote; checks every field.

    A `ValueError` names the file and the field if it is damaged, foreign, inconsistent,
    or has no ball.
    """
    path = os.fspath(path)
    fields = clips_io.read_fields(path)
    files.check_fields(path, fields, _FIELDS)
    clips = clips_io.from_fields(path, fields)
    try:
        return ball_clips(
            clips,
            fields["ball_position"],
            fields["ball_touch"],
            joints=fields["ball_joints"].tolist(),
            radius=float(fields["ball_radius"]),
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def take_ball_clips(data: BallClips, indices: Sequence[int] | np.ndarray) -> BallClips:
    """Clips of those numbers, in order; `ValueError` for none or an unknown one."""
    kept = take_clips(data.clips, indices)
    offsets = np.asarray(data.clips.offsets)
    frames = np.concatenate([np.arange(offsets[i], offsets[i + 1]) for i in indices])
    return dataclasses.replace(
        data,
        clips=kept,
        position=jnp.asarray(np.asarray(data.position)[frames]),
        touch=jnp.asarray(np.asarray(data.touch)[frames]),
    )


def cut_scene(data: BallClips, start: Int[Array, ""], length: int) -> Scene:
    """The `length` frames from `start`, counted over all clips."""
    take = lambda x: jax.lax.dynamic_slice_in_dim(x, start, length)  # noqa: E731
    return Scene(
        motion=Motion(
            root_position=take(data.clips.root_position),
            joint_rotation=take(data.clips.joint_rotation),
            fps=data.clips.fps,
        ),
        ball=take(data.position),
        touch=take(data.touch).astype(jnp.float32),
    )
