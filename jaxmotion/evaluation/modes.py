"""Scores of rollouts among known modes: coverage, precision, transitions.

Source: ours, for Li et al. 2024 (AAMDM), section 4.2, which shows plots only.
"""

import numpy as np
from jaxtyping import Float


def mode_scores(
    points: Float[np.ndarray, "sequences steps axes"],
    centers: Float[np.ndarray, "modes axes"],
    *,
    sigma: float,
    share: float = 0.01,
) -> dict[str, float]:
    """Scores of sequences whose every step should be uniform over the modes.

    Args:
      sigma: Standard deviation of a mode in each axis.
      share: A mode counts as covered at a step if at least this share of that step's
        points is within 3 sigma of its center.

    Returns:
      least_modes_covered: fewest modes covered at any step.
      least_within_3_sigma: least share of points at any step within 3 sigma of some
        center.
      within_3_sigma: the same over all steps.
      spread: root mean square of a coordinate's distance to the nearest center, of
        points within 3 sigma, over sigma (1 for the data, but for the cut; 0 if none).
      kl_to_uniform: divergence in nats of the nearest modes' histogram from uniform.
      transition_distance: total variation between the frequencies of pairs of
        neighboring modes and uniform ones.
    """
    distance = np.linalg.norm(points[..., None, :] - centers, axis=-1)
    nearest, least = distance.argmin(axis=-1), distance.min(axis=-1)
    inside = least <= 3 * sigma
    number = len(centers)
    counts = np.stack(
        [np.mean(inside & (nearest == mode), axis=0) for mode in range(number)]
    )
    histogram = np.bincount(nearest.ravel(), minlength=number) / nearest.size
    known = histogram[histogram > 0]
    pairs = np.zeros((number, number))
    np.add.at(pairs, (nearest[:, :-1].ravel(), nearest[:, 1:].ravel()), 1.0)
    pairs /= pairs.sum()
    offset = points[inside] - np.asarray(centers)[nearest[inside]]
    return {
        "least_modes_covered": float((counts >= share).sum(axis=0).min()),
        "least_within_3_sigma": float(inside.mean(axis=0).min()),
        "within_3_sigma": float(inside.mean()),
        "spread": float(np.sqrt(np.mean(offset**2)) / sigma) if inside.any() else 0.0,
        "kl_to_uniform": float(np.sum(known * np.log(known * number))),
        "transition_distance": float(0.5 * np.abs(pairs - 1 / number**2).sum()),
    }
