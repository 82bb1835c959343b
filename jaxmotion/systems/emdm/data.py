"""Motions with actions for EMDM: choice of labels, splits, and batches on the device.

Actions are drawn uniformly, then a clip of the action, then where it is cut: sets with
rare actions train and score all of them alike. A clip shorter than a sample stays in
its last pose, as in the released code.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.data import captions, clips_io, mirror, resample, selection, text_motion
from jaxmotion.data.clips import Clips
from jaxmotion.data.text_motion import TextMotions
from jaxmotion.learning import model_json, runs
from jaxmotion.motion import features, humanml, humanml_skeleton, skeleton
from jaxmotion.motion.humanml_layout import HUMANML3D
from jaxmotion.systems.emdm import features as emdm_features
from jaxmotion.systems.emdm import loss as emdm_loss
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import training as emdm_training
from jaxmotion.systems.emdm.features import Representation
from jaxmotion.typing import Key

# Labels of Bandai-Namco that name the same action as others, for `merges`.
MERGE = ("bye=wave-right-hand", "byebye=wave-both-hands", "dash=run")


def merges(pairs: tuple[str, ...]) -> dict[str, str]:
    """The new label of each old one, from pairs "old=new" (else `ValueError`)."""
    merge = {}
    for pair in pairs:
        old, equals, new = pair.partition("=")
        if not (old and equals and new):
            raise ValueError(f"merge {pair!r}: expected old=new")
        merge[old] = new
    return merge


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ActionArrays:
    """Clips by action, on the device.

    Members are clips of each action, filled up with -1; a sample has so many frames.
    """

    clips: Clips
    members: Int[Array, "actions most"]
    counts: Int[Array, " actions"]
    frames: int = jax.tree.static()


def prepare_clips(
    paths: tuple[Path, ...],
    *,
    field: str,
    merge: Mapping[str, str],
    least: int,
    fps: float,
) -> tuple[Clips, tuple[str, ...]]:
    """Clips of all files at one rate, and the labels that were too rare.

    Actions are labels of the field; `merge` gives labels that are the same action as
    others, and those others; an action has `least` clips at least. `ValueError` if
    files or labels do not fit, or nothing is left.
    """
    if not paths:
        raise ValueError("no files of clips: at least one is needed")
    clips = selection.concatenate([clips_io.load_clips(path) for path in paths])
    try:
        clips = selection.merge_labels(clips, field, merge)
    except ValueError as error:
        raise ValueError(f"merge: {error}; name labels of these, or none") from None
    kept = selection.frequent_labels(clips, field, least=least)
    left_out = tuple(word for word in clips.names(field) if word not in kept)
    if not kept:
        raise ValueError(f"no {field} has {least} clips")
    clips = selection.relabel(selection.select(clips, field, kept), field)
    return resample.resample_clips(clips, fps), left_out


def action_arrays(clips: Clips, *, field: str, frames: int) -> ActionArrays:
    """Puts clips on the device, listed by action (`field`).

    A sample has `frames` frames; a `ValueError` names an action without a clip.
    """
    names = clips.names(field)
    labels = np.asarray(clips.labels[field])
    counts = np.bincount(labels, minlength=len(names))
    if not counts.all():
        raise ValueError(f"{field} {names[int(counts.argmin())]!r} has no clip")
    members = np.full((len(names), counts.max()), -1)
    for action in range(len(names)):
        own = np.flatnonzero(labels == action)
        members[action, : own.size] = own
    return ActionArrays(
        clips=clips,
        members=jnp.asarray(members, jnp.int32),
        counts=jnp.asarray(counts, jnp.int32),
        frames=frames,
    )


def sample_motions(
    key: Key, arrays: ActionArrays, action: Int[Array, " batch"]
) -> skeleton.Motion:
    """Draws a motion of each action, from the ground's origin and facing +z."""
    key_clip, key_start = jax.random.split(key)
    clips, frames = arrays.clips, arrays.frames
    place = jax.random.randint(key_clip, action.shape, 0, arrays.counts[action])
    clip = arrays.members[action, place]
    first, stop = clips.offsets[clip], clips.offsets[clip + 1]
    latest = jnp.maximum(stop - first - frames, 0)
    start = first + jax.random.randint(key_start, action.shape, 0, latest + 1)
    return motions_at(arrays, start, clip)


def motions_at(
    arrays: ActionArrays, start: Int[Array, " batch"], clip: Int[Array, " batch"]
) -> skeleton.Motion:
    """Motions from rows of clips on, from the ground's origin and facing +z."""
    clips = arrays.clips
    rows = jnp.add.outer(start, jnp.arange(arrays.frames))
    stop = clips.offsets[clip + 1]
    rows = jnp.minimum(rows, jnp.broadcast_to(stop[:, None] - 1, rows.shape))
    motions = skeleton.Motion(
        root_position=clips.root_position[rows],
        joint_rotation=clips.joint_rotation[rows],
        fps=clips.fps,
    )
    return features.to_first_pose(clips.skeleton, motions)


