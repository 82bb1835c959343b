"""Frames per second of whole steered rollouts.

Example:
  python benchmarks/rollout_batch.py --system camdm --characters 1 16 256
"""

import dataclasses
import functools
from pathlib import Path
from typing import Literal

import jax
import numpy as np
import suite
import tyro

from jaxmotion.control import rollout
from jaxmotion.data import procedural
from jaxmotion.protocols import camdm as protocol
from jaxmotion.systems import camdm, camdm_control, camdm_model


@dataclasses.dataclass(frozen=True)
class Config:
    """Rollouts of the procedural walker, for several numbers of characters.

    Each is one compiled program for all seconds and characters; commands change for
    all characters at the same ticks (the preset "forward").

    Attributes:
      system: What to measure.
      characters: Characters that are rolled out together.
      seconds: Length of a rollout.
      run: Model of the procedural walker (run folder or exported file); None for
        random parameters of the paper's network, which take the same time as trained
        ones.
      chunk: Characters at a time in batches of 16 and more; 0 for all at once.
      runs: Timed rollouts of each size.
      limit: Seconds of timed rollouts of each size, at most.
      out: Folder for rollout_batch.json.
      gate: Report to compare with; exit status 1 if something is worse.
    """

    system: Literal["camdm"] = "camdm"
    characters: tuple[int, ...] = (1, 16, 256)
    seconds: float = 4.0
    run: Path | None = None
    chunk: int = 4
    runs: int = 10
    limit: float = 40.0
    out: Path = Path("runs/benchmarks")
    gate: Path | None = None


def main() -> None:
    """Measures and writes the report."""
    args = tyro.cli(Config, description=__doc__)
    clips = procedural.make_clips(minutes=2)
    if args.run is None:
        config = camdm.Config(num_joints=22, num_labels=len(clips.names("style")))
        params = camdm.init(jax.random.key(0), config)
        model = camdm_model.Model(
            config=config,
            bones=clips.skeleton,
            labels=clips.names("style"),
            source=clips.source,
        )
    else:
        model, params, _ = camdm_model.load(args.run)
    controller = camdm_control.controller(params, model.bones, config=model.config)
    metrics = []
    for number in args.characters:
        labels = np.arange(number) % len(model.labels)
        states = protocol.start_states(clips, model, labels, field="style", seed=0)
        commands = protocol.preset_batch(
            "forward", labels, np.ones(number), seconds=args.seconds, fps=30.0
        )
        divides = args.chunk and number >= 16 and number % args.chunk == 0
        chunk = args.chunk if divides else None
        run = jax.jit(functools.partial(rollout.rollout, controller, chunk=chunk))
        given = (jax.random.key(0), states, commands)
        timing = suite.measure(run, *given, runs=args.runs, limit_s=args.limit)
        frames = 1000 * number * commands.label.shape[1] / timing.p50_ms
        name = f"{args.system} characters={number}"
        print(name, timing, flush=True)
        metrics += [
            suite.Metric(f"{name} frames", frames, "frames/s", "higher"),
            suite.Metric(f"{name} p50", timing.p50_ms, "ms"),
            suite.Metric(f"{name} p95", timing.p95_ms, "ms", tolerance=0.6),
            suite.Metric(f"{name} compile", timing.compile_s, "s", tolerance=0.6),
            suite.Metric(f"{name} programs", 1, "compiled"),
        ]
    suite.report("rollout_batch", metrics, args.out, gate=args.gate)


if __name__ == "__main__":
    main()
