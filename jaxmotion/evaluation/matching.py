"""How well motions match their sentences, in the space of a text-motion evaluator.

Row i of the sentences' embeddings belongs to row i of the motions'. Both measures use
the Euclidean distance.

Source: Guo et al. 2022 (T2M), section 5 and released code.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def _check(text: Array, motion: Array) -> None:
    if text.shape != motion.shape:
        raise ValueError(
            f"sentences {text.shape} and motions {motion.shape}: expected one shape"
        )


@functools.partial(jax.jit, static_argnames=("top", "pool"))
def r_precision(
    text: Float[Array, "samples embedding"],
    motion: Float[Array, "samples embedding"],
    *,
    top: int = 3,
    pool: int = 32,
) -> Float[Array, " top"]:
    """How often a sentence's own motion is among the nearest of a pool.

    Consecutive rows make a pool, so rows should come in random order; those that fill
    no pool are left out, as in the source. A motion tied with others counts by the
    chance that it comes first in a random order of them: embeddings that are all equal
    score k / pool, not 1. The source leaves the order of ties to its sorting routine.

    Pools may hold the same sentence twice. Nothing can then tell which of the two
    motions is meant, and real motions too score below 1: compare only figures of the
    same pools, or of many.

    Fractions for k = 1..top, in 0..1; NaN if an embedding is. `ValueError` if there are
    fewer samples than a pool, or shapes differ.

    Source: Guo et al. 2022 (T2M), R-precision.
    """
    _check(text, motion)
    if not 1 <= top <= pool:
        raise ValueError(f"top {top}, expected 1..{pool}, the size of a pool")
    pools = text.shape[0] // pool
    if pools == 0:
        raise ValueError(f"{text.shape[0]} samples, expected at least a pool of {pool}")

    def hits(rows: tuple[Array, Array]) -> Array:
        # Differences, not the expanded square: equal motions are then equally far.
        gap = rows[0][:, None] - rows[1][None]
        squared = jnp.sum(gap * gap, axis=-1)
        own = jnp.diagonal(squared)[:, None]
        closer = jnp.sum(squared < own, axis=-1)
        tied = jnp.sum(squared == own, axis=-1)
        k = jnp.arange(1, top + 1)
        chance = (k[None] - closer[:, None]) / tied[:, None]
        chance = jnp.where(jnp.isnan(own), jnp.nan, jnp.clip(chance, 0.0, 1.0))
        return jnp.mean(chance, axis=0)

    cut = lambda x: x[: pools * pool].reshape(pools, pool, -1)  # noqa: E731
    return jnp.mean(jax.lax.map(hits, (cut(text), cut(motion))), axis=0)


@jax.jit
def matching_distance(
    text: Float[Array, "samples embedding"], motion: Float[Array, "samples embedding"]
) -> Float[Array, ""]:
    """Mean Euclidean distance of sentences to their own motions (MM-Dist).

    In units of the embedding, over all rows.

    Source: Guo et al. 2022 (T2M), multimodal distance.
    """
    _check(text, motion)
    return jnp.mean(jnp.linalg.norm(text - motion, axis=-1))
