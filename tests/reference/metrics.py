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
    """Meters and seconds that feet [F, feet, 3] slide while low."""
    meters, frames = 0.0, 0
    for f in range(len(feet) - 1):
        for k in range(feet.shape[1]):
            if feet[f, k, 1] < max_height:
                dx, _, dz = feet[f + 1, k] - feet[f, k]
                meters += np.hypot(dx, dz)
                frames += 1
    return meters / (frames / fps), frames / fps


def camdm_release(names, joints, move=None, look=None):
    """What CAMDM's scripts compute of one recording: floats by name, angles in degrees.

    Written from a description of the scripts. `joints` is [F, J, 3], meters, y up,
    right-handed; move and look (x, z) are what was told in each frame, in these axes.
    The scripts read BVHs in centimeters, and a preset in Unity's axes, whose x points
    the other way.
    """
    names, joints = list(names), 100.0 * np.asarray(joints, np.float64)
    toes = []
    for name in ("LeftToeBase", "RightToeBase", "LeftToe", "RightToe"):
        if name in names:
            toes.append(names.index(name))
    floor = min(joints[f, toe, 1] for f in range(len(joints)) for toe in toes)
    pace = [np.hypot(*d) for d in np.diff(joints[:, 0, [0, 2]], axis=0)]
    pace = np.mean(pace) or 1.0  # of a root that stands still
    slid = []
    for f in range(len(joints)):
        for toe in toes:
            if joints[f, toe, 1] - floor < 1.0:
                after = joints[min(f + 1, len(joints) - 1), toe]
                slid.append(np.hypot(*(after - joints[f, toe])[[0, 2]]))
    moved = [
        np.linalg.norm(joints[f + 1, j] - joints[f, j])
        for f in range(len(joints) - 1)
        for j in range(len(names))
    ]
    found = {"slide": np.mean(slid) / pace, "coherence": np.mean(moved) / pace}
    if move is not None:
        preset = [(0.0 - x, z) for x, z in np.float64(move)]
        walked = [(0.0 - x, z) for x, z in np.diff(joints[:, 0, [0, 2]], axis=0)]
        errors = [
            np.degrees(np.arctan2(z, x) - np.arctan2(w, u))
            for (x, z), (u, w) in zip(preset[:-1], walked, strict=True)
        ]
        found["trajectory"] = abs(np.mean(errors))
    if look is not None:
        preset = [(0.0 - x, z) for x, z in np.float64(look)]
        errors = []
        for f, (x, z) in enumerate(preset):
            across = np.zeros(3)
            for left, right in body_pairs(names):
                gap = joints[f, left] - joints[f, right]
                across += gap / np.linalg.norm(gap)
            ahead = np.cross(across, [0.0, 1.0, 0.0])
            faced = np.arctan2(ahead[2], ahead[0])
            errors.append(np.degrees(np.arctan2(z, -x) - faced))
        found["orientation"] = abs(np.mean(errors))
    return found


def body_pairs(names):
    """Joints (left, right) of shoulders and hips, as the scripts look for them."""
    shoulder, hip = (
        ("Collar", "Hip") if "LeftCollar" in names else ("Shoulder", "UpLeg")
    )
    return [
        (names.index(f"Left{part}"), names.index(f"Right{part}"))
        for part in (shoulder, hip)
    ]


def frechet_of_rows(a, b):
    """Fréchet distance without any covariance, for fewer rows than features."""
    x, y = ((m - m.mean(0)) / np.sqrt(len(m) - 1) for m in map(np.float64, (a, b)))
    cross = np.linalg.svd(x @ y.T, compute_uv=False).sum()
    gap = np.float64(a).mean(0) - np.float64(b).mean(0)
    return gap @ gap + np.sum(x * x) + np.sum(y * y) - 2 * cross
