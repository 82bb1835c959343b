"""Fréchet distance between Gaussians fitted to features.

    d^2 = |m_a - m_b|^2 + tr A + tr B - 2 tr (A^{1/2} B A^{1/2})^{1/2}            (1)

The last trace is the sum of the singular values of A^{1/2} B^{1/2}: no root of a
rounding error is taken, which is what makes (1) by eigenvalues alone unusable in
float32. The square roots drop eigenvalues below the rounding error of the largest.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Moments:
    """Mean and covariance, unbiased (divided by count - 1), of features.

    Leading axes come from `jax.vmap` over sets; the functions here take one set.
    """

    mean: Float[Array, "*batch features"]
    covariance: Float[Array, "*batch features features"]
    count: Float[Array, "*batch"]


@jax.jit
def moments(features: Float[Array, "samples features"]) -> Moments:
    """Mean and unbiased covariance of one row per sample, two at least."""
    count = features.shape[0]
    if count < 2:
        raise ValueError(f"{count} samples, expected at least 2 to have a covariance")
    mean = jnp.mean(features, axis=0)
    centered = features - mean[None]
    covariance = jnp.matmul(centered.T, centered, precision="highest") / (count - 1)
    return Moments(
        mean=mean, covariance=covariance, count=jnp.asarray(count, features.dtype)
    )


@jax.jit
def masked_moments(
    features: Float[Array, "samples features"], mask: Bool[Array, " samples"]
) -> Moments:
    """Moments of the rows that count; how many is no part of the shape.

    One program thus serves subsets of any size. The covariance is NaN where fewer than
    two rows count.
    """
    weight = mask.astype(features.dtype)[:, None]
    count = jnp.sum(weight)
    mean = jnp.sum(features * weight, axis=0) / count
    centered = (features - mean[None]) * weight
    scatter = jnp.matmul(centered.T, centered, precision="highest")
    covariance = jnp.where(count > 1, scatter / (count - 1), jnp.nan)
    return Moments(mean=mean, covariance=covariance, count=count)


def _square_root(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    values, vectors = jnp.linalg.eigh(matrix)
    floor = matrix.shape[0] * jnp.finfo(matrix.dtype).eps * jnp.max(jnp.abs(values))
    root = jnp.sqrt(jnp.where(values > floor, values, 0.0))
    return jnp.matmul(vectors * root[None], vectors.T, precision="highest")


@jax.jit
def frechet_distance(a: Moments, b: Moments) -> Float[Array, ""]:
    """Squared Fréchet (Wasserstein-2) distance of two Gaussians: (1) of this module.

    The usual FID, not divided by the number of features, in their squared units, not
    negative. Fewer samples than features are allowed, though the estimate is then
    biased upwards: compare only distances of equal counts. In float32 the error
    measured with 512 features is 1e-4 of tr A + tr B where covariances are nearly
    singular, below 1e-6 elsewhere; 64-bit inputs need `jax.enable_x64`.

    Source: Dowson and Landau 1982; Heusel et al. 2017.
    """
    gap = a.mean - b.mean
    product = jnp.matmul(
        _square_root(a.covariance), _square_root(b.covariance), precision="highest"
    )
    cross = jnp.sum(jnp.linalg.svd(product, compute_uv=False))
    spread = jnp.trace(a.covariance) + jnp.trace(b.covariance) - 2.0 * cross
    return jnp.sum(gap * gap) + jnp.maximum(spread, 0.0)


@jax.jit
def frechet_distance_of_rows(
    a: Float[Array, "rows features"],
    count_a: Int[Array, ""],
    b: Float[Array, "others features"],
    count_b: Int[Array, ""],
) -> Float[Array, ""]:
    """Squared Fréchet distance of the Gaussians fitted to two sets of few rows.

    In squared units of the features, not negative; NaN where fewer than two rows count.
    With centered rows X and Y divided by the root of their number less one, the last
    trace of (1) is the sum of the singular values of X Y^T: no covariance is formed, so
    that singular ones lose nothing. Rows from their count on are padding.
    """

    def centered(x: Array, count: Array) -> tuple[Array, Array]:
        own = (jnp.arange(len(x)) < count)[:, None]
        mean = jnp.mean(x, axis=0, where=own)
        spread = jnp.where(own, x - mean[None], 0.0)
        return mean, spread / jnp.sqrt(jnp.maximum(count - 1, 1).astype(x.dtype))

    (m_a, x), (m_b, y) = centered(a, count_a), centered(b, count_b)
    product = jnp.matmul(x, y.T, precision="highest")
    cross = jnp.sum(jnp.linalg.svd(product, compute_uv=False))
    spread = jnp.sum(x * x) + jnp.sum(y * y) - 2.0 * cross
    distance = jnp.sum((m_a - m_b) ** 2) + jnp.maximum(spread, 0.0)
    return jnp.where((count_a > 1) & (count_b > 1), distance, jnp.nan)
