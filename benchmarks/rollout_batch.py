"""Frames per second of whole steered rollouts; how many characters run in real time.

Examples:
  python benchmarks/rollout_batch.py --system camdm --characters 1 16 256
  python benchmarks/rollout_batch.py --characters 64 --chunks 1 4 16 0 --staggered
  python benchmarks/rollout_batch.py --system aamdm --characters 1 64 4096
  python benchmarks/rollout_batch.py --run dribble --characters 1 64 4096 --seconds 0.1
  python benchmarks/rollout_batch.py --characters 1 16 256 4096 65536 --seconds 0.5
      --width 128 --frames-per-token 5
"""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import suite
import workload

from jaxmotion import cli, files
from jaxmotion.control import rollout
from jaxmotion.evaluation import timing
from jaxmotion.networks import work
from jaxmotion.viz import plots

COLUMNS = {
    "characters": "characters",
    "chunk": "chunk",
    "calls": "calls",
    "traces": "traces",
    "compile_s": "compile s",
    "p50_ms": "p50 ms",
    "p95_ms": "p95 ms",
    "runs": "runs",
    "plans": "plans each",
    "frames_per_second": "frames/s",
    "per_cpu_second": "frames/CPU s",
    "realtime": "x real time",
    "per_core": "frames/s/core",
    "characters_per_core": "characters/core",
    "bound_per_core": "bound",
    "memory_mib": "MiB",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(suite.Settings):
    """Rollouts of a character, for several numbers of characters.

    All seconds and characters of a rollout are one compiled program ("traces" counts
    how often it was traced). Frames per second are those of all characters together;
    "x real time" is how much faster than its clock each character runs;
    "characters/core" are so many that one core (or accelerator) runs in real time, and
    "bound" how many it would be if it only multiplied the networks' matrices, at the
    rate of a 1024 x 1024 float32 matmul timed here. Both grow if plans are used longer.
    Crowds that would need too much memory run in smaller chunks, or in several calls.

    Attributes:
      system: What to measure: camdm steers the procedural walker by plans of 45
        frames; aamdm makes every frame, free, and one character is compared with
        Python loops over jitted frames, steps and networks.
      characters: Characters that are rolled out together.
      seconds: Length of a rollout.
      run: Name of a shipped model of any system, to be steered; or a trained model:
        for CAMDM a run folder or exported file of the procedural walker, for AAMDM a
        run folder; None for random parameters, which take the same time.
      chunks: Characters at a time, in batches of 16 and more; 0 for all at once.
        Several compare.
      staggered: CAMDM: change commands at other ticks for each character; without it
        they all plan at the same ticks, which is the least work.
      arguments: Pass the parameters as arguments; without it they are constants of
        the program, as in deployment.
      frames_per_token: CAMDM, of the network with random parameters; 1 is the paper's.
      width: Width of random networks: channels of a token (CAMDM) or of a hidden layer
        (AAMDM); None for 256.
      runs: Timed rollouts of each size; where it is one, none before warms up.
      limit: Seconds of timed rollouts of each size, at most, but one rollout.
      memory_gib: Limit for the program of each size.
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
    memory_gib: float = 4.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Program:
    """The rollout of a crowd, or of a part of it that fits the memory.

    Attributes:
      run: `run(first)` rolls out the part that begins with that character.
      ticks: Ticks of a rollout.
      chunk: Characters at a time.
      calls: Parts of the crowd.
      traces: How often it was traced.
      compile_s: Seconds to compile it.
      needs: Bytes, see `suite.needs_of`.
    """

    run: Callable[[int], Any]
    ticks: int
    chunk: int
    calls: int
    traces: int
    compile_s: float
    needs: dict[str, int]


def compiled(
    args: Config, load: workload.Rollouts, number: int, chunk: int, calls: int
) -> Program:
    """Compiles the rollout of one of so many parts of a crowd."""
    traces: list[int] = []
    states, commands = load.start(number // calls)

    def roll(params, key, first, states, commands):
        traces.append(1)
        return rollout.rollout(
            load.controller(params), key, states, commands, first=first, chunk=chunk
        )

    key, given = jax.random.key(0), (states, commands)
    if args.arguments:
        function, head = jax.jit(roll), (load.params, key)
    else:
        function, head = jax.jit(lambda *rest: roll(load.params, *rest)), (key,)
    first = jnp.int32(0)
    run, seconds = timing.compile_program(function, *head, first, *given)
    return Program(
        run=lambda first: run(*head, jnp.int32(first), *given),
        ticks=commands.label.shape[1],
        chunk=chunk,
        calls=calls,
        traces=len(traces),
        compile_s=seconds,
        needs=suite.needs_of(run, chunk),
    )


def fitting(
    args: Config, load: workload.Rollouts, number: int, chunk: int | None
) -> Program:
    """The program with the largest chunk, and the fewest parts, that fits the memory.

    Raises:
      ValueError: if one character does not fit.
    """
    size, calls, limit = chunk or number, 1, args.memory_gib * suite.GIB
    while True:
        program = compiled(args, load, number, size, calls)
        needs = program.needs
        if needs["total"] <= limit:
            return program
        part = number // calls
        if needs["intermediate"] > limit / 2 and size % 2 == 0:
            size //= 2
        elif part % 2 == 0:
            calls, size = 2 * calls, min(size, part // 2)
        else:
            need = needs["total"] / suite.GIB
            raise ValueError(
                f"--memory-gib {args.memory_gib:g}: {part} characters need {need:.3g} "
                "GiB: expected a higher limit, or a number that can be halved"
            )


def plan_flops(load: workload.Rollouts) -> int:
    """FLOPs of one plan of one character, by the cheapest planner."""
    states, commands = load.start(1)
    state, command = jax.tree.map(lambda x: x[0], (states, commands))
    plan = load.controller(load.params).plans[0]
    now = jax.tree.map(lambda x: x[0], command)
    return work.count(plan, jax.random.key(0), state, now).flops


def processors() -> int:
    """One accelerator, or the cores that this process may use."""
    if jax.default_backend() != "cpu":
        return 1
    known = hasattr(os, "sched_getaffinity")
    return len(os.sched_getaffinity(0)) if known else os.cpu_count() or 1


def case(
    args: Config,
    load: workload.Rollouts,
    number: int,
    chunk: int | None,
    floor: tuple[float, int],
) -> dict[str, Any]:
    """Measures one number of characters and one chunk (None for all): a row.

    Args:
      args: The settings.
      load: What is rolled out.
      number: Characters.
      chunk: Characters at a time, at most.
      floor: FLOP per second of a matmul, and FLOPs of a plan.
    """
    program = fitting(args, load, number, chunk)
    calls, part = program.calls, number // program.calls

    made: list[Any] = []

    def run() -> None:
        for i in range(calls):
            made.clear()
            made.append(jax.block_until_ready(program.run(i * part))[1])

    times, cpu = timing.time_in_turn(
        {"": run},
        rounds=args.runs,
        limit_s=args.limit,
        warmup=min(args.runs - 1, 1),
        least=1,
    )[""].T
    plans = load.plans(made[0]) / part
    p50, p95 = np.percentile(times, [50, 95])
    rate = 1000 * number * program.ticks / p50
    cores, seconds = processors(), program.ticks / load.fps
    return {
        "characters": number,
        "chunk": program.chunk,
        "calls": calls,
        "traces": program.traces,
        "compile_s": program.compile_s,
        "p50_ms": float(p50),
        "p95_ms": float(p95),
        "runs": len(times),
        "plans": plans,
        "frames_per_second": float(rate),
        "per_cpu_second": float(1000 * number * program.ticks / np.median(cpu)),
        "realtime": float(rate / number / load.fps),
        "per_core": float(rate / cores),
        "characters_per_core": float(rate / load.fps / cores),
        "bound_per_core": floor[0] / (plans * floor[1] / seconds) / cores,
        "memory_mib": program.needs["total"] / 2**20,
    }


def python_loops(
    args: Config, load: workload.Rollouts
) -> dict[str, tuple[float, float]]:
    """Python loops over the ticks of one character, timed in turn with the program.

    Returns:
      By name, frames per second and how many times as fast the program is: medians,
      the latter of ratios within a round. Empty where the system has no loops.
    """
    _, commands = load.start(1)
    if not (loops := load.loops(commands.label.shape[1])):
        return {}
    program = fitting(args, load, 1, None)
    times = timing.time_in_turn(
        {"": lambda: program.run(0), **loops},
        rounds=args.runs,
        limit_s=args.limit,
        least=1,
    )
    wall = {name: values[:, 0] for name, values in times.items()}
    return {
        name: (
            float(1000 * program.ticks / np.median(wall[name])),
            float(np.median(wall[name] / wall[""])),
        )
        for name in loops
    }


def slope(rows: list[dict[str, Any]]) -> float | None:
    """Exponent e of time ~ characters^e, by least squares over the logarithms.

    Returns:
      1 where cost grows as the crowd; None for one number of characters.
    """
    x, y = (np.log([row[name] for row in rows]) for name in ("characters", "p50_ms"))
    return float(np.polyfit(x, y, 1)[0]) if np.ptp(x) else None


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
    shipped = args.run is not None and files.shipped(args.run) is not None
    if args.run is not None and args.width is not None:
        raise ValueError("--width is of random networks, expected none beside --run")
    if shipped:
        load = workload.shipped_rollouts(str(args.run), args.seconds, args.staggered)
    else:
        make = workload.of(args.system, "rollouts")
        sizes = workload.Sizes(width=args.width, frames_per_token=args.frames_per_token)
        load = make(sizes, args.run, args.seconds, args.staggered)
    chunks = (load.chunk,) if args.chunks is None else args.chunks
    cases = [(n, chunk) for n in args.characters for chunk in chunks_of(n, chunks)]
    floor = timing.matmul_rate(), plan_flops(load)
    print(f"matmul: {floor[0] / 1e9:.4g} GFLOP/s; a plan: {floor[1] / 1e9:.4g} GFLOP")
    rows, metrics, what = [], [], args.run.name if shipped else args.system
    for number, chunk in cases:
        row = case(args, load, number, chunk, floor)
        rows.append(row)
        name = f"{what} characters={number} chunk={row['chunk']}"
        metrics += suite.time_metrics(name, row)
        metrics.append(
            suite.Metric(f"{name} traces", row["traces"], "traces", tolerance=0.0)
        )
        print(f"{number} characters: {row['frames_per_second']:,.0f} frames/s")
        suite.save("rollout_batch", metrics, args, rows=rows)
    suite.print_table(rows, COLUMNS)
    suite.write_table(args.out / "rollout_batch", rows, COLUMNS)
    steep = slope(rows)
    if steep is not None:
        print(f"time grows as characters^{steep:.3f}")
        table = np.array([(row["characters"], row["p50_ms"]) for row in rows])
        plots.plot_sweep(
            args.out / "rollout_batch.png",
            {what: (*table.T, None)},
            xlabel="characters",
            ylabel=f"{args.seconds:g} s of motion, ms (p50)",
        )
    loops = python_loops(args, load) if 1 in args.characters else {}
    for name, (rate, ratio) in loops.items():
        metrics.append(
            suite.Metric(
                f"{args.system} Python loop, {name}", rate, "frames/s", "higher", 0.6
            )
        )
        print(
            f"Python loop, {name}: {rate:,.1f} frames/s; one program is {ratio:.2f} "
            "times as fast"
        )
    more = {"slope": steep, "matmul_gflops": floor[0] / 1e9, "plan_flops": floor[1]}
    more |= {"python_loops": loops} if loops else {}
    suite.report("rollout_batch", metrics, args, rows=rows, **more)


if __name__ == "__main__":
    cli.start(main)
