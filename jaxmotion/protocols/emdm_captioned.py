"""Text motions made of labelled clips: HumanML3D's features, captions by a grammar."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmotion.data import captions, resample, text_motion
from jaxmotion.data.clips import Clips
from jaxmotion.data.text_motion import TextMotions
from jaxmotion.motion import humanml, humanml_skeleton, skeleton
from jaxmotion.motion.humanml import HUMANML3D

# Clips are padded to multiples of so many frames, and made so many at a time: one
# compilation for each length.
_BUCKET, _CHUNK = 64, 64
_PER_CLIP = 4


def clip_features(
    clips: Clips,
) -> tuple[list[Float[np.ndarray, "_ features"]], float]:
    """HumanML3D's features of every clip, and how well they give its joints back.

    Args:
      clips: Of a skeleton that `humanml_skeleton.joint_mapping` knows, at the rate of
        the features.

    Returns:
      One array a clip, of one frame less than the clip; and the largest error of joints
      to features to joints, metres.

    Raises:
      ValueError: if the skeleton is unknown.
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
            for clip, features in zip(chunk, np.asarray(made), strict=False):
                found[clip] = features[: lengths[clip] - 1].copy()
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

    Args:
      clips: With label fields "content" and "style".
      unseen: Pairs "content/style".
      held_out: Part of the other clips in "test".
      least: Shortest clip, frames at the new rate.
      fps: Frames a second of the features.
      seed: Of captions and of the split.

    Returns:
      The text motions, and the largest error of joints to features to joints, metres.

    Raises:
      ValueError: if a label or the skeleton is unknown, or no clip has an unseen pair.
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
