"""How much samples differ: over a set, for one condition, and within a style."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.typing import Key


def _random_pairs(key: Key, count: int, num_pairs: int) -> tuple[Array, Array]:
    """Pairs of two different indices below count, all equally likely."""
    if count < 2:
        raise ValueError(f"{count} samples, expected at least 2 to have a pair")
    key_first, key_shift = jax.random.split(key)
    first = jax.random.randint(key_first, (num_pairs,), 0, count)
    shift = jax.random.randint(key_shift, (num_pairs,), 1, count)
    return first, (first + shift) % count


@functools.partial(jax.jit, static_argnames=("num_pairs",))
def diversity(
    key: Key, features: Float[Array, "samples features"], *, num_pairs: int
) -> Float[Array, ""]:
    """Mean Euclidean distance of random pairs of samples, in the features' units.

    Differs from the source: pairs are of two different samples, drawn anew each, so
    that the mean is unbiased; there two random subsets are paired, and a sample may
    meet itself.

    Features are one row a sample, of all conditions together; the source draws 200 or
    300 pairs.

    Source: Guo et al. 2020 (Action2Motion).
    """
    first, second = _random_pairs(key, features.shape[0], num_pairs)
    gap = features[first] - features[second]
    return jnp.mean(jnp.linalg.norm(gap, axis=-1))


@functools.partial(jax.jit, static_argnames=("num_pairs",))
def multimodality(
    key: Key, features: Float[Array, "conditions repeats features"], *, num_pairs: int
) -> Float[Array, ""]:
    """Mean Euclidean distance of random pairs of samples of the same condition.

    In the features' units; `num_pairs` are of each condition (the source: 10 or 20).

    Source: Guo et al. 2020 (Action2Motion), with pairs of two different samples.
    """

    def of_one(key: Key, repeats: Array) -> Array:
        return diversity(key, repeats, num_pairs=num_pairs)

    keys = jax.random.split(key, features.shape[0])
    return jnp.mean(jax.vmap(of_one)(keys, features))


@functools.partial(jax.jit, static_argnames=("num_pairs",))
def joint_distance(
    key: Key, positions: Float[Array, "samples frames joints 3"], *, num_pairs: int
) -> Float[Array, ""]:
    """Mean distance, meters, of a joint in one sample to the same joint in another.

    Over random pairs of two different samples, their frames and joints. Unlike
    `diversity` it has the unit of a length and does not grow with frames or joints.
    Positions are world for the whole rollout, root-local for the pose alone.
    """

    def distance(pair: tuple[Array, Array]) -> Array:
        gap = positions[pair[0]] - positions[pair[1]]
        return jnp.mean(jnp.linalg.norm(gap, axis=-1))

    # Few at a time: all pairs at once would be larger than the samples.
    pairs = _random_pairs(key, positions.shape[0], num_pairs)
    return jnp.mean(jax.lax.map(distance, pairs, batch_size=16))


@jax.jit
def intra_style_variance(
    positions: Float[Array, "repeats frames joints 3"],
) -> Float[Array, ""]:
    """Variance of joint positions over repeats of one style and one control.

    Square meters, summed over the three axes. The paper's definition of diversity is a
    sentence: the variance of each joint's spatial location, averaged over all joints,
    of motions generated with the same control. Here: at each frame and joint the mean
    squared distance to the mean over the repeats, unbiased, averaged over frames and
    joints. Positions as in `joint_distance`.

    Source: Chen et al. 2024 (CAMDM), sec. 4.1, metric 4 (no code was released).
    """
    repeats = positions.shape[0]
    if repeats < 2:
        raise ValueError(f"{repeats} repeats, expected at least 2 to have a variance")
    gap = positions - jnp.mean(positions, axis=0, keepdims=True)
    variance = jnp.sum(gap * gap, axis=(0, -1)) / (repeats - 1)
    return jnp.mean(variance)
