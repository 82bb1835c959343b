"""Replications as rows of a table."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxmotion.evaluation import table
from jaxmotion.evaluation.table import Cell


def cells(scores: list[dict[str, Array]]) -> dict[str, Cell]:
    """Means over replications with 95 % intervals.

    Args:
      scores: One dictionary a replication.

    Returns:
      A row of the table.
    """
    return {
        name: table.cell(jnp.stack([one[name] for one in scores])) for name in scores[0]
    }
