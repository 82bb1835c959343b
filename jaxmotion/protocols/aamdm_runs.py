"""A folder of AAMDM: the data it was made from, its spaces, and its networks.

    frames/, config.json      pose vectors and path features, and how they were made
    autoencoder/              stage 1
    embedded/, full_pose/     spaces: scales, and the autoencoder's averaged parameters
    <space>/T<steps>/polisher, generator    stages 2 and 3 of chains of that length

Chains of one length share their networks: three drafts and one polish need the same two
as two and two.
"""

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion import files
from jaxmotion.data import clips_io, mirror, npz, selection
from jaxmotion.learning import checkpoint, training
from jaxmotion.motion import pose
from jaxmotion.motion.skeleton import MAX_METRES, Skeleton
from jaxmotion.protocols import aamdm_data, aamdm_stages, stages
from jaxmotion.protocols.aamdm_data import PoseData
from jaxmotion.protocols.aamdm_stages import Budget
from jaxmotion.systems import (
    aamdm_embedding,
    aamdm_space,
    model_json,
)
from jaxmotion.systems.aamdm_space import Autoencoder, Space

SpaceName = Literal["embedded", "full_pose"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """Data of a run folder.

    Attributes:
      folder: The folder.
      bones: The skeleton.
      train: Training frames.
      held_out: Frames that no network saw.
      source: The data, and its licence.
      config: JSON of how the frames were made.
    """

    folder: Path
    bones: Skeleton
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
            num_joints=self.bones.num_joints, fps=self.train.fps
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
      fps: Frames a second.
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
        stages.check_made(folder, run.config, [data], made)
        return run
    source = stages.made_from([data])
    clips = clips_io.load_clips(data)
    if labels:
        clips = selection.select(clips, field, labels)
    if mirrored:
        clips = selection.concatenate([clips, mirror.mirror_clips(clips)])
    frames, names = aamdm_data.pose_data(clips, fps=fps)
    skipped = sorted(set(clips.clip_names) - set(names))
    print(f"{len(names)} clips, {frames.num_frames} frames; too short: {skipped}")
    with files.replacing(folder / "frames.npz") as file:
        np.savez(file, poses=frames.poses, paths=frames.paths, offsets=frames.offsets)
    value = {
        "system": "aamdm",
        "skeleton": model_json.skeleton_to_json(clips.skeleton),
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
        bones = model_json.skeleton_from_json(value["skeleton"])
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path}: field 'skeleton': {error}") from None
    frames = _read_frames(folder / "frames.npz", bones, fps=float(value["fps"]))
    try:
        train, held_out = aamdm_data.split_ends(frames, value["held_out"])
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from None
    return Run(
        folder=folder,
        bones=bones,
        train=train,
        held_out=held_out,
        source=value["source"],
        config=value,
    )


def _read_frames(path: Path, bones: Skeleton, *, fps: float) -> PoseData:
    """The frames of a run folder; raises unless its arrays agree."""
    arrays = files.read_arrays(path, name=str(path), what="frame")
    wanted = {"poses": ("f", 2), "paths": ("f", 2), "offsets": ("i", 1)}
    npz.check_fields(str(path), arrays, wanted)
    offsets = arrays["offsets"].astype(np.int64)
    number = offsets[-1] if offsets.size else 0
    if offsets.size < 2 or offsets[0] != 0 or (np.diff(offsets) < 1).any():
        raise ValueError(f"{path}: field 'offsets' should ascend from 0")
    features = {"poses": pose.pose_layout(bones.num_joints).size, "paths": 12}
    for name, size in features.items():
        shape = arrays[name].shape
        if shape != (number, size):
            raise ValueError(
                f"{path}: field {name!r} has shape {shape}, expected {(number, size)}"
            )
        # Positions, velocities and directions; also keeps them within float32.
        if not (np.abs(arrays[name].astype(np.float64)) <= MAX_METRES).all():
            raise ValueError(
                f"{path}: field {name!r} has numbers that are not within {MAX_METRES:g}"
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
        parents=run.bones.parents,
        config=config,
    )
    optimizer = aamdm_stages.make_optimizer(budget)
    params = aamdm_embedding.init(jax.random.key(budget.seed), config)
    both = jnp.concatenate([data.poses, data.paths], axis=-1)
    windows, arrays = aamdm_stages.frame_windows(both, data, 2, batch=budget.batch)
    size = config.num_features

    def sample(key, arrays):
        found = windows(key, arrays)
        return found[..., :size], found[..., size:]

    state = aamdm_stages.fit(
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
    aamdm_stages.save_space(run.folder / name, space, {"source": run.source})
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

    return aamdm_stages.restore_space(run.folder / name, like)
