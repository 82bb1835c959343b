"""Training of the action evaluator on whole motions, and its use on others.

The published one draws the recurrent states before the first frame from N(0, 1) at each
call, so that even real motions get other features each time. Here the draw is made from
a key that the caller gives: the same key gives the same features, and a protocol that
wants the published noise draws a key a repetition. The scale of the draw is part of the
configuration; 0 starts from zero states.

Source: Guo et al. 2020 (Action2Motion), as released with EMDM (Zhou et al. 2024).
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.evaluators.network import ActionClassifier
from jaxmotion.networks import blocks
from jaxmotion.typing import Key, Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Size of the evaluator; `state_scale` is the deviation of the first states."""

    num_classes: int
    num_joints: int
    num_features: int = 30
    hidden: int = 128
    state_scale: float = 1.0

    @property
    def network(self) -> ActionClassifier:
        """The module of these sizes."""
        return ActionClassifier(self.num_classes, self.num_features, self.hidden)


def _initial_state(key: Key, batch: int, config: Config) -> Array:
    return config.state_scale * jax.random.normal(key, (batch, 2, config.hidden))


@functools.partial(jax.jit, static_argnames="config")
def init(key: Key, config: Config) -> Params:
    """Initial parameters of `ActionClassifier`."""
    x = jnp.zeros((1, 1, 3 * config.num_joints))
    state = jnp.zeros((1, 2, config.hidden))
    return config.network.init(key, x, state)["params"]


def classify(
    params: Params,
    key: Key,
    x: Float[Array, "batch frames channels"],
    *,
    config: Config,
) -> tuple[Float[Array, "batch features"], Float[Array, "batch classes"]]:
    """Features (for Fréchet distance and diversity) and logits of motions.

    The key draws the states before the first frame; the same key, batch size and
    motions give the same features. Joint positions are in meters, of motions that start
    at the origin facing +z.
    """
    state = _initial_state(key, x.shape[0], config)
    return blocks.apply(params, config.network, x, state)


def loss(
    params: Params,
    key: Key,
    batch: tuple[Float[Array, "batch frames channels"], Int[Array, " batch"]],
    *,
    config: Config,
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Cross entropy and accuracy of a batch: joint positions as above, and classes."""
    x, labels = batch
    _, logits = classify(params, key, x, config=config)
    return style_evaluator.cross_entropy(logits, labels)


def train(
    key: Key,
    x: Float[Array, "motions frames channels"],
    labels: Int[Array, " motions"],
    *,
    config: Config,
    num_steps: int = 1500,
    batch: int = 32,
    learning_rate: float = 3e-3,
) -> tuple[Params, dict[str, Array]]:
    """Trains an evaluator as one compiled program.

    Positions of joints, meters, are of motions that start at the origin facing +z; they
    are drawn with replacement; Adam's rate has a cosine decay to a tenth. With the
    moving average of the parameters come losses and accuracies by step.
    """
    return style_evaluator.train_classifier(
        key,
        lambda key: init(key, config),
        functools.partial(loss, config=config),
        (x, labels),
        num_steps=num_steps,
        batch=batch,
        learning_rate=learning_rate,
        max_norm=1.0,
    )
