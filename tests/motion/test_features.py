import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmotion.motion import features, rotation, trajectory
from jaxmotion.motion.skeleton import Motion, Skeleton
from tests import tiny

BONES = Skeleton(
    offsets=jnp.array([[0, 0, 0], [0.1, 0.3, 0], [0, 0.2, 0.4]], jnp.float32),
    parents=(-1, 0, 1),
    names=("a", "b", "c"),
)


def motion(shape=(4,), seed=0):
    key_p, key_r = jax.random.split(jax.random.key(seed))
    matrix = rotation.matrix_from_rot6d(jax.random.normal(key_r, (*shape, 3, 6)))
    return Motion(
        root_position=jax.random.normal(key_p, (*shape, 3)),
        joint_rotation=rotation.rot6d_from_matrix(matrix),
        fps=60.0,
    )


def frame(yaw, origin):
    yaw = jnp.asarray(yaw, jnp.float32)
    return trajectory.PlanarFrame(
        origin=jnp.asarray(origin, jnp.float32),
        facing=jnp.stack([jnp.sin(yaw), jnp.cos(yaw)], axis=-1),
    )


def test_normalizer_is_numpys_mean_and_std():
    x = np.random.default_rng(0).normal(1000.0, [0.01, 2.0, 50.0], (5, 40, 3))
    x[..., 0] = 7.0  # a constant channel
    fitted = features.fit_normalizer(jnp.asarray(x, jnp.float32), floor=1e-3)
    rows = x.astype(np.float32).astype(np.float64).reshape(-1, 3)
    np.testing.assert_allclose(fitted.mean, rows.mean(0), rtol=1e-5)
    np.testing.assert_allclose(fitted.std[1:], rows.std(0)[1:], rtol=1e-4)
    np.testing.assert_allclose(fitted.std[0], 1e-3, rtol=1e-6)
    z = features.normalize(fitted, jnp.asarray(x, jnp.float32))
    np.testing.assert_allclose(z[..., 0], 0.0, atol=1e-6)
    np.testing.assert_allclose(np.std(np.asarray(z[..., 1:]), (0, 1)), 1.0, rtol=1e-3)
    np.testing.assert_allclose(features.denormalize(fitted, z), x, rtol=1e-6, atol=1e-3)


def test_to_frame_moves_every_joint_rigidly():
    yaw, origin = [0.4, -3.0], [[1.0, 2.0], [-5.0, 0.5]]
    world = motion((2, 4))
    local = features.to_frame(world, frame(yaw, origin))
    before = np.asarray(tiny.positions(BONES, world))
    after = np.asarray(tiny.positions(BONES, local))
    for b in range(2):
        moved = before[b] - np.array([origin[b][0], 0.0, origin[b][1]])
        turn = Rotation.from_rotvec([0, yaw[b], 0]).inv()
        want = turn.apply(moved.reshape(-1, 3)).reshape(moved.shape)
        np.testing.assert_allclose(after[b], want, atol=1e-5)
    np.testing.assert_array_equal(
        local.root_position[..., 1], world.root_position[..., 1]
    )
    np.testing.assert_array_equal(
        local.joint_rotation[..., 1:, :], world.joint_rotation[..., 1:, :]
    )
    assert local.fps == 60.0


def test_from_frame_inverts_to_frame():
    world, where = motion((2, 4)), frame([1.0, 2.5], [[1.0, 2.0], [-5.0, 0.5]])
    back = features.from_frame(features.to_frame(world, where), where)
    np.testing.assert_allclose(back.root_position, world.root_position, atol=2e-6)
    np.testing.assert_allclose(back.joint_rotation, world.joint_rotation, atol=1e-6)


def test_frame_change_agrees_with_that_of_the_path():
    skeleton = Skeleton(
        offsets=jnp.array([[0, 0, 0], [0.1, 0, 0], [-0.1, 0, 0]], jnp.float32),
        parents=(-1, 0, 0),
        names=("Hips", "LeftUpLeg", "RightUpLeg"),
    )
    world, where = motion((4,)), frame(2.0, [0.3, -1.0])
    path = trajectory.root_trajectory(skeleton, world)
    want = trajectory.to_local(path, where)
    got = trajectory.root_trajectory(skeleton, features.to_frame(world, where))
    np.testing.assert_allclose(got.position, want.position, atol=1e-5)
    np.testing.assert_allclose(got.facing, want.facing, atol=1e-5)


