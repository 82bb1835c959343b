"""Clips on disk: one npz file without pickles, written whole or not at all."""

import os
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxmotion import files
from jaxmotion.data.clips import Clips
from jaxmotion.motion.skeleton import MAX_METERS, Skeleton, check_skeleton

_FORMAT = "jaxmotion-clips"
_VERSION = 1
RATES = (1e-3, 1e5)  # frames per second
ROTATION_ERROR = 0.02  # of squared lengths and of the columns' product
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
    """Clips as named arrays."""
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
    """Writes clips (.npz); the file appears under its name only when it is whole.

    Its folder is made if need be. Nothing is written if the fields do not agree
    (`ValueError`, see `load_clips`).
    """
    fields = to_fields(clips)
    _check_fields(os.fspath(path), fields)
    files.write_arrays(path, fields)


def read_fields(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """All arrays of a file of clips, each of the expected kind and number of axes.

    `ValueError` if the file is damaged, foreign, of another version, or lacks a field.
    """
    path = os.fspath(path)
    about: dict[str, Any] = dict(what="clips", format_name=_FORMAT, version=_VERSION)
    try:
        fields = files.read_versioned(path, _FIELDS, **about)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{error}: {files.CLIPS_MAKER}") from None
    labels = {f"label.{field}": ("i", 1) for field in fields["label_fields"]}
    names = {f"names.{field}": ("U", 1) for field in fields["label_fields"]}
    files.check_fields(path, fields, labels | names)
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
    position = fields["root_position"]
    inside = np.abs(_single(position)) <= MAX_METERS
    if not inside.all():
        index = np.argwhere(~inside)[0].tolist()
        raise ValueError(
            f"{path}: field 'root_position' is not within {MAX_METERS:g} m at {index}: "
            f"found {position[tuple(index)]}"
        )
    _check_rotations(path, _single(fields["joint_rotation"]))
    _check_ranges(path, fields, num_frames)
    try:
        check_skeleton(
            **{
                name: fields[f"skeleton_{name}"].tolist()
                for name in ("offsets", "parents", "names", "feet")
            }
        )
    except ValueError as error:
        raise ValueError(f"{path}: field 'skeleton': {error}") from None


def _single(values: np.ndarray) -> np.ndarray:
    """As float32; what overflows becomes infinite."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32, copy=False)


def _check_rotations(path: str, columns: np.ndarray) -> None:
    """Raises unless the numbers are two columns of rotations, to a hundredth."""
    x, y = columns[..., :3], columns[..., 3:]
    with np.errstate(all="ignore"):
        products = [np.sum(a * b, -1) for a, b in ((x, x), (y, y), (x, y))]
    wrong = np.zeros(columns.shape[:-1], bool)
    for product, expected in zip(products, (1.0, 1.0, 0.0), strict=True):
        wrong |= ~(np.abs(product - expected) <= ROTATION_ERROR)
    if wrong.any():
        frame, joint = np.argwhere(wrong)[0].tolist()
        raise ValueError(
            f"{path}: field 'joint_rotation' of frame {frame}, joint {joint} is no "
            f"rotation: expected two orthogonal columns of length 1, found "
            f"{columns[frame, joint].tolist()}"
        )


def _check_ranges(path: str, fields: dict[str, np.ndarray], num_frames: int) -> None:
    """Raises unless clips, rate and labels are in range."""
    offsets = fields["offsets"].astype(np.int64)
    num_clips = offsets.size - 1
    if num_clips < 1 or offsets[0] != 0 or offsets[-1] != num_frames:
        raise ValueError(
            f"{path}: field 'offsets' should run from 0 to {num_frames} frames"
        )
    if (np.diff(offsets) < 1).any():
        clip = int(np.argmax(np.diff(offsets) < 1))
        raise ValueError(f"{path}: field 'offsets': clip {clip} has no frames")
    check_rate(path, fields["fps"])
    words = [str(field) for field in fields["label_fields"]]
    if len(set(words)) != len(words):
        raise ValueError(f"{path}: field 'label_fields' has one twice: {words}")
    for field in words:
        label, count = fields[f"label.{field}"], fields[f"names.{field}"].size
        if label.min() < 0 or label.max() >= count:
            raise ValueError(
                f"{path}: field 'label.{field}' should be in 0..{count - 1}, found "
                f"{label.min()}..{label.max()}"
            )


def check_rate(path: str, fps: np.ndarray | float) -> None:
    """Raises a `ValueError`, with the file, unless a rate is one of motions."""
    low, high = RATES
    if not low <= fps <= high:
        raise ValueError(
            f"{path}: field 'fps' should be in {low:g}..{high:g} frames per second, "
            f"found {fps}"
        )


def load_clips(path: str | os.PathLike) -> Clips:
    """Clips on the default device, as `save_clips` wrote them; checks every field.

    A `ValueError` names the file and the field if it is damaged, foreign, of another
    version, or inconsistent.
    """
    return from_fields(os.fspath(path), read_fields(path))


def from_fields(path: str, fields: dict[str, np.ndarray]) -> Clips:
    """Clips, on the default device, of what `read_fields` read; checks every field.

    A `ValueError` names the file and the field that do not agree.
    """
    _check_fields(path, fields)
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
            parents=tuple(int(parent) for parent in fields["skeleton_parents"]),
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
