"""Squ-9-Gaussian: who keeps all nine modes when each step may go to any of them?

Points in the plane follow each other; each is drawn from one of nine Gaussians on a
3 x 3 grid, and the next may come from any of them. AAMDM and the baselines of its
tables learn the step, and are then rolled out from the same starts.

Example: python experiments/squ9.py --out runs/squ9

Source: Li et al. 2024 (AAMDM), section 4.2 and figure 4. The numbers of the toy
(centers -1, 0, 1, deviation 0.1, uniform modes) are ours, since the paper gives none.
"""

import dataclasses
import functools
import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from baselines import amdm, lmm, mvae

from jaxmotion import cli, files
from jaxmotion.evaluation import modes
from jaxmotion.learning import adversarial, loop, training
from jaxmotion.systems.aamdm import loss as aamdm_loss
from jaxmotion.systems.aamdm import model as aamdm_model
from jaxmotion.viz import plots

CENTERS = np.stack(np.meshgrid(*2 * [[-1.0, 0.0, 1.0]]), axis=-1).reshape(9, 2)
SIGMA = 0.1
SCALE = float(np.sqrt(2 / 3 + SIGMA**2))  # standard deviation of a coordinate


@dataclasses.dataclass(frozen=True)
class Config:
    """Trains AAMDM, AMDM5, MVAE and LMM on the toy, rolls out, scores and plots.

    Attributes:
      out: Folder for scores.json and squ9.png.
      steps: Updates of each model; the GAN makes twice as many.
      batch: Windows per update.
      width: Channels of hidden layers.
      sequences: Rollouts of each model.
      length: Steps of a rollout.
    """

    out: Path = Path("runs/squ9")
    steps: int = 3000
    batch: int = 256
    width: int = 128
    sequences: int = 1000
    length: int = 50
    seed: int = 0


def sequences(key: jax.Array, number: int, length: int) -> jax.Array:
    """Sequences of the toy, in units of a coordinate's standard deviation."""
    key_mode, key_point = jax.random.split(key)
    mode = jax.random.randint(key_mode, (number, length), 0, 9)
    noise = jax.random.normal(key_point, (number, length, 2))
    return (jnp.asarray(CENTERS, jnp.float32)[mode] + SIGMA * noise) / SCALE


def fit(update, state, key, *, steps: int, batch: int, window: int):
    """Trains on fresh sequences, as one compiled program."""
    run = training.train_chunk(
        update, lambda key, _: sequences(key, batch, window), num_steps=steps
    )
    state, info = run(state, key, None)
    if not np.isfinite(np.asarray(info["loss"])).all():
        raise FloatingPointError("squ9: the loss is not finite")
    return state


def train_aamdm(args: Config, key):
    """AAMDM on the points themselves; returns its stepper."""
    config = aamdm_model.Config(features=2, width=args.width, latent=16)
    key_init, key_p, key_g = jax.random.split(key, 3)
    params = aamdm_model.init(key_init, config)
    polisher_loss = functools.partial(aamdm_loss.polisher_loss, config=config)
    optimizer = training.make_optimizer("radam", learning_rate=1e-3)
    state = fit(
        training.make_update(polisher_loss, optimizer),
        training.init_train_state(params["polisher"], optimizer),
        key_p,
        steps=args.steps,
        batch=args.batch // 4,
        window=config.window + 1,
    )
    players = [
        training.make_optimizer("radam", learning_rate=rate) for rate in (5e-4, 5e-4)
    ]
    update = adversarial.make_gan_update(
        functools.partial(aamdm_loss.discriminator_loss, config=config),
        functools.partial(aamdm_loss.generator_loss, config=config),
        tuple(players),
    )
    names = ("generator", "discriminator")
    starts = {
        name: training.init_train_state(params[name], player)
        for name, player in zip(names, players, strict=True)
    }
    gan = fit(
        update,
        adversarial.GanState(**starts),
        key_g,
        steps=2 * args.steps,
        batch=args.batch,
        window=3,
    )
    trained = {"polisher": state.ema_params, "generator": gan.generator.ema_params}
    return aamdm_model.sampler(trained, config=config)


def train_baseline(args: Config, key, module, config, *, window: int):
    """A baseline; returns its stepper."""
    key_init, key_train = jax.random.split(key)
    optimizer = training.make_optimizer(
        "adamw", learning_rate=1e-3, num_steps=args.steps
    )
    state = fit(
        training.make_update(functools.partial(module.loss, config=config), optimizer),
        training.init_train_state(module.init(key_init, config), optimizer),
        key_train,
        steps=args.steps,
        batch=args.batch,
        window=window,
    )
    return module.stepper(state.ema_params, config=config)


def roll(step, key, start, length: int):
    """Rollouts [sequences, length, 2] of a stepper, in the toy's own units."""

    def tick(x, i):
        x = step(jax.random.fold_in(key, i), x)
        return x, x

    _, points = jax.jit(lambda x: jax.lax.scan(tick, x, jnp.arange(length)))(start)
    return np.asarray(jnp.swapaxes(points, 0, 1)) * SCALE


def main() -> None:
    """Trains, rolls out, scores and plots."""
    args = cli.check(tyro.cli(Config, description=__doc__))
    loop.check_writable(args.out)
    cli.announce("compiling each model's training", 40)
    began = time.perf_counter()
    key, key_start, key_roll, key_data = jax.random.split(jax.random.key(args.seed), 4)
    sizes = dict(features=2, width=args.width)
    baseline = functools.partial(train_baseline, args)
    trainers = {
        "AAMDM": functools.partial(train_aamdm, args),
        "AMDM5": functools.partial(
            baseline, module=amdm, config=amdm.Config(**sizes), window=3
        ),
        "MVAE": functools.partial(
            baseline, module=mvae, config=mvae.Config(**sizes, latent=8), window=8
        ),
        "LMM": functools.partial(
            baseline, module=lmm, config=lmm.Config(**sizes), window=20
        ),
    }
    start = sequences(key_start, args.sequences, 1)[:, 0]
    data = sequences(key_data, args.sequences, args.length)
    points = {"data": np.asarray(data) * SCALE}
    seconds = {}
    for i, (name, train) in enumerate(trainers.items()):
        before = time.perf_counter()
        step = train(jax.random.fold_in(key, i))
        points[name] = roll(step, key_roll, start, args.length)
        seconds[name] = round(time.perf_counter() - before, 1)
        print(f"{name}: trained and rolled out in {seconds[name]} s")
    scores = {
        name: modes.mode_scores(x, CENTERS, sigma=SIGMA) for name, x in points.items()
    }
    heads = list(next(iter(scores.values())))
    print(" " * 8 + "".join(f"{head:>28}" for head in heads))
    for name, row in scores.items():
        print(f"{name:8}" + "".join(f"{row[head]:28.3f}" for head in heads))
    report = {
        "scores": scores,
        "train_seconds": seconds,
        "seconds": round(time.perf_counter() - began, 1),
        "config": {k: str(v) for k, v in dataclasses.asdict(args).items()},
        "jax": jax.__version__,
        "platform": jax.devices()[0].platform,
    }
    files.write_text(args.out / "scores.json", json.dumps(report, indent=1))
    plots.write_scatter(
        args.out / "squ9.png",
        {name: x.reshape(-1, 2) for name, x in points.items()},
        marks=CENTERS,
        title=f"{args.sequences} rollouts of {args.length} steps",
    )
    print(f"done in {report['seconds']} s: see {args.out}")


if __name__ == "__main__":
    cli.start(main)
