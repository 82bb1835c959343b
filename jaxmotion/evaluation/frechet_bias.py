"""How far a Fréchet distance depends on the number of samples, and its value without.

Moments of N samples have errors of order 1 / sqrt(N), and the distance is convex in
them, so that it is too large by

    E d^2_N = d^2 + c / N + O(1 / N^2)                                            (1)

c differs from model to model: distances of equal N need not be in the order of the true
ones. The line through distances of several N against 1 / N meets 1 / N = 0 at an
estimate of d^2 without that bias.

Source: Chong and Forsyth 2020, "Effectively Unbiased FID and Inception Score and where
to find them".
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.evaluation import frechet
from jaxmotion.typing import Key


class BiasCheck(NamedTuple):
    """Distances of subsets, and the line through them.

    Attributes:
      sizes: Samples of a subset, N.
      distances: Distances of each subset, in squared units of the features.
      extrapolated: The line at N = infinity; may be negative where the distance is
        about zero.
      slope: c of (1): by how much a distance of N samples is too large, times N.
    """

    sizes: Float[Array, " sizes"]
    distances: Float[Array, "sizes repeats"]
    extrapolated: Float[Array, ""]
    slope: Float[Array, ""]


def subset_sizes(count: int, *, number: int = 15, least: int) -> tuple[int, ...]:
    """Ascending sizes evenly spaced from the least to all samples, as in the source.

    Fewer than two different sizes raise `ValueError`. The least is at least the number
    of features (the source: 5,000 for 2,048): below it (1) has further terms, and the
    line misses them.
    """
    if number < 2 or not 2 <= least <= count - number + 1:
        raise ValueError(
            f"{number} sizes from {least} to {count} samples: expected 2 sizes or "
            "more, from 2 samples or more, and a sample between neighbors"
        )
    step = (count - least) / (number - 1)
    return tuple(round(least + i * step) for i in range(number))


@functools.partial(jax.jit, static_argnames=("sizes", "repeats"))
def frechet_bias(
    key: Key,
    features: Float[Array, "samples features"],
    reference: frechet.Moments,
    *,
    sizes: tuple[int, ...],
    repeats: int = 1,
) -> BiasCheck:
    """Distances of random subsets of several sizes, extrapolated to infinitely many.

    Subsets are drawn without replacement. Subsets of one set of samples overlap, so the
    scatter of their distances is no measure of the error of the extrapolated value:
    repeat it with independent samples for that. What the reference lacks in samples is
    not extrapolated away.

    The sizes, two at least, are in 2..samples (else `ValueError`).

    Source: Chong and Forsyth 2020, sec. 3; theirs is one subset of each of 15 sizes.
    """
    count = features.shape[0]
    if len(set(sizes)) < 2 or min(sizes) < 2 or max(sizes) > count or repeats < 1:
        raise ValueError(
            f"{repeats} subsets of sizes {sizes} of {count} samples: expected a subset "
            f"or more of two different sizes or more, each in 2..{count}"
        )

    def distance(x: tuple[Array, Array]) -> Array:
        key, size = x
        rank = jax.random.permutation(key, count)
        chosen = frechet.masked_moments(features, rank < size)
        return frechet.frechet_distance(chosen, reference)

    each = jnp.repeat(jnp.asarray(sizes), repeats)
    keys = jax.random.split(key, each.shape[0])
    distances = jax.lax.map(distance, (keys, each))
    slope, extrapolated = jnp.polyfit(1.0 / each.astype(distances.dtype), distances, 1)
    return BiasCheck(
        sizes=jnp.asarray(sizes, distances.dtype),
        distances=distances.reshape(len(sizes), repeats),
        extrapolated=extrapolated,
        slope=slope,
    )
