"""Float64 oracles of CAMDM's features, losses and sampler, with loops.

Written from the paper (Chen et al. 2024, eq. 2-5) and the released code's shapes: six
numbers a joint (the first two rows of its matrix, or columns), then (x, y, z, 0, 0, 0).
"""

import numpy as np

from tests.reference import diffusion, motion


def pose_from_features(features, layout):
    """Root position and matrices of one frame."""
    joints = np.asarray(features, np.float64).reshape(-1, 6)
    matrices = [motion.gram_schmidt(six) for six in joints[:-1]]
    if layout == "rows":
        matrices = [matrix.T for matrix in matrices]
    return joints[-1, :3], np.stack(matrices)


def joint_positions(offsets, parents, frames, layout):
    """World positions [frames, joints, 3] of feature frames."""
    places = []
    for frame in frames:
        root, matrices = pose_from_features(frame, layout)
        worlds = motion.world_transforms(offsets, parents, root, matrices)
        places.append(worlds[:, :3, 3])
    return np.stack(places)


def loss_terms(offsets, parents, feet, prediction, target, *, layout, fps, speed):
    """The six terms of batches [batch, frames, features], as plain means."""
    sums = {}

    def add(name, value):
        sums.setdefault(name, []).append(value)

    for p, x in zip(prediction, target, strict=True):
        found = joint_positions(offsets, parents, p, layout)
        wanted = joint_positions(offsets, parents, x, layout)
        p, x = p[:, :-6], x[:, :-6]
        add("velocity", np.mean((np.diff(p, axis=0) - np.diff(x, axis=0)) ** 2))
        add("position", np.mean((found - wanted) ** 2))
        moved = np.diff(found, axis=0) - np.diff(wanted, axis=0)
        add("position_velocity", np.mean(moved**2))
        twice = np.diff(found, n=2, axis=0) - np.diff(wanted, n=2, axis=0)
        add("acceleration", np.mean(twice**2))
        for frame in range(len(p) - 1):
            for foot in feet:
                step = wanted[frame + 1, foot] - wanted[frame, foot]
                stands = np.linalg.norm(step) * fps <= speed
                slide = found[frame + 1, foot] - found[frame, foot]
                add("foot", np.mean(slide**2) if stands else 0.0)
    terms = {name: np.mean(values) for name, values in sums.items()}
    return terms | {"data": np.mean((prediction - target) ** 2)}


def sample(predict, x, noise, num_steps, scale=None):
    """Ancestral sampling; predict(x, t, keep_past), t = num_steps..1."""
    table = diffusion.coefficients(diffusion.cosine_betas(num_steps))
    for t in range(num_steps, 0, -1):
        clean = predict(x, t, True)
        if scale is not None:
            null = predict(x, t, False)
            clean = null + scale * (clean - null)
        x = table["c1"][t - 1] * clean + table["c2"][t - 1] * x
        x = x + np.sqrt(table["v"][t - 1]) * noise[t]
    return x
