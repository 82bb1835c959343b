"""What AAMDM's data need before training: a higher rate, and a simulation bone.

The simulation bone is a smooth path on the ground under the chest, with the smoothed
facing of the hips. Motion is then described from it, and it is what moves a character.

Source: Holden et al. 2020 (Learned Motion Matching), released pipeline. Differs: the
facing comes from the line between the hip joints, not from an axis of the hips, which
is a convention of one rig; and resampling does not change a clip's duration.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter

from jaxmotion.motion import rotation
from jaxmotion.motion.facing import hip_facing, plain_names
from jaxmotion.motion.skeleton import Motion, Skeleton, from_root
from jaxmotion.motion.trajectory import Trajectory

# Windows of the filters, seconds (31 and 61 frames at 60 per second), and their degree.
_POSITION, _FACING, _DEGREE = 31 / 60, 61 / 60, 3
# The joint whose ground projection is the bone's position; the first that exists.
_CHESTS = ("spine2", "chest2", "chest", "spine1")


def upsample(motion: Motion, fps: float) -> Motion:
    """The motion at a higher rate, by cubic splines through its frames.

    The same one if it has that rate. The last frame is the last that is not after the
    motion's own.

    `ValueError` for a rate that is lower than the motion's or more than 16 times as
    high, or fewer than two frames.
    """
    frames = motion.root_position.shape[0]
    if not (np.isfinite(fps) and motion.fps <= fps <= 16 * motion.fps):
        raise ValueError(
            f"{motion.fps:g} frames per second cannot be resampled to {fps:g}: "
            "expected a rate that is as high or up to 16 times as high"
        )
    if fps == motion.fps:
        return motion
    if frames < 2:
        raise ValueError("1 frame or none, expected at least 2 to resample")
    quaternion = np.array(
        rotation.quaternion_from_matrix(
            rotation.matrix_from_rot6d(motion.joint_rotation)
        ),
        np.float64,
    )
    # q and -q are one rotation: keep to the side of the frame before.
    flips = np.sum(quaternion[1:] * quaternion[:-1], axis=-1) < 0
    quaternion[1:] *= np.where(np.cumsum(flips, axis=0) % 2, -1.0, 1.0)[..., None]
    count = int(np.floor((frames - 1) * fps / motion.fps + 1e-6)) + 1
    time = np.minimum(np.arange(count) * motion.fps / fps, frames - 1)
    position = CubicSpline(np.arange(frames), np.asarray(motion.root_position))(time)
    turned = CubicSpline(np.arange(frames), quaternion)(time)
    turned /= np.linalg.norm(turned, axis=-1, keepdims=True)
    matrix = rotation.matrix_from_quaternion(jnp.asarray(turned, jnp.float32))
    return Motion(
        root_position=jnp.asarray(position, jnp.float32),
        joint_rotation=rotation.rot6d_from_matrix(matrix),
        fps=float(fps),
    )


def chest_joint(skeleton: Skeleton) -> int:
    """Index of the joint under which the simulation bone runs.

    Spine2, Chest2, Chest or Spine1, the first of these that exists, in any case and
    after a prefix like "mixamorig:".

    A `ValueError` names the joints if there is none.
    """
    plain = plain_names(skeleton)
    for name in _CHESTS:
        if name in plain:
            return plain.index(name)
    raise ValueError(
        "no chest joint: expected Spine2, Chest2, Chest or Spine1 among the joint "
        f"names {', '.join(skeleton.names)}"
    )


def _window(seconds: float, fps: float) -> int:
    """Odd number of frames."""
    return 2 * round((seconds * fps - 1) / 2) + 1


def least_frames(fps: float) -> int:
    """Frames that a simulation bone needs: the filters' longest window."""
    return max(_window(_FACING, fps), _DEGREE + 2)


def simulation_bone(skeleton: Skeleton, motion: Motion) -> Trajectory:
    """The smooth path on the ground that carries a clip (world).

    Position under the chest and facing of the hips, both filtered (Savitzky-Golay of
    degree 3 over about half a second and a second).

    `ValueError` if a joint that it needs is missing, or the clip is too short.

    Source: Holden et al. 2020, released pipeline.
    """
    chest = chest_joint(skeleton)
    frames, least = motion.root_position.shape[0], least_frames(motion.fps)
    if frames < least:
        raise ValueError(
            f"{frames} frames at {motion.fps:g} per second, expected at least {least} "
            "for the simulation bone"
        )
    above = from_root(skeleton, motion.joint_rotation, chest)
    positions = np.asarray(motion.root_position + above, np.float64)
    facing = np.asarray(hip_facing(skeleton, motion.joint_rotation), np.float64)

    def smooth(x: Float[np.ndarray, "f 2"], seconds: float) -> Float[np.ndarray, "f 2"]:
        window = max(_window(seconds, motion.fps), _DEGREE + 2)
        return np.asarray(savgol_filter(x, window, _DEGREE, axis=0, mode="interp"))

    position = smooth(positions[:, ::2], _POSITION)
    facing = smooth(facing, _FACING)
    length = np.maximum(np.linalg.norm(facing, axis=-1, keepdims=True), 1e-6)
    return Trajectory(
        position=jnp.asarray(position, jnp.float32),
        facing=jnp.asarray(facing / length, jnp.float32),
    )
