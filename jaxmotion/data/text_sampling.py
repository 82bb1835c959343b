"""Batches of motions with captions, drawn on the device inside jit.

`text_arrays` puts one split on the device once, z-scored; `sample_text_batch` gathers
from it and compiles once.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.data.text_motion import TextMotions
from jaxmotion.typing import Key


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TextArrays:
    """Clips of one split on the device.

    Attributes:
      features: Z-scored feature vectors of all clips behind each other, then zeros, so
        that a window from any frame stays inside.
      starts: First frame of each clip.
      lengths: Frames of each clip.
      captions: Captions of all clips behind each other, as numbers in `TextMotions`.
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
    """Puts the clips of a split on the default device, z-scored.

    Args:
      motions: Clips with captions.
      split: "train", "val" or "test".
      max_frames: Frames of a sample; 196 in the published experiments.
      unit_length: Lengths of samples are multiples of it, frames.

    Returns:
      What `sample_text_batch` draws from.

    Raises:
      ValueError: if the split has no clips, a clip is shorter than a unit (names it),
        or max_frames is.
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

    Args:
      key: Consumed.
      arrays: Clips of one split.
      batch: Samples to draw.

    Returns:
      Z-scored features, zero behind their end; lengths in frames; and captions as
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
