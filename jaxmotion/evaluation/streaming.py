"""Moments of more samples than fit into the memory.

Chunks are made one after the other inside one compiled loop, and merged by Chan's
formula (`frechet.merge`), so memory holds a chunk and the moments whatever the number
of samples. float32 keeps it accurate because all is counted from the first chunk's
mean: what is summed then has the size of the deviations, not of the mean.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.evaluation import frechet

Chunk = Callable[[Int[Array, ""]], Float[Array, "samples features"]]


def streaming_moments(chunk: Chunk, *, num_chunks: int) -> frechet.Moments:
    """Mean and covariance of all chunks together; jit it as a whole.

    The count is a float32, exact up to 16,777,216 samples and rounded above.

    Args:
      chunk: `chunk(i) -> features` for i in 0..num_chunks - 1, traced; always the same
        number of samples, at least two. It may roll out characters, or cut windows
        out of clips.
      num_chunks: How many to make.

    Returns:
      The moments, as `frechet.moments` of all samples would be.

    Raises:
      ValueError: if there is no chunk, or chunks have fewer than two samples.

    Source: Chan et al. 1979.
    """
    if num_chunks < 1:
        raise ValueError(f"{num_chunks} chunks, expected 1 or more")
    first = chunk(jnp.zeros((), jnp.int32))
    origin = jnp.mean(first, axis=0)

    def merged(
        total: frechet.Moments, i: Int[Array, ""]
    ) -> tuple[frechet.Moments, None]:
        found = frechet.moments(chunk(i) - origin[None])
        return frechet.merge(total, found), None

    start = frechet.moments(first - origin[None])
    total, _ = jax.lax.scan(merged, start, jnp.arange(1, num_chunks))
    return dataclasses.replace(total, mean=total.mean + origin)
