"""Frames per second of whole steered rollouts.

Example:
  python benchmarks/rollout_batch.py --system camdm --characters 1 16 256
  python benchmarks/rollout_batch.py --characters 64 --chunks 1 4 16 0 --staggered
  python benchmarks/rollout_batch.py --system aamdm --characters 1 64 4096
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np
import suite
import workload

from jaxmotion import cli
from jaxmotion.control import rollout
from jaxmotion.evaluation import timing

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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(suite.Settings):
    """Rollouts of a character, for several numbers of characters.

    All seconds and characters of a rollout are one compiled program ("traces" counts
    how often it was traced). Frames per second are those of all characters together;
    "x real time" is how much faster than its clock each character runs.

    Attributes:
      system: What to measure: camdm steers the procedural walker by plans of 45
        frames; aamdm makes every frame, free, and is compared with a Python loop over
        its jitted networks.
      characters: Characters that are rolled out together.
      seconds: Length of a rollout.
      run: Trained model: for CAMDM a run folder or exported file of the procedural
        walker, for AAMDM a run folder; None for random parameters, which take the same
        time as trained ones.
      chunks: Characters at a time, in batches of 16 and more; 0 for all at once.
        Several compare.
      staggered: CAMDM: change commands at other ticks for each character; without it
        they all plan at the same ticks, which is the least work.
      arguments: Pass the parameters as arguments; without it they are constants of
        the program, as in deployment.
      frames_per_token: CAMDM, of the network with random parameters; 1 is the paper's.
      width: Width of random networks: channels of a token (CAMDM) or of a hidden layer
        (AAMDM); None for 256.
      runs: Timed rollouts of each size.
      limit: Seconds of timed rollouts of each size, at most, but three rollouts.
    """

    system: str = "camdm"
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


def case(
    args: Config, load: workload.Rollouts, number: int, chunk: int | None
) -> dict[str, Any]:
    """Measures one number of characters and one chunk (None for all): a row."""
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
        lambda: run(*given), rounds=args.runs, limit_s=args.limit, warmup=1, least=3
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


def chunks_of(number: int, chunks: tuple[int, ...]) -> list[int | None]:
    """Chunks to measure a number of characters with.

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
    args = suite.parse(Config, __doc__)
    suite.at_least(args, characters=1, runs=1)
    make = workload.of(args.system, "rollouts")
    sizes = workload.Sizes(width=args.width, frames_per_token=args.frames_per_token)
    load = make(sizes, args.run, args.seconds, args.staggered)
    chunks = (load.chunk,) if args.chunks is None else args.chunks
    cases = [(n, chunk) for n in args.characters for chunk in chunks_of(n, chunks)]
    rows, metrics = [], []
    for number, chunk in cases:
        row = case(args, load, number, chunk)
        rows.append(row)
        name = f"{args.system} characters={number} chunk={row['chunk']}"
        metrics += suite.time_metrics(name, row)
        metrics.append(
            suite.Metric(f"{name} traces", row["traces"], "traces", tolerance=0.0)
        )
        print(f"{number} characters: {row['frames_per_second']:,.0f} frames/s")
    suite.print_table(rows, COLUMNS)
    alone = [row["frames_per_second"] for row in rows if row["characters"] == 1]
    loops = {}
    for name, rate in load.loops(args.limit).items():
        loops[name] = rate
        metrics.append(
            suite.Metric(
                f"{args.system} Python loop, {name}", rate, "frames/s", "higher", 0.6
            )
        )
        text = f"Python loop, {name}: {rate:,.1f} frames/s"
        if alone:
            loops[f"ratio, {name}"] = alone[0] / rate
            text += f"; as one program {alone[0] / rate:.1f} times as many"
        print(text)
    more = {"python_loops": loops} if loops else {}
    suite.report("rollout_batch", metrics, args, rows=rows, **more)


if __name__ == "__main__":
    cli.start(main)
