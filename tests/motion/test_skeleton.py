import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from jaxmotion.motion import rotation
from jaxmotion.motion.skeleton import (
    Motion,
    Skeleton,
    check_parents,
    check_skeleton,
    forward_kinematics,
    from_root,
    global_transforms,
    joint_positions,
)
from tests.reference import motion as reference
from tests.tiny import float32

PARENTS = (-1, 0, 1, 2, 0, 4, 5, 1, 7, 0)
NAMES = tuple(f"joint{j}" for j in range(len(PARENTS)))
OFFSETS = np.random.default_rng(0).normal(size=(len(PARENTS), 3))
SHAPE = (3, 4)


@pytest.fixture
def skeleton():
    return Skeleton(offsets=float32(OFFSETS), parents=PARENTS, names=NAMES, feet=(3, 6))


def pose(seed, shape=SHAPE):
    """Root positions, and rotations as matrices and as six numbers."""
    count = int(np.prod(shape)) * len(PARENTS)
    matrices = reference.random_rotations(seed, count).as_matrix()
    matrices = matrices.reshape(*shape, len(PARENTS), 3, 3)
    root = np.random.default_rng(seed).normal(size=(*shape, 3))
    return root, matrices, rotation.rot6d_from_matrix(float32(matrices))


def test_forward_kinematics_agrees_with_products_of_matrices(skeleton):
    root, matrices, rot6d = pose(1)
    positions, turns = global_transforms(skeleton, float32(root), rot6d)
    for index in np.ndindex(SHAPE):
        expected = reference.world_transforms(
            OFFSETS, PARENTS, root[index], matrices[index]
        )
        np.testing.assert_allclose(positions[index], expected[:, :3, 3], atol=5e-6)
        np.testing.assert_allclose(turns[index], expected[:, :3, :3], atol=5e-6)
    np.testing.assert_array_equal(
        forward_kinematics(skeleton, float32(root), rot6d), positions
    )


@pytest.mark.parametrize("joint", range(len(PARENTS)))
def test_a_joint_s_own_chain_leads_to_it(skeleton, joint):
    _, matrices, rot6d = pose(1)
    found = from_root(skeleton, rot6d, joint)
    for index in np.ndindex(SHAPE):
        expected = reference.world_transforms(
            OFFSETS, PARENTS, np.zeros(3), matrices[index]
        )
        np.testing.assert_allclose(found[index], expected[joint, :3, 3], atol=5e-6)


def test_equivariance_under_rigid_motion(skeleton):
    root, matrices, rot6d = pose(2)
    turn = Rotation.from_rotvec([0.3, -1.1, 0.8]).as_matrix()
    shift = np.array([2.0, -1.0, 0.5])
    moved = matrices.copy()
    moved[..., 0, :, :] = turn @ matrices[..., 0, :, :]
    moved_rot6d = rotation.rot6d_from_matrix(float32(moved))
    before = forward_kinematics(skeleton, float32(root), rot6d)
    after = forward_kinematics(skeleton, float32(root @ turn.T + shift), moved_rot6d)
    np.testing.assert_allclose(after, np.asarray(before) @ turn.T + shift, atol=5e-6)


def test_bone_lengths_are_constant(skeleton):
    # Numbers that are no rotations yet: the lengths must not depend on them.
    rot6d = float32(np.random.default_rng(3).normal(size=(*SHAPE, len(PARENTS), 6)))
    positions = forward_kinematics(skeleton, jnp.zeros((*SHAPE, 3)), rot6d)
    bone = positions[..., 1:, :] - positions[..., np.array(PARENTS[1:]), :]
    lengths = np.linalg.norm(OFFSETS[1:], axis=-1)
    found = np.linalg.norm(bone, axis=-1)
    np.testing.assert_allclose(found, np.broadcast_to(lengths, found.shape), rtol=1e-5)


def test_rest_pose_adds_offsets(skeleton):
    rest = jnp.broadcast_to(float32([1, 0, 0, 0, 1, 0]), (len(PARENTS), 6))
    found = forward_kinematics(skeleton, float32([1.0, 2.0, 3.0]), rest)
    for joint in range(len(PARENTS)):
        path = reference.chain_of_joints(PARENTS, joint)[1:]
        expected = np.array([1.0, 2.0, 3.0]) + OFFSETS[path].sum(axis=0)
        np.testing.assert_allclose(found[joint], expected, atol=1e-6)


def test_a_joint_moves_only_what_hangs_on_it(skeleton):
    root, _, rot6d = pose(4, ())
    turned = rot6d.at[1].set(float32([0, 0, 1, 0, 1, 0]))
    before, after = (
        forward_kinematics(skeleton, float32(root), d) for d in (rot6d, turned)
    )
    moved = np.linalg.norm(after - before, axis=-1) > 1e-3
    below = [1 in reference.chain_of_joints(PARENTS, j)[:-1] for j in range(10)]
    np.testing.assert_array_equal(moved, below)


