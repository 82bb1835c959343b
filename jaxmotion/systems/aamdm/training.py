"""How AAMDM is trained: poses and paths of clips, and its three stages.

autoencoder                                  poses to embeddings
embedded/P<p>_D<d>/polisher, .../generator   both networks of a chain
embedded/T<n>/...                            of all chains of n steps (`levels="all"`)
full_pose/...                                the same without the embedding
"""

import dataclasses
import functools
import operator
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion import files
from jaxmotion.data import clips_io, mirror, selection
from jaxmotion.data.clips import measured_toes
from jaxmotion.learning import adversarial, checkpoint, model_json, runs, training
from jaxmotion.learning.runs import Budget
from jaxmotion.motion import pose
from jaxmotion.motion.skeleton import MAX_METERS, Skeleton
from jaxmotion.systems.aamdm import data as aamdm_data
from jaxmotion.systems.aamdm import embedding as aamdm_embedding
from jaxmotion.systems.aamdm import loss as aamdm_loss
from jaxmotion.systems.aamdm import model as aamdm_model
from jaxmotion.systems.aamdm import space as aamdm_space
from jaxmotion.systems.aamdm import stored as aamdm_stored
from jaxmotion.systems.aamdm.data import PoseData
from jaxmotion.systems.aamdm.model import Sample
from jaxmotion.systems.aamdm.space import Autoencoder, Space
from jaxmotion.typing import Key, Params

SpaceName = Literal["embedded", "full_pose"]


def frame_windows(
    frames: Array, data: PoseData, length: int, *, batch: int, balance: float = 0.0
) -> tuple[Callable, tuple[Array, Int[Array, " windows"]]]:
    """`sample_batch(key, arrays) -> windows` of so many frames, and its arrays.

    By `balance` rare speeds and turns are drawn more often, see `data.balanced_starts`.
    `ValueError` if no clip is long enough.
    """
    offsets = jnp.arange(length)

    def sample(key: Key, arrays: tuple[Array, Array]) -> Array:
        frames, first = arrays
        chosen = first[jax.random.randint(key, (batch,), 0, first.shape[0])]
        return frames[jnp.add.outer(chosen, offsets)]

    first = aamdm_data.balanced_starts(data, length, power=balance)
    return sample, (frames, first)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """A run folder and its data; no network saw frames that are held out.

    Attributes:
      toe_height: Where toes rest in its clips, meters; None where nobody measured it.
    """

    record: runs.Run
    skeleton: Skeleton
    embedding: aamdm_embedding.Config
    train: PoseData
    held_out: PoseData
    toe_height: float | None = None

    @property
    def balance(self) -> float:
        """How much more often training draws rare speeds and turns."""
        return self.record.settings["balance"]

    @property
    def source(self) -> str:
        """The data, and its license."""
        return self.record.source


def prepare(
    folder: Path,
    data: Path,
    *,
    field: str,
    labels: tuple[str, ...],
    fps: float,
    held_out: float,
    mirrored: bool,
    balance: float = 0.0,
) -> Run:
    """Makes the frames of a run folder, or loads those it has.

    Clips are chosen by labels of the field (none: all); of each a part at its end is
    held out. The balance is as in `frame_windows`, for all stages. `ValueError` if the
    folder's frames were made otherwise, or the clips do not fit.
    """

    def make() -> runs.Content:
        clips = clips_io.load_clips(data)
        if labels:
            clips = selection.select(clips, field, labels)
        if mirrored:
            clips = mirror.with_mirrored(clips)
        print(f"making frames of {clips.num_clips} clips", flush=True)
        frames, names = aamdm_data.pose_data(clips, fps=fps)
        skipped = sorted(set(clips.clip_names) - set(names))
        print(f"{len(names)} clips, {frames.num_frames} frames; too short: {skipped}")
        loops = [selection.is_loop(name) for name in names]
        parts = aamdm_data.split_ends(frames, held_out, whole=loops)
        config = aamdm_embedding.Config(num_joints=clips.skeleton.num_joints, fps=fps)
        return runs.Content(
            model={
                "config": dataclasses.asdict(config),
                "skeleton": model_json.skeleton_to_json(clips.skeleton),
                "toe_height": measured_toes(clips),
            },
            source=clips.source,
            # The end of each clip is held out.
            split={"train": list(names), "held_out": list(names)},
            files={
                name: functools.partial(_write_frames, part)
                for name, part in zip(_FILES, parts, strict=True)
            },
        )

    settings = dict(
        field=field,
        labels=list(labels),
        fps=fps,
        held_out=held_out,
        mirrored=mirrored,
        balance=balance,
    )
    record = runs.begin(
        folder, system=aamdm_model.SYSTEM, data=[data], settings=settings, make=make
    )
    return _decode(record)


