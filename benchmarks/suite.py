"""What the benchmarks share: timing, the machine, reports, and a gate.

A time is measured around a call that ends with its result ready; compiling is measured
apart; the first calls warm up and do not count.
"""

import dataclasses
import datetime
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import flax
import jax
import numpy as np


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


@dataclasses.dataclass(frozen=True)
class Timing:
    """Times of one compiled program.

    Attributes:
      compile_s: Seconds of tracing, lowering and compiling.
      p50_ms: Median of the timed calls, milliseconds.
      p95_ms: 95th percentile, milliseconds.
      runs: Timed calls.
    """

    compile_s: float
    p50_ms: float
    p95_ms: float
    runs: int


def compile_program(function: Callable, *arguments: Any) -> tuple[Callable, float]:
    """Compiles a jitted function; returns the program and the seconds it took."""
    start = time.perf_counter()
    program = function.lower(*arguments).compile()
    return program, time.perf_counter() - start


def time_calls(
    call: Callable[[], Any], *, runs: int = 50, warmup: int = 3, limit_s: float = 60.0
) -> np.ndarray:
    """Milliseconds of each of `runs` calls, fewer where the limit comes first.

    Args:
      call: Does the work; what it returns is waited for.
      runs: Calls to time.
      warmup: Calls before.
      limit_s: Stop after so many seconds, but not before five calls.

    Returns:
      One time a call.
    """
    for _ in range(warmup):
        jax.block_until_ready(call())
    times: list[float] = []
    begin = time.perf_counter()
    while len(times) < runs:
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(1000 * (time.perf_counter() - start))
        if len(times) >= 5 and time.perf_counter() - begin > limit_s:
            break
    return np.array(times)


def measure(function: Callable, *arguments: Any, runs: int, limit_s: float) -> Timing:
    """Compiles a jitted function, and times it."""
    program, seconds = compile_program(function, *arguments)
    times = time_calls(lambda: program(*arguments), runs=runs, limit_s=limit_s)
    p50, p95 = np.percentile(times, [50, 95])
    return Timing(seconds, float(p50), float(p95), len(times))


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(x.split(":")[1].strip() for x in lines if "model name" in x)
    except (OSError, StopIteration):
        return platform.processor()


def environment() -> dict[str, Any]:
    """Hardware, versions, command and date, for every report."""
    return {
        "device": str(jax.devices()[0]),
        "devices": len(jax.devices()),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "flax": flax.__version__,
        "numpy": np.__version__,
        "command": " ".join(["python", *sys.argv]),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def compare(metrics: list[Metric], baseline: Path) -> list[str]:
    """Metrics that are worse than a baseline report by more than their tolerance.

    Args:
      metrics: Measured now.
      baseline: Report of `write_report`; metrics it lacks are not compared.

    Returns:
      One line for each.
    """
    known = {m["name"]: m["value"] for m in json.loads(baseline.read_text())["metrics"]}
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


def report(
    name: str,
    metrics: list[Metric],
    out: Path,
    *,
    gate: Path | None = None,
    **more: Any,
) -> None:
    """Prints metrics, writes them as JSON, and applies the gate.

    Args:
      name: Of the benchmark; the file is <out>/<name>.json.
      metrics: What was measured.
      out: Folder.
      gate: Baseline report, or None.
      **more: Further entries of the file.

    Raises:
      SystemExit: with status 1, if the gate finds something worse.
    """
    width = max(len(metric.name) for metric in metrics)
    for metric in metrics:
        print(f"{metric.name:{width}}  {metric.value:10.4g} {metric.unit}")
    out.mkdir(parents=True, exist_ok=True)
    value = {
        "benchmark": name,
        "environment": environment(),
        "metrics": [dataclasses.asdict(metric) for metric in metrics],
        **more,
    }
    path = out / f"{name}.json"
    path.write_text(json.dumps(value, indent=1))
    print(f"wrote {path}")
    worse = [] if gate is None else compare(metrics, gate)
    if worse:
        print("worse than the baseline:", *worse, sep="\n  ")
        raise SystemExit(1)
