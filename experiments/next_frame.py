"""How much of the next frame is new: whether a frame-by-frame model can work.

Of a run folder of AAMDM: networks with a squared error predict the change to the next
frame of the space, given one frame and more, as they are and smoothed in time. What
they leave of held-out changes is what a model of that state has to draw; how much of
the next frame's is the same says how slowly. And for a chain of T steps on frames, and
on changes, the loss of a perfect discriminator against a generator that predicts the
mean: 2 ln 2 = 1.386 where there is nothing to tell apart.

Example: python experiments/next_frame.py --run runs/aamdm --out runs/next_frame
"""

import dataclasses
import functools
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
import tyro

from jaxmotion import cli, reporting
from jaxmotion.diffusion import schedule
from jaxmotion.evaluation.table import Cell
from jaxmotion.learning import loop, runs, training
from jaxmotion.systems.aamdm import data as aamdm_data
from jaxmotion.systems.aamdm import network as aamdm_network
from jaxmotion.systems.aamdm import space as aamdm_space
from jaxmotion.systems.aamdm import training as aamdm_training


@dataclasses.dataclass(frozen=True)
class Config:
    """Measure how much of the next frame is new.

    Attributes:
      run: Run folder of AAMDM.
      out: Folder for metrics.json and table.md.
      space: Which of its spaces.
      given: Frames that are given.
      smooth: Deviations of the Gaussian that frames are smoothed by in time, in frames;
        0 for none.
      steps: Updates of each network.
      width: Channels of its hidden layers.
      diffusion_steps: T of the chains.
    """

    run: Path
    out: Path = Path("runs/next_frame")
    space: Literal["embedded", "full_pose"] = "embedded"
    given: tuple[int, ...] = (1, 2, 3)
    smooth: tuple[float, ...] = (0.0, 1.0, 2.0)
    steps: int = 3000
    width: int = 512
    diffusion_steps: int = 5
    seed: int = 0


def frames_of(space: aamdm_space.Space, data: aamdm_data.PoseData, smooth: float):
    """Frames of the space, smoothed within each clip."""
    frames = np.asarray(aamdm_space.to_frames(space, data.poses, data.paths))
    if not smooth:
        return frames
    offsets = np.asarray(data.offsets)
    ends = zip(offsets[:-1], offsets[1:], strict=True)
    blur = functools.partial(
        scipy.ndimage.gaussian_filter1d, sigma=smooth, axis=0, mode="nearest"
    )
    return np.concatenate([blur(frames[a:b]) for a, b in ends])


def examples(
    frames: np.ndarray, data: aamdm_data.PoseData, given: int, size: np.ndarray
):
    """The last frames and their changes, the change that follows, and where it is."""
    now = np.asarray(aamdm_data.starts(data, given + 1)) + given - 1
    change = lambda back: (frames[now - back + 1] - frames[now - back]) / size  # noqa: E731
    state = [frames[now], *(change(back) for back in range(1, given))]
    return np.concatenate(state, axis=1), change(0), now


def fit(state: np.ndarray, change: np.ndarray, args: Config):
    """A network that predicts changes; returns it as a function."""
    net = aamdm_network.PoseDecoder(features=change.shape[1], width=args.width, depth=4)
    budget = runs.Budget(steps=args.steps, optimizer="adamw", learning_rate=1e-3)
    optimizer = runs.make_optimizer(budget)

    def loss(params, key, batch):
        error = net.apply({"params": params}, batch[0]) - batch[1]
        return jnp.mean(jnp.square(error)), {}

    def sample(key, data):
        rows = jax.random.randint(key, (512,), 0, len(data[0]))
        return jax.tree.map(lambda x: x[rows], data)

    key_init, key_train = jax.random.split(jax.random.key(args.seed))
    params = net.init(key_init, jnp.asarray(state[:1]))["params"]
    update = training.make_update(loss, optimizer, ema_decay=0.999)
    run = training.train_chunk(update, sample, num_steps=args.steps)
    data = tuple(jnp.asarray(x, jnp.float32) for x in (state, change))
    made, _ = run(training.init_train_state(params, optimizer), key_train, data)
    return jax.jit(lambda x: net.apply({"params": made.ema_params}, x))


