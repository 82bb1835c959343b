"""Updates per second of several models trained as one program, and one after another.

Models of the same sizes can be trained by one program that maps an update over their
parameters (`jax.vmap`); they see the same batches. A small model leaves most of a large
device idle, so several at once may cost what one does; where one model keeps the device
busy, nothing is gained. Both ways are timed in turn, in one run.

Examples:
  python benchmarks/train_together.py
  python benchmarks/train_together.py --system aamdm --width 64 256 --batch 64
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import suite
import workload

from jaxmotion import cli
from jaxmotion.evaluation import timing
from jaxmotion.learning import training

COLUMNS = {
    "width": "width",
    "parameters": "parameters",
    "alone": "one after another, updates/s",
    "together": "together, updates/s",
    "ratio": "ratio",
    "low": "p10",
    "high": "p90",
    "rounds": "rounds",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(suite.Settings):
    """Training of several models at once against one after another.

    Updates per second are of single models: five models that each make one update per
    second make five. The ratio is the median over rounds of how much faster training
    together is, with its 10th and 90th percentile.

    Attributes:
      system: camdm (preset "small", on the procedural walker), or aamdm (its polisher,
        on random windows).
      width: Channels; a row each.
      models: Models.
      updates: Optimizer steps of a call.
      batch: Windows of an update.
      rounds: Timed rounds; each has all models' updates both ways.
      limit: Seconds to time for, at most.
    """

    system: str = "camdm"
    width: tuple[int, ...] = (32, 128)
    models: int = 5
    updates: int = 4
    batch: int = 48
    rounds: int = 15
    limit: float = 120.0


# Axis of the models in each field; they share the number of updates made.
MODELS = training.TrainState(step=None, params=0, ema_params=0, opt_state=0)


def measure(args: Config, width: int) -> dict[str, Any]:
    """Both ways, in turn: a row of the report."""
    make = workload.of(args.system, "training")
    program = make(workload.Sizes(width=width), args.batch)
    keys = jax.random.split(jax.random.key(0), args.models)
    key, data = jax.random.key(1), jax.tree.map(jnp.asarray, program.data)
    # The programs donate their state: what they return replaces it.
    singles = [jax.jit(program.init)(k) for k in keys]
    stacked = [jax.jit(jax.vmap(program.init, out_axes=MODELS))(keys)]
    run_one, run_all = (
        training.train_chunk(update, program.sample, num_steps=args.updates)
        for update in (
            program.update,
            jax.vmap(program.update, (MODELS, None, None), (MODELS, 0)),
        )
    )

    def alone() -> list:
        singles[:] = [run_one(state, key, data)[0] for state in singles]
        return singles

    def at_once() -> list:
        stacked[:] = [run_all(stacked[0], key, data)[0]]
        return stacked

    times = timing.time_in_turn(
        {"alone": alone, "together": at_once},
        rounds=args.rounds,
        warmup=2,
        limit_s=args.limit,
    )
    wall = {name: rows[:, 0] for name, rows in times.items()}
    made = args.models * args.updates
    low, ratio, high = np.percentile(wall["alone"] / wall["together"], [10, 50, 90])
    params = jax.tree.leaves(stacked[0].params)
    return {
        "width": width,
        "parameters": sum(x.size for x in params) // args.models,
        "ratio": float(ratio),
        "low": float(low),
        "high": float(high),
        "rounds": len(wall["alone"]),
    } | {name: float(1000 * made / np.median(x)) for name, x in wall.items()}


def main() -> None:
    """Measures, prints the table and writes the report."""
    args = suite.parse(Config, __doc__)
    suite.at_least(args, width=1, models=1, updates=1, batch=1, rounds=1)
    rows = [measure(args, width) for width in args.width]
    suite.print_table(rows, COLUMNS)
    metrics = [
        suite.Metric(
            f"{args.system}, width {row['width']}: {args.models} together over alone",
            row["ratio"],
            "",
            direction="higher",
        )
        for row in rows
    ]
    suite.report("train_together", metrics, args, rows=rows)


if __name__ == "__main__":
    cli.start(main)
