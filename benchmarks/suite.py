"""What the benchmarks share: command lines, metrics, reports, a gate, memory.

A report says how many calls a percentile comes from, and how busy other processes kept
the machine meanwhile: figures from a shared machine are no figures of the program.
"""

import csv
import dataclasses
import datetime
import importlib.metadata
import json
import math
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TypeVar

import jax
import numpy as np
import tyro

from jaxmotion import files, reporting
from jaxmotion.learning.loop import check_writable

GIB = float(2**30)


@dataclasses.dataclass(frozen=True)
class Metric:
    """One number of a benchmark.

    Attributes:
      name: What was measured, with its settings.
      value: The number.
      unit: Unit of the value.
      direction: Whether a lower or a higher value is better.
      tolerance: Relative change for the worse that the gate still lets pass.
      low: Lower end of its interval; None for none.
      high: Upper end.
      samples: Measurements that it came from.
    """

    name: str
    value: float
    unit: str
    direction: Literal["lower", "higher"] = "lower"
    tolerance: float = 0.3
    low: float | None = None
    high: float | None = None
    samples: int = 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """Where reports go; a benchmark adds its own settings.

    Attributes:
      out: Folder of the report.
      gate: Report to compare with; exit status 1 if something is worse.
      history: JSONL file to append every metric to, with commit and date, and to draw
        as a picture beside it.
    """

    out: Path = Path("runs/benchmarks")
    gate: Path | None = None
    history: Path | None = None


S = TypeVar("S", bound=Settings)


def parse(kind: type[S], description: str | None) -> S:
    """Settings from the command line, checked before any work.

    Raises:
      OSError: if the folder cannot be written, or the baseline not be read.
      ValueError: if the baseline is no report.
    """
    args = tyro.cli(kind, description=description)
    # Who sets JAX_COMPILATION_CACHE_DIR would be told seconds of reading it.
    jax.config.update("jax_enable_compilation_cache", False)
    prepare(args)
    return args


def prepare(args: Settings) -> None:
    """Raises if the report could not be written or compared."""
    check_writable(args.out)
    if args.gate is not None:
        read_baseline(args.gate)
    if args.history is not None:
        check_writable(args.history.parent)
        read_history(args.history)


def at_least(args: Settings, **least: int) -> None:
    """Raises unless options (or all values of one) are at least so large.

    Raises:
      ValueError: names the option.
    """
    for name, expected in least.items():
        value = getattr(args, name)
        for found in value if isinstance(value, tuple) else (value,):
            if found is not None and found < expected:
                option = name.replace("_", "-")
                raise ValueError(f"--{option} {found}: expected {expected} or more")


def time_metrics(name: str, row: dict[str, Any]) -> list[Metric]:
    """Metrics of a row with the fields of a `timing.Timing` and a rate."""
    return [
        Metric(f"{name} frames", row["frames_per_second"], "frames/s", "higher"),
        Metric(f"{name} p50", row["p50_ms"], "ms"),
        Metric(f"{name} p95", row["p95_ms"], "ms", tolerance=0.6),
        Metric(f"{name} compile", row["compile_s"], "s", tolerance=0.6),
    ]


def read_baseline(path: Path) -> dict[str, float]:
    """Values of a report by the names of its metrics.

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
    """Command-line settings as JSON; paths as text."""

    def plain(value: Any) -> Any:
        if isinstance(value, tuple):
            return [plain(x) for x in value]
        return str(value) if isinstance(value, Path) else value

    return {name: plain(value) for name, value in dataclasses.asdict(args).items()}


def compare(metrics: list[Metric], baseline: Path) -> list[str]:
    """Metrics that are worse than a baseline report by more than their tolerance.

    Metrics that the baseline lacks are not compared.

    Returns:
      One line for each.

    Raises:
      ValueError: if the baseline has none of the metrics.
    """
    known = read_baseline(baseline)
    if not any(metric.name in known for metric in metrics):
        raise ValueError(
            f"--gate {baseline}: has none of the metrics measured here, expected a "
            "report of this benchmark with the same settings"
        )
    worse = []
    for metric in metrics:
        if metric.name not in known:
            continue
        old, new = known[metric.name], metric.value
        better, other = (new, old) if metric.direction == "lower" else (old, new)
        # Also true of what is not a number, and of anything but 0 where 0 was.
        if not better <= other * (1.0 + metric.tolerance):
            factor = better / other if other else math.inf
            worse.append(
                f"{metric.name}: {new:.4g} {metric.unit}, baseline {old:.4g} "
                f"({factor:.2f} times worse, {1 + metric.tolerance:.2f} allowed)"
            )
    return worse


def _cells(rows: list[dict[str, Any]], columns: dict[str, str]) -> list[list[str]]:
    def cell(value: Any) -> str:
        if value is None:
            return "–"
        if isinstance(value, float):
            return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
        return str(value)

    lines = [list(columns.values())]
    return lines + [[cell(row[key]) for key in columns] for row in rows]


def write_table(
    path: Path, rows: list[dict[str, Any]], columns: dict[str, str]
) -> None:
    """Writes rows as CSV, in full precision, and as Markdown.

    Args:
      path: Without a suffix.
      rows: The table; None is an empty cell of the CSV, and a dash.
      columns: Titles of the keys to write.

    Raises:
      OSError: if a file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    head, *lines = [f"| {' | '.join(line)} |" for line in _cells(rows, columns)]
    text = "\n".join([head, "|---" * len(columns) + "|", *lines])
    path.with_suffix(".md").write_text(text + "\n")


