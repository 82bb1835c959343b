"""Rows of windows: what CAMDM's motions are measured with, and how."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxmotion.control.frame import Frame
from jaxmotion.data import windows
from jaxmotion.evaluation import (
    diversity,
    frechet,
    frechet_bias,
    health,
    locomotion,
    table,
)
from jaxmotion.evaluation.table import Row
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.evaluators.style import (
    StyleEvaluator,
    contact_height,
    features_and_hits,
    in_batches,
)
from jaxmotion.motion.skeleton import Skeleton, joint_positions
from jaxmotion.systems.camdm import release as camdm_release


def frechet_cell(
    feature: np.ndarray,
    reference: np.ndarray,
    *,
    count: int,
    seed: int,
    repeats: int = 5,
) -> table.Cell:
    """Fréchet distance to the reference, of random subsets of equal size.

    The interval is over the `repeats` subsets of `count` windows (the same for all
    rows), and allows for what they share, not for what windows of one clip do. There is
    none where a subset is all there is.
    """
    if count == len(feature):
        repeats = 1
    generator = np.random.default_rng(seed)
    target = frechet.moments(jnp.asarray(reference))
    found = []
    for _ in range(repeats):
        chosen = generator.choice(len(feature), count, replace=False)
        own = frechet.moments(jnp.asarray(feature[chosen]))
        found.append(frechet.frechet_distance(own, target))
    return table.cell(jnp.stack(found), part=count / len(feature))


def unbiased_cells(
    feature: np.ndarray, reference: np.ndarray, *, seed: int, sizes: int = 5
) -> Row:
    """The distance extrapolated to infinitely many windows, "fid_unbiased".

    It has no interval; nothing if there are too few windows for the extrapolation to
    hold. There are `sizes` subsets, from as many windows as there are features to all.

    Source: `frechet_bias`.
    """
    count, least = feature.shape
    if count < least + sizes - 1:
        return {}
    found = frechet_bias.frechet_bias(
        jax.random.key(seed),
        jnp.asarray(feature),
        frechet.moments(jnp.asarray(reference)),
        sizes=frechet_bias.subset_sizes(count, number=sizes, least=least),
        repeats=3,
    )
    return {"fid_unbiased": table.Cell(value=float(found.extrapolated), samples=count)}


def frechet_cells(
    feature: np.ndarray,
    reference: np.ndarray,
    *,
    count: int,
    seed: int,
    repeats: int = 5,
) -> Row:
    """The cell "fid", and "fid_unbiased" if there are enough windows."""
    fid = frechet_cell(feature, reference, count=count, seed=seed, repeats=repeats)
    return {"fid": fid} | unbiased_cells(feature, reference, seed=seed)


def random_half(clips: np.ndarray, labels: np.ndarray, seed: int) -> np.ndarray:
    """True for the windows of a random half of each style's clips (not only one)."""
    different, first = np.unique(clips, return_index=True)
    if len(different) < 2:
        raise ValueError("one clip, expected at least two to compare halves")
    shuffled = np.random.default_rng(seed).permutation(len(different))
    # Sorted by style, every second one: both halves hold every style alike.
    order = shuffled[np.argsort(labels[first][shuffled], kind="stable")]
    return np.isin(clips, different[order][::2])


_DEGREES = 180.0 / np.pi


# Column: metric, metric that weights its windows, factor.
_COLUMNS = {
    "trajectory_error": ("trajectory_error", "trajectory_used", _DEGREES),
    "orientation_error": ("orientation_error", None, _DEGREES),
    "foot_slide": ("slide_speed", "slide_seconds", 1.0),
    "skate_ratio": ("skate_ratio", None, 1.0),
    "acceleration": ("acceleration", None, 1.0),
    "jerk": ("jerk", None, 1.0),
}


@jax.jit
def _metrics(
    skeleton: Skeleton, height: Array, x: windows.EvalWindows
) -> dict[str, Array]:
    return locomotion.locomotion_metrics(
        skeleton, x.motion, x.velocity, x.facing, contact_height=height
    )


def metric_row(
    skeleton: Skeleton,
    found: windows.EvalWindows,
    hits: np.ndarray | None,
    *,
    height: float,
) -> Row:
    """All columns but the Fréchet distances, with intervals over clips or rollouts.

    Angles are in degrees. `hits` come from `style.features_and_hits`; None leaves style
    accuracy out. Below `height`, meters, a foot joint should not move.
    """
    run = functools.partial(_metrics, skeleton, jnp.float32(height))
    values = in_batches(run, found)
    row = {}
    if hits is not None:
        means = table.group_means(hits, found.group)
        row["style_accuracy"] = table.cell(means, scale=100.0, bounds=(0.0, 1.0))
    for column, (name, weights, scale) in _COLUMNS.items():
        weight = None if weights is None else values[weights]
        means = table.group_means(values[name], found.group, weight)
        bounds = (0.0, 1.0) if name == "skate_ratio" else (-np.inf, np.inf)
        row[column] = table.cell(means, scale=scale, bounds=bounds)
    return row