_FILES = ("train.npz", "held_out.npz")


def with_takes(run: Run, data: Path) -> Run:
    """The run with frames of other takes, chosen and split as its own were.

    `ValueError` if their skeleton is another, or they do not fit.
    """
    settings = run.record.settings
    labels = tuple(settings["labels"])
    with tempfile.TemporaryDirectory() as folder:
        other = prepare(Path(folder) / "run", data, **{**settings, "labels": labels})
    if other.skeleton.names != run.skeleton.names:
        raise ValueError(
            f"{data}: has joints {', '.join(other.skeleton.names)}, expected those of "
            f"{run.record.folder}: {', '.join(run.skeleton.names)}"
        )
    return dataclasses.replace(run, train=other.train, held_out=other.held_out)


def load_run(folder: Path) -> Run:
    """Loads the data of a run folder; a `ValueError` names what is none of AAMDM's."""
    return _decode(runs.load(folder, system=aamdm_model.SYSTEM))


def _decode(record: runs.Run) -> Run:
    parts = {
        "config": lambda x: model_json.config_from_json(aamdm_embedding.Config, x),
        "skeleton": model_json.skeleton_from_json,
    }
    found = model_json.decode(record.model, str(record.config), parts)
    config, skeleton = found["config"], found["skeleton"]
    if config.num_joints != skeleton.num_joints:
        raise ValueError(
            f"{record.config}: field 'skeleton' has {skeleton.num_joints} joints, the "
            f"config {config.num_joints}"
        )
    train, held_out = (
        _read_frames(record.file(name), skeleton, fps=config.fps) for name in _FILES
    )
    return Run(
        record=record,
        skeleton=skeleton,
        embedding=config,
        train=train,
        held_out=held_out,
        toe_height=model_json.toe_height_from_json(
            record.model.get("toe_height"), where=str(record.config)
        ),
    )


