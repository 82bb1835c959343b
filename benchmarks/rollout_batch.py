"""Frames per second of whole steered rollouts.

Example:
  python benchmarks/rollout_batch.py --system camdm --characters 1 16 256
  python benchmarks/rollout_batch.py --characters 64 --chunks 1 4 16 0 --staggered
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import suite
import timing
import tyro
import workload

from jaxmotion.control import rollout
from jaxmotion.data.clips import Clips
from jaxmotion.systems import camdm_control, camdm_model
from jaxmotion.typing import Params

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
    """Rollouts of the procedural walker, for several numbers of characters.

    All seconds and characters of a rollout are one compiled program ("traces" counts
    how often it was traced). Frames a second are those of all characters together;
    "x real time" is how much faster than its clock each character runs.

    Attributes:
      system: What to measure.
      characters: Characters that are rolled out together.
      seconds: Length of a rollout.
      run: Model of the procedural walker (run folder or exported file); None for
        random parameters of the paper's network, which take the same time as trained
        ones.
      chunks: Characters at a time, in batches of 16 and more; 0 for all at once.
        Several compare.
      staggered: Change commands at other ticks for each character; without it they
        all plan at the same ticks, which is the cheapest.
      arguments: Pass the parameters as arguments; without it they are constants of
        the program, as in deployment.
      frames_per_token: Of the network with random parameters; 1 is the paper's.
      width: Likewise, channels of a token.
      runs: Timed rollouts of each size.
      limit: Seconds of timed rollouts of each size, at most, but three rollouts.
      out: Folder for rollout_batch.json.
      gate: Report to compare with; exit status 1 if something is worse.
    """

    system: Literal["camdm"] = "camdm"
    characters: tuple[int, ...] = (1, 16, 256)
    seconds: float = 2.0
    run: Path | None = None
    chunks: tuple[int, ...] = (4,)
    staggered: bool = False
    arguments: bool = False
    frames_per_token: int = 1
    width: int = 256
    runs: int = 50
    limit: float = 30.0
    out: Path = Path("runs/benchmarks")
    gate: Path | None = None


def program(
    model: camdm_model.Model, params: Params, chunk: int | None, arguments: bool
) -> tuple[Callable, tuple, list[int]]:
    """The rollout as a jitted function.

    Args:
      model: The model.
      params: Its parameters.
      chunk: Characters at a time; None for all.
      arguments: Whether the parameters are arguments, not constants.

    Returns:
      The function, its first arguments, and a list that grows with every trace.
    """
    traces: list[int] = []

    def run(params: Params, key, states, commands):
        traces.append(1)
        controller = camdm_control.controller(params, model.bones, config=model.config)
        return rollout.rollout(controller, key, states, commands, chunk=chunk)

    if arguments:
        return jax.jit(run), (params,), traces
    return jax.jit(lambda *given: run(params, *given)), (), traces


def case(
    args: Config,
    model: camdm_model.Model,
    params: Params,
    clips: Clips,
    number: int,
    chunk: int | None,
) -> dict[str, Any]:
    """Measures one number of characters and one chunk.

    Args:
      args: The settings.
      model: The model.
      params: Its parameters.
      clips: Where the characters start.
      number: Characters.
      chunk: Characters at a time; None for all.

    Returns:
      One row of the report.
    """
    function, first, traces = program(model, params, chunk, args.arguments)
    states, commands = workload.steered(
        model, clips, number, seconds=args.seconds, staggered=args.staggered
    )
    given = (*first, jax.random.key(0), states, commands)
    run, compile_s = timing.compile_program(function, *given)
    times = timing.time_calls(
        lambda: run(*given), runs=args.runs, limit_s=args.limit, warmup=1, least=3
    )
    _, frames = run(*given)
    p50, p95 = np.percentile(times, [50, 95])
    rate = 1000 * frames.planned.size / p50
    return {
        "characters": number,
        "chunk": chunk or number,
        "traces": len(traces),
        "compile_s": compile_s,
        "p50_ms": float(p50),
        "p95_ms": float(p95),
        "runs": len(times),
        "plans": float(frames.planned.sum() / number),
        "frames_per_second": float(rate),
        "realtime": float(rate / number / model.config.fps),
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


def main() -> None:
    """Measures and writes the report."""
    args = tyro.cli(Config, description=__doc__)
    suite.prepare(args.out, args.gate)
    cases = [(n, chunk) for n in args.characters for chunk in chunks_of(n, args.chunks)]
    clips = workload.make_clips()
    model, params = workload.walker_model(
        clips, args.run, width=args.width, frames_per_token=args.frames_per_token
    )
    rows = []
    for number, chunk in cases:
        rows.append(case(args, model, params, clips, number, chunk))
        print(f"{number} characters: {rows[-1]['frames_per_second']:,.0f} frames/s")
    suite.print_table(rows, COLUMNS)
    suite.report(
        "rollout_batch",
        [metric for row in rows for metric in metrics_of(args.system, row)],
        args.out,
        gate=args.gate,
        rows=rows,
        settings=suite.settings(args),
    )


if __name__ == "__main__":
    suite.start(main)
