"""What a system brings to a sweep."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxtyping import Array

from jaxmotion.evaluation.table import Cell
from jaxmotion.evaluators.frozen import Evaluator, Kind
from sweeps.budgets import Amounts
from sweeps.points import Point

Row = dict[str, Cell]
Rows = dict[str, Row]

# Rows of recorded motion, in every table.
GROUND_TRUTH = "ground truth (held-out clips)"
NOISE_FLOOR = "noise floor (training clips)"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Job:
    """One sweep of one system.

    Attributes:
      points: Step counts.
      data: Files of clips.
      models: Folder of the trained models.
      budget: Numbers, from `budgets.resolve`.
      replications: Of the evaluation.
      seed: Of everything random.
      evaluator: A frozen recognizer; None to train one.
    """

    points: tuple[Point, ...]
    data: tuple[Path, ...]
    models: Path
    budget: dict[str, Any]
    replications: int
    seed: int
    evaluator: Evaluator | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bench:
    """The same evaluation for every trained model of a sweep.

    Attributes:
      real: Rows of recorded motion: `GROUND_TRUTH` and `NOISE_FLOOR`.
      score: Row of a model; every model gets the same noise and commands.
      sampler: A jitted function of a key that makes one sample at batch 1, with the
        parameters as constants.
      rollout: Writes motion of a model into a folder that exists.
      describe: JSON: data source, sample counts, evaluator.
    """

    real: Rows
    score: Callable[[Point], Row]
    sampler: Callable[[Point], Callable[[Array], Any]]
    rollout: Callable[[Point, Path], None]
    describe: dict[str, Any]


@dataclasses.dataclass(frozen=True, kw_only=True)
class System:
    """A system with a number of steps to choose.

    Attributes:
      data: Files of clips, where none are given.
      amounts: Its budgets.
      points: Reads step counts: `(texts, drafts=...) -> points`.
      trainer: `(job) -> train`, where `train(point)` leaves a model in the job's
        folder; one that is there is left alone.
      bench: Prepares the evaluation of trained models.
      quality: Column of the plot, lower is better.
      sample: What one sample is, for the time at batch 1.
      judge: Kind of its recognizer; None if it is judged without one.
    """

    data: tuple[Path, ...]
    amounts: Amounts
    points: Callable[..., tuple[Point, ...]]
    trainer: Callable[[Job], Callable[[Point], None]]
    bench: Callable[[Job], Bench]
    quality: str
    sample: str
    judge: Kind | None = None
