"""How CAMDM is trained: clips of styles, and its one stage, "motion"."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxmotion.data import bvh, bvh_text, clips_io, mirror, selection, windows
from jaxmotion.data.clips import Clips, measured_toes
from jaxmotion.learning import checkpoint, model_json, runs
from jaxmotion.motion import skeleton
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.systems.camdm import loss as camdm_loss
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm.model import (
    STAGE,
    SYSTEM,
    Model,
    from_json,
    load,
    to_json,
)
from jaxmotion.typing import Key, Params

# Sizes and weights of `camdm.Config`, by name.
PRESETS = {
    # The paper's network and frame; a day on a large GPU.
    "paper": dict(),
    # For a CPU or a short run: 31 tokens instead of 147, samples that face +z,
    # rotations of unit variance. The features must outweigh the displacements: these
    # are least for a body that does not step, and a network that meets them first
    # stays for thousands of steps on the mean pose.
    "small": dict(
        width=192,
        hidden=768,
        frames_per_token=5,
        token_margin=4,
        norm="pre",
        heading="facing",
        rotation_scale=4.0,
        dropout=0.0,
        weight_data=10.0,
        weight_velocity=5.0,
        weight_position=2.0,
        weight_position_velocity=5.0,
        weight_foot=5.0,
    ),
}
# A second, short training of a "small" model: displacements of positions and feet weigh
# 40 times more against features, so that feet stand still, and changes of displacements
# count, so that joints do not shake.
PRESETS["planted"] = PRESETS["small"] | dict(
    weight_data=1.0,
    weight_position_velocity=20.0,
    weight_acceleration=20.0,
    weight_foot=20.0,
)
# How the presets are trained, as fields of `runs.Budget`.
FITTING: dict[str, dict[str, Any]] = {
    # The paper: as MDM, that is AdamW at 1e-4. The released code: the same, batch 512,
    # a moving average that is never saved; neither clips, decays or warms up. First
    # weights are PyTorch's, about.
    "paper": dict(
        optimizer="adamw",
        learning_rate=1e-4,
        batch=512,
        warmup=0,
        max_norm=0.0,
        ema=0.0,
        initial_scale=0.577,
    ),
    "small": dict(
        optimizer="muon",
        learning_rate=1e-3,
        batch=48,
        warmup=300,
        max_norm=1.0,
        ema=0.999,
        initial_scale=0.3,
    ),
}
FITTING["planted"] = FITTING["small"]


def make_model(clips: Clips, *, field: str, **sizes: Any) -> Model:
    """A model for clips; where rotations are scaled, with the mean of their rotations.

    Skeleton, rate, styles (labels of `field`), source and where toes rest are those of
    the clips; `sizes` are the other fields of `camdm.Config`.
    """
    config = camdm_model.Config(
        num_joints=clips.skeleton.num_joints,
        num_labels=len(clips.names(field)),
        fps=clips.fps,
        **sizes,
    )
    if config.rotation_scale != 1.0:
        every = max(clips.num_frames // 10_000, 1)
        frames = skeleton.Motion(
            root_position=clips.root_position[::every],
            joint_rotation=clips.joint_rotation[::every],
            fps=clips.fps,
        )
        mean = camdm_loss.mean_rotations(clips.skeleton, frames, config=config)
        config = dataclasses.replace(config, rotation_mean=mean)
    return Model(
        config=config,
        skeleton=clips.skeleton,
        labels=clips.names(field),
        source=clips.source,
        toe_height=measured_toes(clips),
    )


# What has no parameters. Attention to a prefix alone is soon learned anew.
_FREE = (
    "attention",
    "noise_levels",
    "own_levels",
    "cubic_wishes",
    "seam_half_life",
)


def continued(model: Model, path: Path) -> tuple[Model, Params]:
    """A run's or exported model's averaged parameters, to be trained as this model.

    Weights of the losses, attention and noise levels are this model's. A `ValueError`
    names skeleton, styles or sizes that differ.
    """
    first, params = load(path)
    source = dict(source="", toe_height=None)
    model_json.check_start(
        path,
        to_json(first) | source,
        to_json(model) | source,
        free=(*_FREE, "rotation_mean"),
    )
    # The mean rotation is part of what the network has learned.
    mean = first.config.rotation_mean
    config = dataclasses.replace(model.config, rotation_mean=mean)
    own = dict(
        config=config,
        source=model.source,
        steps=model.steps,
        toe_height=model.toe_height,
    )
    return dataclasses.replace(first, **own), params


def window_sampler(
    *, field: str, batch: int
) -> Callable[[Key, tuple[Clips, windows.WindowIndex]], tuple[skeleton.Motion, Array]]:
    """`(key, (clips, index)) -> (motion, label)`: random windows and their styles."""

    def sample_batch(
        key: Key, data: tuple[Clips, windows.WindowIndex]
    ) -> tuple[skeleton.Motion, Array]:
        clips, index = data
        motion, clip = windows.sample_windows(key, clips, index, batch=batch)
        return motion, clips.labels[field][clip]

    return sample_batch


# Locomotion of Bandai-Namco: what a model and its evaluator are trained on.
CONTENTS = ("walk", "walk-turn-left", "walk-turn-right", "run")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """What a run left behind: averaged parameters, and its clips without mirrored ones.

    No network saw those held out; the style is the label field `field`.
    """

    model: camdm_model.Model
    params: Params
    train: Clips
    held_out: Clips
    field: str


def split_data(
    data: Path,
    contents: tuple[str, ...],
    label: str,
    held_out: float,
    *,
    labels: tuple[str, ...] = (),
    held_out_clips: tuple[str, ...] = (),
) -> tuple[Clips, Clips]:
    """Training and held-out clips; the same for every run with these arguments.

    Kept are clips of these contents (none, or clips without such a field: all) and
    styles, labels of the field `label` (others are forgotten; none: all). Held out is a
    part of each style's clips, in (0, 1), or those named in `held_out_clips`.
    `ValueError` if the file holds no clips, or an argument does not fit them.
    """
    clips = clips_io.load_clips(data)
    clips.names(label)
    if contents and "content" in dict(clips.label_names):
        clips = selection.select(clips, "content", contents)
    if labels:
        clips = selection.relabel(selection.select(clips, label, labels), label)
    if held_out_clips:
        return selection.split_by_name(clips, held_out_clips)
    return selection.split_clips(clips, fraction=held_out, seed=0, field=label)


def released_skeleton(path: Path, *, scale: float) -> Skeleton:
    """The skeleton of a BVH file as CAMDM's preprocessing leaves it.

    Fingers and eyes are dropped; the scale is in meters per unit. `BvhError` if the
    file is malformed or has no toes.
    """
    from jaxmotion.data.builders import style100

    content = style100.without_fingers(bvh_text.read_bvh(path))
    skeleton, _ = bvh.motion_from_bvh(content, scale=scale)
    return dataclasses.replace(skeleton, feet=style100.toes(skeleton, str(path)))


def _splitter(settings: dict[str, Any]) -> Callable[[Path], tuple[Clips, Clips]]:
    """`split_data` with the settings of a run."""
    return functools.partial(
        split_data,
        contents=tuple(settings["contents"]),
        label=settings["label"],
        held_out=settings["held_out"],
        labels=tuple(settings["labels"]),
        held_out_clips=tuple(settings["held_out_clips"]),
    )


_FILES = ("train.npz", "held_out.npz")


def _unmeasured(held_out: Clips, field: str) -> list[str]:
    """Labels without a clip as long as the windows that are measured."""
    long = np.diff(np.asarray(held_out.offsets)) >= windows.EVAL_WINDOW
    known = np.unique(np.asarray(held_out.labels[field])[long])
    return [x for i, x in enumerate(held_out.names(field)) if i not in known]


def prepare(
    folder: Path,
    data: Path,
    *,
    label: str,
    contents: tuple[str, ...] = (),
    labels: tuple[str, ...] = (),
    held_out: float = 0.1,
    held_out_clips: tuple[str, ...] = (),
    mirrored: bool = False,
    balance: float = 0.0,
    make: Callable[[Clips], Model],
    settings: dict[str, Any],
) -> runs.Run:
    """Makes model and clips of a run folder, or loads those it has.

    Clips are chosen and split as by `split_data`; `balance` is as in `windows.balance`;
    `settings` is the JSON of what `make` makes the model from. `ValueError` if the
    folder was made otherwise, or the clips do not fit.
    """
    chosen = dict(
        label=label,
        contents=list(contents),
        labels=list(labels),
        held_out=held_out,
        held_out_clips=list(held_out_clips),
        mirror=mirrored,
        balance=balance,
    )

    def content() -> runs.Content:
        parts = _splitter(chosen)(data)
        model = make(mirror.with_mirrored(parts[0]) if mirrored else parts[0])
        camdm_model.check_clips(model, parts[0], label)
        if names := _unmeasured(parts[1], label):
            print(
                f"no held-out clip of {label} {', '.join(names)} has "
                f"{windows.EVAL_WINDOW} frames: evaluations have none to compare with"
            )
        return runs.Content(
            model=to_json(model),
            source=model.source,
            split={
                name: list(part.clip_names)
                for name, part in zip(("train", "held_out"), parts, strict=True)
            },
            files={
                name: functools.partial(clips_io.save_clips, clips=part)
                for name, part in zip(_FILES, parts, strict=True)
            },
        )

    return runs.begin(
        folder, system=SYSTEM, data=[data], settings=chosen | settings, make=content
    )


def training_windows(
    run: runs.Run, config: camdm_model.Config
) -> tuple[Clips, windows.WindowIndex]:
    """Clips of a run, mirrored ones included, and where their windows are; says so.

    `ValueError` if no clip is as long as a window.
    """
    clips = clips_io.load_clips(run.file(_FILES[0]))
    if run.settings["mirror"]:
        clips = mirror.with_mirrored(clips)
    index = windows.window_index(clips, config.window, short="skip")
    if power := run.settings["balance"]:
        last = config.past - 1
        index, shares = windows.balance(clips, index, last=last, power=power)
        (rare, often), (rarely, most) = 100 * shares.min(0), 100 * shares.max(0)
        print(
            f"{len(shares)} kinds of windows: the rarest has {often:.2g} % instead of "
            f"{rare:.2g} %, the most frequent {most:.2g} % instead of {rarely:.2g} %"
        )
    short = int(np.sum(np.diff(np.asarray(clips.offsets)) < config.window))
    print(
        f"{clips.num_clips} clips ({short} too short to use), {clips.num_frames} "
        f"frames, {index.starts.shape[0]} windows of {index.length} frames"
    )
    return jax.tree.map(jnp.asarray, (clips, index))


def train(run: runs.Run, budget: runs.Budget, *, init: Path | None = None) -> None:
    """Trains the model of a run, from its newest checkpoint if there is one.

    A new training starts with the parameters of `init`, a run folder or exported model;
    None for random ones. `ValueError` if no clip is as long as a window, or the
    checkpoint has other settings; `TrainingDiverged` if a loss is not finite.
    """
    model = from_json(run.model, where=str(run.config))
    config = model.config
    data = training_windows(run, config)
    key_init, key_train = jax.random.split(jax.random.key(budget.seed))
    if init is None or checkpoint.latest_step(run.checkpoints(STAGE)) is not None:
        params = runs.initial(camdm_model.init(key_init, config), budget)
    else:
        _, params = continued(model, init)
    runs.minimize(
        params,
        run,
        STAGE,
        functools.partial(camdm_loss.loss, skeleton=model.skeleton, config=config),
        window_sampler(field=run.settings["label"], batch=budget.batch),
        data,
        budget=budget,
        model=dataclasses.asdict(config),
        key=key_train,
        show=("loss", "data", "position", "foot"),
    )


def load_run(
    folder: Path, data: Path | None = None, contents: tuple[str, ...] = ()
) -> Run:
    """Loads a run folder.

    Other data are chosen and split as those that it was trained on; of `contents`, if
    any, clips of these alone are kept. A `ValueError` names a folder without a whole
    checkpoint of such a run, or what differs in the clips.
    """
    run = runs.load(folder, system=SYSTEM)
    model, params = load(folder)
    field = run.settings["label"]
    if data is None:
        parts = tuple(clips_io.load_clips(run.file(name)) for name in _FILES)
    else:
        parts = _splitter(run.settings)(data)
    if contents and "content" in dict(parts[0].label_names):
        parts = tuple(selection.select(part, "content", contents) for part in parts)
    camdm_model.check_clips(model, parts[0], field)
    return Run(
        model=model, params=params, train=parts[0], held_out=parts[1], field=field
    )


def exported_run(
    source: Path, data: Path | None, held_out_clips: tuple[str, ...]
) -> Run:
    """A shipped or exported model beside clips with its styles.

    The source is a shipped model's name or a file of `camdm.py export`. Clips of other
    styles are left out; `held_out_clips` names those that the model never saw.
    `ValueError` if no clips are given, or they do not fit the model; names what.
    """
    model, params = load(source)
    if data is None or not held_out_clips:
        raise ValueError(
            f"{source} has no clips of its own: give --data and --held-out-clips"
        )
    clips, field = camdm_model.fitting_clips(model, clips_io.load_clips(data))
    train, held_out = selection.split_by_name(clips, held_out_clips)
    return Run(model=model, params=params, train=train, held_out=held_out, field=field)
