"""Whether an ordering that a paper claims is seen in what was measured here."""

import dataclasses
import functools
import math
import operator
from collections.abc import Sequence
from typing import Literal

import numpy as np

from jaxmotion.evaluation import sequential, statistics
from jaxmotion.evaluation.statistics import Spread
from jaxmotion.evaluation.table import Cell
from reports.claims import Claim, Column, Row, Stated, Table
from reports.results import Found

Ends = tuple[float, float]
Verdict = Literal["reproduced", "not reproduced", "not decided", "not run"]

_QUANTILE = 1.96  # of the normal distribution, two-sided 95 %

# Familywise probability of a false verdict of a claim, on either side.
ALPHA = 0.05
# A claim that as many trainings leave open is given up.
MAX_TRAININGS = 12

RULE = (
    "A claim is a set of comparisons, each of two rows of one column. For each, the "
    "claimed difference is taken within every training: both rows have the same seed, "
    "data, commands and noise in their evaluation. A training without one of the rows, "
    "or with a value that is not finite, decides nothing.",
    "Trainings are added one at a time, and evidence is counted after each by a "
    "sequential t-test (`jaxmotion/evaluation/sequential.py`): the probability that it "
    "ever exceeds 1 / a without an effect is at most a, whenever one stops.",
    "A claim of k comparisons is **reproduced** once evidence for each has exceeded "
    f"{1 / ALPHA:g}, and **not reproduced** once evidence for the opposite of one has "
    f"exceeded {1 / ALPHA:g} k: either verdict is false with probability {ALPHA:g} at "
    "most. What comes first stands. It is **not run** if a row was not measured, and "
    f"else **not decided**; after {MAX_TRAININGS} trainings it stays so, and its "
    "interval says how large a difference may be.",
    "Trainings that a row's recipe was chosen on decide nothing.",
    "One training decides nothing, for intervals over its replications, clips or "
    "rollouts do not hold what another seed would change.",
    "Where the larger is claimed to be so many times the smaller, the difference is "
    "that of the logarithms of the larger and of so many times the smaller: a busy "
    "machine slows both by a factor. The bar is ours, below the paper's own ratio, "
    "since machines differ. Nearness to recorded motion compares distances to it.",
    "That two rows are alike is claimed with a margin: both that their difference is "
    "above its negative and that it is below it must hold (two one-sided tests). Of "
    f"its two opposites either has the bar {2 / ALPHA:g} k.",
    "Rows of several files that an evaluator scored are compared only if the files "
    "name the same evaluator and reference clips.",
    "Intervals of a claim's differences hold the mean at all numbers of trainings at "
    "once with 95 %; those of a cell are Student's, or of the file where it was "
    "trained once (Wilson's of counts).",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Decision:
    """A verdict, and what it rests on.

    Attributes:
      verdict: The verdict.
      reason: Comparisons that failed, are open or could not be made; or "".
      differences: By how much each comparison holds in each training; negative where it
        fails.
      trainings: Trainings until the verdict, or of the comparison that has fewest.
      open: Comparisons that several trainings have left open.
    """

    verdict: Verdict
    reason: str = ""
    differences: dict[tuple[str, str], np.ndarray] = dataclasses.field(
        default_factory=dict
    )
    trainings: int = 0
    open: tuple[tuple[str, str], ...] = ()


def cells_of(
    table: Table, row: Row, column: Column, found: Found
) -> tuple[Cell | None, ...]:
    """What was measured of each training, in the paper's unit.

    Args:
      table: The table.
      row: One of its rows.
      column: One of its columns.
      found: All that was measured.

    Returns:
      A cell a training; None if it was not measured.
    """
    measured, cells = found.get(table.source_of(row)), []
    if measured is None or row.here is None:
        return (None,)
    for one in measured.trainings:
        cell = one and one.rows.get(row.here, {}).get(column.here)
        if cell and column.scale != 1.0:
            ends = {name: getattr(cell, name) for name in ("value", "low", "high")}
            scaled = {k: x and x * column.scale for k, x in ends.items()}
            cell = dataclasses.replace(cell, **scaled)
        cells.append(cell)
    return tuple(cells)


def cell_of(table: Table, row: Row, column: Column, found: Found) -> Cell | None:
    """What was measured of the first training; None if it was not."""
    return cells_of(table, row, column, found)[0]


def over_trainings(
    table: Table, row: Row, column: Column, found: Found
) -> Spread | None:
    """Values of a cell over trainings; None if there are fewer than two.

    Nor for recorded motion, which is scored alike beside every training.
    """
    measured = found.get(table.source_of(row))
    there = filter(None, measured.trainings if measured else ())
    scored = [one.rows[row.here] for one in there if row.here in one.rows]
    if scored and all(cells == scored[0] for cells in scored):
        return None
    cells = cells_of(table, row, column, found)
    values = [cell.value for cell in cells if cell is not None]
    return statistics.spread(np.array(values)) if len(values) > 1 else None


def interval(spread: Spread) -> Ends:
    """The 95 % interval of a mean over trainings."""
    half = spread.half_width()
    return float(spread.mean - half), float(spread.mean + half)


def wilson(count: float, samples: int) -> Ends:
    """The 95 % interval of a count of so many samples (Wilson 1927)."""
    part, z2 = count / samples, _QUANTILE**2
    middle = (part + z2 / (2 * samples)) / (1 + z2 / samples)
    spread = part * (1 - part) / samples + z2 / (4 * samples**2)
    half = _QUANTILE / (1 + z2 / samples) * math.sqrt(spread)
    return samples * (middle - half), samples * (middle + half)


def printed(value: Stated) -> float | None:
    """The value alone of what a paper prints.

    Args:
      value: With or without the half width of its interval.

    Returns:
      The value; None if the paper prints none.
    """
    return value[0] if isinstance(value, tuple) else value


def _unseen(found: Found) -> Found:
    """Without the trainings that a recipe was chosen on."""
    made = dict(found)
    for source, measured in found.items():
        if measured is None or not source.chosen_on:
            continue
        kept = [
            x
            for x in measured.trainings
            if x is not None and not {*x.seeds} & {*source.chosen_on}
        ]
        made[source] = (
            dataclasses.replace(kept[0], again=tuple(kept[1:])) if kept else None
        )
    return made


def _paired(table: Table, rows: list[Row], found: Found) -> Found:
    """The trainings of the seeds that the files of all rows have, in their order.

    As they are where there is one file, where one says of no seed, or where each has
    one training, which nothing is paired of.
    """
    sources = {table.source_of(row) for row in rows}
    files = {source: x for source in sources if (x := found.get(source))}
    own = {
        source: {one.seeds: one for one in x.trainings if one is not None}
        for source, x in files.items()
    }
    one_each = all(len(seeds) == 1 for seeds in own.values())
    if len(own) <= 1 or one_each or any(() in seeds for seeds in own.values()):
        return found
    common = functools.reduce(operator.and_, (seeds.keys() for seeds in own.values()))
    kept = {source: [own[source][seed] for seed in sorted(common)] for source in own}
    return found | {
        source: dataclasses.replace(trained[0], again=tuple(trained[1:]))
        for source, trained in kept.items()
        if trained
    }


def _incomparable(table: Table, column: Column, rows: list[Row], found: Found) -> str:
    """Why rows of several files do not compare; "" if they do."""
    sources = {table.source_of(row) for row in rows}
    files = [x for source in sources if (x := found.get(source))]
    if len(files) <= 1:
        return ""
    several = any(len(x.trainings) > 1 for x in files)
    for trained in zip(*(x.trainings for x in files), strict=False):
        there = [x for x in trained if x is not None]
        evaluators = {x.evaluator for x in there}
        if column.evaluated and (len(evaluators) > 1 or None in evaluators):
            return "rows were scored by different or unrecorded evaluators"
        if several and len({x.seeds for x in there}) > 1:
            return "rows were trained with different seeds"
        # Where last digits of the same clips differ, checksums cannot tell.
        told = [x.about for x in there if "data" in x.about]
        rounded = any("rounded" in x for x in told)
        if not rounded and len({str(x["data"]) for x in told}) > 1:
            return "rows were trained on different data"
    return ""


def holds(claim: Claim, values: Sequence[float]) -> float:
    """By how much a comparison holds for the values of its rows.

    Args:
      claim: The claim.
      values: Of the smaller (nearer) row and of the larger (farther) one, and of that
        which they are near to.

    Returns:
      Positive where it holds, negative where it does not; for a claim of likeness, how
      far the difference is below the margin; for one of a factor a logarithm, not
      finite where a value is not positive.
    """
    first, second, *target = values
    if target:
        first, second = (abs(x - target[0]) for x in (first, second))
    if claim.factor is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            return float(np.log(second) - np.log(claim.factor * first))
    difference = second - first
    return difference if claim.margin is None else claim.margin - abs(difference)


def _compared(table: Table, claim: Claim, pair: tuple[str, str]) -> list[Row]:
    """The rows of a comparison, and that which they are to be near to."""
    names = (*pair, claim.toward) if claim.toward else pair
    return [table.row(name) for name in names]


def _differences(
    table: Table, claim: Claim, found: dict[tuple[str, str], Found]
) -> dict[tuple[str, str], np.ndarray]:
    """Claimed differences of pairs of rows, one per training that has both."""
    made, column = {}, table.column(claim.column)
    for pair, own in found.items():
        rows = _compared(table, claim, pair)
        cells = [cells_of(table, row, column, own) for row in rows]
        values = [
            [cell.value for cell in trained]
            for trained in zip(*cells, strict=False)
            if None not in trained
        ]
        plain = dataclasses.replace(claim, margin=None)
        own = np.array([holds(plain, x) for x in values])
        made[pair] = own[np.isfinite(own)][:MAX_TRAININGS]
    return made


def _first(evidence: np.ndarray, bar: float) -> float:
    """Trainings after which evidence has exceeded a bar; infinite if it never does."""
    over = np.flatnonzero(evidence >= math.log(bar))
    return float(over[0] + 1) if over.size else math.inf


def when_decided(
    differences: Sequence[np.ndarray], *, margin: float | None = None
) -> tuple[float, float]:
    """After how many trainings a set of comparisons is found to hold, or not to.

    Args:
      differences: One of each training, in their order; an array per comparison.
      margin: Of likeness; None where differences should be positive.

    Returns:
      Trainings until all comparisons hold, and until one fails; infinite for never.
      Without an effect the one or the other is finite with probability `ALPHA` at most.
    """
    hold = []
    for own in differences:
        sides = [own] if margin is None else [margin + own, margin - own]
        hold += [_first(sequential.log_evidence(x), 1 / ALPHA) for x in sides]
    return max(hold), min(_failed(x, len(differences), margin) for x in differences)


def _failed(own: np.ndarray, comparisons: int, margin: float | None) -> float:
    """Trainings until one of so many comparisons is found to fail."""
    against = [-own] if margin is None else [own - margin, -own - margin]
    bar = comparisons * len(against) / ALPHA
    return min(_first(sequential.log_evidence(x), bar) for x in against)


def decide(table: Table, claim: Claim, found: Found) -> Decision:
    """Decides a claim.

    Args:
      table: The claim's table.
      claim: The claim.
      found: All that was measured.

    Returns:
      The decision.
    """
    column = table.column(claim.column)
    rows = [table.row(name) for name in claim.rows]
    found = _unseen(found)
    cells = {row.name: cells_of(table, row, column, found) for row in rows}
    absent = [name for name, own in cells.items() if not any(own)]
    paired = {
        pair: _paired(table, _compared(table, claim, pair), found)
        for pair in claim.pairs
    }
    for pair, own in paired.items():
        compared = _compared(table, claim, pair)
        present = [row for row in compared if row.name not in absent]
        if reason := _incomparable(table, column, present, own):
            return Decision(verdict="not decided", reason=reason)
    differences = _differences(table, claim, paired)
    trainings = min(x.size for x in differences.values())
    decision = functools.partial(Decision, differences=differences, trainings=trainings)
    hold, fail = when_decided(list(differences.values()), margin=claim.margin)
    if fail < hold:
        # Each by the bar of them all.
        failed = [
            pair
            for pair, own in differences.items()
            if _failed(own, len(differences), claim.margin) <= fail
        ]
        reason = f"fails: {_pairs(failed)}"
        return decision(verdict="not reproduced", reason=reason, trainings=int(fail))
    if absent:
        return decision(verdict="not run", reason=f"not measured: {', '.join(absent)}")
    if hold < math.inf:
        return decision(verdict="reproduced", trainings=int(hold))
    if trainings < 2:
        reason = f"{trainings} trainings with finite values of all rows: expected more"
        return decision(verdict="not decided", reason=reason)
    open_pairs = [
        pair
        for pair, own in differences.items()
        if when_decided([own], margin=claim.margin)[0] == math.inf
    ]
    reason = f"open after {trainings} trainings: {_pairs(open_pairs)}"
    return decision(verdict="not decided", reason=reason, open=tuple(open_pairs))


def _pairs(pairs: list[tuple[str, str]]) -> str:
    return "; ".join(f"{first} and {second}" for first, second in pairs)
