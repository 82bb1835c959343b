"""Motions with captions: ragged clips of feature vectors, several sentences a clip.

The feature vectors are those of `motion.humanml`, 263 numbers a frame for HumanML3D and
251 for KIT-ML, or others that come with their mean and deviation.

`TextMotions` is NumPy on the host, and one npz file on disk. `text_arrays` puts one
split on the device, z-scored; `sample_text_batch` gathers batches from it inside jit,
and compiles once.
"""

import collections
import dataclasses
import functools
import os
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion import files
from jaxmotion.data import clips_io
from jaxmotion.motion.humanml_layout import HUMANML3D, KIT_ML
from jaxmotion.typing import Key

SPLITS = ("train", "val", "test")
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


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TextMotions:
    """Ragged clips with captions, on the host.

    Attributes:
      features: Feature vectors of all clips, concatenated, not normalized.
      offsets: First frame of each clip, and the number of frames at the end.
      mean: Mean of each feature, over frames.
      std: Standard deviation of each feature (or of its group), positive.
      captions: Sentences, those of one clip next to each other.
      tokens: For each sentence its words as "word/POS word/POS".
      caption_clip: The clip of each caption, ascending.
      split: Number of each clip's split.
      split_names: Name of each split.
      source: Where the data came from and its license.
    """

    features: Float[np.ndarray, "frames features"]
    offsets: Int[np.ndarray, "boundaries"]
    mean: Float[np.ndarray, "features"]
    std: Float[np.ndarray, "features"]
    captions: tuple[str, ...]
    tokens: tuple[str, ...]
    caption_clip: Int[np.ndarray, "captions"]
    split: Int[np.ndarray, "clips"]
    clip_names: tuple[str, ...]
    fps: float
    split_names: tuple[str, ...] = SPLITS
    source: str = ""

    @property
    def num_clips(self) -> int:
        """Number of clips."""
        return self.offsets.shape[0] - 1

    @property
    def num_features(self) -> int:
        """Numbers in a feature vector."""
        return self.features.shape[1]

    def clips_of(self, split: str) -> Int[np.ndarray, "_"]:
        """Numbers of a split's clips, ascending; `ValueError` for an unknown split."""
        if split not in self.split_names:
            raise ValueError(
                f"unknown split {split!r}: there are {', '.join(self.split_names)}"
            )
        return np.flatnonzero(self.split == self.split_names.index(split))


def check_statistics(
    mean: Float[np.ndarray, "..."],
    std: Float[np.ndarray, "..."],
    num_features: int,
    *,
    names: tuple[str, str] = ("mean", "std"),
) -> None:
    """Raises unless both have one usable number for each feature.

    `names` is what to call them, such as their files. A `ValueError` names the channels
    that are not finite, or deviations that are not positive.
    """
    for name, values in zip(names, (mean, std), strict=True):
        if values.shape != (num_features,):
            raise ValueError(
                f"{name}: expected {num_features} numbers, found shape {values.shape}"
            )
        if not np.isfinite(values).all():
            bad = np.flatnonzero(~np.isfinite(values)).tolist()
            raise ValueError(f"{name}: channels {bad} are not finite")
    if (std <= 0).any():
        bad = np.flatnonzero(std <= 0).tolist()
        raise ValueError(f"{names[1]}: channels {bad} are not positive")


def grouped_statistics(
    features: Sequence[Float[np.ndarray, "_ features"]],
) -> tuple[Float[np.ndarray, "features"], Float[np.ndarray, "features"]]:
    """Mean of each feature, and standard deviations averaged within groups.

    Raises:
      ValueError: if a group never changes, or the vectors are of neither set's size.

    Source: HumanML3D, the published Mean.npy and Std.npy. Differs: those are of the
      clips of all splits; callers here give the training clips.
    """
    layouts = {layout.num_features: layout for layout in (HUMANML3D, KIT_ML)}
    if features[0].shape[1] not in layouts:
        raise ValueError(
            f"{features[0].shape[1]} features, expected one of {sorted(layouts)}; "
            "give mean and std for other vectors"
        )
    groups = layouts[features[0].shape[1]].channels.fields
    count = sum(len(clip) for clip in features)
    # Clip by clip in float64: the whole set in float64 would not fit in memory.
    none = np.zeros(features[0].shape[1])
    mean = sum((clip.sum(0, dtype=np.float64) for clip in features), none) / count
    square = sum((((clip - mean) ** 2).sum(0) for clip in features), none) / count
    std = np.sqrt(square)
    for name, start, stop in groups:
        std[start:stop] = std[start:stop].mean()
        # Below float32's resolution of the mean it is rounding, not motion.
        if std[start] <= 1e-6 * max(1.0, np.abs(mean[start:stop]).max()):
            raise ValueError(
                f"std: group {name!r}, channels {start}..{stop - 1}, never changes in "
                f"the training clips"
            )
    return mean.astype(np.float32), std.astype(np.float32)


