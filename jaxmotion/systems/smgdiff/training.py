"""How SMGDiff is trained: a stage for each kind and number of steps.

motion_<T>   the motion model of T steps, after a draft of its own
paths_<T>    the trajectory generator
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax

from jaxmotion.data import windows
from jaxmotion.data.ball_clips import BallClips, load_ball_clips, save_ball_clips
from jaxmotion.data.clips import measured_toes
from jaxmotion.learning import checkpoint, model_json, runs
from jaxmotion.systems.smgdiff import data as smgdiff_data
from jaxmotion.systems.smgdiff import loss as smgdiff_loss
from jaxmotion.systems.smgdiff import model as smgdiff_model
from jaxmotion.systems.smgdiff import scene as smgdiff_scene
from jaxmotion.systems.smgdiff import trajectory as smgdiff_trajectory
from jaxmotion.systems.smgdiff.model import SYSTEM, Model
from jaxmotion.typing import Key, Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """A run folder, its model and its data."""

    record: runs.Run
    model: Model
    train: BallClips
    held_out: BallClips


def make_model(
    data: BallClips, *, sizes: dict[str, Any], paths: dict[str, Any] | None = None
) -> Model:
    """A model for clips with a ball, its features standardized on them.

    Skeleton, rate, skills and source are those of the clips; `sizes` are fields of
    `smgdiff.Config`, `paths` of `smgdiff_trajectory.Config`. `ValueError` if no clip is
    as long as a window.
    """
    clips, labels = data.clips, data.clips.names(smgdiff_data.FIELD)
    names = smgdiff_scene.feature_layout(clips.skeleton, data.joints)
    config = smgdiff_model.Config(
        num_features=names.size, num_labels=len(labels), fps=clips.fps, **sizes
    )
    if config.seam_half_life:
        stops = {name: stop for name, _, stop in names.fields}
        config = dataclasses.replace(config, seam_features=stops["rotations"])
    arrays = smgdiff_data.scene_arrays(data, config.window)
    return Model(
        config=config,
        paths=smgdiff_trajectory.Config(
            num_labels=len(labels),
            past=config.past,
            future=config.future,
            seconds=config.future / config.fps,
            **(paths or {}),
        ),
        representation=smgdiff_data.fit_representation(arrays, past=config.past),
        labels=labels,
        speeds=tuple(round(float(v), 4) for v in smgdiff_data.skill_speeds(data)),
        source=clips.source,
        toe_height=measured_toes(clips),
    )


def check_stage_name(stage: str) -> tuple[str, int]:
    """Kind and T of a stage such as "motion_8" or "paths_1" (else `ValueError`)."""
    kind, _, steps = stage.partition("_")
    if kind not in ("motion", "paths") or not steps.isdecimal() or int(steps) < 1:
        raise ValueError(
            f"unknown stage {stage!r}: expected motion_<steps> or paths_<steps>, such "
            "as motion_8"
        )
    return kind, int(steps)


def with_steps(model: Model, stage: str) -> Model:
    """The model with the number of steps that a stage such as "motion_8" says."""
    kind, steps = check_stage_name(stage)
    field = "config" if kind == "motion" else "paths"
    changed = dataclasses.replace(getattr(model, field), num_steps=steps)
    return dataclasses.replace(model, **{field: changed})


# Fields of both configs that change no parameter's shape; "noise" also begins
# "noise_levels".
_FREE = (
    "num_steps",
    "noise",
    "seconds",
    "attention",
    "own_levels",
    "cubic_wishes",
    "seam_half_life",
    "seam_features",
)


def continued(model: Model, path: Path) -> tuple[Model, dict[str, Params]]:
    """A run's or exported model's parameters, to be trained on as this model.

    The units of features go with them; weights of the losses, attention, noise levels
    and seam are this model's.

    A `ValueError` names skeleton, skills or sizes that differ.
    """
    first, params = load(path)

    def part(model: Model) -> dict[str, Any]:
        value = smgdiff_model.to_json(model)
        features = ("skeleton", "joints", "fps")
        value["representation"] = {k: value["representation"][k] for k in features}
        return {k: value[k] for k in ("config", "paths", "representation", "labels")}

    model_json.check_start(path, part(first), part(model), free=_FREE)
    return dataclasses.replace(model, representation=first.representation), params


def prepare(
    folder: Path,
    data: Path,
    *,
    held_out: float,
    sizes: dict[str, Any],
    paths: dict[str, Any] | None = None,
    init: Path | None = None,
) -> Run:
    """Makes model and clips of a run folder, or loads those it has.

    Sizes and paths are as `make_model` takes them; `held_out` is the part of the
    recordings to hold out; `init` is a model to start from.

    `ValueError` if the folder was made otherwise, or the clips do not fit.
    """

    def make() -> runs.Content:
        parts = smgdiff_data.split(load_ball_clips(data), fraction=held_out)
        model = make_model(parts[0], sizes=sizes, paths=paths)
        if init is not None:
            model = continued(model, init)[0]
        return runs.Content(
            model=smgdiff_model.to_json(model),
            source=model.source,
            split={
                name: list(part.clips.clip_names)
                for name, part in zip(("train", "held_out"), parts, strict=True)
            },
            files={
                name: functools.partial(save_ball_clips, data=part)
                for name, part in zip(_FILES, parts, strict=True)
            },
        )

    record = runs.begin(
        folder,
        system=SYSTEM,
        data=[data],
        settings={
            "held_out": held_out,
            "sizes": sizes,
            "paths": paths or {},
            "init": init and str(init),
        },
        make=make,
    )
    return _decode(record)


_FILES = ("train.npz", "held_out.npz")


def load_run(folder: Path) -> Run:
    """Reads a run folder; a `ValueError` names the file and field that are wrong."""
    return _decode(runs.load(folder, system=SYSTEM))


def _decode(record: runs.Run) -> Run:
    train, held_out = (load_ball_clips(record.file(name)) for name in _FILES)
    model = smgdiff_model.from_json(record.model, where=str(record.config))
    return Run(record=record, model=model, train=train, held_out=held_out)


def stage_json(model: Model, stage: str) -> dict[str, Any]:
    """JSON of the networks of a stage of the model with that number of steps."""
    is_motion = stage.startswith("motion")
    return dataclasses.asdict(model.config if is_motion else model.paths)


def init_stage(key: Key, model: Model, stage: str) -> Params:
    """Initial parameters of a stage of the model with that number of steps."""
    if stage.startswith("motion"):
        return smgdiff_model.init(key, model.config)
    return smgdiff_trajectory.init(key, model.paths)


def load_stage(run: Run, stage: str) -> tuple[Model, Params]:
    """The model with a stage's number of steps, and the stage's averaged parameters.

    `CheckpointError` if the stage was not trained, or with other sizes.
    """
    model = with_steps(run.model, stage)
    runs.check_model(run.record, stage, stage_json(model, stage))
    init = lambda: init_stage(jax.random.key(0), model, stage)  # noqa: E731
    return model, runs.load_params(run.record, stage, init)


def load(path: Path) -> tuple[Model, dict[str, Params]]:
    """Model and parameters of a file, or of a folder as `load_networks` reads it.

    `CheckpointError` if a stage was not trained or the file is damaged.
    """
    if path.is_file():
        return smgdiff_model.import_file(path)
    return load_networks(load_run(path))


def path_stages(run: Run) -> list[str]:
    """The run's trajectory generators, that of most steps last."""
    found = (folder.name for folder in run.record.folder.glob("paths_*"))
    return sorted(found, key=lambda stage: check_stage_name(stage)[1])


