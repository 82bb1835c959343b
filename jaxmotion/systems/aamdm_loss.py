"""AAMDM's losses: the diffusion model over windows, and the two players of the GAN.

Source: Li et al. 2024 (AAMDM), eq. 6-12; norms and weights are ours (L1 means).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.diffusion import gan, schedule
from jaxmotion.systems import aamdm
from jaxmotion.systems.aamdm import Config
from jaxmotion.typing import Key, Params

Frames = Float[Array, "batch frames features"]


def polisher_loss(
    params: Params, key: Key, windows: Frames, *, config: Config
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Loss of the diffusion model on windows, fed with its own predictions.

    The first frame is given. Each further frame is noised to a random step and
    predicted from it and from the prediction of the frame before; the gradient runs
    through the whole window.

    Args:
      params: The diffusion model's.
      key: Consumed.
      windows: Frames of the data, `config.window` + 1 each.
      config: The method.

    Returns:
      The weighted sum, and its terms "value" and "velocity".
    """
    table = config.table()
    size, frames, _ = windows.shape
    key_t, key_noise = jax.random.split(key)
    steps = jax.random.randint(key_t, (frames, size), 1, config.num_steps + 1)
    noise = jax.random.normal(key_noise, windows.shape)
    noisy = schedule.q_sample(table, windows, steps.T, noise)

    def predict(previous: Array, given: tuple[Array, Array]) -> tuple[Array, Array]:
        x_t, t = given
        net = aamdm.network(config)
        prediction = net.apply({"params": params}, x_t, t, previous)
        return prediction, prediction

    first = windows[:, 0]
    rest = (jnp.swapaxes(noisy, 0, 1)[1:], steps[1:])
    _, predictions = jax.lax.scan(predict, first, rest)
    predictions = jnp.swapaxes(predictions, 0, 1)
    whole = jnp.concatenate([first[:, None], predictions], axis=1)
    change = jnp.diff(whole, axis=1) - jnp.diff(windows, axis=1)
    terms = {
        "value": jnp.mean(jnp.abs(predictions - windows[:, 1:])),
        "velocity": jnp.mean(jnp.abs(change)),
    }
    return terms["value"] + config.weight_velocity * terms["velocity"], terms


def discriminator_loss(
    params: Params, generator: Params, key: Key, windows: Frames, *, config: Config
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """The discriminator's loss on the last frames of windows, with its R1 penalty.

    Args:
      params: The discriminator's.
      generator: The generator's.
      key: Consumed.
      windows: Frames of the data, at least three each; the last three are used.
      config: The method.

    Returns:
      The loss, and "adversarial" and "r1".
    """
    previous, t, x_prev, x_t, fake = _pairs(generator, key, windows, config=config)
    net = aamdm.discriminator(config)
    judge = lambda x: net.apply({"params": params}, x, x_t, t, previous)  # noqa: E731
    adversarial = gan.discriminator_loss(judge(x_prev), judge(fake))
    r1 = gan.r1_penalty(judge, x_prev)
    loss = adversarial + 0.5 * config.weight_r1 * r1
    return loss, {"adversarial": adversarial, "r1": r1}


def generator_loss(
    params: Params, discriminator: Params, key: Key, windows: Frames, *, config: Config
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """The generator's loss on the last frames of windows.

    Args:
      params: The generator's.
      discriminator: The discriminator's.
      key: Consumed.
      windows: Frames of the data, at least three each; the last three are used.
      config: The method.

    Returns:
      The loss, and nothing more.
    """
    previous, t, _, x_t, fake = _pairs(params, key, windows, config=config)
    net = aamdm.discriminator(config)
    logits = net.apply({"params": discriminator}, fake, x_t, t, previous)
    return gan.generator_loss(logits), {}


def _pairs(
    generator: Params, key: Key, windows: Frames, *, config: Config
) -> tuple[Array, ...]:
    """Previous frame, step, real x_{t-1}, x_t, and generated x_{t-1}."""
    table, size = config.table(), windows.shape[0]
    names = ("own", "choice", "t", "pair", "latent", "posterior")
    keys = dict(zip(names, jax.random.split(key, len(names)), strict=True))
    before, previous, x_0 = (windows[:, i] for i in (-3, -2, -1))
    own = _own(generator, keys["own"], before, previous, config=config)
    choice = jax.random.bernoulli(keys["choice"], config.own_previous, (size, 1))
    previous = jnp.where(choice, jax.lax.stop_gradient(own), previous)

    t = jax.random.randint(keys["t"], (size,), 1, config.num_steps + 1)
    x_prev, x_t = gan.q_pair(table, keys["pair"], x_0, t)
    prediction = aamdm.draft(generator, previous, config=config)(keys["latent"], x_t, t)
    fake = gan.posterior_sample(table, keys["posterior"], prediction, x_t, t)
    return previous, t, x_prev, x_t, fake


def _own(
    generator: Params, key: Key, before: Array, frame: Array, *, config: Config
) -> Array:
    """The generator's prediction of a frame from a noised one and the frame before."""
    key_t, key_noise, key_latent = jax.random.split(key, 3)
    t = jax.random.randint(key_t, frame.shape[:1], 1, config.num_steps + 1)
    noise = jax.random.normal(key_noise, frame.shape)
    x_t = schedule.q_sample(config.table(), frame, t, noise)
    return aamdm.draft(generator, before, config=config)(key_latent, x_t, t)
