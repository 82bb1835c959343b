"""Latency of one sample against the number of diffusion steps.

Examples:
  python benchmarks/step_counts.py --system camdm --steps 2 4 8 16 32 --batch 1 64
  python benchmarks/step_counts.py --system emdm --steps 1 5 10 20 50 --batch 1 32
  python benchmarks/step_counts.py --system smgdiff --guided
"""

import dataclasses
from typing import Any

import numpy as np
import suite
import workload

from jaxmotion import cli
from jaxmotion.evaluation import timing
from jaxmotion.viz import plots

COLUMNS = {
    "batch": "batch",
    "steps": "steps",
    "guided": "guided",
    "compile_s": "compile s",
    "p50_ms": "p50 ms",
    "p95_ms": "p95 ms",
    "runs": "runs",
    "frames_per_second": "frames/s",
    "ms_per_frame": "ms/frame",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(suite.Settings):
    """Compile time, p50 and p95 of one sample for several step counts and batches.

    A sample is a plan, or EMDM's whole motion, or AAMDM's frame. Parameters are random:
    they do not change the time. Each step count and batch is a program of its own,
    compiled on purpose.

    Attributes:
      system: What to measure: camdm, aamdm, emdm or smgdiff.
      steps: Diffusion steps.
      batch: Characters that are sampled together.
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
    """

    system: str = "camdm"
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


def case(args: Config, steps: int, batch: int, guided: bool) -> dict[str, Any]:
    """Measures one step count and batch: a row of the report."""
    sizes = workload.Sizes(
        steps=steps,
        width=args.width,
        frames_per_token=args.frames_per_token,
        paper=args.paper,
        guided=guided,
    )
    samples = workload.of(args.system, "samples")(sizes)
    run, given = samples.program(batch, chunk=args.chunk, arguments=args.arguments)
    found = timing.measure(run, *given, rounds=args.runs, limit_s=args.limit)
    frames = batch * samples.frames
    return {
        "batch": batch,
        "steps": steps,
        "guided": guided,
        **dataclasses.asdict(found),
        "frames_per_second": 1000 * frames / found.p50_ms,
        "ms_per_frame": found.p50_ms / frames,
    }


def main() -> None:
    """Measures, writes the report and the plot."""
    args = suite.parse(Config, __doc__)
    suite.at_least(args, steps=1, batch=1, chunk=0, runs=1)
    if args.guided and args.system != "smgdiff":
        raise ValueError(f"--guided is of smgdiff, not of {args.system}")
    rows, metrics, lines = [], [], {}
    for batch in args.batch:
        for guided in (False, True) if args.guided else (False,):
            own = []
            for steps in args.steps:
                own.append(case(args, steps, batch, guided))
                about = f"steps={steps} batch={batch}{' guided' if guided else ''}"
                print(f"{about}: {own[-1]['p50_ms']:.4g} ms", flush=True)
                metrics += suite.time_metrics(f"{args.system} {about}", own[-1])
            lines[f"batch {batch}{', guided' if guided else ''}"] = tuple(
                np.array([row[name] for row in own])
                for name in ("steps", "p50_ms", "p95_ms")
            )
            rows += own
    suite.print_table(rows, COLUMNS)
    plots.plot_sweep(
        args.out / "step_counts.png",
        lines,
        xlabel="diffusion steps",
        ylabel="a batch of samples, ms (p50, whisker to p95)",
    )
    suite.report("step_counts", metrics, args, rows=rows)


if __name__ == "__main__":
    cli.start(main)
