"""What the benchmarks share: metrics, reports, and a gate against a baseline.

A report says how many calls a percentile comes from, and how busy other processes kept
the machine meanwhile: figures from a shared machine are no figures of the program.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal, Protocol

import machine

from jaxmotion.learning.loop import check_writable


@dataclasses.dataclass(frozen=True)
class Metric:
    """One number of a benchmark.

    Attributes:
      name: What was measured, with its settings.
      value: The number.
      unit: Of the value.
      direction: Whether a lower or a higher value is better.
      tolerance: Relative change for the worse that the gate still lets pass.
    """

    name: str
    value: float
    unit: str
    direction: Literal["lower", "higher"] = "lower"
    tolerance: float = 0.3


class Settings(Protocol):
    """Command-line settings of a benchmark: a dataclass with these fields."""

    @property
    def out(self) -> Path:
        """Folder of the report."""
        ...

    @property
    def gate(self) -> Path | None:
        """Baseline report, or None."""
        ...


def prepare(args: Settings) -> None:
    """Raises if the report could not be written or compared; before any work.

    Args:
      args: The settings.

    Raises:
      OSError: if the folder cannot be written, or the baseline not be read.
      ValueError: if the baseline is no report.
    """
    check_writable(args.out)
    if args.gate is not None:
        read_baseline(args.gate)


def read_baseline(path: Path) -> dict[str, float]:
    """Values of a report by the names of its metrics.

    Args:
      path: Report of `report`.

    Returns:
      The values.

    Raises:
      OSError: if there is no such file.
      ValueError: if it is no report; names the file.
    """
    try:
        metrics = json.loads(path.read_text())["metrics"]
        return {metric["name"]: float(metric["value"]) for metric in metrics}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path}: {error!r}: expected a report with a list 'metrics' of names and "
            "values"
        ) from error


def settings(args: Any) -> dict[str, Any]:
    """Command-line settings as JSON.

    Args:
      args: A dataclass.

    Returns:
      Its fields; paths as text.
    """

    def plain(value: Any) -> Any:
        if isinstance(value, tuple):
            return [plain(x) for x in value]
        return str(value) if isinstance(value, Path) else value

    return {name: plain(value) for name, value in dataclasses.asdict(args).items()}


def compare(metrics: list[Metric], baseline: Path) -> list[str]:
    """Metrics that are worse than a baseline report by more than their tolerance.

    Args:
      metrics: Measured now.
      baseline: Report of `write_report`; metrics it lacks are not compared.

    Returns:
      One line for each.
    """
    known = read_baseline(baseline)
    worse = []
    for metric in metrics:
        if metric.name not in known:
            continue
        old = known[metric.name]
        factor = (
            metric.value / old if metric.direction == "lower" else old / metric.value
        )
        if factor > 1.0 + metric.tolerance:
            worse.append(
                f"{metric.name}: {metric.value:.4g} {metric.unit}, baseline {old:.4g} "
                f"({factor:.2f} times worse, {1 + metric.tolerance:.2f} allowed)"
            )
    return worse


def print_table(rows: list[dict[str, Any]], columns: dict[str, str]) -> None:
    """Prints rows as a table.

    Args:
      rows: Their values by key.
      columns: Title of each key to print.
    """

    def cell(value: Any) -> str:
        if isinstance(value, float):
            return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
        return str(value)

    lines = [list(columns.values())]
    lines += [[cell(row[key]) for key in columns] for row in rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for line in lines:
        print("  ".join(x.rjust(w) for x, w in zip(line, widths, strict=True)))


def report(
    name: str,
    metrics: list[Metric],
    args: Settings,
    *,
    rows: Any,
    **more: Any,
) -> None:
    """Writes metrics as JSON, and applies the gate.

    Args:
      name: Of the benchmark; the file is <out>/<name>.json.
      metrics: What was measured.
      args: The settings.
      rows: The table.
      **more: Further entries of the file.

    Raises:
      SystemExit: with status 1, if the gate finds something worse.
    """
    args.out.mkdir(parents=True, exist_ok=True)
    here = machine.environment()
    value = {
        "benchmark": name,
        "environment": here,
        "metrics": [dataclasses.asdict(metric) for metric in metrics],
        "rows": rows,
        "settings": settings(args),
        **more,
    }
    path = args.out / f"{name}.json"
    path.write_text(json.dumps(value, indent=1))
    print(f"{here['cpu']}, {here['cores']} cores, jax {here['jax']}")
    # Memory is what it is on a busy machine, too.
    timed = any(metric.unit != "GiB" for metric in metrics)
    if timed and (here["other_load"] or 0.0) > 0.1:
        print(
            f"Not idle: other processes used {here['other_load']} cores meanwhile, "
            "so these times are too long."
        )
    print(f"wrote {path}")
    worse = [] if args.gate is None else compare(metrics, args.gate)
    if worse:
        print("worse than the baseline:", *worse, sep="\n  ")
        raise SystemExit(1)
