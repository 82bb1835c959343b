"""Cells of a table from what was measured: scores of replications, and times."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxmotion.evaluation import table
from jaxmotion.evaluation.table import Cell

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
