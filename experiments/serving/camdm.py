"""CAMDM's characters for the server."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.motion import skeleton
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import training as camdm_training
from serving.controlled import ControlledSimulation


def mean_pose(model: camdm_model.Model) -> skeleton.Motion:
    """A character that stands at the origin in the mean pose of its data, facing +z.

    Args:
      model: One with a mean pose (`Config.rotation_mean`) of samples that face +z.

    Returns:
      As many equal frames as a plan wants to see; the lowest joint is on the ground.
    """
    config = model.config
    zeros = jnp.zeros((config.past, config.num_features))
    motion = camdm_model.to_motion(zeros, config=config)
    lowest = jnp.min(skeleton.joint_positions(model.skeleton, motion)[..., 1])
    raised = motion.root_position.at[:, 1].set(-lowest)
    return dataclasses.replace(motion, root_position=raised)


def first_state(
    run: Path, data: Path | None, model: camdm_model.Model
) -> camdm_controller.CharacterState:
    """The state that characters begin with.

    Args:
      run: Run folder or exported file.
      data: Clips to start from; None for the model's mean pose, or where it has none,
        for the clips that the run was trained on.
      model: The run's model.

    Returns:
      The state of a character at the origin that faces +z.

    Raises:
      OSError: if clips are needed and cannot be read.
      ValueError: if they do not fit the model.
    """
    config = model.config
    if data is None and config.rotation_mean and config.heading == "facing":
        return camdm_controller.init_state(
            model.skeleton, mean_pose(model), config=config
        )
    loaded = camdm_training.load_run(run, data)
    states = camdm_controller.start_states(
        loaded.train, model, np.zeros(1, int), field=loaded.field, seed=0
    )
    return jax.tree.map(lambda x: x[0], states)


def load(run: Path, data: Path | None) -> ControlledSimulation:
    """Characters of a run of `camdm.py train`.

    Args:
      run: Run folder or exported file.
      data: As of `first_state`.

    Returns:
      The simulation; nothing of it is compiled yet.

    Raises:
      OSError: if a file cannot be read.
      ValueError: if it is no such run.
    """
    model, params, _ = camdm_model.load(run)
    return ControlledSimulation(
        camdm_controller.controller(params, model.skeleton, config=model.config),
        model.skeleton,
        first_state(run, data, model),
        lambda frame: {"root": frame.root_position, "rotations": frame.joint_rotation},
        labels=model.labels,
        fps=model.config.fps,
    )
