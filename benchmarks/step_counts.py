"""Latency of one plan against the number of diffusion steps.

Examples:
  python benchmarks/step_counts.py --system camdm --steps 2 4 8 16 32 --batch 1 64
  python benchmarks/step_counts.py --system emdm --steps 1 5 10 20 50 --batch 1 32
  python benchmarks/step_counts.py --system smgdiff --guided
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import suite
import timing
import tyro
import workload
import workload_emdm
import workload_smgdiff
from jaxtyping import Array

from jaxmotion import cli
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.typing import Params
from jaxmotion.viz import figure

COLUMNS = {
    "batch": "batch",
    "steps": "steps",
    "guided": "guided",
    "network_calls": "network calls",
    "compile_s": "compile s",
    "p50_ms": "p50 ms",
    "p95_ms": "p95 ms",
    "runs": "runs",
    "frames_per_second": "frames/s",
    "ms_per_frame": "ms/frame",
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Compile time, p50 and p95 of one plan for several step counts and batches.

    Parameters are random: they do not change the time. Each step count and batch is a
    program of its own, compiled on purpose.

    Attributes:
      system: What to measure.
      steps: Diffusion steps.
      batch: Characters that plan together.
      arguments: Pass the parameters as arguments; without it they are constants of
        the program, as in deployment.
      chunk: Run batches of 16 and more in chunks of so many characters; 0 for all at
        once.
      frames_per_token: Frames of one token; 1 is the paper's network.
      width: Channels of a token; None for 256, or 128 (emdm, the size that
        experiments/emdm.py trains).
      guided: Measure SMGDiff's plans with contact guidance in the last two steps as
        well.
      paper: Measure EMDM's network of 12 layers and 1024 channels, one frame a token.
      runs: Timed calls of each program.
      limit: Seconds of timed calls of each program, at most.
      out: Folder for step_counts.json and step_counts.png.
      gate: Report to compare with; exit status 1 if something is worse.
    """

    system: Literal["camdm", "emdm", "smgdiff"] = "camdm"
    steps: tuple[int, ...] = (2, 4, 8, 16, 32)
    batch: tuple[int, ...] = (1, 64)
    arguments: bool = False
    chunk: int = 4
    frames_per_token: int = 1
    width: int | None = None
    guided: bool = False
    paper: bool = False
    runs: int = 50
    limit: float = 25.0
    out: Path = Path("runs/benchmarks")
    gate: Path | None = None


def sampler(
    config: camdm_model.Config, params: Params, batch: int, chunk: int, arguments: bool
) -> tuple[Callable, tuple]:
    """One batch of plans as a jitted function.

    Args:
      config: The network.
      params: Its parameters.
      batch: Characters; 1 is the program of one character, not a batch of one.
      chunk: Characters at a time in batches of 16 and more; 0 for all at once.
      arguments: Whether the parameters are arguments, not constants.

    Returns:
      The function and its arguments.
    """

    def plans(params: Params, keys: Array, conditions: camdm_model.Condition) -> Array:
        plan = camdm_model.sampler(params, config=config)
        if batch == 1:
            return plan(keys[0], jax.tree.map(lambda x: x[0], conditions))
        if not chunk or batch < 16:
            return jax.vmap(plan)(keys, conditions)
        return jax.lax.map(lambda x: plan(*x), (keys, conditions), batch_size=chunk)

    given = (
        jax.random.split(jax.random.key(1), batch),
        workload.conditions(config, batch),
    )
    if arguments:
        return jax.jit(plans), (params, *given)
    return jax.jit(functools.partial(plans, params)), given


def program(
    args: Config, steps: int, batch: int, guided: bool
) -> tuple[Callable, tuple, int]:
    """What is timed.

    Args:
      args: The settings.
      steps: Diffusion steps.
      batch: Characters or motions.
      guided: With contact guidance.

    Returns:
      The jitted function, its arguments, and frames of a plan or motion.
    """
    if args.system == "smgdiff":
        return workload_smgdiff.program(
            steps=steps,
            batch=batch,
            width=args.width or 256,
            frames_per_token=args.frames_per_token,
            guided=guided,
            arguments=args.arguments,
            chunk=args.chunk,
        )
    if args.system == "emdm":
        return workload_emdm.program(
            steps=steps,
            batch=batch,
            width=args.width or 128,
            paper=args.paper,
            arguments=args.arguments,
            chunk=args.chunk,
        )
    config = workload.paper_config(
        steps=steps, width=args.width or 256, frames_per_token=args.frames_per_token
    )
    params = camdm_model.init(jax.random.key(0), config)
    run, given = sampler(config, params, batch, args.chunk, args.arguments)
    return run, given, config.future


def case(
    args: Config, steps: int, batch: int, *, guided: bool = False
) -> dict[str, Any]:
    """Measures one step count and batch.

    Args:
      args: The settings.
      steps: Diffusion steps.
      batch: Characters or motions.
      guided: With contact guidance.

    Returns:
      One row of the report.
    """
    run, given, frames = program(args, steps, batch, guided)
    found = timing.measure(run, *given, runs=args.runs, limit_s=args.limit)
    return {
        "batch": batch,
        "steps": steps,
        "guided": guided,
        "network_calls": steps,
        **dataclasses.asdict(found),
        "frames_per_second": 1000 * batch * frames / found.p50_ms,
        "ms_per_frame": found.p50_ms / (batch * frames),
    }


def metrics_of(system: str, row: dict[str, Any]) -> list[suite.Metric]:
    """Metrics of a row, for the gate.

    Args:
      system: What was measured.
      row: From `case`.

    Returns:
      Four metrics.
    """
    name = f"{system} steps={row['steps']} batch={row['batch']}"
    name += " guided" if row["guided"] else ""
    return [
        suite.Metric(f"{name} p50", row["p50_ms"], "ms"),
        suite.Metric(f"{name} p95", row["p95_ms"], "ms", tolerance=0.6),
        suite.Metric(f"{name} compile", row["compile_s"], "s", tolerance=0.6),
        suite.Metric(f"{name} frames", row["frames_per_second"], "frames/s", "higher"),
    ]


def main() -> None:
    """Measures, writes the report and the plot."""
    args = tyro.cli(Config, description=__doc__)
    if args.guided and args.system != "smgdiff":
        raise ValueError(f"--guided is of smgdiff, not of {args.system}")
    suite.prepare(args)
    kinds = (False, True) if args.guided else (False,)
    rows = []
    for batch in args.batch:
        for steps in args.steps:
            for guided in kinds:
                rows.append(case(args, steps, batch, guided=guided))
                about = f"batch {batch}, {steps} steps{', guided' if guided else ''}"
                print(f"{about}: {rows[-1]['p50_ms']:.4g} ms", flush=True)
    suite.print_table(rows, COLUMNS)
    lines = {}
    for batch in args.batch:
        for guided in kinds:
            own = [r for r in rows if (r["batch"], r["guided"]) == (batch, guided)]
            lines[f"batch {batch}{', guided' if guided else ''}"] = tuple(
                np.array([row[name] for row in own])
                for name in ("steps", "p50_ms", "p95_ms")
            )
    figure.plot_sweep(
        args.out / "step_counts.png",
        lines,
        xlabel="diffusion steps",
        ylabel="a batch of plans, ms (p50, whisker to p95)",
    )
    metrics = [metric for row in rows for metric in metrics_of(args.system, row)]
    suite.report("step_counts", metrics, args, rows=rows)


if __name__ == "__main__":
    cli.start(main)
