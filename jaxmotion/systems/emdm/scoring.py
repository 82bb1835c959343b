"""What scores the rows of one run, from actions and from texts alike."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
from jaxtyping import Array

from jaxmotion.evaluation import table
from jaxmotion.evaluation.by_frame import ByFrame
from jaxmotion.evaluation.table import Row, Rows
from jaxmotion.evaluators.frozen import Evaluator
from jaxmotion.evaluators.text_motion import Padding
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.typing import Key

Scores = dict[str, Array]
# Samples motions: `(key, conditions, scale) -> motions`.
Many = Callable[..., Array]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """How rows are scored.

    Attributes:
      samples: Motions of a replication (actions: rounded down to as many of each).
      replications: Sets of motions of each row.
      scale: Scale of classifier-free guidance; None for the paper's.
      evaluator_steps: Updates of an evaluator that is trained here; None for 1500 of
        that of actions, 600 of that of texts.
      evaluator: A frozen evaluator of actions; None to train one.
      matcher: Published weights of the text-motion evaluator; None to train one.
      glove: Folder of the word vectors that they read.
      padding: What the text-motion evaluator sees beyond the end of generated motions.
      foot_lock: Generated motions are cleaned (`control.foot_lock.clean_motion`).
      seed: Seeds noise and pairs.
    """

    samples: int = 1000
    replications: int = 20
    scale: float | None = None
    evaluator_steps: int | None = None
    evaluator: Evaluator | None = None
    matcher: Path | None = None
    glove: Path | None = None
    padding: Padding = "zeros"
    foot_lock: bool = False
    seed: int = 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class RowScorer:
    """An evaluator with the rows of real motions.

    Attributes:
      real: Rows of real motions.
      score: `(key, many) -> scores` of one replication of what `many` samples.
      scale: Scale of the guidance; None for none.
      one: Condition of one motion, to measure times with.
      samples: Motions of a replication.
      describe: JSON that says what the evaluator is.
      notes: Lines below the table.
      by_frame: `(key, many, frames a token) -> jerk and slide by place in a token`;
        None where motions have no joints in the world.
    """

    real: Rows
    score: Callable[[Key, Many], Scores]
    scale: Array | None
    one: emdm_model.Condition
    samples: int
    describe: dict[str, Any]
    notes: tuple[str, ...] = ()
    by_frame: Callable[[Key, Many, int], ByFrame] | None = None


def replicated_row(key: Key, score: Callable[[Key], Scores], *, number: int) -> Row:
    """Means and intervals of a score over replications with keys of their own."""
    return table.row([score(key) for key in jax.random.split(key, number)])
