"""Clips on disk: one npz file without pickles, written whole or not at all."""

import os

import jax.numpy as jnp
import numpy as np

from jaxmotion.data import npz
from jaxmotion.data.clips import Clips
from jaxmotion.motion.skeleton import Skeleton, check_parents

_FORMAT = "jaxmotion-clips"
_VERSION = 1
# Kind of each field's numbers ("f" float, "i" integer, "U" text) and its axes.
_FIELDS = {
    "root_position": ("f", 2),
    "joint_rotation": ("f", 3),
    "offsets": ("i", 1),
    "skeleton_offsets": ("f", 2),
    "skeleton_parents": ("i", 1),
    "skeleton_names": ("U", 1),
    "skeleton_feet": ("i", 1),
    "fps": ("f", 0),
    "clip_names": ("U", 1),
    "source": ("U", 0),
    "label_fields": ("U", 1),
}


def _text(values: tuple[str, ...]) -> np.ndarray:
    """Text as a NumPy array, also when empty (which would be float otherwise)."""
    return np.array(values, dtype=np.str_)


def to_fields(clips: Clips) -> dict[str, np.ndarray]:
    """Clips as named arrays.

    Args:
      clips: The clips.

    Returns:
      The arrays that a file of clips holds.
    """
    fields = {
        "format": np.array(_FORMAT),
        "version": np.array(_VERSION),
        "root_position": np.asarray(clips.root_position, np.float32),
        "joint_rotation": np.asarray(clips.joint_rotation, np.float32),
        "offsets": np.asarray(clips.offsets, np.int64),
        "skeleton_offsets": np.asarray(clips.skeleton.offsets, np.float32),
        "skeleton_parents": np.array(clips.skeleton.parents, np.int64),
        "skeleton_names": _text(clips.skeleton.names),
        "skeleton_feet": np.array(clips.skeleton.feet, np.int64),
        "fps": np.array(float(clips.fps)),
        "clip_names": _text(clips.clip_names),
        "source": np.array(clips.source),
        "label_fields": _text(tuple(clips.labels)),
    }
    for field, names in clips.label_names:
        fields[f"label.{field}"] = np.asarray(clips.labels[field], np.int64)
        fields[f"names.{field}"] = _text(names)
    return fields


def save_clips(path: str | os.PathLike, clips: Clips) -> None:
    """Writes clips; the file appears under its name only when it is whole.

    Args:
      path: File to write, conventionally .npz; its folder is made if need be.
      clips: The clips.

    Raises:
      OSError: if the file cannot be written.
    """
    npz.write_npz(path, to_fields(clips))


def read_fields(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """All arrays of a file of clips, each of the expected kind and number of axes.

    Args:
      path: The file.

    Returns:
      The arrays.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is damaged, foreign, of another version, or lacks a field.
    """
    path = os.fspath(path)
    about = dict(what="clips", format_name=_FORMAT, version=_VERSION)
    fields = npz.read_npz(path, _FIELDS, **about)
    labels = {f"label.{field}": ("i", 1) for field in fields["label_fields"]}
    names = {f"names.{field}": ("U", 1) for field in fields["label_fields"]}
    npz.check_fields(path, fields, labels | names)
    return fields


def _check_fields(path: str, fields: dict[str, np.ndarray]) -> None:
    """Raises unless the fields agree with each other."""
    num_frames, num_joints = fields["joint_rotation"].shape[:2]
    num_clips = fields["offsets"].size - 1
    shapes = {
        "root_position": (num_frames, 3),
        "joint_rotation": (num_frames, num_joints, 6),
        "skeleton_offsets": (num_joints, 3),
        "skeleton_parents": (num_joints,),
        "skeleton_names": (num_joints,),
        "clip_names": (num_clips,),
        **{f"label.{field}": (num_clips,) for field in fields["label_fields"]},
    }
    for name, shape in shapes.items():
        if fields[name].shape != shape:
            raise ValueError(
                f"{path}: field {name!r} has shape {fields[name].shape}, expected "
                f"{shape}"
            )
    for name in ("root_position", "joint_rotation", "skeleton_offsets"):
        if not np.isfinite(fields[name]).all():
            index = np.argwhere(~np.isfinite(fields[name]))[0].tolist()
            raise ValueError(f"{path}: field {name!r} is not finite at {index}")
    _check_ranges(path, fields, num_frames, num_joints)


def _check_ranges(
    path: str, fields: dict[str, np.ndarray], num_frames: int, num_joints: int
) -> None:
    """Raises unless clips, rate, feet and labels are in range."""
    offsets = fields["offsets"]
    num_clips = offsets.size - 1
    if num_clips < 1 or offsets[0] != 0 or offsets[-1] != num_frames:
        raise ValueError(
            f"{path}: field 'offsets' should run from 0 to {num_frames} frames"
        )
    if (np.diff(offsets) < 1).any():
        clip = int(np.argmax(np.diff(offsets) < 1))
        raise ValueError(f"{path}: field 'offsets': clip {clip} has no frames")
    if not 0 < fields["fps"] < np.inf:
        raise ValueError(f"{path}: field 'fps' should be positive: {fields['fps']}")
    feet = fields["skeleton_feet"]
    if feet.size and not (0 <= feet.min() and feet.max() < num_joints):
        raise ValueError(f"{path}: field 'skeleton_feet' names no joint: {feet}")
    for field in fields["label_fields"]:
        label, count = fields[f"label.{field}"], fields[f"names.{field}"].size
        if label.min() < 0 or label.max() >= count:
            raise ValueError(
                f"{path}: field 'label.{field}' should be in 0..{count - 1}, found "
                f"{label.min()}..{label.max()}"
            )


def load_clips(path: str | os.PathLike) -> Clips:
    """Reads what `save_clips` wrote; checks every field.

    Args:
      path: The file.

    Returns:
      The clips, on the default device.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is damaged, foreign, of another version, or inconsistent; names
        the file and the field.
    """
    return from_fields(os.fspath(path), read_fields(path))


def from_fields(path: str, fields: dict[str, np.ndarray]) -> Clips:
    """Clips of what `read_fields` read; checks every field.

    Args:
      path: The file, for messages.
      fields: Its arrays.

    Returns:
      The clips, on the default device.

    Raises:
      ValueError: if the fields do not agree; names the file and the field.
    """
    _check_fields(path, fields)
    parents = tuple(int(parent) for parent in fields["skeleton_parents"])
    try:
        check_parents(parents)
    except ValueError as error:
        raise ValueError(f"{path}: field 'skeleton_parents': {error}") from None
    label_fields = [str(field) for field in fields["label_fields"]]
    return Clips(
        root_position=jnp.asarray(fields["root_position"], jnp.float32),
        joint_rotation=jnp.asarray(fields["joint_rotation"], jnp.float32),
        offsets=jnp.asarray(fields["offsets"], jnp.int32),
        labels={
            field: jnp.asarray(fields[f"label.{field}"], jnp.int32)
            for field in label_fields
        },
        skeleton=Skeleton(
            offsets=jnp.asarray(fields["skeleton_offsets"], jnp.float32),
            parents=parents,
            names=tuple(str(name) for name in fields["skeleton_names"]),
            feet=tuple(int(foot) for foot in fields["skeleton_feet"]),
        ),
        fps=float(fields["fps"]),
        label_names=tuple(
            (field, tuple(str(name) for name in fields[f"names.{field}"]))
            for field in label_fields
        ),
        clip_names=tuple(str(name) for name in fields["clip_names"]),
        source=str(fields["source"]),
    )
