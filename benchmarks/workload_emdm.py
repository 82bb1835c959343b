"""What the benchmark of EMDM times: whole motions from actions."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import training as emdm_training
from jaxmotion.typing import Params

# HumanAct12: 25 rows of 6 numbers, 60 frames, 12 actions.
_SIZES = dict(features=150, frames=60, condition_size=12)


def program(
    *, steps: int, batch: int, width: int, paper: bool, arguments: bool, chunk: int
) -> tuple[Callable, tuple, int]:
    """Motions of HumanAct12's sizes; random parameters take as long as trained ones.

    Args:
      steps: Diffusion steps.
      batch: Motions; 1 is the program of one motion, not a batch of one.
      width: Channels of a token.
      paper: The published network; else the one that experiments/emdm.py trains.
      arguments: Whether the parameters are arguments, not constants.
      chunk: Motions at a time in batches of 16 and more; 0 for all at once.

    Returns:
      The jitted function, its arguments, and frames of a motion.
    """
    if paper:
        config = emdm_model.Config(**_SIZES, num_steps=steps)
    else:
        config = emdm_model.Config(
            **_SIZES,
            num_steps=steps,
            width=width,
            depth=4,
            heads=4,
            hidden=3 * width,
            frames_per_token=4,
            norm="pre",
        )
    params = emdm_model.init(jax.random.key(0), config)["generator"]
    vectors = emdm_model.action_vectors(jnp.arange(batch) % 12, 12)
    conditions = emdm_model.make_condition(vectors, config=config)
    at_once = chunk if chunk and batch >= 16 else batch

    def motions(params: Params, key: Array, conditions: emdm_model.Condition) -> Array:
        sample = emdm_model.sampler(params, config=config)
        if batch == 1:
            return sample(key, jax.tree.map(lambda x: x[0], conditions))
        return emdm_training.sample_many(sample, chunk=at_once)(key, conditions, None)

    given = (jax.random.key(1), conditions)
    if arguments:
        return jax.jit(motions), (params, *given), config.frames
    return jax.jit(functools.partial(motions, params)), given, config.frames
