"""Times of one sample, of all models in one run."""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxmotion.evaluation import statistics
from jaxmotion.evaluation.table import Cell

ROUNDS, LIMIT_S, LEAST = 100, 60.0, 10


def milliseconds(calls: dict[str, Callable[[Array], Any]]) -> dict[str, np.ndarray]:
    """Times several programs in turn, so that what disturbs one disturbs all.

    Args:
      calls: Jitted functions of a key, by name; two calls of each before the others
        compile it and warm it up.

    Returns:
      Milliseconds of each call: 100 rounds, fewer where they take more than a minute.
    """
    names = list(calls)
    for name in names:
        for i in range(2):
            jax.block_until_ready(calls[name](jax.random.key(i)))
    times: dict[str, list[float]] = {name: [] for name in names}
    begun = time.perf_counter()
    for i in range(ROUNDS):
        # The order moves on, so that none always runs behind the same other.
        turn = i % len(names)
        for name in names[turn:] + names[:turn]:
            key = jax.random.key(i)
            start = time.perf_counter()
            jax.block_until_ready(calls[name](key))
            times[name].append(1000 * (time.perf_counter() - start))
        if i + 1 >= LEAST and time.perf_counter() - begun > LIMIT_S:
            break
    return {name: np.array(found) for name, found in times.items()}


def cells(times: np.ndarray, *, seed: int) -> dict[str, Cell]:
    """Median with its 95 % bootstrap interval, and 95th percentile.

    Args:
      times: Milliseconds.
      seed: Of the resamples.

    Returns:
      Two columns.
    """
    found = statistics.bootstrap_interval(
        jax.random.key(seed), jnp.asarray(times, jnp.float32), jnp.median
    )
    estimate, low, high = (float(x) for x in found)
    return {
        "p50 ms": Cell(value=estimate, low=low, high=high, samples=times.size),
        "p95 ms": Cell(value=float(np.percentile(times, 95)), samples=times.size),
    }
