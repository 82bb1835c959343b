"""Confidence intervals for tables."""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.motion.spring import Scalar
from jaxmotion.typing import Key


class Interval(NamedTuple):
    """An estimate and the ends of its confidence interval."""

    estimate: Float[Array, ""]
    low: Float[Array, ""]
    high: Float[Array, ""]


def _student_quantile(upper: Array, freedom: int) -> Array:
    """Where Student's distribution function is 1 - upper, for 0 < upper < 1/2."""
    # P(|T| < t) = I_u(1 / 2, freedom / 2) at u = t^2 / (freedom + t^2), which grows
    # with u; bisection in u needs no derivative and no starting point.
    half = jnp.asarray(freedom / 2, upper.dtype)

    def bisect(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        is_low = jax.scipy.special.betainc(0.5, half, middle) < 1.0 - 2.0 * upper
        return jnp.where(is_low, middle, low), jnp.where(is_low, high, middle)

    ends = (jnp.zeros_like(upper), jnp.ones_like(upper))
    low, high = jax.lax.fori_loop(0, 60, bisect, ends)
    u = 0.5 * (low + high)
    return jnp.sqrt(freedom * u / (1.0 - u))


@functools.partial(jax.jit, static_argnames=("method",))
def confidence_interval(
    samples: Float[Array, " samples"],
    *,
    level: Scalar = 0.95,
    method: Literal["t", "normal"] = "t",
) -> Interval:
    """Mean of independent samples with its confidence interval.

    Args:
      samples: For example one value a seed or a clip.
      level: Probability that the interval holds the mean, in (0, 1).
      method: Student's "t", right for few samples of a Gaussian; or "normal", the
        1.96 of the literature on text to motion. Both take the deviation with n - 1
        (ddof=1); the released scripts of text to motion divide by n (NumPy's default),
        so their half widths are sqrt(1 - 1 / n) of "normal": 2.5 % less for n = 20.

    Returns:
      Mean, and mean minus and plus the half width.

    Raises:
      ValueError: if there are fewer than two samples or the method is neither.

    Source: Student 1908.
    """
    count = samples.shape[0]
    if count < 2:
        raise ValueError(f"{count} samples, expected at least 2 to have an interval")
    if method not in ("t", "normal"):
        raise ValueError(f"method is {method!r}, expected 't' or 'normal'")
    upper = jnp.asarray((1.0 - level) / 2.0, samples.dtype)
    if method == "t":
        quantile = _student_quantile(upper, count - 1)
    else:
        quantile = -jax.scipy.special.ndtri(upper)
    mean = jnp.mean(samples)
    half_width = quantile * jnp.std(samples, ddof=1) / jnp.sqrt(1.0 * count)
    return Interval(estimate=mean, low=mean - half_width, high=mean + half_width)


def bootstrap_interval(
    key: Key,
    samples: Any,
    statistic: Callable[[Any], Float[Array, ""]],
    *,
    num_resamples: int = 1000,
    level: Scalar = 0.95,
) -> Interval:
    """Confidence interval of any statistic by resampling clips.

    Args:
      key: Consumed.
      samples: Arrays (one or a pytree of them) whose first axis is the clips; whole
        clips are drawn with replacement, because frames of one clip are not
        independent.
      statistic: Function of such arrays.
      num_resamples: How often to draw.
      level: Part of the resampled values that the interval holds, in (0, 1).

    Returns:
      Statistic of the samples themselves, and the percentile interval.

    Raises:
      ValueError: if there are fewer than two clips or their numbers differ.

    Source: Efron 1979.
    """
    counts = {leaf.shape[0] for leaf in jax.tree.leaves(samples)}
    if len(counts) != 1 or min(counts) < 2:
        raise ValueError(f"numbers of clips {sorted(counts)}, expected one, at least 2")
    count = counts.pop()

    def resampled(key: Key) -> Array:
        chosen = jax.random.randint(key, (count,), 0, count)
        return statistic(jax.tree.map(lambda leaf: leaf[chosen], samples))

    values = jax.lax.map(resampled, jax.random.split(key, num_resamples), batch_size=64)
    tail = (1.0 - level) / 2.0
    low, high = jnp.quantile(values, jnp.asarray([tail, 1.0 - tail]))
    return Interval(estimate=statistic(samples), low=low, high=high)
