"""Motion VAE: a conditional VAE of the next frame with a mixture-of-experts decoder.

Source: Ling et al. 2020, "Character Controllers Using Motion VAEs", and its released
code. Differs: its three phases of scheduled sampling (20 teacher, 20 ramp, 100 own
epochs) are one probability per frame here, 0.7 where theirs is 0.79 on average; each
layer of the encoder reads both frames again, there the later one.
"""

import dataclasses
import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxmotion.systems.aamdm import controller as aamdm_controller
from jaxmotion.systems.aamdm.controller import Stepper
from jaxmotion.typing import Key, Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Sizes.

    Attributes:
      features: Channels of a frame.
      latent: Channels of the latent (released code 32).
      width: Channels of a hidden layer (released code 256).
      experts: Experts of the decoder.
      weight_kl: Weight of the divergence, averaged over the latent's channels.
      own_previous: Probability that a frame is conditioned on the own one before it.
    """

    features: int
    latent: int = 32
    width: int = 256
    experts: int = 6
    weight_kl: float = 1.0
    own_previous: float = 0.7


class Encoder(nn.Module):
    """Mean and log variance of the latent; every layer reads the frame again."""

    latent: int
    width: int

    @nn.compact
    def __call__(self, x: Array, previous: Array) -> tuple[Array, Array]:
        """Maps a frame and the one before it to the latent's Gaussian."""
        given = jnp.concatenate([x, previous], axis=-1)
        h = nn.elu(nn.Dense(self.width)(given))
        h = nn.elu(nn.Dense(self.width)(jnp.concatenate([given, h], axis=-1)))
        both = nn.Dense(2 * self.latent)(jnp.concatenate([given, h], axis=-1))
        mean, log_variance = jnp.split(both, 2, axis=-1)
        return mean, log_variance


class Decoder(nn.Module):
    """Layers whose weights are mixed by a gate; each reads the latent again."""

    features: int
    width: int
    experts: int

    @nn.compact
    def __call__(self, latent: Array, previous: Array) -> Array:
        """Maps the latent and the frame before to a frame."""
        given = jnp.concatenate([latent, previous], axis=-1)
        gate = nn.elu(nn.Dense(64)(given))
        gate = nn.elu(nn.Dense(64)(gate))
        mix = nn.softmax(nn.Dense(self.experts)(gate))
        h = previous
        for i, size in enumerate((self.width, self.width, self.features)):
            h = jnp.concatenate([latent, h], axis=-1)
            shape = (self.experts, h.shape[-1], size)
            initializer = nn.initializers.lecun_normal(batch_axis=(0,))
            weight = self.param(f"weight_{i}", initializer, shape)
            bias = self.param(f"bias_{i}", nn.initializers.zeros, shape[::2])
            each = jnp.einsum("...i,eio->...eo", h, weight) + jnp.broadcast_to(
                bias, (*h.shape[:-1], *bias.shape)
            )
            h = jnp.einsum("...e,...eo->...o", mix, each)
            h = nn.elu(h) if size != self.features or i < 2 else h
        return h


def _nets(config: Config) -> tuple[Encoder, Decoder]:
    return (
        Encoder(config.latent, config.width),
        Decoder(config.features, config.width, config.experts),
    )


@functools.partial(jax.jit, static_argnames="config")
def init(key: Key, config: Config) -> Params:
    """Initial parameters."""
    key_e, key_d = jax.random.split(key)
    encoder, decoder = _nets(config)
    x, z = jnp.zeros(config.features), jnp.zeros(config.latent)
    return {
        "encoder": encoder.init(key_e, x, x)["params"],
        "decoder": decoder.init(key_d, z, x)["params"],
    }


def loss(params: Params, key: Key, windows: Array, *, config: Config):
    """Squared error and divergence over windows, partly on own frames (detached)."""
    encoder, decoder = _nets(config)

    def one(previous: Array, given: tuple[Array, Array, Array]):
        x, data_previous, key = given
        key_choice, key_latent = jax.random.split(key)
        own = jax.random.bernoulli(key_choice, config.own_previous, (len(x), 1))
        previous = jnp.where(own, jax.lax.stop_gradient(previous), data_previous)
        mean, log_variance = encoder.apply({"params": params["encoder"]}, x, previous)
        noise = jax.random.normal(key_latent, mean.shape)
        latent = mean + jnp.exp(0.5 * log_variance) * noise
        found = decoder.apply({"params": params["decoder"]}, latent, previous)
        divergence = jnp.square(mean) + jnp.exp(log_variance) - 1.0 - log_variance
        return found, (
            jnp.mean(jnp.square(found - x)),
            jnp.mean(0.5 * divergence),
        )

    frames = jnp.swapaxes(windows, 0, 1)
    keys = jax.random.split(key, len(frames) - 1)
    given = (frames[1:], frames[:-1], keys)
    _, (error, divergence) = jax.lax.scan(one, frames[0], given)
    value, kl = jnp.mean(error), jnp.mean(divergence)
    return value + config.weight_kl * kl, {"value": value, "kl": kl}


def stepper(params: Params, *, config: Config, candidates: int = 32) -> Stepper:
    """The sampler `step(key, previous, goal) -> next`: a latent, decoded.

    With a goal for the path features, it is the best of several latents drawn for the
    frame: the paper's control by sampling, with a horizon of one frame.
    """
    _, decoder = _nets(config)

    def decode(key: Key, previous: Array) -> Array:
        latent = jax.random.normal(key, (*previous.shape[:-1], config.latent))
        return decoder.apply({"params": params["decoder"]}, latent, previous)

    def step(key: Key, previous: Array, goal: Array | None = None) -> Array:
        if goal is None:
            return decode(key, previous)
        keys = jax.random.split(key, candidates)
        frames = jax.vmap(lambda k: decode(k, previous))(keys)
        values = jax.vmap(aamdm_controller.path_objective(goal))(frames)
        return frames[jnp.argmin(values)]

    return Stepper(step)