def _check_clip(
    name: str,
    clip: np.ndarray,
    width: int,
    sentences: Sequence[tuple[str, str]],
    split: str,
) -> None:
    """Raises unless the clip has finite frames, captions with tokens and a split."""
    if clip.ndim != 2 or clip.shape[0] == 0 or clip.shape[1] != width:
        raise ValueError(
            f"clip {name!r}: expected frames of {width} features, found shape "
            f"{clip.shape}"
        )
    if not np.isfinite(clip).all():
        frame = int(np.argwhere(~np.isfinite(clip))[0, 0])
        raise ValueError(f"clip {name!r}: frame {frame} is not finite")
    if not sentences or not all(text and tags for text, tags in sentences):
        raise ValueError(f"clip {name!r} lacks a caption or its tokens")
    if split not in SPLITS:
        raise ValueError(
            f"clip {name!r}: unknown split {split!r}, expected one of "
            f"{', '.join(SPLITS)}"
        )


def _check_clips(
    features: Sequence[np.ndarray],
    captions: Sequence[Sequence[tuple[str, str]]],
    splits: Sequence[str],
    names: Sequence[str],
) -> None:
    """Raises unless there are clips, each whole and with a name of its own."""
    if not features:
        raise ValueError("no clips: at least one is needed")
    per_clip = {"captions": captions, "splits": splits, "names": names}
    for what, values in per_clip.items():
        if len(values) != len(features):
            raise ValueError(f"{len(values)} {what} for {len(features)} clips")
    name, uses = collections.Counter(names).most_common(1)[0]
    if uses > 1:
        raise ValueError(f"{uses} clips have the name {name!r}")
    width = features[0].shape[-1]
    rows = zip(names, features, captions, splits, strict=True)
    for name, clip, sentences, split in rows:
        _check_clip(name, clip, width, sentences, split)


def text_motions(
    features: Sequence[np.ndarray],
    captions: Sequence[Sequence[tuple[str, str]]],
    splits: Sequence[str],
    names: Sequence[str],
    *,
    mean: Float[np.ndarray, "..."] | None = None,
    std: Float[np.ndarray, "..."] | None = None,
    fps: float,
    source: str,
) -> TextMotions:
    """Concatenates clips with captions.

    Of each clip: its feature vectors, one (sentence, tokens) or more, its split
    ("train", "val" or "test") and name. Without mean and deviation, those of the
    training clips are taken. A `ValueError` names the clip or the channels that are not
    as they should be.
    """
    _check_clips(features, captions, splits, names)
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps should be positive, found {fps}")
    if (mean is None) != (std is None):
        raise ValueError("give both mean and std, or neither")
    if mean is None or std is None:
        train = [c for c, s in zip(features, splits, strict=True) if s == "train"]
        if not train:
            raise ValueError("no clip of split 'train' to take mean and std from")
        mean, std = grouped_statistics(train)
    check_statistics(mean, std, features[0].shape[1])
    counts = [len(sentences) for sentences in captions]
    pairs = [pair for sentences in captions for pair in sentences]
    return TextMotions(
        features=np.concatenate(features).astype(np.float32, copy=False),
        offsets=np.cumsum([0, *(len(clip) for clip in features)]),
        mean=mean.astype(np.float32),
        std=std.astype(np.float32),
        captions=tuple(text for text, _ in pairs),
        tokens=tuple(tags for _, tags in pairs),
        caption_clip=np.repeat(np.arange(len(features)), counts),
        split=np.array([SPLITS.index(split) for split in splits]),
        clip_names=tuple(names),
        fps=float(fps),
        source=source,
    )


def save_text_motions(path: str | os.PathLike, motions: TextMotions) -> None:
    """Writes clips with captions (.npz); the file appears only when it is whole.

    Its folder is made if need be.
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
    """Clips on the host, as `save_text_motions` wrote them; checks every field.

    A `ValueError` names the file and the field if it is damaged, foreign, of another
    version, or inconsistent.
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
    arrays: dict[str, Any] = {
        name: fields[name]
        for name, (_, axes) in _FIELDS.items()
        if name not in _TEXTS and axes > 0
    }
    texts: dict[str, Any] = {name: tuple(fields[name].tolist()) for name in _TEXTS}
    return TextMotions(
        **arrays, **texts, fps=float(fields["fps"]), source=str(fields["source"])
    )


