"""How CAMDM is trained: data, objective, optimiser and state of a run, put together."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxmotion.data import windows
from jaxmotion.data.clips import Clips
from jaxmotion.learning import checkpoint, training
from jaxmotion.motion import skeleton
from jaxmotion.protocols import stages
from jaxmotion.systems import camdm, camdm_loss
from jaxmotion.systems.camdm_model import Model, load, to_json
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
OPTIMIZERS = {"muon": training.muon_cosine, "adamw": training.adamw_cosine}
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
    config = camdm.Config(
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
        bones=clips.skeleton,
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
    differ = stages.differences(to_json(found), expected)
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
      num_steps: Optimiser steps of the whole run.
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
    transformation = OPTIMIZERS[optimizer](
        learning_rate=learning_rate,
        num_steps=num_steps,
        warmup_steps=warmup,
        max_norm=max_norm or None,
    )
    objective = functools.partial(
        camdm_loss.loss, bones=model.bones, config=model.config
    )
    update = training.make_update(objective, transformation, ema_decay=ema)
    if devices > jax.device_count():
        raise ValueError(f"devices is {devices}, {jax.device_count()} are there")
    mesh = jax.make_mesh((devices,), ("data",)) if devices > 1 else None

    sample_batch = window_sampler(field=field, batch=batch)
    key_init, key_train = jax.random.split(jax.random.key(seed))
    if params is None:
        params = camdm.init(key_init, model.config)
    state = training.init_train_state(params, transformation)
    if checkpoint.latest_step(checkpoints) is not None:
        state = checkpoint.restore(checkpoints, state)
    run = training.train_chunk(update, sample_batch, num_steps=chunk, mesh=mesh)
    data = training.replicate(jax.tree.map(jnp.asarray, (clips, index)), mesh)
    return run, training.replicate(state, mesh), key_train, data
