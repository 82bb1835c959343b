"""Latency of one plan against the number of diffusion steps.

Example:
  python benchmarks/step_counts.py --system camdm --steps 2 4 8 16 32 --batch 1 64
"""

import dataclasses
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import suite
import tyro

from jaxmotion.motion import trajectory
from jaxmotion.systems import camdm


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
      width: Channels of a token.
      runs: Timed calls of each program.
      limit: Seconds of timed calls of each program, at most.
      out: Folder for step_counts.json and step_counts.png.
      gate: Report to compare with; exit status 1 if something is worse.
    """

    system: Literal["camdm"] = "camdm"
    steps: tuple[int, ...] = (2, 4, 8, 16, 32)
    batch: tuple[int, ...] = (1, 64)
    arguments: bool = False
    chunk: int = 4
    frames_per_token: int = 1
    width: int = 256
    runs: int = 50
    limit: float = 25.0
    out: Path = Path("runs/benchmarks")
    gate: Path | None = None


def condition(config: camdm.Config, batch: int) -> camdm.Condition:
    """A batch of conditions of plausible size; their values do not matter."""
    rng = np.random.default_rng(0)
    facing = rng.normal(size=(batch, config.future, 2))
    facing /= np.linalg.norm(facing, axis=-1, keepdims=True)
    return camdm.Condition(
        past=jnp.asarray(
            rng.normal(size=(batch, config.past, config.num_features)), jnp.float32
        ),
        trajectory=trajectory.Trajectory(
            position=jnp.asarray(
                rng.normal(size=(batch, config.future, 2)), jnp.float32
            ),
            facing=jnp.asarray(facing, jnp.float32),
        ),
        label=jnp.zeros(batch, jnp.int32),
        keep_past=jnp.ones(batch, bool),
    )


def sampler(config: camdm.Config, params, batch: int, chunk: int, arguments: bool):
    """Jitted function and arguments of one batch of plans."""

    def plans(params, keys, conditions):
        plan = camdm.planner(params, config=config)
        size = chunk if chunk and batch >= 16 and batch % chunk == 0 else batch
        if size == batch:
            return jax.vmap(plan)(keys, conditions)
        return jax.lax.map(lambda x: plan(*x), (keys, conditions), batch_size=size)

    keys = jax.random.split(jax.random.key(1), batch)
    conditions = condition(config, batch)
    if batch == 1:
        # The one-character program, not a batch of one.
        keys, conditions = jax.tree.map(lambda x: x[0], (keys, conditions))

        def one(params, key, single):
            return camdm.planner(params, config=config)(key, single)

        run = one
    else:
        run = plans
    if arguments:
        return jax.jit(run), (params, keys, conditions)
    return jax.jit(lambda k, c: run(params, k, c)), (keys, conditions)


def main() -> None:
    """Measures, writes the report and the plot."""
    args = tyro.cli(Config, description=__doc__)
    metrics, rows = [], []
    for batch in args.batch:
        for steps in args.steps:
            config = camdm.Config(
                num_joints=25,
                num_labels=100,
                num_steps=steps,
                width=args.width,
                hidden=4 * args.width,
                frames_per_token=args.frames_per_token,
            )
            params = camdm.init(jax.random.key(0), config)
            run, given = sampler(config, params, batch, args.chunk, args.arguments)
            timing = suite.measure(run, *given, runs=args.runs, limit_s=args.limit)
            frames = 1000 * batch * config.future / timing.p50_ms
            name = f"{args.system} steps={steps} batch={batch}"
            rows.append(
                dataclasses.asdict(timing)
                | {"steps": steps, "batch": batch, "network_calls": steps}
                | {"frames_per_second": frames}
            )
            metrics += [
                suite.Metric(f"{name} p50", timing.p50_ms, "ms"),
                suite.Metric(f"{name} p95", timing.p95_ms, "ms", tolerance=0.6),
                suite.Metric(f"{name} compile", timing.compile_s, "s", tolerance=0.6),
                suite.Metric(f"{name} frames", frames, "frames/s", "higher"),
            ]
            print(name, timing, flush=True)
    suite.report("step_counts", metrics, args.out, gate=args.gate, rows=rows)

    from jaxmotion.viz import figure

    lines = {}
    for batch in args.batch:
        own = [row for row in rows if row["batch"] == batch]
        lines[f"batch {batch}"] = tuple(
            np.array([row[name] for row in own])
            for name in ("steps", "p50_ms", "p95_ms")
        )
    figure.plot_sweep(
        args.out / "step_counts.png",
        lines,
        xlabel="diffusion steps",
        ylabel="one plan, ms (p50, whisker to p95)",
    )


if __name__ == "__main__":
    main()
