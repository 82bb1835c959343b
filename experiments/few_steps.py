"""What an adversary is for: how much variance T steps keep, with it and without.

Given two frames of a character, smoothed in time, chains of T steps learn to draw how
the next change differs from the last: a diffusion model (squared error) and a
denoising-diffusion GAN, with networks of one size, for the same time. What a regression
leaves of it is open; samples for one state should have that deviation ("kept" is 1),
and a classifier that is trained afterwards, given the state, should not tell them from
data (accuracy .5).

Examples:
  python experiments/aamdm.py train --data data/o3de60.npz --field style --labels neutral crouch --rows aamdm --out runs/aamdm
  python experiments/few_steps.py --run runs/aamdm --out runs/few_steps
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
from jaxtyping import Array, Float
from next_frame import examples, frames_of

from jaxmotion import cli, reporting
from jaxmotion.diffusion import chain, gan, schedule
from jaxmotion.evaluation import frechet
from jaxmotion.evaluation.table import Cell, Row
from jaxmotion.learning import adversarial, loop, training
from jaxmotion.networks import blocks, mlp
from jaxmotion.systems.aamdm import network as aamdm_network
from jaxmotion.systems.aamdm import training as aamdm_training
from jaxmotion.typing import Key, Params

Pairs = tuple[Float[Array, "rows state"], Float[Array, "rows channels"]]
CHUNK = 200  # updates of one compiled call
CLASSIFIER = 1000  # updates of the classifier, alike for all rows
HELD = 0.2  # part of the pairs that classifiers are scored on


@dataclasses.dataclass(frozen=True)
class Config:
    """Measure how much variance few steps keep, with an adversary and without.

    Attributes:
      run: Run folder of AAMDM; only its autoencoder is used.
      out: Folder for metrics.json and table.md.
      diffusion_steps: T of the chains.
      seconds: Processor time of each chain's training, without compilation.
      smooth: Deviation of the Gaussian that frames are smoothed by in time, in frames.
      width: Channels of hidden layers.
      batch: Examples per update.
      learning_rate: Learning rate of generators and diffusion models.
      discriminator_rate: Learning rate of discriminators.
    """

    run: Path
    out: Path = Path("runs/few_steps")
    diffusion_steps: tuple[int, ...] = (1, 2, 3, 5, 10)
    seconds: float = 90.0
    smooth: float = 1.0
    width: int = 256
    batch: int = 64
    learning_rate: float = 5e-4
    discriminator_rate: float = 5e-4
    seed: int = 0


def transitions(run: aamdm_training.Run, args: Config) -> Pairs:
    """States of two training frames, and how the next change differs from the last."""
    space = aamdm_training.load_space(run, "embedded")
    frames = frames_of(space, run.train, args.smooth)
    size = np.sqrt(np.mean(np.diff(frames, axis=0) ** 2, axis=0))
    state, change, _ = examples(frames, run.train, 2, size)
    turn = change - state[:, -change.shape[1] :]
    pairs = state, turn / np.std(turn, axis=0)
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), pairs)


def draw(key: Key, pairs: Pairs, *, batch: int) -> Pairs:
    """Rows at random."""
    rows = jax.random.randint(key, (batch,), 0, len(pairs[0]))
    return jax.tree.map(lambda x: x[rows], pairs)


def train(update, state: Any, key: Key, pairs: Pairs, args: Config) -> tuple[Any, Any]:
    """Trains for `args.seconds`; returns the state and what the last updates report."""
    run = training.train_chunk(
        update, lambda key, data: draw(key, data, batch=args.batch), num_steps=CHUNK
    )
    state, _ = run(state, key, pairs, 0)  # compiles
    begun, info = time.process_time(), {}
    while time.process_time() - begun < args.seconds:
        state, info = run(state, key, pairs, CHUNK)
        info = jax.tree.map(lambda x: float(np.mean(x)), info)
        if not np.isfinite(info["loss"]):
            raise FloatingPointError("few_steps: the loss is not finite")
    return state, info


Trained = tuple[Callable[[Params, Array], Callable], Params, dict[str, float]]


def diffusion_model(key: Key, pairs: Pairs, num_steps: int, args: Config) -> Trained:
    """A diffusion model of T steps: its denoiser's maker, parameters, and a report."""
    table = schedule.cosine_schedule(num_steps)
    net = mlp.ConditionedMlp(
        features=pairs[1].shape[1], num_steps=num_steps, width=args.width
    )

    def loss(params: Params, key: Key, batch: Pairs):
        state, x_0 = batch
        key_t, key_noise = jax.random.split(key)
        t = jax.random.randint(key_t, x_0.shape[:1], 1, num_steps + 1)
        x_t = schedule.q_sample(table, x_0, t, jax.random.normal(key_noise, x_0.shape))
        found = blocks.apply(params, net, x_t, t, state)
        return jnp.mean(jnp.square(found - x_0)), {}

    optimizer = training.make_optimizer("radam", learning_rate=args.learning_rate)
    key_init, key_train = jax.random.split(key)
    state, x_0 = jax.tree.map(lambda x: x[0], pairs)
    params = net.init(key_init, x_0, jnp.array(1), state)["params"]
    update = training.make_update(loss, optimizer, ema_decay=0.999)
    made, _ = train(
        update, training.init_train_state(params, optimizer), key_train, pairs, args
    )

    def denoiser(params: Params, state: Array) -> Callable:
        return lambda key, x_t, t: blocks.apply(params, net, x_t, t, state)

    return denoiser, made.ema_params, {"updates": float(made.step)}


