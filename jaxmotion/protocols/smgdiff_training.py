"""Training of SMGDiff's two stages."""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax

from jaxmotion.learning import training
from jaxmotion.protocols import smgdiff_data, smgdiff_runs, stages
from jaxmotion.protocols.smgdiff_runs import Run
from jaxmotion.systems import smgdiff_loss, smgdiff_trajectory
from jaxmotion.systems.smgdiff_model import SYSTEM, Model
from jaxmotion.typing import Key, Params

# Sizes and weights of `smgdiff.Config`, by name.
PRESETS = {
    # CAMDM's network, which the paper's missing supplement is taken to have.
    "paper": dict(),
    # For a CPU or a short run: 31 tokens instead of 147. Feet and bones weigh more than
    # a long training needs, and the ball has losses of its own: without them it jitters
    # so much that guidance takes every frame for a touch.
    "small": dict(
        width=192,
        hidden=768,
        frames_per_token=5,
        token_margin=4,
        norm="pre",
        dropout=0.0,
        weight_velocity=3.0,
        weight_position=5.0,
        weight_position_velocity=100.0,
        weight_foot=200.0,
        weight_ball=5.0,
        weight_ball_acceleration=300.0,
    ),
}
# Of a training's first part. Displacements are least for a body that does not move, and
# a network that meets them first stays on the mean pose for thousands of updates.
DRAFT = dict(
    weight_position_velocity=5.0, weight_foot=5.0, weight_ball_acceleration=0.0
)


def train_stage(
    run: Run, stage: str, *, budget: stages.Budget, draft_steps: int = 0
) -> None:
    """Trains a stage, from its newest checkpoint if there is one.

    Args:
      run: The run.
      stage: "motion_8", "paths_1", ...
      budget: How long.
      draft_steps: Updates of a motion model before these, with the weights `DRAFT`.

    Raises:
      ValueError: if there is no such stage, or its checkpoint has other settings.
      TrainingDiverged: if a loss is not finite.
    """
    model = smgdiff_runs.with_steps(run.model, stage)
    arrays = smgdiff_data.scene_arrays(run.train, model.config.window)
    folder, key = run.folder / stage, jax.random.key(budget.seed)
    params = jax.jit(lambda key: smgdiff_runs.init_stage(key, model, stage))(key)
    source = run.folder / "train.npz"
    draft = {"draft_steps": draft_steps} if stage.startswith("motion") else None
    if draft_steps and draft:
        params = _fit(
            folder / "draft",
            dataclasses.replace(
                model, config=dataclasses.replace(model.config, **DRAFT)
            ),
            stage,
            params,
            arrays,
            budget=dataclasses.replace(budget, steps=draft_steps),
            source=source,
        )
    _fit(
        folder,
        model,
        stage,
        params,
        arrays,
        budget=budget,
        source=source,
        settings=draft,
    )


def _fit(
    folder: Path,
    model: Model,
    stage: str,
    params: Params,
    arrays: smgdiff_data.SceneArrays,
    *,
    budget: stages.Budget,
    source: Path,
    settings: dict[str, Any] | None = None,
) -> Params:
    """Trains a stage's parameters; returns their average."""
    is_motion, representation = stage.startswith("motion"), model.representation
    if is_motion:
        loss = functools.partial(
            smgdiff_loss.loss, representation=representation, config=model.config
        )
    else:
        loss = functools.partial(
            smgdiff_trajectory.loss, bones=representation.bones, config=model.paths
        )

    def sample_batch(key: Key, arrays: smgdiff_data.SceneArrays) -> tuple[Any, Any]:
        scenes, labels = smgdiff_data.sample_scenes(key, arrays, batch=budget.batch)
        return (scenes if is_motion else scenes.motion), labels

    optimizer = stages.make_optimizer(budget)
    state = stages.fit(
        folder,
        training.init_train_state(params, optimizer),
        training.make_update(loss, optimizer, ema_decay=budget.ema),
        sample_batch,
        arrays,
        system=SYSTEM,
        stage=stage,
        budget=budget,
        config=dict([smgdiff_runs.stage_config(model, stage)]),
        source=source,
        settings=settings,
        show=("loss", "foot") if is_motion else ("loss",),
    )
    return state.ema_params
