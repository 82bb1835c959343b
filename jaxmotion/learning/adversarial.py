"""Two players trained against each other: state, and one update of both."""

import dataclasses
import typing
from collections.abc import Callable
from typing import Any

import jax
from jaxtyping import Array, Float, Int

from jaxmotion.learning import training
from jaxmotion.learning.training import Info
from jaxmotion.typing import Key, Params


# Unchecked, like TrainState.
@typing.no_type_check
@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class GanState:
    """What an adversarial run needs to go on; the discriminator's average is unused."""

    generator: training.TrainState
    discriminator: training.TrainState

    @property
    def step(self) -> Int[Array, ""]:
        """Updates made."""
        return self.generator.step


# Of one player's parameters and the other's, which it leaves alone, a key and a batch:
# the loss, and named values to report.
GanLoss = Callable[[Params, Params, Key, Any], tuple[Float[Array, ""], Info]]


def make_gan_update(
    discriminator_loss: GanLoss,
    generator_loss: GanLoss,
    optimizers: tuple[training.Optimizer, training.Optimizer],
    *,
    ema_decay: float = 0.999,
) -> Callable[[GanState, Key, Any], tuple[GanState, Info]]:
    """Update of a discriminator, then of a generator against the new discriminator.

    Args:
      discriminator_loss: Loss of the discriminator's parameters, then the generator's.
      generator_loss: Loss of the generator's parameters, then the discriminator's.
      optimizers: The generator's and the discriminator's.

    Returns:
      `update(state, key, batch) -> (state, info)`. Names in info begin with
      "generator/" or "discriminator/"; "loss" is the generator's.
    """
    optimizer_g, optimizer_d = optimizers

    def update(state: GanState, key: Key, batch: Any) -> tuple[GanState, Info]:
        key_d, key_g = jax.random.split(key)
        old_g = state.generator.params
        step_d = training.make_update(
            lambda params, k, b: discriminator_loss(params, old_g, k, b),
            optimizer_d,
            ema_decay=0.0,
        )
        discriminator, info_d = step_d(state.discriminator, key_d, batch)
        step_g = training.make_update(
            lambda params, k, b: generator_loss(params, discriminator.params, k, b),
            optimizer_g,
            ema_decay=ema_decay,
        )
        generator, info_g = step_g(state.generator, key_g, batch)
        info = {f"generator/{k}": v for k, v in info_g.items()}
        info |= {f"discriminator/{k}": v for k, v in info_d.items()}
        state = GanState(generator=generator, discriminator=discriminator)
        return state, info | {"loss": info_g["loss"]}

    return update