def rollout_health(
    skeleton: Skeleton,
    frames: Frame,
    *,
    fps: float,
    height: float,
) -> dict[str, int]:
    """Numbers of rollouts, diverged and frozen; bounds as in `evaluation.health`.

    Frames are [characters, ticks, ...]; `height` is that of the standing character's
    root, meters: half of it and 1.5 times of it are the bounds.
    """

    @jax.jit
    def run(x: Frame) -> tuple[Array, Array]:
        positions = joint_positions(skeleton, x.motion)
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
    skeleton: Skeleton, found: windows.EvalWindows, *, repeats: int
) -> table.Cell:
    """Variance (square meters) over characters of one style under one control.

    Windows of the same time are compared in the frame of the root. Every `repeats`
    neighboring characters share style and commands; the interval is over styles.
    """
    local = in_batches(
        jax.jit(functools.partial(style_evaluator.window_input, skeleton)),
        found.motion,
    )
    characters = int(found.group.max()) + 1
    shape = (characters // repeats, repeats, -1, skeleton.num_joints, 3)
    local = jnp.asarray(local).reshape(shape)
    return table.cell(jax.vmap(diversity.intra_style_variance)(local))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reference:
    """What rollouts are measured with, and what recorded motion looks like to it.

    Attributes:
      real: Windows of held-out clips, one after the other.
      hits: Whether the evaluator recognizes their styles.
      features: Features of windows of training clips, with a short stride.
      own: Which of these are of a random half of the clips.
      height: Below it a foot joint should not move, meters.
      root: Median height of the root, meters.
      styles: Features of training clips by style; None where no column needs them.
    """

    skeleton: Skeleton
    evaluator: StyleEvaluator
    real: windows.EvalWindows
    real_features: np.ndarray
    hits: np.ndarray
    features: np.ndarray
    own: np.ndarray
    height: float
    root: float
    styles: camdm_release.Groups | None = None

    def count(self, made: int) -> int:
        """Windows of each Fréchet distance, the same for all rows."""
        own = int(self.own.sum())
        return min(len(self.real_features), made, own, len(self.own) - own)


def make_reference(
    skeleton: Skeleton,
    real: windows.EvalWindows,
    dense: windows.EvalWindows,
    evaluator: StyleEvaluator,
    *,
    seed: int,
) -> Reference:
    """The reference of held-out windows and of dense windows of training clips."""
    real_features, hits = features_and_hits(skeleton, real, evaluator)
    features, _ = features_and_hits(skeleton, dense, evaluator)
    return Reference(
        skeleton=skeleton,
        evaluator=evaluator,
        real=real,
        real_features=real_features,
        hits=hits,
        features=features,
        own=random_half(np.asarray(dense.group), np.asarray(dense.label), seed),
        height=contact_height(skeleton, real),
        root=float(np.median(np.asarray(real.motion.root_position)[..., 1])),
    )


def real_rows(
    reference: Reference, *, count: int, seed: int, repeats: int = 5
) -> tuple[Row, Row]:
    """Rows of held-out clips, and of half of the training clips beside the others."""
    distances = functools.partial(
        frechet_cells, count=count, seed=seed, repeats=repeats
    )
    features, own = reference.features, reference.own
    truth = distances(reference.real_features, features) | metric_row(
        reference.skeleton, reference.real, reference.hits, height=reference.height
    )
    return truth, distances(features[own], features[~own])


def made_row(
    reference: Reference,
    made: windows.EvalWindows,
    *,
    repeats: int,
    count: int,
    seed: int,
    replicated: bool = False,
) -> Row:
    """Row of rollouts in which `repeats` neighbors share style and commands.

    Fréchet distances are of `count` windows each; with one neighbor there is no column
    of diversity. Where `replicated`, intervals run over replications, of which every
    neighbor belongs to another, instead of over rollouts and random subsets.
    """
    features, hits = features_and_hits(reference.skeleton, made, reference.evaluator)
    grouped = made
    row = frechet_cells(features, reference.features, count=count, seed=seed)
    if replicated:
        # One for each replication, not for each character: those are independent.
        owner = np.asarray(made.group) % repeats
        grouped = dataclasses.replace(made, group=jnp.asarray(owner))
        values = [
            frechet_cell(
                features[owner == i],
                reference.features,
                count=count,
                seed=seed,
                repeats=1,
            ).value
            for i in range(repeats)
        ]
        row["fid"] = table.cell(jnp.asarray(values, jnp.float32))
    row |= metric_row(reference.skeleton, grouped, hits, height=reference.height)
    if repeats > 1:
        row["pose_variance"] = repeat_diversity(
            reference.skeleton, made, repeats=repeats
        )
    return row
