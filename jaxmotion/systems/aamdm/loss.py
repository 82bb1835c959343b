"""AAMDM's losses: the diffusion model over windows, and the two players of the GAN.

Source: Li et al. 2024 (AAMDM), eq. 6-12; norms and weights are ours (L1 means).
Differs: eq. 8 divides differences of neighboring frames by h times the frame's time,
here they are per frame and `Config.weight_velocity` scales them. The paper trains both
modules on windows of ten frames and does not say how the GAN's are used; here each
frame of its windows from the third on is predicted from the one before, which the
generator may have predicted itself. The R1 penalty, `own_previous` and the errors of
poses are ours.
"""

from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.diffusion import gan, schedule
from jaxmotion.networks import blocks
from jaxmotion.systems.aamdm import model as aamdm_model
from jaxmotion.systems.aamdm.model import Config
from jaxmotion.typing import Key, Params

Frames = Float[Array, "batch frames features"]
Scale = Float[Array, " features"] | None


def _shaken(key: Key, frame: Array, config: Config) -> Array:
    return frame + random_noise(key, frame.shape, largest=config.previous_noise)


def random_noise(
    key: Key, shape: tuple[int, ...], *, largest: float
) -> Float[Array, "batch features"]:
    """Noise of a size per row, uniform up to the largest deviation."""
    key_size, key_noise = jax.random.split(key)
    size = largest * jax.random.uniform(key_size, (shape[0], 1))
    return size * jax.random.normal(key_noise, shape)


def _draw_steps(
    key: Key,
    shape: tuple[int, ...],
    config: Config,
    network: Literal["generator", "polisher"],
) -> Int[Array, "*shape"]:
    """Steps that a network learns, uniformly."""
    first, last = config.steps(network)
    return jax.random.randint(key, shape, first, last + 1)


