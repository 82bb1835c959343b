"""Motions with actions for EMDM: choice of labels, splits, and batches on the device.

Actions are drawn uniformly, then a clip of the action, then where it is cut: sets with
rare actions train and score all of them alike. A clip shorter than a sample stays in
its last pose, as in the released code.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxmotion.data import clips_io, resample, selection
from jaxmotion.data.clips import Clips
from jaxmotion.motion import features, skeleton
from jaxmotion.typing import Key


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ActionArrays:
    """Clips by action, on the device.

    Attributes:
      clips: The clips.
      members: Clips of each action, filled up with -1.
      counts: Clips of each action.
      frames: Frames of a sample.
    """

    clips: Clips
    members: Int[Array, "actions most"]
    counts: Int[Array, " actions"]
    frames: int = jax.tree.static()


def prepare_clips(
    paths: tuple[Path, ...],
    *,
    field: str,
    merge: Mapping[str, str],
    least: int,
    fps: float,
) -> tuple[Clips, tuple[str, ...]]:
    """Clips of all files at one rate, with the labels that are frequent enough.

    Args:
      paths: Files of clips of one skeleton.
      field: Label field that is the action.
      merge: Labels that are the same action as others, and those others.
      least: Fewest clips of an action.
      fps: Frames a second.

    Returns:
      The clips, and the labels that were left out.

    Raises:
      OSError: if a file cannot be read.
      ValueError: if the files or labels do not fit, or nothing is left.
    """
    if not paths:
        raise ValueError("no files of clips: at least one is needed")
    clips = selection.concatenate([clips_io.load_clips(path) for path in paths])
    clips = selection.merge_labels(clips, field, merge)
    kept = selection.frequent_labels(clips, field, least=least)
    left_out = tuple(word for word in clips.names(field) if word not in kept)
    if not kept:
        raise ValueError(f"no {field} has {least} clips")
    clips = selection.relabel(selection.select(clips, field, kept), field)
    return resample.resample_clips(clips, fps), left_out


def action_arrays(clips: Clips, *, field: str, frames: int) -> ActionArrays:
    """Puts clips on the device, listed by action.

    Args:
      clips: The clips; every label has some.
      field: Label field that is the action.
      frames: Frames of a sample.

    Returns:
      The arrays.

    Raises:
      ValueError: if an action has no clip; names it.
    """
    names = clips.names(field)
    labels = np.asarray(clips.labels[field])
    counts = np.bincount(labels, minlength=len(names))
    if not counts.all():
        raise ValueError(f"{field} {names[int(counts.argmin())]!r} has no clip")
    members = np.full((len(names), counts.max()), -1)
    for action in range(len(names)):
        own = np.flatnonzero(labels == action)
        members[action, : own.size] = own
    return ActionArrays(
        clips=clips,
        members=jnp.asarray(members, jnp.int32),
        counts=jnp.asarray(counts, jnp.int32),
        frames=frames,
    )


def sample_motions(
    key: Key, arrays: ActionArrays, action: Int[Array, " batch"]
) -> skeleton.Motion:
    """Draws a motion of each action, from the ground's origin and facing +z.

    Args:
      key: Consumed.
      arrays: The clips.
      action: Wanted actions.

    Returns:
      The motions.
    """
    key_clip, key_start = jax.random.split(key)
    clips, frames = arrays.clips, arrays.frames
    place = jax.random.randint(key_clip, action.shape, 0, arrays.counts[action])
    clip = arrays.members[action, place]
    first, stop = clips.offsets[clip], clips.offsets[clip + 1]
    latest = jnp.maximum(stop - first - frames, 0)
    start = first + jax.random.randint(key_start, action.shape, 0, latest + 1)
    rows = jnp.add.outer(start, jnp.arange(frames))
    rows = jnp.minimum(rows, jnp.broadcast_to(stop[:, None] - 1, rows.shape))
    motions = skeleton.Motion(
        root_position=clips.root_position[rows],
        joint_rotation=clips.joint_rotation[rows],
        fps=clips.fps,
    )
    return features.to_first_pose(clips.skeleton, motions)
