"""Run folders of SMGDiff, and what was trained in them.

A run folder holds config.json (the model), train.npz and held_out.npz (clips with a
ball), and one folder a stage: motion_8 is the motion model of 8 steps, paths_1 the
trajectory generator of one.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax

from jaxmotion import files
from jaxmotion.data.ball_clips import BallClips, load_ball_clips, save_ball_clips
from jaxmotion.learning import checkpoint
from jaxmotion.protocols import smgdiff_data, stages
from jaxmotion.systems import (
    smgdiff,
    smgdiff_model,
    smgdiff_scene,
    smgdiff_trajectory,
)
from jaxmotion.systems.smgdiff_model import SYSTEM, Model
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
      The model, its features standardised on the clips.

    Raises:
      ValueError: if no clip is as long as a window.
    """
    clips, labels = data.clips, data.clips.names(smgdiff_data.FIELD)
    names = smgdiff_scene.feature_layout(clips.skeleton, data.joints)
    config = smgdiff.Config(
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
        differ = stages.differences(files.read_object(where, what=_WHAT), value)
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
        return smgdiff.init(key, model.config)
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
    value = stages.check_stage(folder, stage, system=SYSTEM)
    field, expected = stage_config(model, stage)
    if value.get(field) != expected:
        raise checkpoint.CheckpointError(
            f"{folder}: field {field!r} is not that of {run.folder}/config.json"
        )
    init = lambda: init_stage(jax.random.key(0), model, stage)  # noqa: E731
    return model, stages.load_params(folder, stage, init, system=SYSTEM)