def is_text_motions(path: str | os.PathLike) -> bool:
    """Whether a file says that it holds text motions; nothing else of it is checked.

    False also for what is no npz file.
    """
    name = os.fspath(path)
    try:
        fields = files.read_arrays(path, name=name, what="motion", only=("format",))
    except ValueError:
        return False
    return str(fields.get("format")) == _FORMAT


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TextArrays:
    """Clips of one split on the device.

    Attributes:
      features: Z-scored feature vectors of all clips, concatenated, then zeros, so
        that a window from any frame stays inside.
      starts: First frame of each clip.
      lengths: Frames of each clip.
      captions: Captions of all clips, concatenated, as numbers in `TextMotions`.
      caption_starts: First entry of each clip in `captions`.
      caption_counts: Captions of each clip.
      max_frames: Frames of a sample, with its padding.
      unit_length: Lengths of samples are multiples of it, frames.
    """

    features: Float[Array, "rows features"]
    starts: Int[Array, "clips"]
    lengths: Int[Array, "clips"]
    captions: Int[Array, "captions"]
    caption_starts: Int[Array, "clips"]
    caption_counts: Int[Array, "clips"]
    max_frames: int = jax.tree.static()
    unit_length: int = jax.tree.static()


def text_arrays(
    motions: TextMotions,
    *,
    split: str,
    max_frames: int,
    unit_length: int = 4,
) -> TextArrays:
    """The z-scored clips of a split on the default device, for `sample_text_batch`.

    Samples have `max_frames` frames, 196 in the published experiments. `ValueError` if
    the split has no clips, or a clip (named) or max_frames is shorter than a unit.
    """
    clips = motions.clips_of(split)
    if clips.size == 0:
        raise ValueError(f"no clip of split {split!r}")
    if not 0 < unit_length <= max_frames:
        raise ValueError(
            f"expected 0 < unit_length <= max_frames, found unit_length {unit_length} "
            f"and max_frames {max_frames}"
        )
    lengths = np.diff(motions.offsets)[clips]
    if lengths.min() < unit_length:
        short = int(lengths.argmin())
        raise ValueError(
            f"clip {motions.clip_names[clips[short]]!r} has {lengths[short]} frames, "
            f"expected at least a unit of {unit_length}"
        )
    # Filled in place: the published set takes gigabytes, and each copy as much.
    scored = np.zeros((lengths.sum() + max_frames, motions.num_features), np.float32)
    starts = np.cumsum(lengths) - lengths
    for clip, start, length in zip(clips, starts, lengths, strict=True):
        first = motions.offsets[clip]
        own = motions.features[first : first + length]
        scored[start : start + length] = (own - motions.mean) / motions.std
    counts = np.bincount(motions.caption_clip, minlength=motions.num_clips)[clips]
    number = lambda values: jnp.asarray(values, jnp.int32)  # noqa: E731
    return TextArrays(
        features=jnp.asarray(scored),
        starts=number(starts),
        lengths=number(lengths),
        captions=number(np.flatnonzero(np.isin(motions.caption_clip, clips))),
        caption_starts=number(np.cumsum(counts) - counts),
        caption_counts=number(counts),
        max_frames=max_frames,
        unit_length=unit_length,
    )


@functools.partial(jax.jit, static_argnames=("batch",))
def sample_text_batch(
    key: Key, arrays: TextArrays, *, batch: int
) -> tuple[
    Float[Array, "{batch} frames features"],
    Int[Array, "{batch}"],
    Int[Array, "{batch}"],
]:
    """Draws clips uniformly, of each a caption uniformly, and a random crop.

    The length is that of the clip, at most max_frames, rounded down to units; one time
    in three it is a unit shorter still, unless that would leave nothing.

    Returns:
      Z-scored features, zero after their end; lengths in frames; and captions as
      numbers in `TextMotions`.

    Source: the data loader released with T2M, unit length 4.
    """
    key_clip, key_caption, key_length, key_start = jax.random.split(key, 4)
    draw = lambda key, stop: jax.random.randint(key, (batch,), 0, stop)  # noqa: E731
    clip = draw(key_clip, arrays.starts.shape[0])
    caption = draw(key_caption, arrays.caption_counts[clip])
    frames = arrays.lengths[clip]
    units = jnp.minimum(frames, arrays.max_frames) // arrays.unit_length
    shorter = draw(key_length, 3) == 0
    length = jnp.maximum(units - shorter, 1) * arrays.unit_length
    start = arrays.starts[clip] + draw(key_start, frames - length + 1)
    take = lambda row: jax.lax.dynamic_slice_in_dim(  # noqa: E731
        arrays.features, row, arrays.max_frames
    )
    inside = jnp.arange(arrays.max_frames)[None] < length[:, None]
    features = jnp.where(inside[..., None], jax.vmap(take)(start), 0.0)
    return features, length, arrays.captions[arrays.caption_starts[clip] + caption]
