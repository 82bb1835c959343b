"""Float64 oracles of rotations and skeletons: loops and SciPy, no vectorized tricks."""

import numpy as np
from scipy.spatial.transform import Rotation


def random_rotations(seed, count):
    return Rotation.random(count, random_state=np.random.default_rng(seed))


def gram_schmidt(rot6d):
    """Matrix whose first two columns are the orthonormalized halves of six numbers."""
    x = rot6d[:3] / np.linalg.norm(rot6d[:3])
    y = rot6d[3:] - np.dot(x, rot6d[3:]) * x
    y = y / np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def homogeneous(rotation, translation):
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = translation
    return matrix


def chain_of_joints(parents, joint):
    """Joints from the root down to a joint."""
    path = [joint]
    while parents[path[-1]] >= 0:
        path.append(parents[path[-1]])
    return path[::-1]


def world_transforms(offsets, parents, root_position, rotations):
    """World matrices: for each joint the product of 4x4 matrices along its chain."""
    worlds = []
    for joint in range(len(parents)):
        world = np.eye(4)
        for link in chain_of_joints(parents, joint):
            place = root_position if parents[link] < 0 else offsets[link]
            world = world @ homogeneous(rotations[link], place)
        worlds.append(world)
    return np.stack(worlds)
