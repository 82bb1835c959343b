"""Motions with captions on disk: one npz file."""

import os

import numpy as np

from jaxmotion import files
from jaxmotion.data import clips_io
from jaxmotion.data.text_motion import TextMotions, check_statistics

_FORMAT = "jaxmotion-text-motions"
_VERSION = 1
# Kind of each field's numbers ("f" float, "i" integer, "U" text) and its axes.
_FIELDS = {
    "features": ("f", 2),
    "offsets": ("i", 1),
    "mean": ("f", 1),
    "std": ("f", 1),
    "captions": ("U", 1),
    "tokens": ("U", 1),
    "caption_clip": ("i", 1),
    "split": ("i", 1),
    "clip_names": ("U", 1),
    "fps": ("f", 0),
    "split_names": ("U", 1),
    "source": ("U", 0),
}
_TEXTS = ("captions", "tokens", "clip_names", "split_names")


def save_text_motions(path: str | os.PathLike, motions: TextMotions) -> None:
    """Writes clips with captions; the file appears only when it is whole.

    Args:
      path: File to write, conventionally .npz; its folder is made if need be.
      motions: The clips.

    Raises:
      OSError: if the file cannot be written.
    """
    fields = {name: np.asarray(getattr(motions, name)) for name in _FIELDS}
    # Without the type an empty list of names would be stored as numbers.
    fields |= {name: np.array(getattr(motions, name), np.str_) for name in _TEXTS}
    files.write_arrays(
        path, {"format": np.array(_FORMAT), "version": np.array(_VERSION), **fields}
    )


def _check_fields(path: str, fields: dict[str, np.ndarray]) -> None:
    """Raises unless the fields agree with each other."""
    num_frames, num_features = fields["features"].shape
    num_clips, num_captions = fields["offsets"].size - 1, fields["captions"].size
    sizes = {
        "tokens": num_captions,
        "caption_clip": num_captions,
        "split": num_clips,
        "clip_names": num_clips,
    }
    for name, size in sizes.items():
        if fields[name].size != size:
            raise ValueError(
                f"{path}: field {name!r} has {fields[name].size} entries, expected "
                f"{size}"
            )
    if not np.isfinite(fields["features"]).all():
        index = np.argwhere(~np.isfinite(fields["features"]))[0].tolist()
        raise ValueError(f"{path}: field 'features' is not a finite float32 at {index}")
    check_statistics(
        fields["mean"],
        fields["std"],
        num_features,
        names=(f"{path}: field 'mean'", f"{path}: field 'std'"),
    )
    _check_ranges(path, fields, num_frames, num_clips)


def _check_ranges(
    path: str, fields: dict[str, np.ndarray], num_frames: int, num_clips: int
) -> None:
    """Raises unless clips, captions, splits and rate are in range."""
    offsets, owner, split = (fields[k] for k in ("offsets", "caption_clip", "split"))
    if num_clips < 1 or offsets[0] != 0 or offsets[-1] != num_frames:
        raise ValueError(
            f"{path}: field 'offsets' should run from 0 to {num_frames} frames"
        )
    if (np.diff(offsets) < 1).any():
        clip = int(np.argmax(np.diff(offsets) < 1))
        raise ValueError(f"{path}: field 'offsets': clip {clip} has no frames")
    if (np.diff(owner) < 0).any() or not np.array_equal(
        np.unique(owner), np.arange(num_clips)
    ):
        raise ValueError(
            f"{path}: field 'caption_clip' should ascend and give each of the "
            f"{num_clips} clips at least one caption"
        )
    count = fields["split_names"].size
    if split.min() < 0 or split.max() >= count:
        raise ValueError(
            f"{path}: field 'split' should be in 0..{count - 1}, found "
            f"{split.min()}..{split.max()}"
        )
    clips_io.check_rate(path, fields["fps"])


def load_text_motions(path: str | os.PathLike) -> TextMotions:
    """Reads what `save_text_motions` wrote; checks every field.

    Args:
      path: The file.

    Returns:
      The clips, on the host.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is damaged, foreign, of another version, or inconsistent; names
        the file and the field.
    """
    path = os.fspath(path)
    fields = files.read_versioned(
        path, _FIELDS, what="text motions", format_name=_FORMAT, version=_VERSION
    )
    with np.errstate(over="ignore"):  # what overflows is refused next
        for name in ("features", "mean", "std"):
            fields[name] = fields[name].astype(np.float32, copy=False)
    for name in ("offsets", "caption_clip", "split"):
        fields[name] = fields[name].astype(np.int64)
    _check_fields(path, fields)
    arrays = {
        name: fields[name]
        for name, (_, axes) in _FIELDS.items()
        if name not in _TEXTS and axes > 0
    }
    texts = {name: tuple(fields[name].tolist()) for name in _TEXTS}
    return TextMotions(
        **arrays, **texts, fps=float(fields["fps"]), source=str(fields["source"])
    )


def is_text_motions(path: str | os.PathLike) -> bool:
    """Whether a file says that it holds text motions; nothing else of it is checked.

    Args:
      path: A file.

    Returns:
      False also for what is no npz file.

    Raises:
      OSError: if it cannot be read.
    """
    name = os.fspath(path)
    try:
        fields = files.read_arrays(path, name=name, what="motion", only=("format",))
    except ValueError:
        return False
    return str(fields.get("format")) == _FORMAT