def perfect_loss(
    left: np.ndarray, num_steps: int, *, seed: int, draws: int = 4096
) -> list[float]:
    """Loss of a perfect discriminator at t = 1, ..., T against means.

    Both x_{t-1} are normal given x_t and the state, with one mean: that of the data has
    the variance that x_0 has left, too.

    Args:
      left: [n, channels] what networks leave of x_0, in its deviations.
      num_steps: T of the cosine schedule.
      seed: Seeds the draws.
      draws: Samples of each.

    Returns:
      The losses; 0 at t = 1, where x_0 itself is shown.
    """
    table, found = schedule.cosine_schedule(num_steps), [0.0]
    alpha_bar, noise = (
        np.asarray(x, np.float64) for x in (table.alpha_bar, table.one_minus_alpha_bar)
    )
    variance = np.maximum(np.linalg.eigvalsh(np.atleast_2d(np.cov(left.T))), 1e-12)
    generator = np.random.default_rng(seed)
    for t in range(2, num_steps + 1):
        known = variance * noise[t] / (alpha_bar[t] * variance + noise[t])
        zero, step = jnp.zeros(()), jnp.array(t)
        own = float(schedule.posterior(table, zero, zero, step).variance)
        weight = float(schedule.posterior_weight(table, step))
        real, fake = own + weight**2 * known, np.full_like(known, own)

        def logit(x, real=real, fake=fake):
            terms = np.log(fake / real) + np.square(x) * (1 / fake - 1 / real)
            return 0.5 * terms.sum(axis=-1)

        drawn = generator.normal(size=(2, draws, len(real)))
        reals = np.logaddexp(0.0, -logit(drawn[0] * np.sqrt(real)))
        fakes = np.logaddexp(0.0, logit(drawn[1] * np.sqrt(fake)))
        found.append(float(reals.mean() + fakes.mean()))
    return found


def measure(run, space, args: Config, *, given: int, smooth: float) -> dict[str, float]:
    """One row."""
    train, held = (frames_of(space, data, smooth) for data in (run.train, run.held_out))
    size = np.sqrt(np.mean(np.diff(train, axis=0) ** 2, axis=0))  # ends hardly count
    predict = fit(*examples(train, run.train, given, size)[:2], args)
    state, change, place = examples(held, run.held_out, given, size)
    left = np.asarray(predict(jnp.asarray(state, jnp.float32))) - change
    following = np.diff(place) == 1
    same = np.mean(left[:-1][following] * left[1:][following]) / np.mean(left**2)
    row = {
        "deviation of the change": float(np.sqrt(np.mean(change**2))),
        "left of it": float(np.sqrt(np.mean(left**2))),
        "same in the next frame": float(same),
    }
    for name, unit in (("frames", size), ("changes", np.ones_like(size))):
        losses = perfect_loss(left * unit, args.diffusion_steps, seed=args.seed)
        row |= {f"{name}, t = {t}": x for t, x in enumerate(losses, 1) if t > 1}
    return row


def main() -> None:
    """Writes the table."""
    args = cli.check(tyro.cli(Config, description=__doc__))
    loop.check_writable(args.out)
    run = aamdm_training.load_run(args.run)
    space = aamdm_training.load_space(run, args.space)
    rows = {}
    for smooth in args.smooth:
        for given in args.given:
            name = f"given {given}, " + (
                f"smoothed by {smooth:g}" if smooth else "as is"
            )
            found = measure(run, space, args, given=given, smooth=smooth)
            rows[name] = {k: Cell(value=x) for k, x in found.items()}
            print(name, {k: round(x, 3) for k, x in found.items()}, flush=True)
    about = {"source": run.source} | reporting.provenance(args)
    reporting.write_table(args.out, rows, about, (run.source,))


if __name__ == "__main__":
    cli.start(main)
