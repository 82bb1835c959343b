"""Learned Motion Matching: the next frame, and the frame that fits a wish, regressed.

The stepper predicts velocities and is trained over windows of its own frames. The
projector maps wanted path features to the frame of the data that fits them best.

Source: Holden et al. 2020, "Learned Motion Matching", and its released code: three
linear layers in the stepper, five in the projector, queries with noise of a random
size. Differs: the projector looks at the path alone (there also at feet and hips), it
is asked at random moments, on average every 0.2 s (there every 0.1 s), and its frame
is taken up by half instead of by inertialized blending.
"""

import dataclasses
import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxmotion.systems.aamdm.controller import Stepper
from jaxmotion.typing import Key, Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Sizes.

    Attributes:
      features: Channels of a frame.
      width: Channels of a hidden layer (released code 512).
      weight_velocity: Weight of the differences of frames against the frames.
      queries: Path features, the first channels of a frame; 0 for no projector.
      projections: Probability a frame that the projector is asked.
    """

    features: int
    width: int = 512
    weight_velocity: float = 0.1
    queries: int = 0
    projections: float = 1 / 12


class Mlp(nn.Module):
    """Linear layers with ReLU between them."""

    features: int
    width: int
    depth: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Maps vectors to vectors."""
        for _ in range(self.depth - 1):
            x = nn.relu(nn.Dense(self.width)(x))
        return nn.Dense(self.features)(x)


def _nets(config: Config) -> tuple[Mlp, Mlp]:
    return (
        Mlp(config.features, config.width, 3),
        Mlp(config.features, config.width, 5),
    )


@functools.partial(jax.jit, static_argnames="config")
def init(key: Key, config: Config) -> Params:
    """Initial parameters."""
    key_s, key_p = jax.random.split(key)
    net, projector = _nets(config)
    params = {"stepper": net.init(key_s, jnp.zeros(config.features))["params"]}
    if config.queries:
        query = jnp.zeros(config.queries)
        params["projector"] = projector.init(key_p, query)["params"]
    return params


def _next(params: Params, x: Array, config: Config, change: Array | None) -> Array:
    found = _nets(config)[0].apply({"params": params["stepper"]}, x)
    scale = 1.0 if change is None else jnp.broadcast_to(change, x.shape)
    return x + scale * found


def stepper(params: Params, *, config: Config, change: Array | None = None) -> Stepper:
    """The deterministic `step(key, previous, goal) -> next`.

    With a goal for the path features, the projector's frame is asked for at some ticks.
    `change` is the deviation of each channel's changes, in which they are predicted.
    """
    projector = _nets(config)[1]

    def step(key: Key, previous: Array, goal: Array | None = None) -> Array:
        frame = _next(params, previous, config, change)
        if goal is None:
            return frame
        fitting = projector.apply({"params": params["projector"]}, goal)
        asked = jax.random.bernoulli(key, config.projections)
        return jnp.where(asked, 0.5 * (frame + fitting), frame)

    return Stepper(step)


def loss(
    params: Params,
    key: Key,
    windows: Array,
    *,
    config: Config,
    change: Array | None = None,
    database: Array | None = None,
):
    """Mean squared error over windows that start with one frame of the data.

    With a database of frames, the projector's error is added: noisy path features of
    the first frames against the frames that fit them best.
    """
    _, own = jax.lax.scan(
        lambda x, _: (_next(params, x, config, change),) * 2,
        windows[:, 0],
        None,
        windows.shape[1] - 1,
    )
    whole = jnp.concatenate([windows[:, :1], jnp.swapaxes(own, 0, 1)], axis=1)
    error = whole - windows
    if change is not None:
        error = error / change.reshape(1, 1, -1)
    value = jnp.mean(jnp.square(error))
    velocity = jnp.mean(jnp.square(jnp.diff(error, axis=1)))
    total = value + config.weight_velocity * velocity
    if database is None:
        return total, {"value": value}
    key_size, key_noise = jax.random.split(key)
    paths = windows[:, 0, : config.queries]
    size = jax.random.uniform(key_size, (len(paths), 1))
    query = paths + size * jax.random.normal(key_noise, paths.shape)
    known = database[:, : config.queries]
    distance = jnp.sum(known**2, axis=1)[None] - 2.0 * query @ known.T
    nearest = database[jnp.argmin(distance, axis=1)]
    found = _nets(config)[1].apply({"params": params["projector"]}, query)
    projection = jnp.mean(jnp.abs(found - nearest))
    return total + projection, {"value": value, "projection": projection}
