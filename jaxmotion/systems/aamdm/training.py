"""Stages 2 and 3: the polisher and the generator of a chain of some length."""

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxmotion import files
from jaxmotion.data import clips_io, mirror, selection
from jaxmotion.learning import adversarial, checkpoint, runs, training
from jaxmotion.learning.runs import Budget as Budget
from jaxmotion.learning.runs import make_optimizer as make_optimizer
from jaxmotion.motion import pose
from jaxmotion.motion.skeleton import MAX_METERS, Skeleton
from jaxmotion.systems.aamdm import data as aamdm_data
from jaxmotion.systems.aamdm import embedding as aamdm_embedding
from jaxmotion.systems.aamdm import loss as aamdm_loss
from jaxmotion.systems.aamdm import model as aamdm_model
from jaxmotion.systems.aamdm import space as aamdm_space
from jaxmotion.systems.aamdm.data import PoseData, starts
from jaxmotion.systems.aamdm.model import Sample
from jaxmotion.systems.aamdm.space import Autoencoder, Space
from jaxmotion.typing import Key, Params

check_stage = functools.partial(runs.check_stage, system="aamdm")
fit = functools.partial(runs.fit, system="aamdm")
load_params = functools.partial(runs.load_params, system="aamdm")


def frame_windows(
    frames: Array, data: PoseData, length: int, *, batch: int
) -> tuple[Callable, tuple[Array, Int[Array, " windows"]]]:
    """Windows of frames for training.

    Args:
      frames: One a frame of the data.
      data: The data.
      length: Frames per window.
      batch: Windows per batch.

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


SpaceName = Literal["embedded", "full_pose"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """Data of a run folder.

    Attributes:
      folder: The folder.
      skeleton: The skeleton.
      train: Training frames.
      held_out: Frames that no network saw.
      source: The data, and its license.
      config: JSON of how the frames were made.
    """

    folder: Path
    skeleton: Skeleton
    train: PoseData
    held_out: PoseData
    source: str
    config: dict[str, Any]

    @property
    def frames(self) -> Path:
        """File of the frames."""
        return self.folder / "frames.npz"

    @property
    def embedding(self) -> aamdm_embedding.Config:
        """Sizes of the autoencoder."""
        return aamdm_embedding.Config(
            num_joints=self.skeleton.num_joints, fps=self.train.fps
        )


def prepare(
    folder: Path,
    data: Path,
    *,
    field: str,
    labels: tuple[str, ...],
    fps: float,
    held_out: float,
    mirrored: bool,
) -> Run:
    """Makes the frames of a run folder, or loads those it has.

    Args:
      folder: The run folder.
      data: Clips.
      field: Label field by which clips are chosen.
      labels: Their labels; none: all clips.
      fps: Frames per second.
      held_out: Part of each clip, at its end, to hold out.
      mirrored: Whether mirrored clips are added.

    Returns:
      The run.

    Raises:
      OSError: if the clips cannot be read.
      ValueError: if the folder's frames were made otherwise, or the clips do not fit.
    """
    made = dict(
        field=field,
        labels=list(labels),
        fps=fps,
        held_out=held_out,
        mirrored=mirrored,
    )
    if (folder / "config.json").exists():
        run = load_run(folder)
        runs.check_made(folder, run.config, [data], made)
        return run
    source = runs.made_from([data])
    clips = clips_io.load_clips(data)
    if labels:
        clips = selection.select(clips, field, labels)
    if mirrored:
        clips = selection.concatenate([clips, mirror.mirror_clips(clips)])
    frames, names = aamdm_data.pose_data(clips, fps=fps)
    skipped = sorted(set(clips.clip_names) - set(names))
    print(f"{len(names)} clips, {frames.num_frames} frames; too short: {skipped}")
    arrays = {name: getattr(frames, name) for name in ("poses", "paths", "offsets")}
    files.write_arrays(folder / "frames.npz", arrays)
    value = {
        "system": "aamdm",
        "skeleton": runs.skeleton_to_json(clips.skeleton),
        "source": clips.source,
        "clips": list(names),
    } | source
    files.write_text(folder / "config.json", json.dumps(value | made, indent=1))
    return load_run(folder)


def load_run(folder: Path) -> Run:
    """Loads the frames of a run folder.

    Args:
      folder: Its path.

    Returns:
      The run.

    Raises:
      ValueError: if it is no run folder of AAMDM; names the file and the field.
    """
    path = folder / "config.json"
    for needed in (path, folder / "frames.npz"):
        if not needed.is_file():
            raise ValueError(
                f"{folder}: no run folder of `experiments/aamdm.py train`: "
                f"{needed.name} is missing"
            )
    value = files.read_object(
        path, what="expected a run folder of `experiments/aamdm.py train`"
    )
    if value.get("system") != "aamdm":
        raise ValueError(
            f"{path}: field 'system' is {value.get('system')!r:.80}, expected 'aamdm'"
        )
    for name in ("skeleton", "fps", "held_out", "source"):
        if name not in value:
            raise ValueError(f"{path}: field {name!r} is missing")
    limits = {"fps": (5, clips_io.RATES[1]), "held_out": (0, 1)}
    for name, (low, high) in limits.items():
        right = isinstance(value[name], int | float) and low < value[name] < high
        if not right or isinstance(value[name], bool):
            raise ValueError(
                f"{path}: field {name!r} is {value[name]!r:.80}, expected more than "
                f"{low:g} and less than {high:g}"
            )
    if not isinstance(value["source"], str):
        raise ValueError(f"{path}: field 'source' is no text: {value['source']!r:.80}")
    try:
        skeleton = runs.skeleton_from_json(value["skeleton"])
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path}: field 'skeleton': {error}") from None
    frames = _read_frames(folder / "frames.npz", skeleton, fps=float(value["fps"]))
    try:
        train, held_out = aamdm_data.split_ends(frames, value["held_out"])
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from None
    return Run(
        folder=folder,
        skeleton=skeleton,
        train=train,
        held_out=held_out,
        source=value["source"],
        config=value,
    )


def _read_frames(path: Path, skeleton: Skeleton, *, fps: float) -> PoseData:
    """The frames of a run folder; raises unless its arrays agree."""
    arrays = files.read_arrays(path, name=str(path), what="frame")
    wanted = {"poses": ("f", 2), "paths": ("f", 2), "offsets": ("i", 1)}
    files.check_fields(str(path), arrays, wanted)
    offsets = arrays["offsets"].astype(np.int64)
    number = offsets[-1] if offsets.size else 0
    if offsets.size < 2 or offsets[0] != 0 or (np.diff(offsets) < 1).any():
        raise ValueError(f"{path}: field 'offsets' should ascend from 0")
    features = {"poses": pose.pose_layout(skeleton.num_joints).size, "paths": 12}
    for name, size in features.items():
        shape = arrays[name].shape
        if shape != (number, size):
            raise ValueError(
                f"{path}: field {name!r} has shape {shape}, expected {(number, size)}"
            )
        # Positions, velocities and directions; also keeps them within float32.
        if not (np.abs(arrays[name].astype(np.float64)) <= MAX_METERS).all():
            raise ValueError(
                f"{path}: field {name!r} has numbers that are not within {MAX_METERS:g}"
            )
    return PoseData(
        poses=jnp.asarray(arrays["poses"], jnp.float32),
        paths=jnp.asarray(arrays["paths"], jnp.float32),
        offsets=jnp.asarray(offsets, jnp.int32),
        fps=fps,
    )


def train_autoencoder(run: Run, budget: Budget) -> Autoencoder:
    """Stage 1.

    Args:
      run: The run.
      budget: How long.

    Returns:
      The autoencoder, with averaged parameters.
    """
    config, data = run.embedding, run.train
    statistics = aamdm_embedding.fit_statistics(data.poses, data.paths, config=config)
    loss = functools.partial(
        aamdm_embedding.loss,
        statistics=statistics,
        parents=run.skeleton.parents,
        config=config,
    )
    optimizer = make_optimizer(budget)
    params = aamdm_embedding.init(jax.random.key(budget.seed), config)
    both = jnp.concatenate([data.poses, data.paths], axis=-1)
    windows, arrays = frame_windows(both, data, 2, batch=budget.batch)
    size = config.num_features

    def sample(key, arrays):
        found = windows(key, arrays)
        return found[..., :size], found[..., size:]

    state = fit(
        run.folder / "autoencoder",
        training.init_train_state(params, optimizer),
        training.make_update(loss, optimizer, ema_decay=budget.ema),
        sample,
        arrays,
        stage="autoencoder",
        budget=budget,
        config={"config": dataclasses.asdict(config), "source": run.source},
        source=run.frames,
        show=("loss", "value", "change"),
    )
    return Autoencoder(params=state.ema_params, statistics=statistics, config=config)


def _space(run: Run, autoencoder: Autoencoder | None) -> Space:
    return aamdm_space.fit_space(
        run.train.poses,
        run.train.paths,
        aamdm_data.starts(run.train, 2),
        autoencoder=autoencoder,
    )


def make_space(run: Run, autoencoder: Autoencoder | None) -> Space:
    """Makes a space of the run and stores it; one that is there is loaded.

    Args:
      run: The run.
      autoencoder: For the embedded space; None for full poses.

    Returns:
      The space.
    """
    name: SpaceName = "full_pose" if autoencoder is None else "embedded"
    if checkpoint.latest_step(run.folder / name / "checkpoints") is not None:
        return load_space(run, name)
    space = jax.jit(functools.partial(_space, run))(autoencoder)
    save_space(run.folder / name, space, {"source": run.source})
    return space


def load_space(run: Run, name: SpaceName) -> Space:
    """A space of a run folder.

    Args:
      run: The run.
      name: Which.

    Returns:
      The space.

    Raises:
      CheckpointError: if the run has not made it.
    """

    def like() -> Space:
        if name == "full_pose":
            return _space(run, None)
        config = run.embedding
        params = aamdm_embedding.init(jax.random.key(0), config)
        statistics = aamdm_embedding.fit_statistics(
            run.train.poses, run.train.paths, config=config
        )
        own = Autoencoder(params=params, statistics=statistics, config=config)
        return _space(run, own)

    return restore_space(run.folder / name, like)


def chain_folder(run: Run, space: SpaceName, *, num_steps: int, target: str) -> Path:
    """Where the networks of a chain lie.

    Args:
      run: The run.
      space: Its space.
      num_steps: T.
      target: What the chain denoises.

    Returns:
      The folder.
    """
    name = f"T{num_steps}" + ("" if target == "frame" else f"_{target}")
    return run.folder / space / name


def _shared(config: aamdm_model.Config) -> dict:
    """What chains of one length have in common, as JSON."""
    value = dataclasses.asdict(config) | {"num_steps": config.num_steps}
    del value["drafts"], value["polishes"]
    return value


def _folder(run: Run, name: SpaceName, config: aamdm_model.Config) -> Path:
    return chain_folder(run, name, num_steps=config.num_steps, target=config.target)


def train_polisher(
    run: Run, name: SpaceName, space: Space, config: aamdm_model.Config, budget: Budget
) -> Params:
    """Stage 2.

    Args:
      run: The run.
      name: Of the space.
      space: The space.
      config: The method.
      budget: How long.

    Returns:
      Averaged parameters.
    """
    frames = aamdm_space.to_frames(space, run.train.poses, run.train.paths)
    change = space.change if config.target == "change" else None
    loss = functools.partial(aamdm_loss.polisher_loss, config=config, change=change)
    optimizer = make_optimizer(budget)
    params = aamdm_model.init(jax.random.key(budget.seed), config)["polisher"]
    sample, arrays = frame_windows(
        frames, run.train, config.window + 1, batch=budget.batch
    )
    state = fit(
        _folder(run, name, config) / "polisher",
        training.init_train_state(params, optimizer),
        training.make_update(loss, optimizer, ema_decay=budget.ema),
        sample,
        arrays,
        stage="polisher",
        budget=budget,
        config={"config": _shared(config), "space": name, "source": run.source},
        source=run.frames,
        show=("loss", "value", "velocity"),
    )
    return state.ema_params


def train_generator(
    run: Run, name: SpaceName, space: Space, config: aamdm_model.Config, budget: Budget
) -> Params:
    """Stage 3.

    Args:
      run: The run.
      name: Of the space.
      space: The space.
      config: The method.
      budget: How long; both players have its optimizer.

    Returns:
      The generator's averaged parameters.
    """
    frames = aamdm_space.to_frames(space, run.train.poses, run.train.paths)
    change = space.change if config.target == "change" else None
    judge, make = (
        functools.partial(loss, config=config, change=change)
        for loss in (aamdm_loss.discriminator_loss, aamdm_loss.generator_loss)
    )
    optimizer = make_optimizer(budget)
    params = aamdm_model.init(jax.random.key(budget.seed), config)
    players = {
        player: training.init_train_state(params[player], optimizer)
        for player in ("generator", "discriminator")
    }
    sample, arrays = frame_windows(frames, run.train, 3, batch=budget.batch)
    state = fit(
        _folder(run, name, config) / "generator",
        adversarial.GanState(**players),
        adversarial.make_gan_update(
            judge, make, (optimizer, optimizer), ema_decay=budget.ema
        ),
        sample,
        arrays,
        stage="generator",
        budget=budget,
        config={"config": _shared(config), "space": name, "source": run.source},
        source=run.frames,
        show=("generator/loss", "discriminator/loss"),
    )
    return state.generator.ema_params


def _stored_config(folder: Path, *, drafts: int, polishes: int) -> aamdm_model.Config:
    """The configuration that a chain was trained with."""
    stage = "polisher" if polishes else "generator"
    value = check_stage(folder / stage, stage)
    try:
        stored = dict(value["config"])
        num_steps = stored.pop("num_steps")
        own = {"drafts": drafts, "polishes": polishes}
        config = runs.config_from_json(aamdm_model.Config, stored | own)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{folder / stage}: field 'config' is wrong: {error}"
        ) from error
    if num_steps != config.num_steps:
        raise ValueError(
            f"{folder / stage}: trained for chains of {num_steps} steps, expected "
            f"{config.num_steps}"
        )
    return config


def load_networks(
    run: Run,
    name: SpaceName,
    space: Space,
    *,
    drafts: int,
    polishes: int,
    target: Literal["frame", "change"] = "frame",
) -> tuple[Params, aamdm_model.Config]:
    """The networks of a trained chain.

    Args:
      run: The run.
      name: Of the space.
      space: The space.
      drafts: Steps of the generator.
      polishes: Steps of the diffusion model.
      target: What the chain denoises.

    Returns:
      Parameters of those stages that take steps, and the configuration that they were
      trained with.

    Raises:
      CheckpointError: if a stage that it needs is missing, or of another kind.
      ValueError: if a stage was trained for another chain or another space.
    """
    folder = chain_folder(run, name, num_steps=drafts + polishes, target=target)
    config = _stored_config(folder, drafts=drafts, polishes=polishes)
    if config.features != space.num_features:
        raise ValueError(
            f"{folder}: networks of {config.features} channels, expected the "
            f"{space.num_features} of the space"
        )
    init = functools.partial(aamdm_model.init, jax.random.key(0), config)
    params = {}
    if drafts:
        params["generator"] = load_params(
            folder / "generator",
            "generator",
            lambda: init()["generator"],
            adversarial=True,
        )
    if polishes:
        params["polisher"] = load_params(
            folder / "polisher", "polisher", lambda: init()["polisher"]
        )
    return params, config


def load_chain(run: Run, name: SpaceName, space: Space, **chain: Any) -> Sample:
    """The sampler of a trained chain.

    Args:
      run: The run.
      name: Of the space.
      space: The space.
      **chain: As of `load_networks`.

    Returns:
      The sampler.

    Raises:
      CheckpointError, ValueError: as `load_networks`.
    """
    params, config = load_networks(run, name, space, **chain)
    change = space.change if config.target == "change" else None
    return aamdm_model.sampler(params, config=config, change=change)