def all_windows(
    arrays: ActionArrays,
) -> tuple[Int[Array, " windows"], Int[Array, " windows"]]:
    """First row and clip of every motion that can be drawn."""
    offsets = np.asarray(arrays.clips.offsets)
    number = np.maximum(np.diff(offsets) - arrays.frames, 0) + 1
    clip = np.repeat(np.arange(len(number)), number)
    place = np.arange(len(clip)) - np.repeat(np.cumsum(number) - number, number)
    return jnp.asarray(offsets[clip] + place), jnp.asarray(clip)


# Motions from which means and deviations of features are taken.
_FIT = 2048


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActionRun:
    """A run folder and its data.

    Clips are at the run's rate, those that no network saw last; actions are labels of
    `field`.
    """

    record: runs.Run
    clips: Clips
    train: ActionArrays
    held_out: ActionArrays
    representation: Representation
    field: str

    @property
    def actions(self) -> tuple[str, ...]:
        """Names of the actions."""
        return self.clips.names(self.field)


_FILES = ("train.npz", "held_out.npz")


def prepare(
    folder: Path,
    data: tuple[Path, ...],
    *,
    task: emdm_training.TaskName,
    field: str,
    merge: Mapping[str, str],
    least: int,
    fps: float,
    frames: int,
    held_out: float,
    mirrored: bool = False,
) -> ActionRun:
    """Makes the clips of a run folder, or loads those it has.

    The task is "action", or "none" for motions from nothing; a sample has `frames`
    frames; a part of each action's clips is held out; other arguments as
    `prepare_clips`. `ValueError` if the folder was made otherwise, or files or labels
    do not fit.
    """

    def make() -> runs.Content:
        clips, left_out = prepare_clips(
            data, field=field, merge=merge, least=least, fps=fps
        )
        print(f"{field}s left out: {', '.join(left_out) or 'none'}")
        parts = selection.split_clips(clips, fraction=held_out, seed=0, field=field)
        if mirrored:
            parts = (mirror.with_mirrored(parts[0]), parts[1])
            new = [x for x in parts[0].names(field) if x not in clips.names(field)]
            if new:
                raise ValueError(
                    f"mirror images would be of {field} {new[0]!r}, of which no clip "
                    "is held out: leave them out, or give clips of it"
                )
        fitted = _fit(parts[0], action_arrays(parts[0], field=field, frames=frames))
        return runs.Content(
            model={
                "actions": list(clips.names(field)),
                "normalizer": model_json.normalizer_to_json(fitted.normalizer),
            },
            source=clips.source,
            split={
                name: list(part.clip_names)
                for name, part in zip(("train", "held_out"), parts, strict=True)
            },
            files={
                name: functools.partial(clips_io.save_clips, clips=part)
                for name, part in zip(_FILES, parts, strict=True)
            },
        )

    settings = dict(
        task=task,
        field=field,
        merge=dict(merge),
        least=least,
        fps=fps,
        frames=frames,
        held_out=held_out,
    ) | ({"mirrored": True} if mirrored else {})
    return _decode(
        runs.begin(
            folder,
            system=emdm_training.SYSTEM,
            data=data,
            settings=settings,
            make=make,
        )
    )


def load_run(folder: Path) -> ActionRun:
    """Loads the data of a run folder; a `ValueError` names what is none of actions."""
    return _decode(runs.load(folder, system=emdm_training.SYSTEM))


def _decode(record: runs.Run) -> ActionRun:
    emdm_training.check_task(record, ("action", "none"))
    field, frames = record.settings["field"], record.settings["frames"]
    parts = [clips_io.load_clips(record.file(name)) for name in _FILES]
    train, held_out = (action_arrays(x, field=field, frames=frames) for x in parts)
    clips, where = parts[0], str(record.config)
    size = 6 * (clips.skeleton.num_joints + 1)
    decode = functools.partial(model_json.normalizer_from_json, size=size)
    if "normalizer" in record.model:
        made = model_json.decode(record.model, where, {"normalizer": decode})
        representation = Representation(
            skeleton=clips.skeleton, fps=clips.fps, normalizer=made["normalizer"]
        )
    else:  # an older folder
        representation = _fit(clips, train)
    return ActionRun(
        record=record,
        clips=selection.concatenate(parts),
        train=train,
        held_out=held_out,
        representation=representation,
        field=field,
    )


def _fit(clips: Clips, arrays: ActionArrays) -> Representation:
    """Units of features; they hang on what JAX draws, so run folders keep them."""
    actions = jnp.arange(_FIT) % arrays.counts.shape[0]
    motions = sample_motions(jax.random.key(0), arrays, actions)
    return emdm_features.fit(clips.skeleton, motions)


