"""Whether an ordering that a paper claims is seen in what was measured here."""

import dataclasses
import functools
import math
from typing import Any, Literal

import numpy as np

from jaxmotion.evaluation import statistics
from jaxmotion.evaluation.statistics import Spread
from jaxmotion.evaluation.table import Cell
from reports.claims import Claim, Column, Row, Stated, Table
from reports.results import Found

Ends = tuple[float, float]
Verdict = Literal["reproduced", "not reproduced", "not decided", "not run"]

# In place of the interval of a time that has none.
TIME_FACTOR = 1.25
_QUANTILE = 1.96  # of the normal distribution, two-sided 95 %

RULE = (
    "A claim is a set of comparisons, each of two rows of one column. A comparison "
    "holds if the intervals are apart in the claimed order, fails if they are apart in "
    "the opposite one, and is undecided if they overlap. (That two intervals of 95 % "
    "are apart asks for more than Welch's test at 5 % does.)",
    "The claim is **reproduced** if all hold, **not reproduced** if one fails, **not "
    "run** if a row was not measured and none fails, and else **not decided**.",
    "Where the larger is claimed to be so many times the smaller, its interval must "
    "begin above so many times the upper end of the smaller. The bar is ours, below "
    "the paper's own ratio, since machines differ.",
    "Nearness to recorded motion must come out alike for every value in the latter's "
    "interval.",
    "Intervals are those of the file, of 95 %. Counts have Wilson's. Times have what "
    "their column says, and those without spread a factor of "
    f"{TIME_FACTOR:g} either way; others without an interval decide nothing.",
    "Rows of several files that an evaluator scored are compared only if the files "
    "name the same evaluator and reference clips.",
    "Where both rows were trained with several seeds, these intervals do not decide: "
    "the claimed difference is taken within each seed, and the comparison holds or "
    "fails if the 95 % interval of its mean over seeds (Student's t, as in a paired "
    "t-test) is above or below zero. Within a seed both rows have the same data, "
    "and the same commands and noise in their evaluation.",
    "Where they were trained once, intervals run over replications, clips or rollouts "
    "of that training: what another seed would change is not in them.",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Decision:
    """A verdict, and what it rests on.

    Attributes:
      verdict: The verdict.
      reason: Comparisons that failed, were undecided or could not be made; or "".
      differences: By how much the comparisons of rows of several trainings hold, over
        these; negative where they fail.
      trainings: Fewest trainings that a comparison rests on.
    """

    verdict: Verdict
    reason: str = ""
    differences: dict[tuple[str, str], Spread] = dataclasses.field(default_factory=dict)
    trainings: int = 1


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


def _wilson(count: float, samples: int) -> Ends:
    part, z2 = count / samples, _QUANTILE**2
    middle = (part + z2 / (2 * samples)) / (1 + z2 / samples)
    spread = part * (1 - part) / samples + z2 / (4 * samples**2)
    half = _QUANTILE / (1 + z2 / samples) * math.sqrt(spread)
    return samples * (middle - half), samples * (middle + half)


def ends(cell: Cell, column: Column) -> Ends:
    """Interval of a cell, for decisions.

    Args:
      cell: With a finite value.
      column: Its column.

    Returns:
      Lower and upper end.
    """
    if column.kind == "count" and cell.samples:
        return _wilson(cell.value, cell.samples)
    if cell.low is not None and cell.high is not None:
        return cell.low, cell.high
    if column.kind == "time":
        return cell.value / TIME_FACTOR, cell.value * TIME_FACTOR
    # A single sample says nothing about its spread.
    return -math.inf, math.inf


def ordered(smaller: Ends, larger: Ends, factor: float = 1.0) -> bool | None:
    """Whether one quantity is below another.

    Args:
      smaller: Interval of what is claimed to be the smaller.
      larger: That of the larger.
      factor: The larger is at least so many times the smaller.

    Returns:
      True or False if the intervals are apart; None if they overlap.
    """
    if factor * smaller[1] < larger[0]:
        return True
    return False if larger[1] < factor * smaller[0] else None


def _distance(interval: Ends, point: float) -> Ends:
    far = max(abs(end - point) for end in interval)
    near = min(abs(end - point) for end in interval)
    return (0.0 if interval[0] <= point <= interval[1] else near), far


def nearer(near: Ends, far: Ends, target: Ends) -> bool | None:
    """Whether one quantity is nearer to a third than another.

    Args:
      near: Interval of what is claimed to be the nearer.
      far: That of the farther.
      target: That of the third.

    Returns:
      True or False if it is so for every target; None otherwise.
    """
    # Distances are straight lines between these points.
    low, high = target
    points = {low, high} | {min(max(x, low), high) for x in (*near, *far)}
    answers = {ordered(_distance(near, x), _distance(far, x)) for x in points}
    return answers.pop() if len(answers) == 1 else None


def compare(claim: Claim, intervals: dict[str, Ends]) -> dict[tuple[str, str], bool]:
    """Makes the comparisons of a claim that can be made.

    Args:
      claim: The claim.
      intervals: Intervals of rows; those that are not known are missing.

    Returns:
      True, False or None for each pair of known rows.
    """
    answers = {}
    for pair in claim.pairs:
        names = (*pair, claim.toward) if claim.toward else pair
        if not all(name in intervals for name in names):
            continue
        known = [intervals[name] for name in names]
        answers[pair] = (
            nearer(*known) if claim.toward else ordered(*known, claim.factor)
        )
    return answers


def printed(value: Stated) -> float | None:
    """The value alone of what a paper prints.

    Args:
      value: With or without the half width of its interval.

    Returns:
      The value; None if the paper prints none.
    """
    return value[0] if isinstance(value, tuple) else value


def _incomparable(table: Table, column: Column, rows: list[Row], found: Found) -> str:
    """Why rows of several files do not compare; "" if they do."""
    sources = {table.source_of(row) for row in rows}
    files = [x for source in sources if (x := found.get(source))]
    if len(files) <= 1:
        return ""
    several = all(len(x.trainings) > 1 for x in files)
    for trained in zip(*(x.trainings for x in files), strict=False):
        there = [x for x in trained if x is not None]
        evaluators = {x.evaluator for x in there}
        if column.evaluated and (len(evaluators) > 1 or None in evaluators):
            return "rows were scored by different or unrecorded evaluators"
        if several and len({x.seeds for x in there}) > 1:
            return "rows were trained with different seeds"
        if len({str(data) for x in there if (data := x.about.get("data"))}) > 1:
            return "rows were trained on different data"
    return ""


def _differences(table: Table, claim: Claim, found: Found) -> dict[Any, Spread]:
    """Claimed differences of pairs of rows over trainings, where there are several."""
    spreads, column = {}, table.column(claim.column)
    for pair in claim.pairs:
        names = (*pair, claim.toward) if claim.toward else pair
        cells = [cells_of(table, table.row(name), column, found) for name in names]
        made = []
        for trained in zip(*cells, strict=False):
            if None in trained:
                continue
            first, second, *target = (cell.value for cell in trained)
            if target:
                first, second = (abs(x - target[0]) for x in (first, second))
            made.append(second - claim.factor * first)
        if len(made) > 1:
            spreads[pair] = statistics.spread(np.array(made))
    return spreads


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
    cells = {row.name: cell_of(table, row, column, found) for row in rows}
    absent = [name for name, cell in cells.items() if cell is None]
    present = {name: cell for name, cell in cells.items() if cell is not None}
    own = [table.row(name) for name in present]
    if reason := _incomparable(table, column, own, found):
        return Decision(verdict="not decided", reason=reason)
    finite = {
        name: ends(cell, column)
        for name, cell in present.items()
        if math.isfinite(cell.value)
    }
    answers, differences = compare(claim, finite), _differences(table, claim, found)
    for pair, spread in differences.items():
        low, high = interval(spread)
        answers[pair] = True if low > 0 else False if high < 0 else None
    numbers = [x.count for x in differences.values()]
    several = len(numbers) == len(claim.pairs)
    decision = functools.partial(
        Decision, differences=differences, trainings=min(numbers) if several else 1
    )
    failed = [pair for pair, answer in answers.items() if answer is False]
    if failed:
        return decision(verdict="not reproduced", reason=f"fails: {_pairs(failed)}")
    if absent:
        return decision(verdict="not run", reason=f"not measured: {', '.join(absent)}")
    open_pairs = [pair for pair in claim.pairs if answers.get(pair) is None]
    if open_pairs:
        reason = f"intervals overlap, hold 0 or are missing: {_pairs(open_pairs)}"
        return decision(verdict="not decided", reason=reason)
    return decision(verdict="reproduced")


def lines(tables: tuple[Table, ...], found: Found) -> list[str]:
    """What became of every claim of some tables, one line each.

    Args:
      tables: The tables.
      found: All that was measured.

    Returns:
      Verdict, claim, and what the verdict rests on.
    """
    shown = []
    for table in tables:
        for claim in table.claims:
            made = decide(table, claim, found)
            reason = f" ({made.reason})" if made.reason else ""
            shown.append(f"{made.verdict}: {claim.words}{reason}")
    return shown


def _pairs(pairs: list[tuple[str, str]]) -> str:
    return "; ".join(f"{first} and {second}" for first, second in pairs)
