"""Spaces in which characters are generated frame by frame.

A *frame* here is a vector of unit variance in each channel. Its first 12 channels are
always the path features, so that one objective steers in every space. Two kinds:

* embedded: path features and the autoencoder's latent, 12 + 52;
* full pose: path features and the pose vector itself, 12 + 338 for 22 joints.

Source: Li et al. 2024 (AAMDM), sections 3.1 and 4.3 (the ablation without embedding).
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.motion import features
from jaxmotion.systems.aamdm import embedding as aamdm_embedding
from jaxmotion.systems.aamdm.embedding import PATH
from jaxmotion.typing import Params

# Channels that hardly vary, such as the lengths of bones, must not be blown up.
_LEAST = 1e-3
_TAIL = 0.005


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Autoencoder:
    """A trained autoencoder."""

    params: Params
    statistics: aamdm_embedding.Statistics
    config: aamdm_embedding.Config = jax.tree.static()


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Space:
    """How frames are made and read.

    Attributes:
      normalizer: Normalizer of the channels before they are scaled.
      change: Deviation of each channel's change from frame to frame.
      low: Least value of each channel that a frame is let take: the lowest half per
        cent of the data lie below it.
      high: Greatest such value.
      autoencoder: Autoencoder of an embedded space; None for full poses.
    """

    normalizer: features.Normalizer
    change: Float[Array, " channels"]
    low: Float[Array, " channels"]
    high: Float[Array, " channels"]
    autoencoder: Autoencoder | None

    @property
    def num_features(self) -> int:
        """Channels of a frame."""
        return self.normalizer.mean.shape[0]


def _raw(
    autoencoder: Autoencoder | None,
    poses: Float[Array, "*batch features"],
    paths: Float[Array, "*batch 12"],
) -> Float[Array, "*batch channels"]:
    if autoencoder is None:
        return jnp.concatenate([paths, poses], axis=-1)
    return aamdm_embedding.encode(
        autoencoder.params,
        autoencoder.statistics,
        poses,
        paths,
        config=autoencoder.config,
    )


def fit_space(
    poses: Float[Array, "frames features"],
    paths: Float[Array, "frames 12"],
    neighbors: Int[Array, "pairs"],
    *,
    autoencoder: Autoencoder | None,
) -> Space:
    """The space of training frames; without an autoencoder that of full poses.

    Neighbors are frames that are followed by another of the same clip.
    """
    raw = _raw(autoencoder, poses, paths)
    normalizer = features.fit_normalizer(raw, floor=_LEAST)
    frames = features.normalize(normalizer, raw)
    step = frames[neighbors + 1] - frames[neighbors]
    change = jnp.maximum(jnp.sqrt(jnp.mean(step**2, axis=0)), 1e-4)
    some = frames[:: max(len(frames) // 20_000, 1)]
    low, high = jnp.quantile(some, jnp.array([_TAIL, 1.0 - _TAIL]), axis=0)
    return Space(
        normalizer=normalizer,
        change=change,
        low=low,
        high=high,
        autoencoder=autoencoder,
    )


def keep_within(
    space: Space, frames: Float[Array, "*batch channels"]
) -> Float[Array, "*batch channels"]:
    """Frames kept within the bounds of the data, channel by channel.

    A network that has drifted to where no data are may go ever farther; held at the
    bounds it comes back.

    Source: ours.
    """
    return jnp.clip(frames, _like(space.low, frames), _like(space.high, frames))


def _like(vector: Array, frames: Array) -> Array:
    return vector.reshape((1,) * (frames.ndim - 1) + (-1,))


def to_frames(
    space: Space,
    poses: Float[Array, "*batch features"],
    paths: Float[Array, "*batch 12"],
) -> Float[Array, "*batch channels"]:
    """Frames, of unit variance over the training data, of poses and path features."""
    return features.normalize(space.normalizer, _raw(space.autoencoder, poses, paths))


def to_poses(
    space: Space, frames: Float[Array, "*batch channels"]
) -> Float[Array, "*batch features"]:
    """Pose vectors of frames, in their own units."""
    raw = features.denormalize(space.normalizer, frames)
    if space.autoencoder is None:
        return raw[..., PATH:]
    own = space.autoencoder
    return aamdm_embedding.decode(own.params, own.statistics, raw, config=own.config)


def to_paths(
    space: Space, frames: Float[Array, "*batch channels"]
) -> Float[Array, "*batch 12"]:
    """Path features of frames: meters, and directions."""
    return features.denormalize(path_normalizer(space), frames[..., :PATH])


def path_normalizer(space: Space) -> features.Normalizer:
    """How path features, the first 12 channels, are scaled in frames."""
    own = space.normalizer
    return features.Normalizer(mean=own.mean[:PATH], std=own.std[:PATH])
