"""Bodies of capsules, for what is no person: a robot's links."""

import numpy as np

from jaxmotion.motion.anatomy import unit, zero_pose
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.viz import raster
from jaxmotion.viz.mannequin import Mannequin

_PALETTE = ("#c9ced6", "#3c424b")


def describe(
    skeleton: Skeleton, joints: np.ndarray, ends: np.ndarray, radii: np.ndarray
) -> Mannequin:
    """A body of rigid capsules, each with the joint [n] that it follows.

    Ends [n, 2, 3] are from its joint in the zero pose; these and radii are in meters.
    """
    places = zero_pose(skeleton)
    ball, faces = raster.sphere()
    vertices, normals = [], []
    for joint, (start, end), radius in zip(joints, ends, radii, strict=True):
        # A ball, one half of it at each end.
        axis = unit(end - start) if np.any(end != start) else np.array([0.0, 1.0, 0.0])
        half = (ball @ axis > 0)[:, None]
        vertices.append(places[joint] + radius * ball + np.where(half, end, start))
        normals.append(ball)
    count = len(ball)
    starts = count * np.arange(len(joints))
    following = np.zeros((count * len(joints), 4), np.uint16)
    following[:, 0] = np.repeat(joints, count)
    weights = np.zeros(following.shape, np.float32)
    weights[:, 0] = 1.0
    # What is small is dark: hands, feet, housings of motors.
    dark = np.asarray(radii) < 0.6 * np.median(radii)
    return Mannequin(
        vertices=np.concatenate(vertices).astype(np.float32),
        normals=np.concatenate(normals).astype(np.float32),
        faces=(starts[:, None, None] + faces).reshape(-1, 3).astype(np.int32),
        joints=following,
        weights=weights,
        materials=np.repeat(dark.astype(np.uint8), count),
        palette=_PALETTE,
        bind_position=places.astype(np.float32),
        bind_rotation=np.broadcast_to(
            np.eye(3, dtype=np.float32), (len(places), 3, 3)
        ).copy(),
    )
