import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmotion.data.builders import chains

PARENTS = (-1, 0, 1, 0, 3, 3)
OFFSETS = np.array(
    [[0, 0, 0], [0.2, 0.1, 0], [0, -0.4, 0], [0, 0.3, 0], [0.2, 0, 0.1], [-0.2, 0.1, 0]]
)


def turns(seed, frames, angle=None):
    """Random rotations, or small ones of about that angle."""
    generator = np.random.default_rng(seed)
    if angle is None:
        found = Rotation.random(6 * frames, rng=generator)
    else:
        found = Rotation.from_rotvec(generator.normal(0, angle, (6 * frames, 3)))
    return found.as_matrix().reshape(frames, 6, 3, 3)


def chain(local, root):
    """World matrices and positions by 4 x 4 products, joint by joint and frame."""
    frames = len(local)
    found = np.zeros((frames, 6, 4, 4))
    for frame in range(frames):
        for joint, parent in enumerate(PARENTS):
            step = np.eye(4)
            step[:3, :3] = local[frame, joint]
            step[:3, 3] = root[frame] if parent < 0 else OFFSETS[joint]
            above = np.eye(4) if parent < 0 else found[frame, parent]
            found[frame, joint] = above @ step
    return found[..., :3, :3], found[..., :3, 3]


@pytest.fixture
def pose():
    local = turns(0, 20)
    root = np.random.default_rng(1).normal(size=(20, 3))
    return local, root, *chain(local, root)


def test_kinematics_agrees_with_products_of_matrices(pose):
    local, root, expected, positions = pose
    world = chains.world_rotations(local, PARENTS)
    np.testing.assert_allclose(world, expected, atol=1e-12)
    found = chains.joint_positions(root, world, OFFSETS, PARENTS)
    np.testing.assert_allclose(found, positions, atol=1e-12)
    np.testing.assert_allclose(
        chains.local_rotations(world, PARENTS), local, atol=1e-12
    )


def test_rotations_that_fit_already_come_back(pose):
    _, _, world, positions = pose
    offsets, fitted = chains.fit_rotations(positions, world, PARENTS)
    np.testing.assert_allclose(offsets, OFFSETS, atol=1e-12)
    np.testing.assert_allclose(fitted, world, atol=1e-10)


def test_rotations_a_little_off_are_aimed_at_the_positions(pose):
    _, root, world, positions = pose
    start = world @ turns(2, 20, angle=0.05)
    offsets, fitted = chains.fit_rotations(positions, start, PARENTS)
    found = chains.joint_positions(root, fitted, offsets, PARENTS)
    np.testing.assert_allclose(found, positions, atol=5e-5)
    assert np.abs(
        chains.joint_positions(root, start, OFFSETS, PARENTS) - found
    ).max() > (0.02)
    # A single bone is aimed by the shortest turn: about an axis across it.
    turn = Rotation.from_matrix(
        fitted[:, 1] @ np.swapaxes(start[:, 1], -1, -2)
    ).as_rotvec()
    bone = positions[:, 2] - positions[:, 1]
    assert np.abs(np.einsum("fa,fa->f", turn, bone)).max() < 1e-5
    assert np.linalg.norm(turn, axis=-1).max() > 0.05
    # A joint without children keeps what it had.
    np.testing.assert_allclose(fitted[:, 2], start[:, 2], atol=1e-12)
