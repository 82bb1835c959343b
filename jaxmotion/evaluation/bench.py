"""One evaluation of several models of a system: points, budgets, rows and times.

A point is a model with a number of steps. All points are trained with the same budget,
scored with the same noise, commands and samples, and timed in turn, so that what
disturbs one disturbs all. A system declares its `Bench`; what scores its motion is in
the system's package, and stands there once, for a table of its own too.
"""

import dataclasses
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from jaxmotion.evaluation import statistics, timing
from jaxmotion.evaluation.table import Cell, Row, Rows
from jaxmotion.typing import Key

# Rows of recorded motion, in the table of every sweep.
GROUND_TRUTH = "ground truth (held-out clips)"
NOISE_FLOOR = "noise floor (training clips)"  # one half of them against the other
REFERENCE = "training clips (in the reference)"  # drawn from what they are scored on


@dataclasses.dataclass(frozen=True, kw_only=True)
class Point:
    """One model of a sweep.

    Attributes:
      name: As on the command line, and in the plot: "8", or "2+3".
      row: Its row in the table.
      folder: Name for files and folders.
      parts: Steps; for AAMDM polish steps and draft steps.
      teacher: Name of the point that it is distilled from; None for none.
    """

    name: str
    row: str
    folder: str
    parts: tuple[int, ...]
    teacher: str | None = None

    @property
    def steps(self) -> int:
        """Network calls of one sample."""
        return sum(self.parts)


def _number(text: str, least: int) -> int:
    if not re.fullmatch(r"[0-9]+", text) or int(text) < least:
        raise ValueError(
            f"steps: {text!r} is no number of steps, expected a whole number of at "
            f"least {least}"
        )
    return int(text)


def _check_distinct(points: Sequence[Point]) -> tuple[Point, ...]:
    if not points:
        raise ValueError("steps: there are none, expected at least one number of steps")
    seen: set[str] = set()
    for point in points:
        if point.folder in seen:
            raise ValueError(
                f"steps: {point.row} is given twice, expected distinct ones"
            )
        seen.add(point.folder)
    return tuple(points)


def plain_points(texts: Sequence[str]) -> tuple[Point, ...]:
    """Numbers of steps T, from texts such as "8".

    Raises `ValueError` if one is no positive number, or given twice.
    """
    numbers = [_number(text, 1) for text in texts]
    return _check_distinct(
        [
            Point(name=str(n), row=f"T = {n}", folder=f"T{n}", parts=(n,))
            for n in numbers
        ]
    )


def taught_points(texts: Sequence[str]) -> tuple[Point, ...]:
    """Numbers of steps T, and students of such models, in this order.

    A text is "8" for a model of 8 steps, or "1/8" for its student of 1 step, which
    comes after it. `ValueError` if one is neither, is given twice, or has no teacher
    before it.
    """
    points: list[Point] = []
    for text in texts:
        steps, slash, total = text.partition("/")
        if not slash:
            points += plain_points([text])
            continue
        (teacher,), number = plain_points([total]), _number(steps, 1)
        if number > teacher.steps or teacher.name not in {one.name for one in points}:
            raise ValueError(
                f"steps: {text!r}, expected at most {total} steps of a student, and "
                f"{total!r}, its teacher, before it"
            )
        points.append(
            Point(
                name=f"{number}/{teacher.name}",
                row=f"{number} of {teacher.row}, distilled",
                folder=f"{teacher.folder}_student{number}",
                parts=(number,),
                teacher=teacher.name,
            )
        )
    return _check_distinct(points)


def paired_points(texts: Sequence[str]) -> tuple[Point, ...]:
    """Polish steps preceded by draft steps, in this order.

    A text is "2+3" for 2 polish steps after 3 draft steps (either may be 0), or "2" for
    2 after the paper's 3. `ValueError` if one is neither, has no step, or is given
    twice.
    """
    points = []
    for text in texts:
        polish, plus, draft = text.partition("+")
        both = (
            (_number(polish, 0), _number(draft, 0)) if plus else (_number(polish, 1), 3)
        )
        if sum(both) < 1:
            raise ValueError(f"steps: {text!r} has no step, expected at least one")
        points.append(
            Point(
                name=f"{both[0]}+{both[1]}",
                row=f"{both[0]} polish + {both[1]} draft",
                folder=f"polish{both[0]}_draft{both[1]}",
                parts=both,
            )
        )
    return _check_distinct(points)