def print_table(rows: list[dict[str, Any]], columns: dict[str, str]) -> None:
    """Prints rows as a table; `columns` are the titles of the keys to print."""
    lines = _cells(rows, columns)
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for line in lines:
        print("  ".join(x.rjust(w) for x, w in zip(line, widths, strict=True)))


def save(
    name: str, metrics: list[Metric], args: Settings, *, rows: Any, **more: Any
) -> dict[str, Any]:
    """Writes <out>/<name>.json; again after each row, so that a kill loses one row.

    Args:
      name: Name of the benchmark.
      metrics: What was measured.
      args: The settings.
      rows: The table.
      **more: Further entries of the file.

    Returns:
      What the file says of the machine.
    """
    args.out.mkdir(parents=True, exist_ok=True)
    here = environment() | {"git_commit": reporting.git_commit()}
    value = {
        "benchmark": name,
        "environment": here,
        "metrics": [dataclasses.asdict(metric) for metric in metrics],
        "rows": rows,
        "settings": settings(args),
        **more,
    }
    files.write_text(args.out / f"{name}.json", json.dumps(value, indent=1))
    return here


def report(
    name: str, metrics: list[Metric], args: Settings, *, rows: Any, **more: Any
) -> None:
    """Writes what `save` does, says where, and applies the gate.

    Raises:
      SystemExit: with status 1, if the gate finds something worse.
    """
    here = save(name, metrics, args, rows=rows, **more)
    path = args.out / f"{name}.json"
    print(f"{here['cpu']}, {here['cores']} cores, jax {here['jax']}")
    # Memory is what it is on a busy machine, too.
    timed = any(metric.unit not in ("GiB", "MiB") for metric in metrics)
    if timed and (here["other_load"] or 0.0) > 0.1:
        print(
            f"Not idle: other processes used {here['other_load']} cores meanwhile, "
            "so these times are too long."
        )
    print(f"wrote {path}")
    if args.history is not None:
        append_history(args.history, name, metrics, here)
    worse = [] if args.gate is None else compare(metrics, args.gate)
    if worse:
        print("worse than the baseline:", *worse, sep="\n  ")
        raise SystemExit(1)


def needs_of(compiled: Any, chunk: int) -> dict[str, int]:
    """Bytes that a program needs by name, their total, and its chunk."""
    found = compiled.memory_analysis()
    parts = {
        "arguments": found.argument_size_in_bytes,
        "results": found.output_size_in_bytes,
        "intermediate": found.temp_size_in_bytes,
    }
    return {"chunk": chunk, **parts, "total": sum(parts.values())}