def gan_model(key: Key, pairs: Pairs, num_steps: int, args: Config) -> Trained:
    """A denoising-diffusion GAN of T steps, as `diffusion_model`."""
    table = schedule.cosine_schedule(num_steps)
    channels = pairs[1].shape[1]
    sizes = dict(num_steps=num_steps, width=args.width)
    net = mlp.ConditionedMlp(features=channels, **sizes)
    judge = mlp.PairDiscriminator(**sizes)

    def found(params: Params, key: Key, batch: Pairs):
        state, x_0 = batch
        keys = jax.random.split(key, 4)
        t = jax.random.randint(keys[0], x_0.shape[:1], 1, num_steps + 1)
        x_prev, x_t = gan.q_pair(table, keys[1], x_0, t)
        latent = jax.random.normal(keys[2], x_0.shape)
        prediction = blocks.apply(params, net, x_t, t, state, latent)
        fake = gan.posterior_sample(table, keys[3], prediction, x_t, t)
        return x_prev, fake, (x_t, t, state)

    def discriminate(params: Params, generator: Params, key: Key, batch: Pairs):
        real, fake, given = found(generator, key, batch)
        score = lambda x: blocks.apply(params, judge, x, *given)  # noqa: E731
        return gan.discriminator_loss(score(real), score(fake)), {}

    def generate(params: Params, discriminator: Params, key: Key, batch: Pairs):
        _, fake, given = found(params, key, batch)
        return gan.generator_loss(blocks.apply(discriminator, judge, fake, *given)), {}

    key_g, key_d, key_train = jax.random.split(key, 3)
    state, x_0 = jax.tree.map(lambda x: x[0], pairs)
    t = jnp.array(1)
    params = (
        net.init(key_g, x_0, t, state, x_0)["params"],
        judge.init(key_d, x_0, x_0, t, state)["params"],
    )
    optimizers = tuple(
        training.make_optimizer("radam", learning_rate=rate)
        for rate in (args.learning_rate, args.discriminator_rate)
    )
    players = map(training.init_train_state, params, optimizers)
    players = dict(zip(("generator", "discriminator"), players, strict=True))
    update = adversarial.make_gan_update(
        discriminate, generate, optimizers, ema_decay=0.999
    )
    made, info = train(update, adversarial.GanState(**players), key_train, pairs, args)

    def denoiser(params: Params, state: Array) -> Callable:
        def denoise(key: Key, x_t: Array, t: Array) -> Array:
            latent = jax.random.normal(key, (*x_t.shape[:-1], channels))
            return blocks.apply(params, net, x_t, t, state, latent)

        return denoise

    report = {
        "updates": float(made.step),
        "discriminator": info["discriminator/loss"],
    }
    return denoiser, made.generator.ema_params, report


def sampler(made: Trained, num_steps: int, channels: int) -> Callable[..., Array]:
    """`(key, state) -> x_0`: one sample of a chain for each state; compiled once."""
    denoiser, params, _ = made
    table = schedule.cosine_schedule(num_steps)

    @jax.jit
    def run(params: Params, key: Key, state: Array) -> Array:
        step = chain.ancestral_step(table, denoiser(params, state))
        shape = (len(state), channels)
        return chain.sample(step, key, shape, num_steps=num_steps)

    return functools.partial(run, params)


