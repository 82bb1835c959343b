"""The rows of CAMDM's table.

Source: Chen et al. 2024 (CAMDM), section 4.1.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxmotion.evaluation import diversity, health, locomotion, table
from jaxmotion.learning import recognition
from jaxmotion.motion import skeleton
from jaxmotion.protocols import camdm_distances
from jaxmotion.protocols.camdm import Windows
from jaxmotion.protocols.camdm_styles import Recognized, in_batches, recognized
from jaxmotion.systems import camdm_control

TRUTH, ROLLOUTS = "held-out (ground truth)", "rollouts"
_DEGREES = 180.0 / np.pi
# Column: metric, metric that weights its windows, factor.
_COLUMNS = {
    "trajectory_error_deg": ("trajectory_error", "trajectory_used", _DEGREES),
    "orientation_error_deg": ("orientation_error", None, _DEGREES),
    "foot_slide_m/s": ("slide_speed", "slide_seconds", 1.0),
    "skate_ratio": ("skate_ratio", None, 1.0),
    "acceleration_m/s2": ("acceleration", None, 1.0),
    "jerk_m/s3": ("jerk", None, 1.0),
}


@jax.jit
def _metrics(bones: skeleton.Skeleton, height: Array, x: Windows) -> dict[str, Array]:
    return locomotion.locomotion_metrics(
        bones, x.motion, x.velocity, x.facing, contact_height=height
    )


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
    run = functools.partial(_metrics, bones, jnp.float32(height))
    values = in_batches(run, found)
    row = {}
    if hits is not None:
        means = table.group_means(hits, found.group)
        row["style_accuracy_%"] = table.cell(means, scale=100.0, bounds=(0.0, 1.0))
    for column, (name, weights, scale) in _COLUMNS.items():
        weight = None if weights is None else values[weights]
        means = table.group_means(values[name], found.group, weight)
        bounds = (0.0, 1.0) if name == "skate_ratio" else (-np.inf, np.inf)
        row[column] = table.cell(means, scale=scale, bounds=bounds)
    return row


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


def contact_height(bones: skeleton.Skeleton, real: Windows) -> float:
    """Height below which toes should not move.

    Args:
      bones: The skeleton.
      real: Windows of real clips.

    Returns:
      Where toes rest (their first percentile), and one centimetre more, as the paper's
      "below, e.g., 1 cm"; metres.
    """
    feet = jnp.array(bones.feet)
    toes = in_batches(
        jax.jit(lambda m: skeleton.joint_positions(bones, m)[..., feet, :]), real.motion
    )
    return float(np.percentile(toes[..., 1], 1)) + 0.01


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
      repeats: Neighbouring characters that share style and commands; with one there
        is no column of diversity.
      seed: Of the subsets for Fréchet distances.

    Returns:
      Rows "held-out (ground truth)", "training half vs half (noise floor)" and
      "rollouts"; and the contact height, window counts and health of the rollouts.
    """
    height = contact_height(bones, real)
    real_feature, real_hits = recognized(bones, real, recognizer)
    made_feature, made_hits = recognized(bones, made, recognizer)
    reference, _ = recognized(bones, dense, recognizer)
    own = camdm_distances.random_half(
        np.asarray(dense.group), np.asarray(dense.label), seed
    )
    count = min(len(real_feature), len(made_feature), int(own.sum()), int((~own).sum()))
    distances = functools.partial(camdm_distances.frechet_cells, count=count, seed=seed)
    rows = {
        TRUTH: metric_row(bones, real, real_hits, height=height)
        | distances(real_feature, reference),
        "training half vs half (noise floor)": distances(
            reference[own], reference[~own]
        ),
        ROLLOUTS: metric_row(bones, made, made_hits, height=height)
        | distances(made_feature, reference),
    }
    if repeats > 1:
        found = repeat_diversity(bones, made, repeats=repeats)
        rows[ROLLOUTS]["diversity_m2"] = found
    root = float(np.median(np.asarray(real.motion.root_position)[..., 1]))
    return rows, {
        "contact_height_m": height,
        "windows": {"held_out": len(real_hits), "rollouts": len(made_hits)},
        "fid_windows": count,
        "fid_reference_windows": len(reference),
        "health": rollout_health(bones, frames, fps=made.motion.fps, height=root),
    }