def test_gradient_agrees_with_finite_differences(skeleton):
    root, _, rot6d = pose(5, ())
    weights = float32(np.random.default_rng(1).normal(size=(len(PARENTS), 3)))

    def energy(root, rot6d):
        root, rot6d = jnp.asarray(root), jnp.asarray(rot6d)
        return jnp.sum(weights * forward_kinematics(skeleton, root, rot6d))

    check_grads(
        energy, (float32(root), rot6d), order=1, modes=("rev",), atol=2e-2, rtol=2e-2
    )
    zeros = jax.grad(energy, argnums=1)(float32(root), jnp.zeros_like(rot6d))
    assert bool(jnp.all(jnp.isfinite(zeros)))


def plain_transforms(parents, offsets, root, matrices):
    """Positions and world rotations of one pose, left to the compiler's gradient."""
    positions, turns = [root], [matrices[0]]
    for joint, parent in enumerate(parents[1:], start=1):
        positions.append(positions[parent] + turns[parent] @ offsets[joint])
        turns.append(turns[parent] @ matrices[joint])
    return jnp.stack(positions), jnp.stack(turns)


def energies(shape, parents=PARENTS):
    """The same number of offsets, roots and rotations, by the library and plainly.

    It depends on all positions and on all world rotations.
    """
    rng = np.random.default_rng(2)
    of_positions = float32(rng.normal(size=(*shape, len(parents), 3)))
    of_turns = float32(rng.normal(size=(*shape, len(parents), 3, 3)))
    names = NAMES[: len(parents)]

    def total(positions, turns):
        return jnp.sum(of_positions * positions) + jnp.sum(of_turns * turns)

    def written(offsets, root, rot6d):
        skeleton = Skeleton(offsets=offsets, parents=parents, names=names)
        return total(*global_transforms(skeleton, root, rot6d))

    def plain(offsets, root, rot6d):
        one = functools.partial(plain_transforms, parents, offsets)
        for _ in shape:
            one = jax.vmap(one)
        return total(*one(root, rotation.matrix_from_rot6d(rot6d)))

    return written, plain


@pytest.mark.parametrize(
    "shape",
    [(5,), *(pytest.param(s, marks=pytest.mark.slow) for s in [(), (2, 3)])],
)
def test_written_gradient_is_that_of_a_plain_loop(shape):
    root, _, rot6d = pose(8, shape)
    # Not orthonormal, as a network gives them.
    rot6d = rot6d + 0.3 * float32(np.random.default_rng(3).normal(size=rot6d.shape))
    given = float32(OFFSETS), float32(root), rot6d
    found, expected = (
        jax.jit(jax.grad(energy, argnums=(0, 1, 2)))(*given)
        for energy in energies(shape)
    )
    for name, a, b in zip(("offsets", "root", "rot6d"), found, expected, strict=True):
        assert np.abs(b).max() > 0.1
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=5e-5, err_msg=name)
    # The root is where it is told to be, whatever its offset.
    np.testing.assert_array_equal(found[0][0], 0.0)


@pytest.mark.parametrize("part", ["positions", "rotations", "both"])
def test_written_gradient_is_that_of_finite_differences(part):
    """In float64, by products of 4x4 matrices."""
    root, _, _ = pose(9, ())
    rng = np.random.default_rng(4)
    numbers = rng.normal(size=(len(PARENTS), 6))
    weights = rng.normal(size=(len(PARENTS), 3, 4))
    weights[..., 3] *= part != "rotations"
    weights[..., :3] *= part != "positions"

    def oracle(offsets, root, numbers):
        matrices = [reference.gram_schmidt(n) for n in numbers]
        worlds = reference.world_transforms(offsets, PARENTS, root, matrices)
        return np.sum(weights * worlds[:, :3])

    def energy(offsets, root, rot6d):
        skeleton = Skeleton(offsets=offsets, parents=PARENTS, names=NAMES)
        positions, turns = global_transforms(skeleton, root, rot6d)
        whole = jnp.concatenate([turns, positions[..., None]], axis=-1)
        return jnp.sum(float32(weights) * whole)

    given = OFFSETS, root, numbers
    found = jax.jit(jax.grad(energy, argnums=(0, 1, 2)))(*map(float32, given))
    for place, (array, slopes) in enumerate(zip(given, found, strict=True)):
        for _ in range(6):
            index = tuple(rng.integers(0, n) for n in array.shape)
            ends = []
            for sign in (1, -1):
                moved = [np.array(x, np.float64) for x in given]
                moved[place][index] += sign * 1e-6
                ends.append(oracle(*moved))
            expected = (ends[0] - ends[1]) / 2e-6
            np.testing.assert_allclose(slopes[index], expected, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_gradient_of_a_gradient_is_that_of_a_plain_loop():
    few = PARENTS[:4]
    root, _, rot6d = pose(10, (2,))
    root, rot6d, offsets = float32(root), rot6d[:, :4], float32(OFFSETS[:4])

    def bent(energy):
        def size(offsets, rot6d):
            slopes = jax.grad(energy, argnums=(0, 2))(offsets, root, rot6d)
            return sum(jnp.sum(x**2) for x in slopes)

        return jax.jit(jax.grad(size, argnums=(0, 1)))

    written, plain = (bent(energy) for energy in energies((2,), few))
    pairs = zip(written(offsets, rot6d), plain(offsets, rot6d), strict=True)
    for found, expected in pairs:
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4 * scale)
    singular = written(offsets, jnp.zeros_like(rot6d))
    assert all(np.isfinite(x).all() for x in singular)


