"""AMDM: an autoregressive diffusion model that predicts noise, frame by frame.

Source: Shi et al. 2024, "Interactive Character Control with Auto-Regressive Motion
Diffusion Models", and its released code: L1 on the noise, cosine schedule, reverse
noise of variance beta, own predictions as conditions for a part of training. Differs:
the released code alternates epochs with and without own predictions (4 to 1), here
each example is of the second kind with probability 0.2.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxmotion.diffusion import chain, guidance, schedule
from jaxmotion.networks import mlp
from jaxmotion.systems.aamdm import controller as aamdm_controller
from jaxmotion.systems.aamdm.controller import Stepper
from jaxmotion.typing import Key, Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Sizes.

    Attributes:
      features: Channels of a frame.
      num_steps: T; AAMDM's tables have 5 and 200.
      width: Channels of a hidden layer (released code 1024).
      depth: Hidden layers.
      own_previous: Share of examples whose previous frame is predicted, not the data's.
    """

    features: int
    num_steps: int = 5
    width: int = 512
    depth: int = 4
    own_previous: float = 0.2


def network(config: Config) -> mlp.ConditionedMlp:
    """The noise predictor."""
    return mlp.ConditionedMlp(
        features=config.features,
        num_steps=config.num_steps,
        width=config.width,
        depth=config.depth,
    )


@functools.partial(jax.jit, static_argnames="config")
def init(key: Key, config: Config) -> Params:
    """Initial parameters."""
    x, t = jnp.zeros(config.features), jnp.ones((), jnp.int32)
    return network(config).init(key, x, t, x)["params"]


def _predict(params: Params, key: Key, x_0: Array, previous: Array, config: Config):
    """Predicted noise, true noise, and the clean frame that the prediction means."""
    table = schedule.cosine_schedule(config.num_steps)
    key_t, key_noise = jax.random.split(key)
    t = jax.random.randint(key_t, x_0.shape[:1], 1, config.num_steps + 1)
    noise = jax.random.normal(key_noise, x_0.shape)
    x_t = schedule.q_sample(table, x_0, t, noise)
    found = network(config).apply({"params": params}, x_t, t, previous)
    return found, noise, schedule.x0_from_noise(table, found, x_t, t)


def loss(params: Params, key: Key, windows: Array, *, config: Config):
    """Mean absolute error of the noise of the last frame of windows."""
    key_own, key_choice, key_last = jax.random.split(key, 3)
    before, previous, x_0 = (windows[:, i] for i in (-3, -2, -1))
    own = jax.lax.stop_gradient(_predict(params, key_own, previous, before, config)[2])
    # A prediction from nearly pure noise is divided by nearly nothing.
    own = jnp.clip(own, -5.0, 5.0)
    chosen = jax.random.bernoulli(key_choice, config.own_previous, (len(x_0), 1))
    previous = jnp.where(chosen, own, previous)
    found, noise, _ = _predict(params, key_last, x_0, previous, config)
    return jnp.mean(jnp.abs(found - noise)), {}


def stepper(params: Params, *, config: Config, scale: float = 0.0) -> Stepper:
    """The sampler `step(key, previous, goal) -> next`; its noise has variance beta.

    With a goal for the path features every prediction of the clean frame moves down
    the gradient of their distance, by `scale` (eq. 13 of AAMDM).
    """
    table = schedule.cosine_schedule(config.num_steps)

    def step(key: Key, previous: Array, goal: Array | None = None) -> Array:
        def denoise(key: Key, x_t: Array, t: Array) -> Array:
            del key
            noise = network(config).apply({"params": params}, x_t, t, previous)
            return schedule.x0_from_noise(table, noise, x_t, t)

        if goal is not None:
            denoise = guidance.gradient_guidance(
                table, denoise, aamdm_controller.path_objective(goal), scale=scale
            )

        def reverse(key: Key, x_t: Array, t: Array) -> Array:
            x_0 = denoise(key, x_t, t)
            mean = schedule.posterior(table, x_0, x_t, t).mean
            spread = jnp.sqrt(table.beta[t]) * (t > 1)
            return mean + spread * jax.random.normal(key, x_t.shape)

        return chain.sample(reverse, key, previous.shape, num_steps=config.num_steps)

    return Stepper(step)
