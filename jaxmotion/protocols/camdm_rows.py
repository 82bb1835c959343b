"""Style recognition and the rows of CAMDM's table.

Source: Chen et al. 2024 (CAMDM), section 4.1; released feature extractor.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxmotion.data.clips import Clips
from jaxmotion.evaluation import diversity, frechet, health, locomotion, table
from jaxmotion.learning import recognition
from jaxmotion.motion import skeleton
from jaxmotion.protocols.camdm import WINDOW, Windows, data_windows
from jaxmotion.systems import camdm_control
from jaxmotion.typing import Key, Params


def in_batches(function, x, size: int = 256):
    """Applies a jitted function to slices of the first axis, to bound the memory.

    Args:
      function: Array or pytree with a first axis to the like.
      x: Its argument.
      size: Rows at a time.

    Returns:
      The results, put together.
    """
    number = jax.tree.leaves(x)[0].shape[0]
    parts = [
        jax.device_get(function(jax.tree.map(lambda a: a[i : i + size], x)))  # noqa: B023
        for i in range(0, number, size)
    ]
    return jax.tree.map(lambda *p: np.concatenate(p), *parts)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recognized:
    """A style recogniser and its size.

    Attributes:
      params: Its parameters.
      config: Its size.
    """

    params: Params
    config: recognition.RecognizerConfig


def fit_recognizer(
    key: Key, clips: Clips, *, field: str, num_steps: int = 1500
) -> Recognized:
    """Trains the style recogniser on windows with a stride of 10 frames.

    Args:
      key: Consumed.
      clips: Training clips.
      field: Label field that is the style.
      num_steps: Updates.

    Returns:
      The recogniser.
    """
    found = data_windows(clips, stride=10, field=field)
    config = recognition.RecognizerConfig(
        num_classes=len(clips.names(field)),
        num_joints=clips.skeleton.num_joints,
        frames=WINDOW,
    )
    to_input = jax.jit(functools.partial(recognition.recognizer_input, clips.skeleton))
    x = jnp.asarray(in_batches(to_input, found.motion))
    params, _ = recognition.train_recognizer(
        key, x, found.label, config=config, num_steps=num_steps
    )
    return Recognized(params=params, config=config)


def recognized(
    bones: skeleton.Skeleton, found: Windows, recognizer: Recognized
) -> tuple[np.ndarray, np.ndarray]:
    """Features of windows, and whether each one's style is recognised.

    Args:
      bones: The skeleton.
      found: Windows.
      recognizer: From `fit_recognizer`.

    Returns:
      Features [windows, 512], and hits [windows] (0 or 1).
    """

    @jax.jit
    def run(x: tuple[skeleton.Motion, Array]) -> tuple[Array, Array]:
        motion, label = x
        given = recognition.recognizer_input(bones, motion)
        feature, logits = recognition.recognize(
            recognizer.params, given, config=recognizer.config
        )
        return feature, (jnp.argmax(logits, axis=-1) == label).astype(jnp.float32)

    return in_batches(run, (found.motion, found.label))


def metric_row(
    bones: skeleton.Skeleton,
    found: Windows,
    hits: np.ndarray | None,
    *,
    height: float,
) -> dict[str, table.Cell]:
    """All columns but the Fréchet distances, with intervals over clips or rollouts.

    Args:
      bones: The skeleton.
      found: Windows.
      hits: From `recognized`; None to leave style accuracy out.
      height: Below it a foot joint should not move, metres.

    Returns:
      Columns; angles in degrees.
    """

    @jax.jit
    def run(x: Windows) -> dict[str, Array]:
        return locomotion.locomotion_metrics(
            bones, x.motion, x.velocity, x.facing, contact_height=height
        )

    values = in_batches(run, found)
    degrees = 180.0 / np.pi

    def column(name: str, *, weights: str | None = None, scale: float = 1.0):
        weight = None if weights is None else values[weights]
        return table.cell(
            table.group_means(values[name], found.group, weight), scale=scale
        )

    style = {}
    if hits is not None:
        means = table.group_means(hits, found.group)
        style = {"style_accuracy_%": table.cell(means, scale=100.0)}
    return style | {
        "trajectory_error_deg": column(
            "trajectory_error", weights="trajectory_used", scale=degrees
        ),
        "orientation_error_deg": column("orientation_error", scale=degrees),
        "foot_slide_m/s": column("slide_speed", weights="slide_seconds"),
        "skate_ratio": column("skate_ratio"),
        "acceleration_m/s2": column("acceleration"),
        "jerk_m/s3": column("jerk"),
        "slide_camdm_release": column("slide_camdm_release"),
        "coherence_camdm_release": column("coherence_camdm_release"),
        "trajectory_camdm_release_deg": column(
            "trajectory_camdm_release", scale=degrees
        ),
        "orientation_camdm_release_deg": column(
            "orientation_camdm_release", scale=degrees
        ),
    }


def frechet_cell(
    feature: np.ndarray,
    reference: np.ndarray,
    *,
    count: int,
    seed: int,
    repeats: int = 5,
) -> table.Cell:
    """Fréchet distance to the reference, of random subsets of equal size.

    Args:
      feature: Features of the windows of a row.
      reference: Features of the reference windows.
      count: Windows of each subset, the same for all rows.
      seed: Of the subsets.
      repeats: Subsets.

    Returns:
      Mean, and interval over the subsets (not over clips).
    """
    generator = np.random.default_rng(seed)
    target = frechet.moments(jnp.asarray(reference))
    found = []
    for _ in range(repeats):
        chosen = generator.choice(len(feature), count, replace=False)
        own = frechet.moments(jnp.asarray(feature[chosen]))
        found.append(frechet.frechet_distance(own, target))
    return table.cell(jnp.stack(found))


def rollout_health(
    bones: skeleton.Skeleton, frames: camdm_control.Frame, *, fps: float, height: float
) -> dict[str, int]:
    """How many rollouts diverged or froze; bounds as in `evaluation.health`.

    Args:
      bones: The skeleton.
      frames: Displayed frames [characters, ticks, ...].
      fps: Frames a second.
      height: Root height of the standing character, metres; half of it and 1.5
        times of it are the bounds.

    Returns:
      Counts by name, and the number of rollouts.
    """

    @jax.jit
    def run(x: camdm_control.Frame) -> tuple[Array, Array]:
        motion = skeleton.Motion(
            root_position=x.root_position, joint_rotation=x.joint_rotation, fps=fps
        )
        positions = skeleton.joint_positions(bones, motion)
        diverged = health.has_diverged(
            positions, fps=fps, min_root=0.5 * height, max_root=1.5 * height
        )
        return diverged, health.is_frozen(positions, x.desired_velocity, fps=fps)

    diverged, frozen = in_batches(run, frames, size=10)
    return {
        "diverged": int(diverged.sum()),
        "frozen": int(frozen.sum()),
        "rollouts": int(frozen.size),
    }


def repeat_diversity(
    bones: skeleton.Skeleton, found: Windows, *, repeats: int
) -> table.Cell:
    """Intra-style variance over characters of one style under one control.

    Windows of the same time are compared in the frame of the root.

    Args:
      bones: The skeleton.
      found: Windows of rollouts in which every `repeats` neighbouring characters
        share style and commands.
      repeats: Characters a style.

    Returns:
      Square metres, with an interval over styles.
    """
    local = in_batches(
        jax.jit(functools.partial(recognition.recognizer_input, bones)), found.motion
    )
    characters = int(found.group.max()) + 1
    shape = (characters // repeats, repeats, -1, bones.num_joints, 3)
    local = jnp.asarray(local).reshape(shape)
    return table.cell(jax.vmap(diversity.intra_style_variance)(local))


def evaluation_table(
    bones: skeleton.Skeleton,
    real: Windows,
    dense: Windows,
    made: Windows,
    frames: camdm_control.Frame,
    recognizer: Recognized,
    *,
    repeats: int,
    seed: int = 0,
) -> tuple[dict[str, dict[str, table.Cell]], dict[str, Any]]:
    """The table, and what belongs beside it.

    Args:
      bones: The skeleton.
      real: Windows of held-out clips, one behind the other.
      dense: Windows of training clips with a short stride: the reference.
      made: Windows of the rollouts.
      frames: The rollouts themselves.
      recognizer: From `fit_recognizer`.
      repeats: Neighbouring characters that share style and commands.
      seed: Of the subsets for Fréchet distances.

    Returns:
      Rows "held-out (ground truth)", "training half vs half (noise floor)" and
      "rollouts"; and the contact height, window counts and health of the rollouts.
    """
    toes = in_batches(
        jax.jit(
            lambda m: skeleton.joint_positions(bones, m)[..., jnp.array(bones.feet), :]
        ),
        real.motion,
    )
    root = np.asarray(real.motion.root_position)[..., 1]
    # Where toes rest, and one centimetre more, as the paper's "below, e.g., 1 cm".
    height = float(np.percentile(toes[..., 1], 1)) + 0.01
    real_feature, real_hits = recognized(bones, real, recognizer)
    made_feature, made_hits = recognized(bones, made, recognizer)
    reference, _ = recognized(bones, dense, recognizer)
    clips = np.asarray(dense.group)
    own = np.isin(clips, np.random.default_rng(seed).permutation(np.unique(clips))[::2])
    count = min(len(real_feature), len(made_feature), int(own.sum()), int((~own).sum()))
    distance = functools.partial(frechet_cell, count=count, seed=seed)
    rows = {
        "held-out (ground truth)": metric_row(bones, real, real_hits, height=height)
        | {"fid": distance(real_feature, reference)},
        "training half vs half (noise floor)": {
            "fid": distance(reference[own], reference[~own])
        },
        "rollouts": metric_row(bones, made, made_hits, height=height)
        | {
            "fid": distance(made_feature, reference),
            "diversity_m2": repeat_diversity(bones, made, repeats=repeats),
        },
    }
    return rows, {
        "contact_height_m": height,
        "windows": {"held_out": len(real_hits), "rollouts": len(made_hits)},
        "fid_windows": count,
        "fid_reference_windows": len(reference),
        "health": rollout_health(
            bones, frames, fps=made.motion.fps, height=float(np.median(root))
        ),
    }
