"""What scores the rows of one run."""

import dataclasses
from collections.abc import Callable
from typing import Any

from jaxtyping import Array

from jaxmotion.evaluation.by_frame import ByFrame
from jaxmotion.evaluation.table import Cell
from jaxmotion.systems.emdm import model as emdm_model


@dataclasses.dataclass(frozen=True, kw_only=True)
class Judge:
    """An evaluator with the rows of real motions.

    Attributes:
      real: Rows of real motions.
      score: `(key, many) -> scores` of one replication of what `many` samples.
      scale: Of the guidance; None for none.
      one: Condition of one motion, to measure times with.
      samples: Motions of a replication.
      describe: JSON that says what the evaluator is.
      notes: Lines below the table.
      by_frame: `(key, many) -> jerk and slide by place in a token`; None where motions
        have no joints in the world.
    """

    real: dict[str, dict[str, Cell]]
    score: Callable[[Array, Callable[..., Array]], dict[str, Array]]
    scale: Array | None
    one: emdm_model.Condition
    samples: int
    describe: dict[str, Any]
    notes: tuple[str, ...] = ()
    by_frame: Callable[[Array, Callable[..., Array], int], ByFrame] | None = None