def next_chunk(needs: dict[str, int], limit: float) -> int:
    """Fewer rollouts at a time that should fit, at most half as many.

    What is not intermediate does not shrink with them.

    Raises:
      ValueError: if no number would fit.
    """
    chunk = needs["chunk"]
    room = limit - needs["arguments"] - needs["results"]
    if chunk == 1 or room <= 0:
        need = needs["total"] if chunk == 1 else needs["total"] - needs["intermediate"]
        raise ValueError(
            f"--memory-gib {limit / GIB:g}: one rollout at a time needs "
            f"{need / GIB:.3g} GiB or more, {needs['results'] / GIB:.3g} of it for "
            "the frames that are kept: expected a higher limit, fewer or shorter "
            "rollouts, or a larger --every"
        )
    fits = int(room / (needs["intermediate"] / chunk))
    return max(1, min(chunk // 2, fits))


def fit(
    compiled: Callable[[int], Any], size: int, *, limit: float, shrink: bool
) -> tuple[Any, dict[str, int]]:
    """Compiles a program with the largest chunk that fits a limit.

    The compiler is asked what a program needs; what does not fit is compiled again with
    a smaller chunk.

    Args:
      compiled: Compiles the program for a chunk.
      size: Chunk to begin with.
      limit: Bytes.
      shrink: Whether smaller chunks are allowed.

    Raises:
      ValueError: if it does not fit.
    """
    while True:
        program = compiled(size)
        needs = needs_of(program, size)
        if needs["total"] <= limit:
            return program, needs
        if not shrink:
            raise ValueError(
                f"--chunk {size}: {needs['total'] / GIB:.3g} GiB, more than "
                f"--memory-gib {limit / GIB:g}"
            )
        size = next_chunk(needs, limit)


def describe(needs: dict[str, Any]) -> str:
    """One line about what a program needs; with its "model"."""
    parts = ", ".join(
        f"{needs[name] / GIB:.3f} {name}"
        for name in ("arguments", "results", "intermediate")
    )
    return (
        f"{needs['model']}: {needs['chunk']} rollouts at a time, "
        f"{needs['total'] / GIB:.3f} GiB ({parts})"
    )


def peak() -> dict[str, Any]:
    """The most that was used at once, so far.

    Returns:
      Bytes, and of what: the accelerator, or the process where the device keeps no
      account; 0 bytes where the system keeps none either.
    """
    stats = jax.local_devices()[0].memory_stats()
    if stats and "peak_bytes_in_use" in stats:
        return {"what": "peak of the device", "bytes": stats["peak_bytes_in_use"]}
    try:
        import resource
    except ImportError:  # Windows
        return {"what": "peak unknown", "bytes": 0}
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    unit = 1 if sys.platform == "darwin" else 1024
    return {
        "what": "peak of the process, JAX and compiler included",
        "bytes": used * unit,
    }


def read_history(path: Path) -> list[dict[str, Any]]:
    """Entries of a history, oldest first; none if there is no file.

    Raises:
      ValueError: names the file and the line.
    """
    found = []
    for i, line in enumerate(path.read_text().splitlines() if path.exists() else ()):
        try:
            entry = json.loads(line)
            _ = [entry[key] for key in ("benchmark", "name", "commit", "date", "cpu")]
            found.append(entry | {"value": float(entry["value"])})
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{path}: line {i + 1}: {error!r}: expected a metric that --history "
                "wrote"
            ) from error
    return found


def append_history(
    path: Path, name: str, metrics: list[Metric], here: dict[str, Any]
) -> None:
    """Appends a line per metric, and draws the medians of all runs on this processor.

    Args:
      path: The history; the picture is beside it.
      name: Name of the benchmark.
      metrics: What was measured.
      here: The `environment`.
    """
    # matplotlib is slow to import, and only those who draw need it.
    from jaxmotion.viz import plots

    commit = reporting.git_commit()
    same = {key: here[key] for key in ("date", "cpu", "cores", "device", "other_load")}
    entries = [
        {"benchmark": name, **dataclasses.asdict(metric), "commit": commit, **same}
        for metric in metrics
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.writelines(json.dumps(entry) + "\n" for entry in entries)
    values: dict[str, list[tuple[int, float]]] = {}
    runs: dict[str, str] = {}
    for entry in read_history(path):
        known = entry["benchmark"], entry["cpu"]
        if known != (name, here["cpu"]) or not entry["name"].endswith(" p50"):
            continue
        runs.setdefault(entry["date"], (entry["commit"] or "no commit")[:7])
        places = values.setdefault(entry["name"].removesuffix(" p50"), [])
        places.append((list(runs).index(entry["date"]), entry["value"]))
    if not values:
        return
    lines = {
        name: (*np.array([(run, value / found[0][1]) for run, value in found]).T, None)
        for name, found in values.items()
    }
    picture = path.with_suffix(".png")
    plots.plot_sweep(
        picture,
        lines,
        xlabel="commit",
        ylabel="p50 over the first run's",
        log=False,
        ticks=tuple(runs.values()),
    )
    print(f"wrote {path} and {picture}")


def busy() -> tuple[float, float, float] | None:
    """Where the clocks stand, for `other_load`.

    Returns:
      Seconds of wall clock, of all cores' work, and of that of this process and of its
      children that have ended; None where the system does not say (it is Linux that
      does).
    """
    try:
        fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]
        ticks = [int(x) for x in fields]
    except (OSError, ValueError):
        return None
    idle = sum(ticks[3:5])
    # Guest time (after the eighth field) is counted as user time already.
    used = (sum(ticks[:8]) - idle) / os.sysconf("SC_CLK_TCK")
    return time.perf_counter(), used, sum(os.times()[:4])


_BEGIN = busy()


def other_load(since: tuple[float, float, float] | None = _BEGIN) -> float | None:
    """Cores that other processes kept busy on average, by default since the start.

    Returns:
      0 on an idle machine; None where the system does not say.
    """
    now = busy()
    if now is None or since is None:
        return None
    clock, used, own = (b - a for a, b in zip(since, now, strict=True))
    return round(max(used - own, 0.0) / max(clock, 1e-9), 2)


def environment() -> dict[str, Any]:
    """Hardware, versions, command, date; "other_load" says how far to trust times."""
    versions = {}
    peers = [name for name in ("torch", "onnxruntime") if name in sys.modules]
    for name in ("jax", "jaxlib", "flax", "numpy", "jaxmotion", *peers):
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {
        "device": str(jax.devices()[0]),
        "devices": len(jax.devices()),
        "cpu": reporting.processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        **versions,
        "other_load": other_load(),
        "command": " ".join(["python", *sys.argv]),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
