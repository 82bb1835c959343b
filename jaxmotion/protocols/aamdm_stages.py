"""AAMDM's stages: its windows of frames, and its space on disk."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxmotion.learning import checkpoint
from jaxmotion.protocols import stages
from jaxmotion.protocols.aamdm_data import PoseData, starts
from jaxmotion.protocols.stages import Budget as Budget
from jaxmotion.protocols.stages import make_optimizer as make_optimizer
from jaxmotion.systems.aamdm_space import Space
from jaxmotion.typing import Key

check_stage = functools.partial(stages.check_stage, system="aamdm")
fit = functools.partial(stages.fit, system="aamdm")
load_params = functools.partial(stages.load_params, system="aamdm")


def frame_windows(
    frames: Array, data: PoseData, length: int, *, batch: int
) -> tuple[Callable, tuple[Array, Int[Array, " windows"]]]:
    """Windows of frames for training.

    Args:
      frames: One a frame of the data.
      data: The data.
      length: Frames a window.
      batch: Windows a batch.

    Returns:
      `sample_batch(key, arrays) -> windows`, and its arrays.

    Raises:
      ValueError: if no clip is long enough.
    """
    offsets = jnp.arange(length)

    def sample(key: Key, arrays: tuple[Array, Array]) -> Array:
        frames, first = arrays
        chosen = first[jax.random.randint(key, (batch,), 0, first.shape[0])]
        return frames[jnp.add.outer(chosen, offsets)]

    return sample, (frames, starts(data, length))


def save_space(folder: Path, space: Space, config: dict[str, Any]) -> None:
    """Writes a space.

    Args:
      folder: Of the space.
      space: The space.
      config: JSON of what it was made from.
    """
    value = {"system": "aamdm", "stage": "space"} | config
    leaves = {str(i): x for i, x in enumerate(jax.tree.leaves(space))}
    checkpoint.save(folder / "checkpoints", 0, leaves, value)


def restore_space(folder: Path, like: Callable[[], Space]) -> Space:
    """Reads what `save_space` wrote.

    Args:
      folder: Of the space.
      like: Makes a space of the same shapes; never run.

    Returns:
      The space.

    Raises:
      CheckpointError: if there is none, or it is of another kind.
    """
    check_stage(folder, "space")
    structure = []

    def leaves() -> dict[str, Array]:
        found, tree = jax.tree.flatten(like())
        structure.append(tree)
        return {str(i): x for i, x in enumerate(found)}

    stored = checkpoint.restore(folder / "checkpoints", jax.eval_shape(leaves))
    return jax.tree.unflatten(
        structure[0], [stored[str(i)] for i in range(len(stored))]
    )
