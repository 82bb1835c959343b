"""Training of SMGDiff's two stages."""

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import jax

from jaxmotion import files
from jaxmotion.data.ball_clips import BallClips, load_ball_clips, save_ball_clips
from jaxmotion.learning import checkpoint, runs, training
from jaxmotion.systems.smgdiff import data as smgdiff_data
from jaxmotion.systems.smgdiff import loss as smgdiff_loss
from jaxmotion.systems.smgdiff import model as smgdiff_model
from jaxmotion.systems.smgdiff import scene as smgdiff_scene
from jaxmotion.systems.smgdiff import trajectory as smgdiff_trajectory
from jaxmotion.systems.smgdiff.model import SYSTEM, Model
from jaxmotion.typing import Key, Params

_WHAT = "expected a run folder of `experiments/smgdiff.py train`"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """What a run folder holds besides the parameters.

    Attributes:
      folder: Where it is.
      model: The model.
      train: Clips that it was trained on.
      held_out: Clips that it never saw.
    """

    folder: Path
    model: Model
    train: BallClips
    held_out: BallClips


def make_model(
    data: BallClips, *, sizes: dict[str, Any], paths: dict[str, Any] | None = None
) -> Model:
    """A model for clips with a ball.

    Args:
      data: Training clips; their skeleton, rate, skills and source become the model's.
      sizes: Of `smgdiff.Config`, but for those that the clips decide.
      paths: Of `smgdiff_trajectory.Config`, likewise.

    Returns:
      The model, its features standardized on the clips.

    Raises:
      ValueError: if no clip is as long as a window.
    """
    clips, labels = data.clips, data.clips.names(smgdiff_data.FIELD)
    names = smgdiff_scene.feature_layout(clips.skeleton, data.joints)
    config = smgdiff_model.Config(
        num_features=names.size, num_labels=len(labels), fps=clips.fps, **sizes
    )
    arrays = smgdiff_data.scene_arrays(data, config.window)
    return Model(
        config=config,
        paths=smgdiff_trajectory.Config(
            num_labels=len(labels),
            past=config.past,
            future=config.future,
            **(paths or {}),
        ),
        representation=smgdiff_data.fit_representation(arrays, past=config.past),
        labels=labels,
        speeds=tuple(round(float(v), 4) for v in smgdiff_data.skill_speeds(data)),
        source=clips.source,
    )


def check_stage_name(stage: str) -> tuple[str, int]:
    """Raises unless a stage has a kind and a number of steps.

    Args:
      stage: "motion_8", "paths_1", ...

    Returns:
      "motion" or "paths", and T.

    Raises:
      ValueError: if there is no such stage.
    """
    kind, _, steps = stage.partition("_")
    if kind not in ("motion", "paths") or not steps.isdecimal() or int(steps) < 1:
        raise ValueError(
            f"unknown stage {stage!r}: expected motion_<steps> or paths_<steps>, such "
            "as motion_8"
        )
    return kind, int(steps)


def with_steps(model: Model, stage: str) -> Model:
    """The model with the number of steps that a stage's name says.

    Args:
      model: The model.
      stage: "motion_8", "paths_1", ...

    Returns:
      The model, with that T in that stage.

    Raises:
      ValueError: if there is no such stage.
    """
    kind, steps = check_stage_name(stage)
    field = "config" if kind == "motion" else "paths"
    changed = dataclasses.replace(getattr(model, field), num_steps=steps)
    return dataclasses.replace(model, **{field: changed})


def write_run(run: Run) -> None:
    """Writes all of a run but its stages; one that is there must be the same.

    Args:
      run: The run.

    Raises:
      OSError: if a file cannot be written.
      ValueError: if the folder holds another model; names what differs.
    """
    where = run.folder / "config.json"
    value = smgdiff_model.to_json(run.model)
    if where.exists():
        differ = runs.differences(files.read_object(where, what=_WHAT), value)
        if differ:
            raise ValueError(
                f"{where}: another model: {differ}; choose another folder, or train "
                "with the same data and sizes"
            )
        return
    save_ball_clips(run.folder / "train.npz", run.train)
    save_ball_clips(run.folder / "held_out.npz", run.held_out)
    files.write_text(where, json.dumps(value, indent=1))


