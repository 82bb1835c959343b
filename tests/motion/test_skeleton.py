import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from jaxmotion.motion import rotation, skeleton
from tests.reference import motion as reference

PARENTS = (-1, 0, 1, 2, 0, 4, 5, 1, 7, 0)
NAMES = tuple(f"joint{j}" for j in range(len(PARENTS)))
OFFSETS = np.random.default_rng(0).normal(size=(len(PARENTS), 3))
SHAPE = (3, 4)


def float32(array):
    return jnp.asarray(array, jnp.float32)


@pytest.fixture
def bones():
    return skeleton.Skeleton(
        offsets=float32(OFFSETS), parents=PARENTS, names=NAMES, feet=(3, 6)
    )


def pose(seed, shape=SHAPE):
    """Root positions, and rotations as matrices and as six numbers."""
    count = int(np.prod(shape)) * len(PARENTS)
    matrices = reference.random_rotations(seed, count).as_matrix()
    matrices = matrices.reshape(*shape, len(PARENTS), 3, 3)
    root = np.random.default_rng(seed).normal(size=(*shape, 3))
    return root, matrices, rotation.rot6d_from_matrix(float32(matrices))


def test_forward_kinematics_agrees_with_products_of_matrices(bones):
    root, matrices, rot6d = pose(1)
    positions, turns = skeleton.global_transforms(bones, float32(root), rot6d)
    for index in np.ndindex(SHAPE):
        expected = reference.world_transforms(
            OFFSETS, PARENTS, root[index], matrices[index]
        )
        np.testing.assert_allclose(positions[index], expected[:, :3, 3], atol=5e-6)
        np.testing.assert_allclose(turns[index], expected[:, :3, :3], atol=5e-6)
    np.testing.assert_array_equal(
        skeleton.forward_kinematics(bones, float32(root), rot6d), positions
    )


def test_equivariance_under_rigid_motion(bones):
    root, matrices, rot6d = pose(2)
    turn = Rotation.from_rotvec([0.3, -1.1, 0.8]).as_matrix()
    shift = np.array([2.0, -1.0, 0.5])
    moved = matrices.copy()
    moved[..., 0, :, :] = turn @ matrices[..., 0, :, :]
    moved_rot6d = rotation.rot6d_from_matrix(float32(moved))
    before = skeleton.forward_kinematics(bones, float32(root), rot6d)
    after = skeleton.forward_kinematics(
        bones, float32(root @ turn.T + shift), moved_rot6d
    )
    np.testing.assert_allclose(after, np.asarray(before) @ turn.T + shift, atol=5e-6)


def test_bone_lengths_are_constant(bones):
    # Numbers that are no rotations yet: the lengths must not depend on them.
    rot6d = float32(np.random.default_rng(3).normal(size=(*SHAPE, len(PARENTS), 6)))
    positions = skeleton.forward_kinematics(bones, jnp.zeros((*SHAPE, 3)), rot6d)
    bone = positions[..., 1:, :] - positions[..., np.array(PARENTS[1:]), :]
    lengths = np.linalg.norm(OFFSETS[1:], axis=-1)
    found = np.linalg.norm(bone, axis=-1)
    np.testing.assert_allclose(found, np.broadcast_to(lengths, found.shape), rtol=1e-5)


def test_rest_pose_adds_offsets(bones):
    rest = jnp.broadcast_to(float32([1, 0, 0, 0, 1, 0]), (len(PARENTS), 6))
    found = skeleton.forward_kinematics(bones, float32([1.0, 2.0, 3.0]), rest)
    for joint in range(len(PARENTS)):
        path = reference.chain_of_joints(PARENTS, joint)[1:]
        expected = np.array([1.0, 2.0, 3.0]) + OFFSETS[path].sum(axis=0)
        np.testing.assert_allclose(found[joint], expected, atol=1e-6)


def test_a_joint_moves_only_what_hangs_on_it(bones):
    root, _, rot6d = pose(4, ())
    turned = rot6d.at[1].set(float32([0, 0, 1, 0, 1, 0]))
    before, after = (
        skeleton.forward_kinematics(bones, float32(root), d) for d in (rot6d, turned)
    )
    moved = np.linalg.norm(after - before, axis=-1) > 1e-3
    below = [1 in reference.chain_of_joints(PARENTS, j)[:-1] for j in range(10)]
    np.testing.assert_array_equal(moved, below)


