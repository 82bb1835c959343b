"""Cells of a table from what was measured: scores of replications, and times."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxmotion.evaluation import table
from jaxmotion.evaluation.table import Cell
from jaxmotion.typing import Key

# Words in the names of scores that lie in 0..1.
_PROPORTIONS = ("accuracy", "precision", "ratio", "missed part")


def row(
    scores: Sequence[dict[str, Array]], *, order: Sequence[str] = ()
) -> dict[str, Cell]:
    """Means over replications with 95 % intervals, those of proportions in 0..1.

    Args:
      scores: One dictionary a replication, of the same names.
      order: Names in the order of the table's columns; others come behind. Compiled
        programs return dictionaries in alphabetical order.

    Returns:
      A row of the table.
    """

    def bounds(name: str) -> tuple[float, float]:
        is_proportion = any(word in name for word in _PROPORTIONS)
        return (0.0, 1.0) if is_proportion else (-np.inf, np.inf)

    places = {name: i for i, name in enumerate(order)}
    names = sorted(scores[0], key=lambda name: places.get(name, len(places)))
    return {
        name: table.cell(jnp.stack([one[name] for one in scores]), bounds=bounds(name))
        for name in names
    }


def milliseconds(
    run: Callable[[Key], Any], *, parts: int = 1, seconds: float = 2.0, least: int = 5
) -> Cell:
    """Time of one call, for a column beside the scores; benchmarks measure better.

    Args:
      run: A jitted function of a key, whose result is waited for; the first call, which
        compiles, does not count.
      parts: Of the call's time that is given, such as its frames.
      seconds: Calls go on for so long, but for no more than 200 of them.
      least: Number of calls, at least.

    Returns:
      Median, with the ends of the middle half.
    """
    jax.block_until_ready(run(jax.random.key(0)))
    times: list[float] = []
    while len(times) < least or (sum(times) < seconds and len(times) < 200):
        key = jax.random.key(len(times))
        begun = time.perf_counter()
        jax.block_until_ready(run(key))
        times.append(time.perf_counter() - begun)
    low, middle, high = np.quantile(times, [0.25, 0.5, 0.75]) * 1000 / parts
    return Cell(
        value=float(middle), low=float(low), high=float(high), samples=len(times)
    )