def make_task(
    run: ActionRun, base: emdm_model.Config, *, conditional: bool
) -> emdm_training.Task:
    """What models of a run are trained on: motions from actions, or from nothing.

    Features, frames and condition of `base` are set here.
    """
    number = len(run.actions) if conditional else 0
    representation = run.representation
    base = dataclasses.replace(
        base,
        features=representation.num_features,
        frames=run.train.frames,
        condition="action" if conditional else "none",
        condition_size=number,
    )

    def batch(key: Key, data: ActionArrays, size: int) -> emdm_loss.Batch:
        key_action, key_motion = jax.random.split(key)
        actions = jax.random.randint(key_action, (size,), 0, data.counts.shape[0])
        motions = sample_motions(key_motion, data, actions)
        return emdm_loss.Batch(
            x_0=emdm_features.to_features(motions, representation),
            vector=emdm_model.action_vectors(actions, number),
            mask=jnp.ones((size, data.frames), bool),
        )

    return emdm_training.Task(
        run=run.record,
        base=base,
        data=run.train,
        batch=batch,
        geometry=emdm_features.geometry(
            representation, relative=base.geometry == "root"
        ),
    )


# Clips are padded to multiples of so many frames, and made so many at a time: one
# compilation for each length.
_BUCKET, _CHUNK = 64, 64
_PER_CLIP = 4


def clip_features(
    clips: Clips,
) -> tuple[list[Float[np.ndarray, "_ features"]], float]:
    """HumanML3D's features of every clip, and how well they give its joints back.

    Clips are of a skeleton that `humanml_skeleton.joint_mapping` knows (else
    `ValueError`), at the features' rate; features have one frame less. The error is the
    largest of joints to features to joints, meters.
    """
    mapping = humanml_skeleton.joint_mapping(clips.skeleton)
    offsets = np.asarray(clips.offsets)
    lengths = np.diff(offsets)
    root, turns = np.asarray(clips.root_position), np.asarray(clips.joint_rotation)

    @jax.jit
    def make(root: Array, turns: Array) -> tuple[Array, Array]:
        motion = skeleton.Motion(
            root_position=root, joint_rotation=turns, fps=clips.fps
        )
        joints = skeleton.joint_positions(clips.skeleton, motion)
        joints = humanml_skeleton.mapped_joints(mapping, joints)
        features = humanml.features_from_joints(joints, HUMANML3D)
        truth = humanml.canonical_joints(joints, HUMANML3D)[..., :-1, :, :]
        error = humanml.joints_from_features(features, HUMANML3D) - truth
        return features, jnp.max(jnp.abs(error))

    found: list[Any] = [None] * clips.num_clips
    worst = 0.0
    padded = -(-lengths // _BUCKET) * _BUCKET
    for size in np.unique(padded):
        own = np.flatnonzero(padded == size)
        for chunk in np.array_split(own, -(-len(own) // _CHUNK)):
            # Standing still at the end changes neither floor nor smoothed facings.
            rows = offsets[chunk][:, None] + np.minimum(
                np.arange(size)[None], lengths[chunk][:, None] - 1
            )
            rows = np.pad(rows, ((0, _CHUNK - len(chunk)), (0, 0)), mode="edge")
            made, error = make(jnp.asarray(root[rows]), jnp.asarray(turns[rows]))
            worst = max(worst, float(error))
            for clip, row in zip(chunk, np.asarray(made), strict=False):
                found[clip] = row[: lengths[clip] - 1].copy()
    return found, worst


def from_labels(
    clips: Clips,
    *,
    unseen: Sequence[str],
    held_out: float,
    least: int,
    fps: float,
    seed: int,
) -> tuple[TextMotions, float]:
    """Text motions from clips whose contents and styles the grammar of captions knows.

    Clips of unseen pairs are the split "val": nothing is trained on them. A part of the
    others is the split "test".

    The pairs are "content/style", label fields of the clips; `least` is in frames at
    the new rate. The error is as `clip_features`'s. `ValueError` if a label or the
    skeleton is unknown, or no clip has an unseen pair.
    """
    words = [
        np.array(clips.names(field))[np.asarray(clips.labels[field])]
        for field in ("content", "style")
    ]
    pairs = [f"{content}/{style}" for content, style in zip(*words, strict=True)]
    for pair in unseen:
        if pair not in pairs:
            raise ValueError(f"no clip is of the unseen pair {pair!r}")
    clips = resample.resample_clips(clips, fps)
    features, error = clip_features(clips)
    drawn = np.random.default_rng(seed).random(clips.num_clips) < held_out
    kept = [i for i, x in enumerate(features) if len(x) >= least]
    splits = [
        "val" if pairs[i] in unseen else "test" if drawn[i] else "train" for i in kept
    ]
    motions = text_motion.text_motions(
        [features[i] for i in kept],
        [
            captions.captions_for(
                str(words[0][i]), str(words[1][i]), seed=seed, index=i, count=_PER_CLIP
            )
            for i in kept
        ],
        splits,
        [clips.clip_names[i] for i in kept],
        fps=fps,
        source=f"{clips.source}; captions made from labels",
    )
    return motions, error
