"""SMGDiff's players, each with a ball, for the server."""

from pathlib import Path

import jax

from jaxmotion.systems.smgdiff import controller as smgdiff_controller
from jaxmotion.systems.smgdiff import guidance as smgdiff_guidance
from jaxmotion.systems.smgdiff import scoring as smgdiff_scoring
from jaxmotion.systems.smgdiff import training as smgdiff_training
from jaxmotion.systems.smgdiff import trajectory as smgdiff_trajectory
from serving.controlled import ControlledSimulation


def load(run: Path, data: Path | None) -> ControlledSimulation:
    """Players of a run of `smgdiff.py train`, steered through generated paths.

    Args:
      run: Run folder.
      data: Must be None: a run holds the clips that players start from.

    Returns:
      The simulation; nothing of it is compiled yet.

    Raises:
      OSError: if a file cannot be read.
      ValueError: if it is no such run, or data are given.
    """
    if data is not None:
        raise ValueError(f"--data {data}: players start from the clips in {run}")
    loaded = smgdiff_training.load_run(run)
    model, params = smgdiff_training.load_stage(loaded, "motion_8")
    paths, path_params = smgdiff_training.load_stage(loaded, "paths_1")
    known = smgdiff_scoring.eval_windows(loaded.train, model, number=8, seed=0)
    past = jax.tree.map(lambda x: x[0], known.past)
    skeleton = model.representation.skeleton
    driver = smgdiff_controller.controller(
        smgdiff_trajectory.sampler(path_params, config=paths.paths),
        smgdiff_guidance.sampler(
            params,
            config=model.config,
            representation=model.representation,
            guided=smgdiff_guidance.TUNED,
        ),
        representation=model.representation,
        config=model.config,
    )
    return ControlledSimulation(
        driver,
        skeleton,
        smgdiff_controller.init_state(skeleton, past, config=model.config),
        lambda frame: {
            "root": frame.root_position,
            "rotations": frame.joint_rotation,
            "ball": frame.extra["ball"],
        },
        labels=model.labels,
        fps=model.config.fps,
    )
