"""Motions with captions: ragged clips of feature vectors, several sentences a clip.

The feature vectors are those of `motion.humanml`, 263 numbers a frame for HumanML3D and
251 for KIT-ML, or others that come with their mean and deviation.

Everything here is NumPy on the host; `text_sampling` puts one split on a device,
`text_motion_io` on disk.
"""

import collections
import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from jaxmotion.motion.humanml import HUMANML3D, KIT_ML

SPLITS = ("train", "val", "test")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TextMotions:
    """Ragged clips with captions, on the host.

    Attributes:
      features: Feature vectors of all clips behind each other, not normalized.
      offsets: First frame of each clip, and the number of frames at the end.
      mean: Of each feature, over frames.
      std: Of each feature (or of its group), positive.
      captions: Sentences, those of one clip behind each other.
      tokens: For each sentence its words as "word/POS word/POS".
      caption_clip: The clip of each caption, ascending.
      split: Number of each clip's split.
      clip_names: One name a clip.
      fps: Frames per second.
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
        """Numbers of the clips of a split.

        Args:
          split: Its name.

        Returns:
          Ascending; empty if it has none.

        Raises:
          ValueError: if there is no such split; names those there are.
        """
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

    Args:
      mean: Mean of each feature.
      std: Standard deviation of each feature.
      num_features: Numbers in a feature vector.
      names: What to call them in messages, such as their files.

    Raises:
      ValueError: if a length is wrong, a value is not finite, or a deviation is not
        positive; names the channels.
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

    Args:
      features: Clips.

    Returns:
      Mean and standard deviation.

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
    mean = sum(clip.sum(0, dtype=np.float64) for clip in features) / count
    square = sum(((clip - mean) ** 2).sum(0) for clip in features) / count
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
    """Puts clips with captions behind each other.

    Args:
      features: Feature vectors of each clip.
      captions: For each clip its (sentence, tokens), at least one.
      splits: "train", "val" or "test" for each clip.
      names: One name a clip.
      mean: Mean of each feature; without it and std, those of the training clips.
      std: Standard deviation of each feature.
      fps: Frames per second.
      source: Where the data came from and its license.

    Returns:
      The clips, in the order given.

    Raises:
      ValueError: names the clip or the channels that are not as they should be.
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