def load_run(folder: Path) -> Run:
    """Reads a run folder.

    Args:
      folder: Of `experiments/smgdiff.py train`.

    Returns:
      The run.

    Raises:
      OSError: if a file is missing.
      ValueError: if one is damaged or foreign; names it and the field.
    """
    where = folder / "config.json"
    value = files.read_object(where, what=_WHAT)
    return Run(
        folder=folder,
        model=smgdiff_model.from_json(value, where=str(where)),
        train=load_ball_clips(folder / "train.npz"),
        held_out=load_ball_clips(folder / "held_out.npz"),
    )


def stage_config(model: Model, stage: str) -> tuple[str, dict[str, Any]]:
    """What a stage's checkpoint says of it.

    Args:
      model: The model, with the stage's number of steps.
      stage: "motion_8", "paths_1", ...

    Returns:
      Name of the model's field, and that configuration as JSON.
    """
    field = "config" if stage.startswith("motion") else "paths"
    return field, dataclasses.asdict(getattr(model, field))


def init_stage(key: Key, model: Model, stage: str) -> Params:
    """Initial parameters of a stage.

    Args:
      key: Consumed.
      model: The model, with the stage's number of steps.
      stage: "motion_8", "paths_1", ...

    Returns:
      The parameters.
    """
    if stage.startswith("motion"):
        return smgdiff_model.init(key, model.config)
    return smgdiff_trajectory.init(key, model.paths)


def load_stage(run: Run, stage: str) -> tuple[Model, Params]:
    """Averaged parameters of a stage.

    Args:
      run: The run.
      stage: "motion_8", "paths_1", ...

    Returns:
      The model with the stage's number of steps, and the parameters.

    Raises:
      CheckpointError: if the stage was not trained, or with other sizes.
      ValueError: if there is no such stage.
    """
    model = with_steps(run.model, stage)
    folder = run.folder / stage
    value = runs.check_stage(folder, stage, system=SYSTEM)
    field, expected = stage_config(model, stage)
    if value.get(field) != expected:
        raise checkpoint.CheckpointError(
            f"{folder}: field {field!r} is not that of {run.folder}/config.json"
        )
    init = lambda: init_stage(jax.random.key(0), model, stage)  # noqa: E731
    return model, runs.load_params(folder, stage, init, system=SYSTEM)


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
    run: Run, stage: str, *, budget: runs.Budget, draft_steps: int = 0
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
    model = with_steps(run.model, stage)
    arrays = smgdiff_data.scene_arrays(run.train, model.config.window)
    folder, key = run.folder / stage, jax.random.key(budget.seed)
    params = jax.jit(lambda key: init_stage(key, model, stage))(key)
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
    budget: runs.Budget,
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
            smgdiff_trajectory.loss,
            skeleton=representation.skeleton,
            config=model.paths,
        )

    def sample_batch(key: Key, arrays: smgdiff_data.SceneArrays) -> tuple[Any, Any]:
        scenes, labels = smgdiff_data.sample_scenes(key, arrays, batch=budget.batch)
        return (scenes if is_motion else scenes.motion), labels

    optimizer = runs.make_optimizer(budget)
    state = runs.fit(
        folder,
        training.init_train_state(params, optimizer),
        training.make_update(loss, optimizer, ema_decay=budget.ema),
        sample_batch,
        arrays,
        system=SYSTEM,
        stage=stage,
        budget=budget,
        config=dict([stage_config(model, stage)]),
        source=source,
        settings=settings,
        show=("loss", "foot") if is_motion else ("loss",),
    )
    return state.ema_params
