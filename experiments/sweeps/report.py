"""What a sweep leaves behind: table.md, table.csv, table.json, pareto.png."""

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from jaxmotion import files
from jaxmotion.evaluation import table
from jaxmotion.evaluation.table import Cell
from jaxmotion.viz import pareto
from sweeps.points import Point
from sweeps.system import GROUND_TRUTH, NOISE_FLOOR, Row, Rows


def write(
    out: Path,
    rows: Rows,
    points: tuple[Point, ...],
    report: dict[str, Any],
    *,
    quality: str,
    sample: str,
    title: str,
) -> None:
    """Writes the table in three forms, and the plot.

    Args:
      out: Folder; it must exist.
      rows: The table.
      points: Its models.
      report: What belongs beside it; "notes" stand below the Markdown table too.
      quality: Column of the plot.
      sample: What the times are of.
      title: Of the plot.
    """
    notes = [*report["notes"]]
    left_out = _draw(out / "pareto.png", rows, points, quality, sample, title)
    if left_out:
        notes.append(f"not in the plot, for want of a finite {quality}: {left_out}")
    whole = {"title": title} | report | {"notes": notes, "rows": table.to_json(rows)}
    files.write_text(out / "table.json", json.dumps(whole, indent=1))
    text = table.to_markdown(rows)
    below = "\n".join(f"- {note}" for note in notes)
    files.write_text(out / "table.md", f"# {title}\n\n{text}\n\n{below}\n")
    _write_csv(out / "table.csv", rows, points)
    print(text)


def _write_csv(path: Path, rows: Rows, points: tuple[Point, ...]) -> None:
    """One line a cell, so that columns of any name can be read."""
    names = {point.row: point.name for point in points}
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["row", "steps", "column", "value", "low", "high", "samples"])
        for row, cells in rows.items():
            for column, cell in cells.items():
                ends = ("" if x is None else x for x in (cell.low, cell.high))
                writer.writerow(
                    [row, names.get(row, ""), column, cell.value, *ends, cell.samples]
                )


def _ends(cell: Cell) -> tuple[float, float, float]:
    low = cell.value if cell.low is None else cell.low
    high = cell.value if cell.high is None else cell.high
    return cell.value, low, high


def _fails(cells: Row) -> bool:
    """Whether most rollouts diverge or freeze; then no distance speaks for them."""
    counts = [cells[name] for name in ("diverged", "frozen") if name in cells]
    return any(2 * cell.value > cell.samples for cell in counts)


def _draw(
    path: Path,
    rows: Rows,
    points: tuple[Point, ...],
    quality: str,
    sample: str,
    title: str,
) -> str:
    """Draws the plot; returns the points that cannot be in it."""

    def finite(cells: dict[str, Cell]) -> bool:
        return quality in cells and math.isfinite(cells[quality].value)

    shown = [point for point in points if finite(rows[point.row])]
    if shown:
        pareto.write_pareto(
            path,
            tuple(point.name for point in shown),
            *(
                np.array([_ends(rows[point.row][column]) for point in shown])
                for column in ("p50 ms", quality)
            ),
            references={
                name: np.array(_ends(rows[name][quality]))
                for name in (GROUND_TRUTH, NOISE_FLOOR)
                if finite(rows[name])
            },
            xlabel=f"{sample}, batch 1: p50, ms",
            ylabel=f"{quality} (lower is better)",
            title=title,
            broken=tuple(point.name for point in shown if _fails(rows[point.row])),
        )
    return ", ".join(point.row for point in points if point not in shown)
