"""Frames per second of whole steered rollouts.

Example:
  python benchmarks/rollout_batch.py --system camdm --characters 1 16 256
  python benchmarks/rollout_batch.py --characters 64 --chunks 1 4 16 0 --staggered
  python benchmarks/rollout_batch.py --system aamdm --characters 1 64 4096
"""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import suite
import timing
import tyro
import workload
import workload_aamdm

from jaxmotion import cli
from jaxmotion.control import rollout

# Characters at a time unless told: what was fastest on two cores.
CHUNKS = {"camdm": (4,), "aamdm": (0,)}
COLUMNS = {
    "characters": "characters",
    "chunk": "chunk",
    "traces": "traces",
    "compile_s": "compile s",
    "p50_ms": "p50 ms",
    "p95_ms": "p95 ms",
    "runs": "runs",
    "plans": "plans each",
    "frames_per_second": "frames/s",
    "realtime": "x real time",
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Rollouts of a character, for several numbers of characters.

    All seconds and characters of a rollout are one compiled program ("traces" counts
    how often it was traced). Frames per second are those of all characters together;
    "x real time" is how much faster than its clock each character runs.

    Attributes:
      system: What to measure: CAMDM steers the procedural walker by plans of 45
        frames; AAMDM makes every frame, free, and is compared with a Python loop over
        its jitted networks.
      characters: Characters that are rolled out together.
      seconds: Length of a rollout.
      run: Trained model: for CAMDM a run folder or exported file of the procedural
        walker, for AAMDM a run folder; None for random parameters, which take the same
        time as trained ones.
      chunks: Characters at a time, in batches of 16 and more; 0 for all at once.
        Several compare.
      staggered: CAMDM: change commands at other ticks for each character; without it
        they all plan at the same ticks, which is the cheapest.
      arguments: Pass the parameters as arguments; without it they are constants of
        the program, as in deployment.
      frames_per_token: CAMDM, of the network with random parameters; 1 is the paper's.
      width: Likewise, channels of a token (CAMDM; None: 256), or of a hidden layer
        (AAMDM; None: 256).
      runs: Timed rollouts of each size.
      limit: Seconds of timed rollouts of each size, at most, but three rollouts.
      out: Folder for rollout_batch.json.
      gate: Report to compare with; exit status 1 if something is worse.
    """

    system: Literal["camdm", "aamdm"] = "camdm"
    characters: tuple[int, ...] = (1, 16, 256)
    seconds: float = 2.0
    run: Path | None = None
    chunks: tuple[int, ...] | None = None
    staggered: bool = False
    arguments: bool = False
    frames_per_token: int = 1
    width: int | None = None
    runs: int = 50
    limit: float = 30.0
    out: Path = Path("runs/benchmarks")
    gate: Path | None = None


def case(
    args: Config, load: workload.Load, number: int, chunk: int | None
) -> dict[str, Any]:
    """Measures one number of characters and one chunk.

    Args:
      args: The settings.
      load: What is rolled out.
      number: Characters.
      chunk: Characters at a time; None for all.

    Returns:
      One row of the report.
    """
    traces: list[int] = []

    def roll(params, key, states, commands):
        traces.append(1)
        return rollout.rollout(
            load.controller(params), key, states, commands, chunk=chunk
        )

    states, commands = load.start(number)
    given = (jax.random.key(0), states, commands)
    if args.arguments:
        function, given = jax.jit(roll), (load.params, *given)
    else:
        function = jax.jit(lambda *rest: roll(load.params, *rest))
    run, compile_s = timing.compile_program(function, *given)
    times = timing.time_calls(
        lambda: run(*given), runs=args.runs, limit_s=args.limit, warmup=1, least=3
    )
    _, frames = run(*given)
    p50, p95 = np.percentile(times, [50, 95])
    rate = 1000 * number * commands.label.shape[1] / p50
    return {
        "characters": number,
        "chunk": chunk or number,
        "traces": len(traces),
        "compile_s": compile_s,
        "p50_ms": float(p50),
        "p95_ms": float(p95),
        "runs": len(times),
        "plans": load.plans(frames) / number,
        "frames_per_second": float(rate),
        "realtime": float(rate / number / load.fps),
    }


def metrics_of(system: str, row: dict[str, Any]) -> list[suite.Metric]:
    """Metrics of a row, for the gate.

    Args:
      system: What was measured.
      row: From `case`.

    Returns:
      Five metrics.
    """
    name = f"{system} characters={row['characters']} chunk={row['chunk']}"
    return [
        suite.Metric(f"{name} frames", row["frames_per_second"], "frames/s", "higher"),
        suite.Metric(f"{name} p50", row["p50_ms"], "ms"),
        suite.Metric(f"{name} p95", row["p95_ms"], "ms", tolerance=0.6),
        suite.Metric(f"{name} compile", row["compile_s"], "s", tolerance=0.6),
        suite.Metric(f"{name} traces", row["traces"], "traces", tolerance=0.0),
    ]


def chunks_of(number: int, chunks: tuple[int, ...]) -> list[int | None]:
    """Chunks to measure a number of characters with.

    Args:
      number: Characters.
      chunks: As on the command line.

    Returns:
      Each once; None is all at once. Fewer than 16 characters are not divided.

    Raises:
      ValueError: if a chunk does not divide the number.
    """
    if number < 16:
        return [None]
    for chunk in chunks:
        if chunk < 0 or (chunk and number % chunk):
            raise ValueError(
                f"--chunks {chunk}: expected a divisor of {number} characters, or 0"
            )
    return [chunk or None for chunk in dict.fromkeys(chunks)]


def compare_loops(
    load: workload.Load, rows: list[dict[str, Any]], limit: float
) -> tuple[dict[str, float], list[suite.Metric]]:
    """Times Python loops beside the rollout of one character, and prints the ratios.

    Args:
      load: What is rolled out.
      rows: Of the report.
      limit: Seconds for each loop.

    Returns:
      Frames per second and ratios by name, and metrics for the gate.
    """
    alone = [row["frames_per_second"] for row in rows if row["characters"] == 1]
    found, metrics = {}, []
    for name, glue in (("networks jitted", False), ("whole steps jitted", True)):
        rate = workload_aamdm.python_loop(load, limit_s=limit, glue=glue)
        found[name] = rate
        metrics.append(
            suite.Metric(f"aamdm Python loop, {name}", rate, "frames/s", "higher", 0.6)
        )
        text = f"Python loop, {name}: {rate:,.1f} frames/s"
        if alone:
            found[f"ratio, {name}"] = alone[0] / rate
            text += f"; as one program {alone[0] / rate:.1f} times as many"
        print(text)
    return found, metrics


def main() -> None:
    """Measures and writes the report."""
    args = tyro.cli(Config, description=__doc__)
    suite.prepare(args)
    chunks = CHUNKS[args.system] if args.chunks is None else args.chunks
    cases = [(n, chunk) for n in args.characters for chunk in chunks_of(n, chunks)]
    rows, more = [], {}
    if args.system == "camdm":
        load = workload.camdm_load(
            args.run,
            width=args.width or 256,
            frames_per_token=args.frames_per_token,
            seconds=args.seconds,
            staggered=args.staggered,
        )
    else:
        load = workload_aamdm.make_load(
            args.run, width=args.width or 256, seconds=args.seconds
        )
    for number, chunk in cases:
        rows.append(case(args, load, number, chunk))
        print(f"{number} characters: {rows[-1]['frames_per_second']:,.0f} frames/s")
    suite.print_table(rows, COLUMNS)
    metrics = [metric for row in rows for metric in metrics_of(args.system, row)]
    if args.system == "aamdm":
        loops, extra = compare_loops(load, rows, args.limit)
        metrics, more = metrics + extra, {"python_loops": loops}
    suite.report(
        "rollout_batch",
        metrics,
        args,
        rows=rows,
        **more,
    )


if __name__ == "__main__":
    cli.start(main)
