"""Fréchet distances of windows: of equally many, and extrapolated to infinitely many.

Distances of few windows are too large, and not by the same amount for all models; so
rows are compared at one number of windows, or without that bias.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.evaluation import frechet, frechet_bias, table


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
      Mean, and interval over the subsets (not over clips); no interval where a subset
      is all there is.
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
    return table.cell(jnp.stack(found))


def unbiased_cells(
    feature: np.ndarray, reference: np.ndarray, *, seed: int, sizes: int = 5
) -> dict[str, table.Cell]:
    """Fréchet distance to the reference, extrapolated to infinitely many windows.

    Args:
      feature: Features of all windows of a row.
      reference: Features of the reference windows.
      seed: Of the subsets.
      sizes: Of the subsets, from as many windows as there are features to all.

    Returns:
      "fid_unbiased", without an interval; nothing if there are too few windows for
      the extrapolation to hold.

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
) -> dict[str, table.Cell]:
    """Both distances to the reference.

    Args:
      feature: Features of the windows of a row.
      reference: Features of the reference windows.
      count: Windows of the subsets of `frechet_cell`.
      seed: Of all subsets.
      repeats: Subsets of `frechet_cell`.

    Returns:
      "fid", and "fid_unbiased" if there are enough windows.
    """
    fid = frechet_cell(feature, reference, count=count, seed=seed, repeats=repeats)
    return {"fid": fid} | unbiased_cells(feature, reference, seed=seed)


def random_half(clips: np.ndarray, labels: np.ndarray, seed: int) -> np.ndarray:
    """Which windows are of a random half of each style's clips.

    Args:
      clips: Clip of each window.
      labels: Style of each window.
      seed: Of the choice.

    Returns:
      True for the windows of that half.

    Raises:
      ValueError: if there is one clip only.
    """
    different, first = np.unique(clips, return_index=True)
    if len(different) < 2:
        raise ValueError("one clip, expected at least two to compare halves")
    shuffled = np.random.default_rng(seed).permutation(len(different))
    # Sorted by style, every second one: both halves hold every style alike.
    order = shuffled[np.argsort(labels[first][shuffled], kind="stable")]
    return np.isin(clips, different[order][::2])