def polisher_loss(
    params: Params,
    key: Key,
    windows: Frames,
    *,
    config: Config,
    change: Scale = None,
    pose_error: Callable[[Frames, Frames], Float[Array, ""]] | None = None,
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Loss of the diffusion model on windows, fed with its own predictions.

    The first frame is given. Each further frame is noised to a step of its own and
    predicted from it and from the prediction of the frame before; the gradient runs
    through the whole window, of `config.window` + 1 frames.

    Errors are measured in the `change`, the deviation of each channel's changes, where
    these are predicted; `pose_error` is that of the poses that windows of frames mean,
    and needed where `config.weight_pose` is not zero (else `ValueError`). Terms are
    "value" and "velocity", and "pose" if it counts.
    """
    aamdm_model.check_change(config, change)
    if (pose_error is None) != (config.weight_pose == 0):
        found = "none" if pose_error is None else "one"
        raise ValueError(
            f"weight_pose is {config.weight_pose:g}, but of the errors of poses there "
            f"is {found}: expected one for weights that are not zero"
        )
    table = config.table()
    size, frames, _ = windows.shape
    if config.previous_noise:
        key, key_shake = jax.random.split(key)
        first = _shaken(key_shake, windows[:, 0], config)
        windows = windows.at[:, 0].set(first)
    key_t, key_noise = jax.random.split(key)
    steps = _draw_steps(key_t, (frames, size), config, "polisher")
    noise = jnp.swapaxes(jax.random.normal(key_noise, windows.shape), 0, 1)

    def predict(previous: Array, given: tuple[Array, ...]) -> tuple[Array, Array]:
        frame, noise, t = given
        x_t = schedule.q_sample(table, frame, t, noise)
        denoise = aamdm_model.polish(params, previous, config=config, change=change)
        prediction = denoise(key_t, x_t, t)
        return prediction, prediction

    over_time = jnp.swapaxes(windows, 0, 1)
    given = (over_time[1:], noise[1:], steps[1:])
    _, predictions = jax.lax.scan(predict, over_time[0], given)
    error = predictions - over_time[1:]
    if change is not None:
        error = error / change.reshape(1, 1, -1)
    # The first frame is given: its error is zero.
    velocity = jnp.diff(jnp.concatenate([jnp.zeros_like(error[:1]), error]), axis=0)
    terms = {
        "value": jnp.mean(jnp.abs(error)),
        "velocity": jnp.mean(jnp.abs(velocity)),
    }
    total = terms["value"] + config.weight_velocity * terms["velocity"]
    if pose_error is not None:
        whole = jnp.concatenate([over_time[:1], predictions])
        terms["pose"] = pose_error(jnp.swapaxes(whole, 0, 1), windows)
        total = total + config.weight_pose * terms["pose"]
    return total, terms


def discriminator_loss(
    params: Params,
    generator: Params,
    key: Key,
    windows: Frames,
    *,
    config: Config,
    change: Scale = None,
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """The discriminator's loss on windows, with its R1 penalty: "adversarial" and "r1".

    Windows have `config.gan_window` frames, at least three; `change` is the deviation
    of each channel's changes, where they are predicted only.
    """
    previous, t, x_prev, x_t, fake = _pairs(generator, key, windows, config, change)
    net = aamdm_model.discriminator(config)
    score = lambda x: blocks.apply(params, net, x, x_t, t, previous)  # noqa: E731
    adversarial = gan.discriminator_loss(score(x_prev), score(fake))
    r1 = gan.r1_penalty(score, x_prev)
    loss = adversarial + 0.5 * config.weight_r1 * r1
    return loss, {"adversarial": adversarial, "r1": r1}


def generator_loss(
    params: Params,
    discriminator: Params,
    key: Key,
    windows: Frames,
    *,
    config: Config,
    change: Scale = None,
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """The generator's loss on windows, which has no further terms.

    The arguments are those of `discriminator_loss`.
    """
    previous, t, _, x_t, fake = _pairs(params, key, windows, config, change)
    net = aamdm_model.discriminator(config)
    logits = blocks.apply(discriminator, net, fake, x_t, t, previous)
    return gan.generator_loss(logits), {}


def _pairs(
    generator: Params, key: Key, windows: Frames, config: Config, change: Scale
) -> tuple[Array, ...]:
    """Previous frame, step, real x_{t-1}, x_t, and generated x_{t-1}.

    Of every frame of the windows from the third on, one row each.
    """
    aamdm_model.check_change(config, change)
    key_own, *keys = jax.random.split(key, 5)
    previous = _previous(generator, key_own, windows, config, change)
    rows = lambda x: x.reshape(-1, x.shape[-1])  # noqa: E731
    previous, frame = rows(previous), rows(jnp.swapaxes(windows[:, 2:], 0, 1))

    table = config.table()
    t = _draw_steps(keys[0], frame.shape[:1], config, "generator")
    x_prev, x_t = gan.q_pair(table, keys[1], frame, t)
    draft = aamdm_model.draft(generator, previous, config=config, change=change)
    prediction = draft(keys[2], x_t, t)
    fake = gan.posterior_sample(table, keys[3], prediction, x_t, t)
    return previous, t, x_prev, x_t, fake


def _previous(
    generator: Params, key: Key, windows: Frames, config: Config, change: Scale
) -> Float[Array, "later batch features"]:
    """What stands before each frame of the windows from the third on.

    With probability `config.own_previous` it is the generator's own prediction, made
    from what stood before that; else it is the data's.
    """
    over_time = jnp.swapaxes(windows, 0, 1)

    def follow(before: Array, given: tuple[Key, Array]) -> tuple[Array, Array]:
        key, frame = given
        key_shake, key_own, key_choice = jax.random.split(key, 3)
        if config.previous_noise:
            frame = _shaken(key_shake, frame, config)
        own = _own(generator, key_own, before, frame, config, change)
        choice = jax.random.bernoulli(
            key_choice, config.own_previous, (*frame.shape[:1], 1)
        )
        frame = jnp.where(choice, jax.lax.stop_gradient(own), frame)
        return frame, frame

    keys = jax.random.split(key, windows.shape[1] - 2)
    return jax.lax.scan(follow, over_time[0], (keys, over_time[1:-1]))[1]


def _own(
    generator: Params,
    key: Key,
    before: Array,
    frame: Array,
    config: Config,
    change: Scale,
) -> Array:
    """The generator's prediction of a frame from a noised one and the frame before."""
    key_t, key_noise, key_latent = jax.random.split(key, 3)
    t = _draw_steps(key_t, frame.shape[:1], config, "generator")
    noise = jax.random.normal(key_noise, frame.shape)
    x_t = schedule.q_sample(config.table(), frame, t, noise)
    draft = aamdm_model.draft(generator, before, config=config, change=change)
    return draft(key_latent, x_t, t)
