"""Held-out loss against updates and processor time, of one network by several optimizers.

From the same parameters (but for a factor, if one is given), on the same batches and
noise, with updates made in turn: what else the machine does slows all alike. The loss is of the averaged parameters, on
windows and noise that are the same at all times.

Examples:
  python experiments/camdm.py train --data data/o3de.npz --out runs/curve --steps 1
  python experiments/optimizers.py --run runs/curve --optimizers muon=2e-3 adamw=2e-3
"""  # noqa: E501

import dataclasses
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from jaxmotion import cli, reporting
from jaxmotion.data import clips_io, windows
from jaxmotion.evaluation import table
from jaxmotion.learning import loop, runs, training
from jaxmotion.systems.camdm import loss as camdm_loss
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import training as camdm_training
from jaxmotion.typing import Key, Params
from jaxmotion.viz import plots

PARTS = (0.25, 0.5, 0.75, 1.0)  # of the updates at which tables have the loss


@dataclasses.dataclass(frozen=True)
class Config:
    """Train CAMDM's network by several optimizers, in turn.

    Attributes:
      run: Run folder of `camdm.py train`, for its data and network: random parameters
        are trained here.
      optimizers: Names with their peak rates; a row each. After an "@" a factor on the
        first weights of linear layers.
      out: Folder for metrics.json, table.md and curves.png.
      seeds: Trainings by each, of seeds 0, 1, ...
      steps: Updates of each; warm-up over a tenth of them, cosine to a tenth.
      chunk: Updates between two points of a curve.
      batch: Windows per update.
      windows: Held-out windows.
    """

    run: Path
    optimizers: tuple[str, ...] = ("muon=2e-3", "adamw=2e-3")
    out: Path = Path("runs/optimizers")
    seeds: int = 3
    steps: int = 1000
    chunk: int = 50
    batch: int = 12
    windows: int = 128


def budget_of(text: str, steps: int) -> runs.Budget:
    """How a row is trained.

    Raises:
      ValueError: if the text is no name with a rate.
    """
    name, _, numbers = text.partition("=")
    rate, _, scale = numbers.partition("@")
    known: dict[str, training.OptimizerName] = {x: x for x in training.OPTIMIZERS}
    try:
        return runs.Budget(
            steps=steps,
            optimizer=known[name],
            learning_rate=float(rate),
            warmup=steps // 10,
            final=0.1,
            max_norm=1.0,
            initial_scale=float(scale or 1.0),
        )
    except (KeyError, ValueError) as error:
        raise ValueError(
            f"--optimizers: {text!r}, expected name=rate, a name of {', '.join(known)}"
        ) from error


def crossing(spent: np.ndarray, losses: np.ndarray, level: float) -> float:
    """Where a curve first is as low as a level, between its points; nan if nowhere."""
    below = np.flatnonzero(losses <= level)
    if not below.size:
        return np.nan
    last = max(int(below[0]), 1)
    pair = slice(last - 1, last + 1)
    return float(np.interp(-level, -losses[pair], spent[pair]))


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """A training: held-out losses, and processor seconds of all updates until then."""

    losses: np.ndarray
    seconds: np.ndarray


def train_in_turn(
    programs: dict[str, Callable],
    states: dict[str, Any],
    key: Key,
    data: Any,
    held_out: Callable[[Params], Any],
    *,
    chunk: int,
    rounds: int,
) -> dict[str, Curve]:
    """A curve for each program, from its state before any update.

    Raises:
      FloatingPointError: if a loss is not finite; names the row.
    """
    names = list(programs)
    losses = {k: [float(held_out(states[k].ema_params))] for k in names}
    spent = {k: [0.0] for k in names}
    for count in range(rounds):
        for name in names[count % len(names) :] + names[: count % len(names)]:
            begun = time.process_time()
            made = programs[name](states[name], key, data, chunk)
            states[name], _ = jax.block_until_ready(made)
            spent[name].append(time.process_time() - begun)
            losses[name].append(float(held_out(states[name].ema_params)))
            if not np.isfinite(losses[name][-1]):
                raise FloatingPointError(f"{name}: the held-out loss is not finite")
    return {
        k: Curve(losses=np.array(losses[k]), seconds=np.cumsum(spent[k])) for k in names
    }


