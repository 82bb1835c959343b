"""How CAMDM is trained: data, objective, optimizer and state of a run, put together."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxmotion.data import bvh, bvh_text, clips_io, selection, windows
from jaxmotion.data.clips import Clips
from jaxmotion.learning import checkpoint, runs, training
from jaxmotion.motion import skeleton
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.systems.camdm import loss as camdm_loss
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm.model import Model, load, to_json
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
# 40 times more against features, so that feet stand still.
PRESETS["planted"] = PRESETS["small"] | dict(
    weight_data=1.0,
    weight_position_velocity=20.0,
    weight_foot=20.0,
)
# How the presets are trained, for `start`.
FITTING: dict[str, dict[str, Any]] = {
    # The paper: as MDM, that is AdamW at 1e-4. The released code: the same, batch 512,
    # a moving average that is never saved; neither clips, decays or warms up.
    "paper": dict(
        optimizer="adamw",
        learning_rate=1e-4,
        batch=512,
        warmup=0,
        max_norm=0.0,
        ema=0.0,
    ),
    "small": dict(
        optimizer="muon",
        learning_rate=1e-3,
        batch=48,
        warmup=300,
        max_norm=1.0,
        ema=0.999,
    ),
}
FITTING["planted"] = FITTING["small"]


def make_model(clips: Clips, *, field: str, **sizes: Any) -> Model:
    """A model for clips.

    Args:
      clips: The clips; their skeleton, rate, styles and source become the model's.
      field: Label field that is the style.
      **sizes: Of `camdm.Config`, but for those that the clips decide.

    Returns:
      The model; where rotations are scaled, with the mean of the clips' rotations.

    Raises:
      ValueError: if the clips have no such field.
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
    )


def continued(model: Model, path: Path) -> tuple[Model, Params]:
    """Another run's network and averaged parameters, with this model's loss weights.

    Args:
      model: The model to train.
      path: Run folder or exported model to start from.

    Returns:
      The other model with the weights replaced, and its parameters.

    Raises:
      ValueError: if skeleton, styles or sizes differ; names which.
    """
    first, params, _ = load(path)
    weights = {
        name: value
        for name, value in dataclasses.asdict(model.config).items()
        if name.startswith("weight_")
    }
    # The mean rotation is part of what the network has learned.
    mean = first.config.rotation_mean
    wanted = dataclasses.replace(model.config, rotation_mean=mean)
    found = dataclasses.replace(
        first, config=dataclasses.replace(first.config, **weights)
    )
    expected = to_json(dataclasses.replace(model, config=wanted, source=first.source))
    differ = runs.differences(to_json(found), expected)
    if differ:
        raise ValueError(
            f"{path}: expected a model with the skeleton, labels and config of the one "
            f"to train: {differ}"
        )
    return dataclasses.replace(found, source=model.source), params


def window_sampler(
    *, field: str, batch: int
) -> Callable[[Key, tuple[Clips, windows.WindowIndex]], tuple[skeleton.Motion, Array]]:
    """Random windows and their styles, as `camdm_loss.loss` takes them.

    Args:
      field: Label field that is the style.
      batch: Windows a draw.

    Returns:
      `(key, (clips, index)) -> (motion, label)`.
    """

    def sample_batch(
        key: Key, data: tuple[Clips, windows.WindowIndex]
    ) -> tuple[skeleton.Motion, Array]:
        clips, index = data
        motion, clip = windows.sample_windows(key, clips, index, batch=batch)
        return motion, clips.labels[field][clip]

    return sample_batch