def test_gradient_agrees_with_finite_differences(bones):
    root, _, rot6d = pose(5, ())
    weights = float32(np.random.default_rng(1).normal(size=(len(PARENTS), 3)))

    def energy(root, rot6d):
        root, rot6d = jnp.asarray(root), jnp.asarray(rot6d)
        return jnp.sum(weights * skeleton.forward_kinematics(bones, root, rot6d))

    check_grads(
        energy, (float32(root), rot6d), order=1, modes=("rev",), atol=2e-2, rtol=2e-2
    )
    zeros = jax.grad(energy, argnums=1)(float32(root), jnp.zeros_like(rot6d))
    assert bool(jnp.all(jnp.isfinite(zeros)))


def test_vmap_and_jit_are_leading_axes(bones):
    root, _, rot6d = pose(6)
    whole = skeleton.forward_kinematics(bones, float32(root), rot6d)

    def one(root, rot6d):
        return skeleton.forward_kinematics(bones, root, rot6d)

    mapped = jax.jit(jax.vmap(jax.vmap(one)))(float32(root), rot6d)
    np.testing.assert_allclose(mapped, whole, atol=1e-6)


def test_joint_positions_of_a_motion(bones):
    root, _, rot6d = pose(7)
    motion = skeleton.Motion(
        root_position=float32(root), joint_rotation=rot6d, fps=60.0
    )
    np.testing.assert_array_equal(
        skeleton.joint_positions(bones, motion),
        skeleton.forward_kinematics(bones, float32(root), rot6d),
    )
    doubled = jax.jit(lambda m: jax.tree.map(lambda a: 2.0 * a, m))(motion)
    assert doubled.fps == 60.0
    np.testing.assert_allclose(doubled.root_position, 2.0 * root, rtol=1e-6)


def test_velocities_of_straight_and_of_turning_motion():
    fps, frames = 30.0, 61
    time = np.arange(frames) / fps
    speed = np.array([[1.0, 0.0, -0.5], [0.0, 2.0, 0.0]])
    straight = time[:, None, None] * speed + np.array([5.0, 0.0, 1.0])
    found = skeleton.joint_velocities(float32(straight), fps)
    assert found.shape == (frames - 1, 2, 3)
    np.testing.assert_allclose(found, np.broadcast_to(speed, found.shape), atol=5e-5)
    # On a circle the chord's speed is r * omega * sinc(omega dt / 2).
    omega, radius = 3.0, 0.8
    circle = (
        radius
        * np.stack([np.sin(omega * time), 0 * time, np.cos(omega * time)], axis=-1)[
            :, None
        ]
    )
    speeds = jnp.linalg.norm(skeleton.joint_velocities(float32(circle), fps), axis=-1)
    chord = 2 * radius * np.sin(omega / fps / 2) * fps
    np.testing.assert_allclose(speeds, chord, rtol=1e-5)


def test_skeleton_is_a_static_structure(bones):
    assert bones.num_joints == len(PARENTS)
    assert bones.index("joint4") == 4
    leaves, treedef = jax.tree.flatten(bones)
    assert len(leaves) == 1
    again = jax.tree.unflatten(treedef, leaves)
    assert (again.parents, again.names, again.feet) == (PARENTS, NAMES, (3, 6))


def test_errors_name_what_is_wrong(bones):
    with pytest.raises(ValueError, match="unknown joint 'knee'.*joint9"):
        bones.index("knee")
    with pytest.raises(ValueError, match="has 9 joints, the skeleton 10"):
        skeleton.forward_kinematics(bones, jnp.zeros(3), jnp.zeros((9, 6)))
    skeleton.check_parents(PARENTS)
    for parents, message in [
        ((0, 0), "joint 0 is 0, expected -1"),
        ((-1, 0, 2), r"joint 2 is 2, expected in 0\.\.1"),
        ((-1, 0, -1), r"joint 2 is -1, expected in 0\.\.1"),
        ((-1, 2, 0), r"joint 1 is 2, expected in 0\.\.0"),
    ]:
        with pytest.raises(ValueError, match=message):
            skeleton.check_parents(parents)
