"""NumPy and SciPy oracles of the metrics: loops in float64, from the definitions."""

import numpy as np
import scipy.linalg


def frechet(a, b):
    """Fréchet distance by the matrix square root of the product of covariances."""
    cov_a, cov_b = np.cov(a, rowvar=False), np.cov(b, rowvar=False)
    root = scipy.linalg.sqrtm(cov_a @ cov_b)
    gap = a.mean(0) - b.mean(0)
    return gap @ gap + np.trace(cov_a) + np.trace(cov_b) - 2 * np.trace(root).real


def mean_pair_distance(x):
    """Mean distance of all pairs of two different rows."""
    n = len(x)
    total = [np.linalg.norm(x[i] - x[j]) for i in range(n) for j in range(n) if i != j]
    return np.mean(total)


def slide(feet, fps, max_height):
    """Metres and seconds that feet [F, feet, 3] slide while low."""
    metres, frames = 0.0, 0
    for f in range(len(feet) - 1):
        for k in range(feet.shape[1]):
            if feet[f, k, 1] < max_height:
                dx, _, dz = feet[f + 1, k] - feet[f, k]
                metres += np.hypot(dx, dz)
                frames += 1
    return metres / (frames / fps), frames / fps


def foot_slide_release(feet, root, max_height):
    """Mean step of low samples over mean step of the root, as published."""
    samples = []
    for f in range(len(feet)):
        for k in range(feet.shape[1]):
            if feet[f, k, 1] < max_height:
                last = f == len(feet) - 1
                step = 0 * feet[f, k] if last else feet[f + 1, k] - feet[f, k]
                samples.append(np.hypot(step[0], step[2]))
    root_steps = np.hypot(np.diff(root[:, 0]), np.diff(root[:, 2]))
    return np.mean(samples) / np.mean(root_steps)