def load_networks(run: Run) -> tuple[Model, dict[str, Params]]:
    """The model of 8 steps of motion, paths of the most steps, and its parameters."""
    model, motion = load_stage(run, "motion_8")
    return with_paths({"motion": motion}, model, run)


def with_paths(
    params: dict[str, Params], model: Model, run: Run
) -> tuple[Model, dict[str, Params]]:
    """Model and parameters with the trajectory generator of a run, of its most steps.

    `CheckpointError` if it has none; `ValueError` if skills or lengths differ.
    """
    other, paths = load_stage(run, (path_stages(run) or ["paths_1"])[-1])
    part = lambda m: (m.labels, m.paths.past, m.paths.future, m.config.fps)  # noqa: E731
    if part(other) != part(model):
        raise ValueError(
            f"{run.record.folder}: skills, frames and rate are {part(other)}, expected "
            f"{part(model)}"
        )
    return dataclasses.replace(model, paths=other.paths), params | {"paths": paths}


# Sizes and weights of `smgdiff.Config`, by name.
PRESETS: dict[str, dict[str, Any]] = {
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
# A second training of a "small" model. Standardized rotations make four fifths of its
# loss and planted feet a fiftieth; here feet make a quarter. What the ball weighs
# stays, and yet a sprinter loses it unless fast runs are drawn more often (`balance`).
PRESETS["planted"] = PRESETS["small"] | dict(
    weight_rotation=0.1,
    weight_position_velocity=150.0,
    weight_acceleration=100.0,
    weight_foot=2000.0,
)
# The same of `trajectory.Config`. Tokens that do not overlap make paths leap by
# centimeters every five frames, and beside places displacements count next to nothing.
PATHS = {"paper": dict(), "small": dict(token_margin=4, weight_velocity=100.0)}
PATHS["planted"] = PATHS["small"]
# For the first part of a training. Displacements are least for a body at rest, and
# a network that meets them first stays on the mean pose for thousands of updates.
DRAFT = dict(
    weight_position_velocity=5.0, weight_foot=5.0, weight_ball_acceleration=0.0
)


def train_stage(
    run: Run,
    stage: str,
    *,
    budget: runs.Budget,
    draft_steps: int = 0,
    balance: float = 0.0,
    init: Path | None = None,
) -> None:
    """Trains a stage such as "motion_8", from its newest checkpoint if there is one.

    A motion model first gets `draft_steps` updates with the weights `DRAFT`. `balance`
    is as in `windows.balance`. A new stage starts with the parameters of `init`, and
    then has no draft; None for random ones.

    `ValueError` if there is no such stage, its checkpoint has other settings, or the
    model of `init` does not fit; `TrainingDiverged` if a loss is not finite.
    """
    model = with_steps(run.model, stage)
    arrays = smgdiff_data.scene_arrays(run.train, model.config.window)
    if balance:
        index, _ = windows.balance(
            run.train.clips, arrays.index, last=model.config.past - 1, power=balance
        )
        arrays = dataclasses.replace(arrays, index=index)
    params = jax.jit(lambda key: init_stage(key, model, stage))(
        jax.random.key(budget.seed)
    )
    params = runs.initial(params, budget)
    kind, _ = check_stage_name(stage)
    settings: dict[str, Any] = {"balance": balance} if balance else {}
    if init is not None:
        settings, draft_steps = settings | {"init": str(init)}, 0
        if checkpoint.latest_step(run.record.checkpoints(stage)) is None:
            params = continued(model, init)[1][kind]
    if kind == "motion":
        settings |= {"draft_steps": draft_steps}
        if draft_steps:
            draft = dataclasses.replace(model.config, **DRAFT)
            params = _fit(
                run,
                f"{stage}/draft",
                dataclasses.replace(model, config=draft),
                params,
                arrays,
                budget=dataclasses.replace(budget, steps=draft_steps),
            )
    _fit(run, stage, model, params, arrays, budget=budget, settings=settings)


def _fit(
    run: Run,
    stage: str,
    model: Model,
    params: Params,
    arrays: smgdiff_data.SceneArrays,
    *,
    budget: runs.Budget,
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

    # A draft has batches and noise of its own: what follows it would repeat them.
    key = jax.random.fold_in(jax.random.key(budget.seed), 2)
    state = runs.minimize(
        params,
        run.record,
        stage,
        loss,
        sample_batch,
        arrays,
        budget=budget,
        model=stage_json(model, stage),
        settings=settings,
        key=key if stage.endswith("/draft") else None,
        show=("loss", "foot") if is_motion else ("loss",),
    )
    return state.ema_params