def _write_frames(frames: PoseData, path: Path) -> None:
    fields = ("poses", "paths", "offsets")
    files.write_arrays(
        path, {name: np.asarray(getattr(frames, name)) for name in fields}
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
    """Stage 1; returns the autoencoder with averaged parameters."""
    config, data = run.embedding, run.train
    statistics = aamdm_embedding.fit_statistics(data.poses, data.paths, config=config)
    loss = functools.partial(
        aamdm_embedding.loss,
        statistics=statistics,
        parents=run.skeleton.parents,
        config=config,
    )
    both = jnp.concatenate([data.poses, data.paths], axis=-1)
    windows, arrays = frame_windows(
        both, data, 2, batch=budget.batch, balance=run.balance
    )
    size = config.num_features

    def sample(key: Key, arrays: Any) -> tuple[Array, Array]:
        found = windows(key, arrays)
        return found[..., :size], found[..., size:]

    state = runs.minimize(
        aamdm_embedding.init(jax.random.key(budget.seed), config),
        run.record,
        "autoencoder",
        loss,
        sample,
        arrays,
        budget=budget,
        model=dataclasses.asdict(config),
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

    The autoencoder is that of the embedded space; None for full poses.
    """
    name: SpaceName = "full_pose" if autoencoder is None else "embedded"
    if checkpoint.latest_step(run.record.checkpoints(name)) is not None:
        return load_space(run, name)
    space = jax.jit(functools.partial(_space, run))(autoencoder)
    _store_space(run, name, space)
    return space


def _store_space(run: Run, name: SpaceName, space: Space) -> None:
    leaves = {str(i): x for i, x in enumerate(jax.tree.leaves(space))}
    runs.store(run.record, name, leaves, model=dataclasses.asdict(run.embedding))


def load_space(run: Run, name: SpaceName) -> Space:
    """A space of a run folder; `CheckpointError` if the run has not made it."""
    structure = []

    def leaves() -> dict[str, Array]:
        own, config = None, run.embedding
        if name == "embedded":
            own = Autoencoder(
                params=aamdm_embedding.init(jax.random.key(0), config),
                statistics=aamdm_embedding.fit_statistics(
                    run.train.poses, run.train.paths, config=config
                ),
                config=config,
            )
        found, tree = jax.tree.flatten(_space(run, own))
        structure.append(tree)
        return {str(i): x for i, x in enumerate(found)}

    runs.check_stage(run.record, name)
    like = jax.eval_shape(leaves)
    stored = checkpoint.restore(run.record.checkpoints(name), like)
    return jax.tree.unflatten(
        structure[0], [jnp.asarray(stored[str(i)]) for i in range(len(stored))]
    )


def chain_stage(
    space: SpaceName, *, drafts: int, polishes: int, predict: str, levels: str
) -> str:
    """Name that the stages of a chain share: with all chains of its length, or none."""
    name = f"T{drafts + polishes}" if levels == "all" else f"P{polishes}_D{drafts}"
    return f"{space}/{name}" + ("" if predict == "change" else f"_{predict}")


def _stage(space: SpaceName, config: aamdm_model.Config, network: str) -> str:
    names = ("drafts", "polishes", "predict", "levels")
    chain = chain_stage(space, **{name: getattr(config, name) for name in names})
    return f"{chain}/{network}"


def _shared(config: aamdm_model.Config) -> dict[str, Any]:
    """What chains of one length have in common, as JSON."""
    value = dataclasses.asdict(config)
    del value["drafts"], value["polishes"]
    return value


def scale_of_changes(
    space: Space, config: aamdm_model.Config
) -> Float[Array, " channels"] | None:
    """What predicted changes are in; None for networks that predict frames."""
    return space.change if config.predict == "change" else None


def _pose_error(
    run: Run, space: Space, weight_foot: float, found: Array, frames: Array
) -> Array:
    """Error of the poses that windows of frames mean, as the autoencoder has it.

    With a weight of feet that of slow toes, too.
    """
    poses = [aamdm_space.to_poses(space, x) for x in (found, frames)]
    common = dict(parents=run.skeleton.parents, config=run.embedding)
    errors = aamdm_embedding.pose_errors(*poses, **common)
    total = functools.reduce(operator.add, errors)
    if weight_foot:
        feet = run.skeleton.feet
        error = aamdm_embedding.foot_error(*poses, feet=feet, **common)
        total = total + weight_foot * error
    return total


def start_of(path: Path, run: Run, *, width: int) -> tuple[Space, Params]:
    """Embedded space and networks of another run folder or exported file, to train on.

    The run takes that space as its own, and needs no autoencoder. `CheckpointError` if
    the other folder has not trained its row "aamdm"; a `ValueError` names what differs
    of skeletons, autoencoders or widths of networks, that the run has another space, or
    a file without an encoder.
    """
    if path.is_dir():
        first = load_run(path)
        space, skeleton = load_space(first, "embedded"), first.skeleton
        networks, config = load_networks(first, "embedded", space, drafts=3, polishes=2)
    else:
        model, networks = aamdm_stored.load(path)
        space, skeleton, config = model.space, model.skeleton, model.config
    own = space.autoencoder
    if own is None or "encoder" not in own.params:
        raise ValueError(f"{path}: has no encoder: expected a file exported with one")
    found, wanted = (
        {
            "config": dataclasses.asdict(x),
            "skeleton": model_json.skeleton_to_json(joints),
            "width": size,
        }
        for x, joints, size in (
            (own.config, skeleton, config.width),
            (run.embedding, run.skeleton, width),
        )
    )
    model_json.check_start(path, found, wanted, free=())
    if checkpoint.latest_step(run.record.checkpoints("embedded")) is None:
        _store_space(run, "embedded", space)
    pairs = zip(
        *map(jax.tree.leaves, (load_space(run, "embedded"), space)), strict=True
    )
    if not all(np.array_equal(*pair) for pair in pairs):
        raise ValueError(
            f"{run.record.folder}: has another space than {path}; use another folder"
        )
    return space, networks


def _begin(
    config: aamdm_model.Config, budget: Budget, init: Params | None
) -> dict[str, Params]:
    """Parameters that a chain's stage begins with."""
    params = aamdm_model.init(jax.random.key(budget.seed), config)
    networks = {x: runs.initial(params[x], budget) for x in ("polisher", "generator")}
    return params | (init or networks)


def train_polisher(
    run: Run,
    name: SpaceName,
    space: Space,
    config: aamdm_model.Config,
    budget: Budget,
    *,
    init: Params | None = None,
) -> Params:
    """Stage 2: trains the diffusion model, and returns its averaged parameters.

    A new stage starts with the networks of `init`.
    """
    frames = aamdm_space.to_frames(space, run.train.poses, run.train.paths)
    change = scale_of_changes(space, config)
    error = functools.partial(_pose_error, run, space, config.weight_foot)
    state = runs.minimize(
        _begin(config, budget, init)["polisher"],
        run.record,
        _stage(name, config, "polisher"),
        functools.partial(
            aamdm_loss.polisher_loss,
            config=config,
            change=change,
            pose_error=error if config.weight_pose else None,
        ),
        *frame_windows(
            frames,
            run.train,
            config.window + 1,
            batch=budget.batch,
            balance=run.balance,
        ),
        budget=budget,
        model=_shared(config),
        show=("loss", "value", "velocity"),
    )
    return state.ema_params


def train_generator(
    run: Run,
    name: SpaceName,
    space: Space,
    config: aamdm_model.Config,
    budget: Budget,
    *,
    init: Params | None = None,
) -> Params:
    """Stage 3: trains the generator, and returns its averaged parameters.

    Both players have the budget's optimizer; `init` is as in `train_polisher`.
    """
    frames = aamdm_space.to_frames(space, run.train.poses, run.train.paths)
    change = scale_of_changes(space, config)
    discriminate, generate = (
        functools.partial(loss, config=config, change=change)
        for loss in (aamdm_loss.discriminator_loss, aamdm_loss.generator_loss)
    )
    optimizer = runs.make_optimizer(budget)
    params = _begin(config, budget, init)
    players = {
        player: training.init_train_state(params[player], optimizer)
        for player in ("generator", "discriminator")
    }
    state = runs.fit(
        run.record,
        _stage(name, config, "generator"),
        adversarial.GanState(**players),
        adversarial.make_gan_update(
            discriminate, generate, (optimizer, optimizer), ema_decay=budget.ema
        ),
        *frame_windows(
            frames,
            run.train,
            config.gan_window,
            batch=budget.batch,
            balance=run.balance,
        ),
        budget=budget,
        model=_shared(config),
        show=("generator/loss", "discriminator/loss"),
    )
    return state.generator.ema_params


def load_networks(
    run: Run,
    name: SpaceName,
    space: Space,
    *,
    drafts: int,
    polishes: int,
    predict: Literal["frame", "change"] = "change",
    held: bool = False,
) -> tuple[Params, aamdm_model.Config]:
    """Parameters of a trained chain's stages that take steps, and their configuration.

    The generator takes none where the previous frame is `held` in place of drafts.

    Of networks on their own levels and on all, where both are there, the first count.

    `CheckpointError` if a stage is missing or of another kind, `ValueError` if it was
    trained for another space.
    """
    own = {"drafts": drafts, "polishes": polishes}
    network = "polisher" if polishes else "generator"
    chains = [
        chain_stage(name, predict=predict, levels=levels, **own)
        for levels in ("own", "all")
    ]
    there = (
        x
        for x in chains
        if checkpoint.latest_step(run.record.checkpoints(f"{x}/{network}")) is not None
    )
    chain = next(there, chains[-1])
    stage = f"{chain}/{network}"
    config = runs.stage_config(run.record, stage, aamdm_model.Config, **own)
    if config.features != space.num_features:
        raise ValueError(
            f"{run.record.folder / chain}: networks of {config.features} channels, "
            f"expected the {space.num_features} of the space"
        )
    init = functools.partial(aamdm_model.init, jax.random.key(0), config)
    params = {
        network: runs.load_params(
            run.record,
            f"{chain}/{network}",
            lambda network=network: init()[network],
            adversarial=network == "generator",
        )
        for network, steps in (
            ("generator", 0 if held else drafts),
            ("polisher", polishes),
        )
        if steps
    }
    return params, config


def load_chain(
    run: Run, name: SpaceName, space: Space, *, held: bool = False, **chain: Any
) -> Sample:
    """The sampler of a trained chain, named as `load_networks` takes it."""
    params, config = load_networks(run, name, space, held=held, **chain)
    change = scale_of_changes(space, config)
    return aamdm_model.sampler(params, config=config, change=change, held=held)
