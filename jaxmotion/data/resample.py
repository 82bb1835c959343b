"""Motions at another frame rate."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.data.clips import Clips
from jaxmotion.motion import rotation
from jaxmotion.motion.skeleton import Motion


def slerp(
    a: Float[Array, "*batch 4"], b: Float[Array, "*batch 4"], t: Float[Array, "*batch"]
) -> Float[Array, "*batch 4"]:
    """Spherical interpolation of unit quaternions, a to b in t, along the shorter arc.

    Source: Shoemake 1985.
    """
    cosine = jnp.sum(a * b, axis=-1, keepdims=True)
    b, cosine = jnp.where(cosine < 0, -b, b), jnp.abs(cosine)
    # The angle from both chords is exact near zero, where arccos is not.
    angle = 2.0 * jnp.arctan2(
        jnp.linalg.norm(a - b, axis=-1, keepdims=True),
        jnp.linalg.norm(a + b, axis=-1, keepdims=True),
    )
    t = t[..., None]
    sine = jnp.sin(angle)
    is_small = sine < 1e-6
    divisor = jnp.where(is_small, 1.0, sine)
    weight_a = jnp.where(is_small, 1.0 - t, jnp.sin((1.0 - t) * angle) / divisor)
    weight_b = jnp.where(is_small, t, jnp.sin(t * angle) / divisor)
    mixed = weight_a * a + weight_b * b
    return mixed / jnp.linalg.norm(mixed, axis=-1, keepdims=True)


def resample(motion: Motion, fps: float) -> Motion:
    """The motion at another frame rate, from its first frame on.

    The same rate returns the motion itself. Where the rate divides the motion's by a
    whole number n, every nth frame is taken unchanged. Otherwise positions are
    interpolated linearly and rotations by slerp. Nothing is filtered. The last frame is
    the last one that is not after the motion's own last frame.

    Raises:
      ValueError: if the rate is not positive and finite, the motion has no frames, or
        the rate is more than 16 times or less than 1/16 of the motion's (a mistake).
    """
    num_frames = motion.root_position.shape[-2]
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps should be positive and finite, found {fps}")
    if num_frames == 0:
        raise ValueError("the motion has no frames")
    ratio = motion.fps / fps
    if not 1 / 16 <= ratio <= 16:
        raise ValueError(
            f"resampling from {motion.fps:g} to {fps:g} frames per second is more than "
            "a factor of 16; is one of them wrong?"
        )
    if ratio == 1.0:
        return motion
    step = round(ratio)
    if step >= 1 and abs(ratio - step) < 1e-6 * ratio:
        return dataclasses.replace(
            motion,
            root_position=motion.root_position[..., ::step, :],
            joint_rotation=motion.joint_rotation[..., ::step, :, :],
            fps=float(fps),
        )
    # The tolerance keeps a last frame that rounding puts just after the end.
    count = int(np.floor((num_frames - 1) / ratio + 1e-6)) + 1
    time = np.minimum(np.arange(count) * ratio, num_frames - 1)
    low = np.minimum(np.floor(time).astype(np.int64), max(num_frames - 2, 0))
    high = np.minimum(low + 1, num_frames - 1)
    t = jnp.asarray(time - low, motion.root_position.dtype)
    position, rot6d = _between(
        motion.root_position, motion.joint_rotation, jnp.array(low), jnp.array(high), t
    )
    return Motion(root_position=position, joint_rotation=rot6d, fps=float(fps))


@jax.jit
def _between(
    position: Float[Array, "*batch frames 3"],
    rot6d: Float[Array, "*batch frames joints 6"],
    low: Int[Array, " new"],
    high: Int[Array, " new"],
    t: Float[Array, " new"],
) -> tuple[Float[Array, "*batch new 3"], Float[Array, "*batch new joints 6"]]:
    """Frames between frames low and high."""
    before, after = position[..., low, :], position[..., high, :]
    weight = jnp.broadcast_to(t[:, None], before.shape)
    quaternion = rotation.quaternion_from_matrix(rotation.matrix_from_rot6d(rot6d))
    a, b = quaternion[..., low, :, :], quaternion[..., high, :, :]
    turned = slerp(a, b, jnp.broadcast_to(t[:, None], a.shape[:-1]))
    return (
        (1 - weight) * before + weight * after,
        rotation.rot6d_from_matrix(rotation.matrix_from_quaternion(turned)),
    )


_PART = 1 << 16  # frames at a time: a set may be larger than what mixing it needs


def resample_clips(clips: Clips, fps: float) -> Clips:
    """All clips at another rate, as `resample` makes each, by one compiled program.

    A clip's first frame stays its first; the same rate returns the clips themselves.
    `ValueError` for a rate more than 16 times or less than 1/16 of theirs.
    """
    ratio = clips.fps / fps if fps > 0 else 0.0
    if not 1 / 16 <= ratio <= 16:
        raise ValueError(f"fps is {fps:g}, the clips have {clips.fps:g}")
    if ratio == 1.0:
        return clips
    offsets = np.asarray(clips.offsets, np.int64)
    low, weight, counts = [], [], []
    for start, stop in zip(offsets[:-1], offsets[1:], strict=True):
        last = stop - start - 1
        time = np.minimum(np.arange(int(last / ratio + 1e-6) + 1) * ratio, last)
        frame = np.minimum(np.floor(time), max(last - 1, 0)).astype(np.int64)
        low.append(start + frame)
        weight.append(time - frame)
        counts.append(time.size)
    low, weight = np.concatenate(low), np.concatenate(weight)
    frames = [np.asarray(x) for x in (clips.root_position, clips.joint_rotation)]
    if abs(ratio - round(ratio)) < 1e-6 * ratio:  # every nth frame, unchanged
        near = np.round(low + weight).astype(np.int64)
        made = [x[near] for x in frames]
    else:
        high = np.minimum(low + 1, clips.num_frames - 1)
        made = [np.empty((low.size, *x.shape[1:]), x.dtype) for x in frames]
        size = min(_PART, low.size)
        pair = np.arange(2 * size).reshape(2, size)
        for start in range(0, low.size, size):
            part = np.minimum(start + np.arange(size), low.size - 1)  # as long as all
            ends = [np.concatenate([x[low[part]], x[high[part]]]) for x in frames]
            mixed = _between(*ends, *pair, np.asarray(weight[part], ends[0].dtype))
            for whole, own in zip(made, mixed, strict=True):
                whole[start : start + size] = own[: low.size - start]
    return dataclasses.replace(
        clips,
        root_position=jnp.asarray(made[0]),
        joint_rotation=jnp.asarray(made[1]),
        offsets=jnp.asarray(np.cumsum([0, *counts]), jnp.int32),
        fps=float(fps),
    )
