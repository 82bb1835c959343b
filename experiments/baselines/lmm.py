"""The stepper of Learned Motion Matching: the next frame as a deterministic regression.

Source: Holden et al. 2020, "Learned Motion Matching", and its released code: three
linear layers that predict velocities, trained over windows of its own frames.
"""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxmotion.typing import Key, Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Sizes.

    Attributes:
      features: Channels of a frame.
      width: Channels of a hidden layer (released code 512).
      weight_velocity: Weight of the differences of frames against the frames.
    """

    features: int
    width: int = 512
    weight_velocity: float = 0.1


class Stepper(nn.Module):
    """Change of the frame from one frame to the next."""

    features: int
    width: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Maps a frame to its change."""
        for _ in range(2):
            x = nn.relu(nn.Dense(self.width)(x))
        return nn.Dense(self.features)(x)


def init(key: Key, config: Config) -> Params:
    """Initial parameters."""
    net = Stepper(config.features, config.width)
    return net.init(key, jnp.zeros(config.features))["params"]


def stepper(params: Params, *, config: Config):
    """The deterministic `step(key, previous) -> next`."""
    net = Stepper(config.features, config.width)

    def step(key: Key, previous: Array) -> Array:
        del key
        return previous + net.apply({"params": params}, previous)

    return step


def loss(params: Params, key: Key, windows: Array, *, config: Config):
    """Mean squared error over windows that start with one frame of the data."""
    step = stepper(params, config=config)
    _, own = jax.lax.scan(
        lambda x, _: (step(key, x),) * 2, windows[:, 0], None, windows.shape[1] - 1
    )
    whole = jnp.concatenate([windows[:, :1], jnp.swapaxes(own, 0, 1)], axis=1)
    value = jnp.mean(jnp.square(whole - windows))
    change = jnp.mean(jnp.square(jnp.diff(whole - windows, axis=1)))
    return value + config.weight_velocity * change, {"value": value}
