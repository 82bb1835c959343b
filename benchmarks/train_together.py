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
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import suite
import timing
import tyro
import workload

from jaxmotion import cli
from jaxmotion.data import windows
from jaxmotion.learning import training
from jaxmotion.systems.aamdm import loss as aamdm_loss
from jaxmotion.systems.aamdm import model as aamdm_model
from jaxmotion.systems.camdm import loss as camdm_loss
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import training as camdm_training
from jaxmotion.typing import Key

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


@dataclasses.dataclass(frozen=True)
class Config:
    """Training of several models at once against one after another.

    Updates per second are of single models: five models that each make one update a
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
      out: Folder for train_together.json.
      gate: Report to compare with; exit status 1 if something is worse.
    """

    system: Literal["camdm", "aamdm"] = "camdm"
    width: tuple[int, ...] = (32, 128)
    models: int = 5
    updates: int = 4
    batch: int = 48
    rounds: int = 15
    limit: float = 120.0
    out: Path = Path("runs/benchmarks")
    gate: Path | None = None


class Program(NamedTuple):
    """What trains a model: its update, its batches, and its first state."""

    update: training.Update
    sample: Callable[[Key, Any], Any]
    init: Callable[[Key], training.TrainState]
    data: Any


def camdm_program(width: int, batch: int) -> Program:
    """The transformer on windows of the walker.

    Args:
      width: Channels of a token.
      batch: Windows of an update.

    Returns:
      The program.
    """
    clips = workload.make_clips()
    sizes = camdm_training.PRESETS["small"] | {"width": width, "hidden": 4 * width}
    model = camdm_training.make_model(clips, field="style", **sizes)
    optimizer = training.make_optimizer("muon", learning_rate=1e-3, num_steps=1000)
    loss = functools.partial(
        camdm_loss.loss, skeleton=model.skeleton, config=model.config
    )
    return Program(
        update=training.make_update(loss, optimizer),
        sample=camdm_training.window_sampler(field="style", batch=batch),
        init=lambda key: training.init_train_state(
            camdm_model.init(key, model.config), optimizer
        ),
        data=(clips, windows.window_index(clips, model.config.window)),
    )


def aamdm_program(width: int, batch: int) -> Program:
    """The polisher on windows of random frames.

    Args:
      width: Channels of a hidden layer.
      batch: Windows of an update.

    Returns:
      The program.
    """
    config = aamdm_model.Config(features=64, width=width)
    optimizer = training.make_optimizer("radam", learning_rate=1e-4)
    shape = (4096, config.window + 1, config.features)
    frames = np.random.default_rng(0).normal(size=shape)

    def init(key: Key) -> training.TrainState:
        params = aamdm_model.init(key, config)["polisher"]
        return training.init_train_state(params, optimizer)

    def sample(key: Key, data: jax.Array) -> jax.Array:
        return data[jax.random.randint(key, (batch,), 0, data.shape[0])]

    loss = functools.partial(aamdm_loss.polisher_loss, config=config)
    return Program(
        update=training.make_update(loss, optimizer),
        sample=sample,
        init=init,
        data=jnp.asarray(frames, jnp.float32),
    )


SYSTEMS = {"camdm": camdm_program, "aamdm": aamdm_program}
# Axis of the models in each field; they share the number of updates made.
MODELS = training.TrainState(step=None, params=0, ema_params=0, opt_state=0)


def measure(args: Config, width: int) -> dict[str, Any]:
    """Both ways, in turn.

    Args:
      args: The settings.
      width: Channels.

    Returns:
      One row of the report.
    """
    program = SYSTEMS[args.system](width, args.batch)
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
    args = tyro.cli(Config, description=__doc__)
    for name in ("models", "updates", "batch", "rounds"):
        if getattr(args, name) < 1:
            raise ValueError(f"--{name} {getattr(args, name)}: expected 1 or more")
    suite.prepare(args)
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
