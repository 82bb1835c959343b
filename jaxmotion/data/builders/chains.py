"""Kinematics of whole recordings in NumPy: world rotations, positions, and a fit.

Recordings differ in length, and every length would compile anew in JAX.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

# Weight of the given rotation against the bones; moves a bone by less than 1e-4 of the
# angle between the two.
_KEEP = 1e-4


def world_rotations(
    local: Float[np.ndarray, "frames joints 3 3"], parents: Sequence[int]
) -> Float[np.ndarray, "frames joints 3 3"]:
    """World rotations of all joints, from parent-local ones; the root's are global.

    Each parent is smaller than its joint.
    """
    world = np.array(local)
    for joint, parent in enumerate(parents[1:], start=1):
        world[:, joint] = world[:, parent] @ local[:, joint]
    return world


def local_rotations(
    world: Float[np.ndarray, "frames joints 3 3"], parents: Sequence[int]
) -> Float[np.ndarray, "frames joints 3 3"]:
    """Inverse of `world_rotations`."""
    above = world[:, list(parents[1:])]
    local = np.swapaxes(above, -1, -2) @ world[:, 1:]
    return np.concatenate([world[:, :1], local], axis=1)


def joint_positions(
    root: Float[np.ndarray, "frames 3"],
    world: Float[np.ndarray, "frames joints 3 3"],
    offsets: Float[np.ndarray, "joints 3"],
    parents: Sequence[int],
) -> Float[np.ndarray, "frames joints 3"]:
    """World positions of all joints, meters.

    The root's offset is unused; each parent is smaller than its joint.
    """
    found = [root]
    for joint, parent in enumerate(parents[1:], start=1):
        found.append(found[parent] + world[:, parent] @ offsets[joint])
    return np.stack(found, axis=1)


def fit_rotations(
    position: Float[np.ndarray, "frames joints 3"],
    world: Float[np.ndarray, "frames joints 3 3"],
    parents: Sequence[int],
) -> tuple[Float[np.ndarray, "joints 3"], Float[np.ndarray, "frames joints 3 3"]]:
    """Bone vectors, and the rotations nearest to given ones that aim them right.

    With G the given rotation of joint j and c its children,

        R = argmax tr(R^T (sum_c bone[c] offset[c]^T / sum_c |offset[c]|^2 + e G)),

    where a small e leaves to G only what the bones do not decide: how a single one
    turns about itself. A joint without children keeps G.

    Positions are in the world, meters; with the rotations come the joints' positions in
    their parents' frames (the root's is zero).

    Source: the orthogonal Procrustes problem (Schönemann 1966).
    """
    offsets, fitted = np.zeros(position.shape[1:]), np.array(world)
    for joint in range(len(parents)):
        children = [c for c, parent in enumerate(parents) if parent == joint]
        if not children:
            continue
        skeleton = position[:, children] - position[:, joint, None]
        # The first offsets are means of bones that still swing a little, and short for
        # it; each turn leaves a square of that.
        for _ in range(3):
            mean = np.einsum("fba,fcb->fca", fitted[:, joint], skeleton).mean(0)
            aim = np.einsum("fca,cb->fab", skeleton, mean) / np.sum(mean**2)
            fitted[:, joint] = _nearest_rotation(aim + _KEEP * world[:, joint])
        offsets[children] = mean
    return offsets, fitted


def _nearest_rotation(
    matrix: Float[np.ndarray, "frames 3 3"],
) -> Float[np.ndarray, "frames 3 3"]:
    """The rotation R with the largest tr(R^T matrix)."""
    left, _, right = np.linalg.svd(matrix)
    left[..., -1] *= np.sign(np.linalg.det(left @ right))[:, None]
    return left @ right
