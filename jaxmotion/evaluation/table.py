"""Tables of metrics: rows with intervals and sample counts, as JSON and Markdown.

A sample is one clip or one rollout: windows of one clip are not independent, so they
are averaged within their clip before anything is said about the spread.
"""

import csv
import dataclasses
import io
import math
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.evaluation import columns, statistics


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cell:
    """One number of a table.

    Attributes:
      low: Lower end of its interval; None where none is given.
      samples: Clips, rollouts or resamples that it came from.
    """

    value: float
    low: float | None = None
    high: float | None = None
    samples: int = 1


Row = dict[str, Cell]
Rows = dict[str, Row]


def group_means(
    values: Float[Array | np.ndarray, " windows"],
    groups: Int[Array | np.ndarray, " windows"],
    weights: Float[Array | np.ndarray, " windows"] | None = None,
) -> Float[Array, " groups"]:
    """Mean of the windows of each clip that occurs; clips without weight are left out.

    Weights are of the windows; None for equal ones.
    """
    groups = np.asarray(groups)
    weights = np.ones(groups.shape) if weights is None else np.asarray(weights)
    number = int(groups.max()) + 1
    total = np.bincount(groups, weights, number)
    summed = np.bincount(groups, weights * np.asarray(values, np.float64), number)
    used = total > 0
    return jnp.asarray(summed[used] / total[used], jnp.float32)


def cell(
    samples: Float[Array, " samples"],
    *,
    scale: float = 1.0,
    bounds: tuple[float, float] = (-math.inf, math.inf),
    part: float = 0.0,
) -> Cell:
    """Mean of independent samples with its 95 % interval (Student's t).

    No interval for a single sample, not a number for none. The scale is for the unit of
    the table; the interval is cut to the bounds of what the mean can be before scaling,
    such as 0 and 1 of a proportion. Samples from a `part` of the same things each are
    as in `statistics.confidence_interval`.
    """
    count = int(samples.shape[0])
    if count == 0:
        return Cell(value=math.nan, samples=0)
    if count < 2:
        return Cell(value=float(samples[0]) * scale, samples=count)
    interval = statistics.confidence_interval(samples, part=part)
    estimate, *ends = (float(x) for x in interval)
    low, high = (scale * min(max(end, bounds[0]), bounds[1]) for end in ends)
    return Cell(value=scale * estimate, low=low, high=high, samples=count)


def row(scores: Sequence[dict[str, Array]], *, part: float = 0.0) -> Row:
    """Means over replications, a dictionary each, with 95 % intervals within bounds.

    Replications of a `part` of the same clips or windows each are not independent: see
    `statistics.confidence_interval`.

    Columns stand in the order of their declaration; others follow. (Compiled programs
    return dictionaries in alphabetical order.)
    """
    known = columns.COLUMNS
    places = {name: i for i, name in enumerate(known)}
    found = {}
    for name in sorted(scores[0], key=lambda name: places.get(name, len(places))):
        bounds = known[name].bounds if name in known else (-math.inf, math.inf)
        values = jnp.stack([one[name] for one in scores])
        found[name] = cell(values, bounds=bounds, part=part)
    return found


def to_json(rows: Rows) -> dict[str, Any]:
    """Rows of columns of cells as JSON; null for what is not a finite number."""

    def plain(x: float | int | None) -> float | int | None:
        return None if x is None or not math.isfinite(x) else x

    return {
        name: {
            column: {k: plain(v) for k, v in dataclasses.asdict(x).items()}
            for column, x in row.items()
        }
        for name, row in rows.items()
    }


def _text(x: Cell | None) -> str:
    if x is None:
        return "–"
    if not math.isfinite(x.value):
        return f"– (n={x.samples})"
    if x.low is None or x.high is None:
        return f"{x.value:.3g} (n={x.samples})"
    return f"{x.value:.3g} [{x.low:.3g}, {x.high:.3g}] (n={x.samples})"


def to_markdown(rows: Rows) -> str:
    """Rows as a Markdown table; a cell that a row lacks is a dash.

    Intervals stand in brackets, sample counts in parentheses.
    """
    names = list(dict.fromkeys(name for row in rows.values() for name in row))
    titles = " | ".join(columns.header(name) for name in names)
    lines = [f"| row | {titles} |", "|---" * (len(names) + 1) + "|"]
    for name, cells_of in rows.items():
        cells = " | ".join(_text(cells_of.get(column)) for column in names)
        lines.append(f"| {name} | {cells} |")
    return "\n".join(lines)


def to_csv(rows: Rows, names: dict[str, str]) -> str:
    """Rows as CSV, a line for each cell, so that columns of any name can be read.

    `names` is what stands in the column "steps", for rows that have any.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(["row", "steps", "column", "value", "low", "high", "samples"])
    for row, cells in rows.items():
        for column, x in cells.items():
            ends = ("" if end is None else end for end in (x.low, x.high))
            writer.writerow(
                [row, names.get(row, ""), column, x.value, *ends, x.samples]
            )
    return text.getvalue()