def rows_of(curves: dict[str, list[Curve]], chunk: int) -> table.Rows:
    """Means over seeds, with intervals, for each optimizer.

    Updates and seconds are until the loss at which the worst of them ends, seed by
    seed.
    """
    number = len(next(iter(curves.values())))
    level = [max(own[i].losses[-1] for own in curves.values()) for i in range(number)]
    rows = {}
    for name, own in curves.items():
        last = len(own[0].losses) - 1
        updates = np.arange(last + 1) * chunk
        values = {
            f"held_out_{part * 100:.0f}": [x.losses[round(part * last)] for x in own]
            for part in PARTS
        }
        steps = [np.diff(x.seconds) / chunk * 1000 for x in own]
        values["update_time"] = [np.median(x) for x in steps]
        pairs = list(zip(own, level, strict=True))
        values["updates_needed"] = [crossing(updates, x.losses, y) for x, y in pairs]
        values["seconds_needed"] = [crossing(x.seconds, x.losses, y) for x, y in pairs]
        rows[name] = {k: table.cell(jnp.asarray(x)) for k, x in values.items()}
    return rows


def draw(path: Path, curves: dict[str, list[Curve]], chunk: int) -> None:
    """Means over seeds, with lowest and highest, over updates and over seconds."""

    def line(own: list[Curve], axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        every = np.stack([x.losses for x in own])
        ends = (every.mean(axis=0), every.min(axis=0), every.max(axis=0))
        return axis[1:], np.stack(ends, axis=1)[1:]

    panels = []
    for label in ("updates", "seconds of processor time"):
        lines = {}
        for name, own in curves.items():
            seconds = np.mean([x.seconds for x in own], axis=0)
            updates = np.arange(len(seconds)) * chunk
            lines[name] = line(own, updates if label == "updates" else seconds)
        axes = plots.Curves(
            title="", xlabel=label, ylabel="held-out loss", lines=lines, noisy=False
        )
        panels.append(axes)
    plots.write_curves(path, tuple(panels), title="CAMDM: held-out loss by optimizer")


def main() -> None:
    """Writes table and picture."""
    args = cli.check(tyro.cli(Config, description=__doc__))
    loop.check_writable(args.out)
    if args.steps % args.chunk:
        raise ValueError(
            f"--steps is {args.steps}, expected a multiple of --chunk, {args.chunk}"
        )
    chosen = {text: budget_of(text, args.steps) for text in args.optimizers}
    optimizers = {text: runs.make_optimizer(own) for text, own in chosen.items()}
    run = runs.load(args.run, system=camdm_model.SYSTEM)
    model = camdm_model.from_json(run.model, where=str(run.config))
    config, field = model.config, run.settings["label"]
    data = camdm_training.training_windows(run, config)
    loss = functools.partial(camdm_loss.loss, skeleton=model.skeleton, config=config)
    clips = clips_io.load_clips(run.file("held_out.npz"))
    kept = clips, windows.window_index(clips, config.window, short="skip")
    key_windows, key_noise = jax.random.split(jax.random.key(2**31 - 1))
    draws = camdm_training.window_sampler(field=field, batch=args.windows)
    batch = draws(key_windows, jax.tree.map(jnp.asarray, kept))
    scored = jax.jit(loss)

    def held_out(params: Params) -> Any:
        return scored(params, key_noise, batch)[0]

    sample = camdm_training.window_sampler(field=field, batch=args.batch)
    programs = {
        name: training.train_chunk(
            training.make_update(loss, optimizer, ema_decay=0.999),
            sample,
            num_steps=args.chunk,
        )
        for name, optimizer in optimizers.items()
    }
    curves: dict[str, list[Curve]] = {name: [] for name in chosen}
    for seed in range(args.seeds):
        key_init, key = jax.random.split(jax.random.key(seed))
        params = camdm_model.init(key_init, config)
        states = {}
        for name, optimizer in optimizers.items():
            # A state is donated: each has parameters of its own; the call compiles.
            own = jax.tree.map(jnp.copy, runs.initial(params, chosen[name]))
            begin = training.init_train_state(own, optimizer)
            states[name], _ = programs[name](begin, key, data, 0)
        found = train_in_turn(
            *(programs, states, key, data, held_out),
            chunk=args.chunk,
            rounds=args.steps // args.chunk,
        )
        for name, curve in found.items():
            curves[name].append(curve)
            last = f"{curve.losses[-1]:.4g} after {curve.seconds[-1]:.0f} s"
            print(f"{name}, seed {seed}: held-out loss {last}", flush=True)
    rows = rows_of(curves, args.chunk)
    about = {"source": run.source} | reporting.provenance(args)
    about |= {"seeds": {"training": list(range(args.seeds))}}
    # Of the run, which is not continued.
    for name in ("training", "models", "minutes"):
        about.pop(name, None)
    about["curves"] = {
        name: [
            {"losses": x.losses.tolist(), "seconds": x.seconds.tolist()} for x in own
        ]
        for name, own in curves.items()
    }
    reporting.write_table(args.out, rows, about, (run.source,))
    draw(args.out / "curves.png", curves, args.chunk)


if __name__ == "__main__":
    cli.start(main)
