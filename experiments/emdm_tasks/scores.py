"""Replications as rows of a table."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxmotion.evaluation import table
from jaxmotion.evaluation.table import Cell

# Order of the columns; compiled programs return dictionaries in alphabetical order.
_ORDER = (
    "R-precision 1",
    "R-precision 2",
    "R-precision 3",
    "FID",
    "accuracy",
    "MM-Dist",
    "diversity",
    "multimodality",
)


def cells(scores: list[dict[str, Array]]) -> dict[str, Cell]:
    """Means over replications with 95 % intervals.

    Args:
      scores: One dictionary a replication.

    Returns:
      A row of the table.
    """
    names = sorted(
        scores[0],
        key=lambda name: _ORDER.index(name) if name in _ORDER else len(_ORDER),
    )
    return {
        name: table.cell(jnp.stack([one[name] for one in scores])) for name in names
    }