def start(
    clips: Clips,
    model: Model,
    checkpoints: Path,
    *,
    field: str,
    num_steps: int,
    batch: int,
    optimizer: Literal["muon", "adamw"],
    learning_rate: float,
    warmup: int,
    max_norm: float,
    ema: float,
    chunk: int,
    devices: int = 1,
    seed: int = 0,
    params: Params | None = None,
) -> tuple[Callable, training.TrainState, Key, Any]:
    """All that `loop.train` needs: a new run, or the newest checkpoint of an old one.

    Args:
      clips: Training clips; those shorter than a window are left out.
      model: The model.
      checkpoints: Folder of the run's checkpoints; it need not exist.
      field: Label field that is the style.
      num_steps: Optimizer steps of the whole run.
      batch: Windows a step.
      optimizer: "muon" for short runs, or the paper's "adamw".
      learning_rate: Peak of its rate; cosine to a tenth.
      warmup: Steps of linear rise.
      max_norm: Gradients are clipped to this global norm; 0 for no clipping.
      ema: Decay per step of the parameters' moving average; 0 for no average.
      chunk: Steps of one compiled call.
      devices: Split each batch over so many; 1 for no mesh.
      seed: Of the parameters and of all that training draws.
      params: Where a new run starts; None for random parameters.

    Returns:
      The compiled chunk, the state, the key, and the data on the device.

    Raises:
      ValueError: if no clip is as long as a window, or the checkpoint is of another
        model.
    """
    index = windows.window_index(clips, model.config.window, short="skip")
    transformation = training.make_optimizer(
        optimizer,
        learning_rate=learning_rate,
        num_steps=num_steps,
        warmup_steps=warmup,
        max_norm=max_norm or None,
    )
    objective = functools.partial(
        camdm_loss.loss, skeleton=model.skeleton, config=model.config
    )
    update = training.make_update(objective, transformation, ema_decay=ema)
    if devices > jax.device_count():
        raise ValueError(f"devices is {devices}, {jax.device_count()} are there")
    mesh = jax.make_mesh((devices,), ("data",)) if devices > 1 else None

    sample_batch = window_sampler(field=field, batch=batch)
    key_init, key_train = jax.random.split(jax.random.key(seed))
    if params is None:
        params = camdm_model.init(key_init, model.config)
    state = training.init_train_state(params, transformation)
    if checkpoint.latest_step(checkpoints) is not None:
        state = checkpoint.restore(checkpoints, state)
    run = training.train_chunk(update, sample_batch, num_steps=chunk, mesh=mesh)
    data = training.replicate(jax.tree.map(jnp.asarray, (clips, index)), mesh)
    return run, training.replicate(state, mesh), key_train, data


# Locomotion of Bandai-Namco: what a model and its evaluator are trained on.
CONTENTS = ("walk", "walk-turn-left", "walk-turn-right", "run")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """What a run left behind.

    Attributes:
      model: The model.
      params: Its averaged parameters.
      train: Clips that it was trained on, without mirrored ones.
      held_out: Clips that it never saw.
      field: Label field that is the style.
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

    Args:
      data: File of clips.
      contents: Keep only clips of these contents; none, or clips without such a
        field: keep all.
      label: Label field that is the style.
      held_out: Part of each style's clips to hold out, in (0, 1).
      labels: Keep only clips of these styles, and forget the others; none: keep all.
      held_out_clips: Hold out these clips, by name, instead of a part.

    Returns:
      Both parts.

    Raises:
      OSError: if the file cannot be read.
      ValueError: if it holds no clips, or an argument does not fit them.
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

    Args:
      path: The file; fingers and eyes are dropped.
      scale: Meters per unit of the file.

    Raises:
      OSError: if it cannot be read.
      BvhError: if it is malformed or has no toes.
    """
    from jaxmotion.data.builders import style100

    content = style100.without_fingers(bvh_text.read_bvh(path))
    skeleton, _ = bvh.motion_from_bvh(content, scale=scale)
    return dataclasses.replace(skeleton, feet=style100.toes(skeleton, str(path)))


def load_run(
    run: Path, data: Path | None = None, contents: tuple[str, ...] = ()
) -> Run:
    """Loads a run of `experiments/camdm.py train`.

    Args:
      run: Its folder.
      data: Clips; None for those that it was trained on.
      contents: Keep only clips of these contents, of those that the run used; none:
        keep all.

    Returns:
      Model, parameters and clips.

    Raises:
      OSError: if the clips cannot be read.
      ValueError: if the folder has no whole checkpoint of such a run, or the clips are
        not the model's; names the folder or what differs.
    """
    model, params, value = camdm_model.load(run)
    made_by = value.get("experiment", {})
    wanted = {"data", "contents", "label", "labels", "held_out", "held_out_clips"}
    missing = wanted - set(made_by)
    if missing:
        raise ValueError(
            f"{run}: field 'experiment' lacks {', '.join(sorted(missing))}: expected a "
            "run folder of `experiments/camdm.py train`"
        )
    field = made_by["label"]
    parts = split_data(
        Path(data or made_by["data"]),
        tuple(made_by["contents"]),
        field,
        made_by["held_out"],
        labels=tuple(made_by["labels"]),
        held_out_clips=tuple(made_by["held_out_clips"]),
    )
    if contents and "content" in dict(parts[0].label_names):
        parts = tuple(selection.select(part, "content", contents) for part in parts)
    camdm_model.check_clips(model, parts[0], field)
    return Run(
        model=model, params=params, train=parts[0], held_out=parts[1], field=field
    )