HIPS = Skeleton(
    offsets=jnp.array([[0, 0, 0], [0.1, 0, 0], [-0.1, 0, 0]], jnp.float32),
    parents=(-1, 0, 0),
    names=("Hips", "LeftUpLeg", "RightUpLeg"),
)


TO_FIRST = jax.jit(lambda world: features.to_first_pose(HIPS, world))


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(5,), (2, 3, 5)])
def test_motions_are_moved_to_their_own_first_pose(shape):
    world = motion(shape)
    found = TO_FIRST(world)
    path = jax.jit(lambda m: trajectory.root_trajectory(HIPS, m))(found)
    np.testing.assert_allclose(path.position[..., 0, :], 0.0, atol=1e-5)
    ahead = np.broadcast_to([0.0, 1.0], path.facing[..., 0, :].shape)
    np.testing.assert_allclose(path.facing[..., 0, :], ahead, atol=1e-5)
    # Rigid and upright: heights, distances and limbs stay.
    np.testing.assert_array_equal(
        found.root_position[..., 1], world.root_position[..., 1]
    )
    np.testing.assert_array_equal(
        found.joint_rotation[..., 1:, :], world.joint_rotation[..., 1:, :]
    )
    place = jax.jit(lambda m: tiny.positions(HIPS, m))
    before, after = (
        np.asarray(place(m)).reshape(*shape[:-1], -1, 3) for m in (world, found)
    )
    gaps = [x[..., :, None, :] - x[..., None, :, :] for x in (before, after)]
    lengths = [np.linalg.norm(gap, axis=-1) for gap in gaps]
    np.testing.assert_allclose(lengths[0], lengths[1], atol=1e-4)
    assert found.fps == world.fps


def test_where_a_motion_was_does_not_matter():
    """A motion moved by any ground frame has the same first pose."""
    world = motion((2, 5), seed=4)
    elsewhere = features.from_frame(
        world, frame([0.8, -2.0], [[3.0, 1.0], [0.0, -7.0]])
    )
    a, b = (TO_FIRST(m) for m in (world, elsewhere))
    np.testing.assert_allclose(a.root_position, b.root_position, atol=1e-5)
    np.testing.assert_allclose(a.joint_rotation, b.joint_rotation, atol=1e-5)
    again = TO_FIRST(a)
    np.testing.assert_allclose(again.root_position, a.root_position, atol=1e-5)


@pytest.mark.parametrize("layout", ["rows", "columns"])
def test_motion_features_hold_the_matrix_and_invert(layout):
    given = motion((2, 4))
    x = features.motion_features(given, rotation_layout=layout)
    assert x.shape == (2, 4, (3 + 1) * 6)
    matrix = np.asarray(rotation.matrix_from_rot6d(given.joint_rotation))
    taken = (
        matrix[..., :2, :] if layout == "rows" else matrix[..., :, :2].swapaxes(-1, -2)
    )
    joints = np.asarray(x).reshape(2, 4, 4, 6)
    np.testing.assert_allclose(joints[..., :3, :], taken.reshape(2, 4, 3, 6), atol=1e-6)
    np.testing.assert_array_equal(joints[..., 3, :3], given.root_position)
    np.testing.assert_array_equal(joints[..., 3, 3:], 0.0)
    back = features.motion_from_features(x, 60.0, rotation_layout=layout)
    np.testing.assert_allclose(back.joint_rotation, given.joint_rotation, atol=1e-6)
    np.testing.assert_array_equal(back.root_position, given.root_position)
    assert back.fps == 60.0


@pytest.mark.parametrize("layout", ["rows", "columns"])
def test_predicted_features_become_rotations_with_finite_gradients(layout):
    def total(x):
        made = features.motion_from_features(x, 30.0, rotation_layout=layout)
        return jnp.sum(made.joint_rotation), made

    random = 5 * jax.random.normal(jax.random.key(3), (1, 24))
    x = jnp.concatenate([jnp.zeros((1, 24)), random])
    grad, made = jax.grad(total, has_aux=True)(x)
    assert np.isfinite(grad).all()
    columns = np.asarray(made.joint_rotation).reshape(2, 3, 2, 3)
    gram = columns @ columns.swapaxes(-1, -2)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(2), gram.shape), atol=1e-6)


def test_unknown_layouts_and_sizes_are_refused():
    with pytest.raises(ValueError, match="13 features, expected"):
        features.motion_from_features(jnp.zeros((1, 13)), 30.0)
    with pytest.raises(ValueError, match="6 features, expected"):
        features.motion_from_features(jnp.zeros((1, 6)), 30.0)