BudgetName = Literal["quick", "full"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Amount:
    """One number of a budget.

    Attributes:
      quick: For half an hour of two cores, training of five models included.
      full: As long as the figures of the README, or longer.
      training: Whether trained models depend on it; otherwise only their evaluation.
    """

    quick: float | int
    full: float | int
    meaning: str
    training: bool = True


Amounts = dict[str, Amount]
Budget = dict[str, Any]


def resolve(amounts: Amounts, name: str, changes: Sequence[str] = ()) -> Budget:
    """The numbers of a budget ("quick" or "full"), some changed by "number=value".

    They are whole where the budget's are; a `ValueError` names the field that is wrong.
    """
    if name not in BudgetName.__args__:
        raise ValueError(
            f"budget: unknown budget {name!r}, expected "
            f"{' or '.join(BudgetName.__args__)}"
        )
    found = {key: getattr(amount, name) for key, amount in amounts.items()}
    for change in changes:
        key, equals, text = change.partition("=")
        if not equals or key not in found:
            raise ValueError(
                f"change: {change!r} changes no number of the budget, expected "
                f"name=value with a name of {', '.join(found)}"
            )
        kind = type(found[key])
        try:
            value = kind(text)
        except ValueError:
            what = "a whole number" if kind is int else "a number"
            raise ValueError(f"change: {change!r}, expected {what}") from None
        if not 0 < value < float("inf"):
            raise ValueError(f"change: {change!r}, expected a positive number")
        found[key] = value
    return found


def training_part(amounts: Amounts, budget: Budget) -> Budget:
    """The numbers of a budget that trained models depend on."""
    return {key: budget[key] for key, amount in amounts.items() if amount.training}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Job:
    """One sweep of one system.

    Attributes:
      data: Files of clips.
      models: Folder of the trained models.
      evaluator: A frozen evaluator; None to train one.
    """

    points: tuple[Point, ...]
    data: tuple[Path, ...]
    models: Path
    budget: Budget
    replications: int
    seed: int
    evaluator: Any = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluation:
    """The same evaluation for every trained model of a sweep.

    Attributes:
      real: Rows of recorded motion: `GROUND_TRUTH`, and `NOISE_FLOOR` or `REFERENCE`.
      score: Row of a model; every model gets the same noise and commands.
      sampler: A jitted function of a key that makes one sample at batch 1, with the
        parameters as constants.
      describe: JSON: data source, sample counts, evaluator.
    """

    real: Rows
    score: Callable[[Point], Row]
    sampler: Callable[[Point], Callable[[Key], Any]]
    describe: dict[str, Any]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bench:
    """What a system with a number of steps brings to a sweep.

    Attributes:
      data: Files of clips, where none are given.
      points: Reads step counts: `texts -> points`.
      train: The command of the system's script, with its options, that leaves a point's
        model in the job's folder; one that is there is left alone.
      show: That command of the script, with its options, that writes a motion of a
        point's model to look at, but for the folder that it writes to.
      prepare: The evaluation of a job whose models are trained.
      quality: Column of the plot, lower is better.
      sample: What one sample is, for the time at batch 1.
      evaluator: Kind of its evaluator; None if it needs none.
    """

    data: tuple[Path, ...]
    amounts: Amounts
    points: Callable[..., tuple[Point, ...]]
    train: Callable[[Job, Point], tuple[str, dict[str, Any]]]
    show: Callable[[Job, Point], tuple[str, dict[str, Any]]]
    prepare: Callable[[Job], Evaluation]
    quality: str
    sample: str
    evaluator: str | None = None


def _key(i: int) -> tuple[Key]:
    return (jax.random.key(i),)


def call_time(
    run: Callable[[Key], Any], *, parts: int = 1, seconds: float = 2.0, least: int = 5
) -> Cell:
    """Median time of one call, milliseconds, with the ends of the middle half.

    For a column beside the scores; benchmarks measure better. The time is that of one
    of the call's parts, such as its frames.
    """
    times = timing.time_calls(
        run, arguments=_key, rounds=200, warmup=2, limit_s=seconds, least=least
    )
    low, middle, high = (float(x) for x in np.quantile(times, [0.25, 0.5, 0.75]))
    return Cell(
        value=middle / parts, low=low / parts, high=high / parts, samples=times.size
    )


def time_cells(times: np.ndarray, *, seed: int) -> Row:
    """Median of milliseconds with its 95 % bootstrap interval, and 95th percentile."""
    found = statistics.bootstrap_interval(times, np.median, seed=seed)
    return {
        "p50": Cell(
            value=found.estimate, low=found.low, high=found.high, samples=times.size
        ),
        "p95": Cell(value=float(np.percentile(times, 95)), samples=times.size),
    }


def measure(evaluation: Evaluation, job: Job) -> tuple[Rows, dict[str, float]]:
    """Scores all models, then times them in turn.

    With the table come the seconds that each row's scores took.
    """
    rows, seconds = dict(evaluation.real), {}
    for point in job.points:
        started = time.perf_counter()
        rows[point.row] = evaluation.score(point)
        seconds[f"scores, {point.row}"] = time.perf_counter() - started
        print(f"{point.row}: scored", flush=True)
    calls = {point.row: evaluation.sampler(point) for point in job.points}
    times = timing.time_in_turn(calls, arguments=_key, rounds=100, warmup=2, least=10)
    for row, found in times.items():
        rows[row] = rows[row] | time_cells(found[:, 0], seed=job.seed)
    return rows, seconds


def has_failed(cells: Row) -> bool:
    """Whether most rollouts diverge or freeze; then no distance speaks for them."""
    counts = [cells[name] for name in ("diverged", "frozen") if name in cells]
    return any(2 * cell.value > cell.samples for cell in counts)