@pytest.mark.slow
def test_gradients_of_many_skeletons_by_vmap():
    """The chain is differentiated under vmap over offsets as well."""
    root, _, rot6d = pose(11, (3,))
    sizes = float32([0.5, 1.0, 2.0])

    def energy(size, root, rot6d):
        skeleton = Skeleton(
            offsets=size * float32(OFFSETS), parents=PARENTS, names=NAMES
        )
        return jnp.sum(forward_kinematics(skeleton, root, rot6d) ** 2)

    given = sizes, float32(root), rot6d
    slope = jax.grad(energy, argnums=(0, 2))
    together = jax.jit(jax.vmap(slope))(*given)
    alone = jax.jit(slope)
    for i in range(3):
        for a, b in zip(together, alone(*(x[i] for x in given)), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-4, atol=1e-3)


def test_vmap_and_jit_are_leading_axes(skeleton):
    root, _, rot6d = pose(6)
    whole = forward_kinematics(skeleton, float32(root), rot6d)

    def one(root, rot6d):
        return forward_kinematics(skeleton, root, rot6d)

    mapped = jax.jit(jax.vmap(jax.vmap(one)))(float32(root), rot6d)
    np.testing.assert_allclose(mapped, whole, atol=1e-6)


def test_joint_positions_of_a_motion(skeleton):
    root, _, rot6d = pose(7)
    motion = Motion(root_position=float32(root), joint_rotation=rot6d, fps=60.0)
    np.testing.assert_array_equal(
        joint_positions(skeleton, motion),
        forward_kinematics(skeleton, float32(root), rot6d),
    )
    doubled = jax.jit(lambda m: jax.tree.map(lambda a: 2.0 * a, m))(motion)
    assert doubled.fps == 60.0
    np.testing.assert_allclose(doubled.root_position, 2.0 * root, rtol=1e-6)


def test_skeleton_is_a_static_structure(skeleton):
    assert skeleton.num_joints == len(PARENTS)
    assert skeleton.index("joint4") == 4
    leaves, treedef = jax.tree.flatten(skeleton)
    assert len(leaves) == 1
    again = jax.tree.unflatten(treedef, leaves)
    assert (again.parents, again.names, again.feet) == (PARENTS, NAMES, (3, 6))


def test_errors_name_what_is_wrong(skeleton):
    with pytest.raises(ValueError, match="unknown joint 'knee'.*joint9"):
        skeleton.index("knee")
    with pytest.raises(ValueError, match="has 9 joints, the skeleton 10"):
        forward_kinematics(skeleton, jnp.zeros(3), jnp.zeros((9, 6)))
    check_parents(PARENTS)
    for parents, message in [
        ((0, 0), "joint 0 is 0, expected -1"),
        ((-1, 0, 2), r"joint 2 is 2, expected in 0\.\.1"),
        ((-1, 0, -1), r"joint 2 is -1, expected in 0\.\.1"),
        ((-1, 2, 0), r"joint 1 is 2, expected in 0\.\.0"),
    ]:
        with pytest.raises(ValueError, match=message):
            check_parents(parents)


NAN, FAR = float("nan"), 1e39
ZEROS = [[0.0] * 3] * 3
FIELDS = dict(parents=(-1, 0, 1), offsets=ZEROS, names=("a", "b", "c"), feet=(2,))
BAD_FIELDS = [
    ("parents", (), "expected at least one joint"),
    ("parents", (-1, 2, 0), "parent of joint 1"),
    ("parents", (-1, 0.0, 1), "parents should be whole numbers, found 0.0"),
    ("offsets", [*ZEROS[:2], [0, NAN, 0]], "offset of joint 2 is .0.0, nan, 0.0."),
    ("offsets", [[FAR] * 3, *ZEROS[1:]], r"joint 0 is .1e\+39.*within 1e\+06 m"),
    ("offsets", [*ZEROS[:2], [0.0] * 4], "offsets should be 3 rows of 3"),
    ("offsets", ZEROS[:2], r"offsets have shape \(2, 3\), expected \(3, 3\)"),
    ("names", ("a", "b"), "2 names for 3 joints"),
    ("names", ("a", "", "c"), "name of joint 1 should be text, found ''"),
    ("names", ("a", "b", "a"), "two joints have the name 'a'"),
    ("feet", (1, 3), r"feet .1, 3.: expected different joints in 0\.\.2"),
    ("feet", (2, 2), r"feet .2, 2.: expected different joints"),
    ("feet", ("toe",), "feet should be whole numbers, found 'toe'"),
]


@pytest.mark.parametrize(("field", "value", "message"), BAD_FIELDS)
def test_fields_of_a_file_that_make_no_skeleton_are_named(field, value, message):
    check_skeleton(**FIELDS)
    with pytest.raises(ValueError, match=message):
        check_skeleton(**FIELDS | {field: value})