def told_apart(key: Key, real: Pairs, made: Pairs, args: Config) -> float:
    """Accuracy of a classifier of such pairs on those that it was not trained on."""
    net = aamdm_network.PoseDecoder(features=1, width=args.width, depth=4)
    both = tuple(jnp.concatenate(pairs, axis=-1) for pairs in (real, made))
    cut = round(len(both[0]) * (1 - HELD))

    def logits(params: Params, pairs: Array) -> Array:
        return jnp.asarray(net.apply({"params": params}, pairs))[..., 0]

    def loss(params: Params, key: Key, batch: Any):
        return gan.discriminator_loss(*(logits(params, x) for x in batch)), {}

    optimizer = training.make_optimizer("radam", learning_rate=1e-3)
    key_init, key_train = jax.random.split(key)
    params = net.init(key_init, both[0][0])["params"]
    run = training.train_chunk(
        training.make_update(loss, optimizer, ema_decay=0.99),
        lambda key, data: draw(key, data, batch=256),
        num_steps=CLASSIFIER,
    )
    begin = training.init_train_state(params, optimizer)
    end, _ = run(begin, key_train, tuple(x[:cut] for x in both))
    right = [
        jnp.mean((logits(end.ema_params, x[cut:]) > 0) == truth)
        for x, truth in zip(both, (True, False), strict=True)
    ]
    return float(sum(right) / 2)


def score(key: Key, real: Pairs, made: Pairs, args: Config) -> Row:
    """Columns of samples beside data."""
    distance = frechet.frechet_distance(*(frechet.moments(x[1]) for x in (made, real)))
    found = {"fid": distance, "told_apart": told_apart(key, real, made, args)}
    return {name: Cell(value=float(x)) for name, x in found.items()}


def rms(x: Array) -> float:
    """Root of the mean square."""
    return float(jnp.sqrt(jnp.mean(jnp.square(x))))


def main() -> None:
    """Writes the table."""
    args = cli.check(tyro.cli(Config, description=__doc__))
    loop.check_writable(args.out)
    run = aamdm_training.load_run(args.run)
    pairs = transitions(run, args)
    key = jax.random.key(args.seed)
    key_order, key_score, key_train, key_sample = jax.random.split(key, 4)
    # Neighbors in time must not be on both sides of a classifier's split: whole
    # blocks of a second are shuffled.
    block = round(run.train.fps)
    order = jax.random.permutation(key_order, len(pairs[0]) // block)
    order = (order[:, None] * block + jnp.arange(block)).reshape(-1)
    state, real = pairs = jax.tree.map(lambda x: x[order[: len(order) // 2 * 2]], pairs)
    parts = slice(len(state) // 2), slice(len(state) // 2, None)
    halves = [(state[part], real[part]) for part in parts]
    rows = {"data, one half beside the other": score(key_score, *halves, args)}
    # A chain of one step with a squared error is a regression: it has no noise left.
    keys = jax.random.split(key_sample, 2)
    mean = diffusion_model(key_train, pairs, 1, args)
    size = real.shape[1]
    unexplained = rms(sampler(mean, 1, size)(keys[0], state) - real)
    print(f"left by a regression: {unexplained:.3f} of a deviation", flush=True)
    kinds = {"diffusion": diffusion_model, "GAN": gan_model}
    for num_steps in args.diffusion_steps:
        for name, make in kinds.items():
            own = jax.random.fold_in(key_train, num_steps)
            made = make(own, pairs, num_steps, args)
            draws = sampler(made, num_steps, size)
            drawn = [draws(k, state) for k in keys]
            row = score(key_score, pairs, (state, drawn[0]), args)
            spread = rms(drawn[0] - drawn[1]) / np.sqrt(2.0)
            row["kept"] = Cell(value=spread / unexplained)
            row |= {k: Cell(value=x) for k, x in made[2].items()}
            rows[f"{name}, T = {num_steps}"] = row
            print(
                f"{name}, T = {num_steps}",
                {k: round(x.value, 3) for k, x in row.items()},
                flush=True,
            )
    about = {"source": run.source, "unexplained": unexplained}
    about |= reporting.provenance(args)
    reporting.write_table(args.out, rows, about, (run.source,))


if __name__ == "__main__":
    cli.start(main)
