import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmotion.motion import facing as facing_module
from jaxmotion.motion import ground, trajectory
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.motion.trajectory import Command, PlanarFrame, Trajectory
from tests import tiny
from tests.reference import trajectory as oracle


def directions(angles):
    angles = np.asarray(angles)
    return np.stack([np.sin(angles), np.cos(angles)], -1).astype(np.float32)


def path(position, angles=None):
    position = jnp.asarray(position, jnp.float32)
    if angles is None:
        angles = np.linspace(0.0, 1.0, position.shape[-2])
    return Trajectory(position=position, facing=jnp.asarray(directions(angles)))


def biped(names):
    return Skeleton(
        offsets=jnp.array(
            [[0, 0, 0], [0, 0.1, 0], [0.1, 0, 0.02], [-0.1, 0, 0.02]], jnp.float32
        ),
        parents=(-1, 0, 1, 1),
        names=names,
    )


# --- desired trajectory ----------------------------------------------------------


def test_desired_trajectory_follows_the_equations_at_every_frame():
    frame = PlanarFrame(
        origin=jnp.array([1.0, 2.0]), facing=jnp.asarray(directions(2.9))
    )
    velocity, acceleration = jnp.array([0.4, -0.2]), jnp.array([1.0, 0.5])
    command = Command(
        velocity=jnp.array([-1.0, 1.5]),
        facing=jnp.asarray(directions(-2.5)),
        label=jnp.int32(0),
    )
    got = trajectory.desired_trajectory(
        frame,
        velocity,
        command,
        num_frames=45,
        fps=30.0,
        half_life=0.3,
        acceleration=acceleration,
        turn_rate=jnp.float32(-0.3),
    )
    assert got.position.shape == (45, 2)
    for i in (0, 14, 44):
        t = (i + 1) / 30.0
        for axis in range(2):
            want = oracle.integrate_velocity_spring(
                float(frame.origin[axis]),
                float(velocity[axis]),
                float(acceleration[axis]),
                float(command.velocity[axis]),
                0.3,
                t,
            )[0]
            np.testing.assert_allclose(got.position[i, axis], want, atol=1e-5)
        angle, _ = oracle.integrate_spring(2.9, -0.3, 2 * np.pi - 2.5, 0.3, t)
        error = oracle.wrap(oracle.yaw(np.asarray(got.facing[i])) - angle)
        np.testing.assert_allclose(error, 0.0, atol=1e-5)


def test_desired_trajectory_of_a_batch_is_that_of_each():
    key_v, key_c = jax.random.split(jax.random.key(0))
    velocity = jax.random.normal(key_v, (3, 2))
    wanted = jax.random.normal(key_c, (3, 2))
    facing = ground.unit(wanted)

    def plan(velocity, wanted, facing):
        frame = PlanarFrame(origin=velocity * 2, facing=facing[..., ::-1])
        label = jnp.zeros(velocity.shape[:-1], jnp.int32)
        command = Command(velocity=wanted, facing=facing, label=label)
        return trajectory.desired_trajectory(
            frame, velocity, command, num_frames=5, fps=30.0
        )

    batched = plan(velocity, wanted, facing)
    mapped = jax.vmap(plan)(velocity, wanted, facing)
    for a, b in zip(jax.tree.leaves(batched), jax.tree.leaves(mapped), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


# --- extension -------------------------------------------------------------------


@pytest.mark.parametrize(
    "frames, added, reuse", [(45, 44, 23), (45, 15, 15), (10, 25, 4), (3, 4, 2)]
)
def test_extension_is_the_half_turn_of_the_last_points(frames, added, reuse):
    points = np.random.default_rng(0).normal(size=(frames, 2))
    got = trajectory.extend(path(points), added, reuse=reuse)
    want = oracle.extend(points, added, reuse)
    assert got.position.shape == (frames + added, 2)
    np.testing.assert_allclose(got.position, want, atol=2e-4)


def test_extension_of_45_by_44_with_23_is_two_blocks():
    points = np.random.default_rng(1).normal(size=(45, 2))
    e = np.asarray(trajectory.extend(path(points), 44, reuse=23).position)[45:]
    p = points
    np.testing.assert_allclose(e[:23], 2 * p[44] - p[43:20:-1], atol=1e-5)
    behind = np.concatenate([p[44:45], e[:22]])[::-1][:21]
    np.testing.assert_allclose(e[23:], 2 * e[22] - behind, atol=1e-5)


def test_straight_walk_extends_straight():
    points = np.arange(10)[:, None] * np.array([0.03, 0.04])
    got = trajectory.extend(path(points), 20, reuse=4)
    want = np.arange(30)[:, None] * np.array([0.03, 0.04])
    np.testing.assert_allclose(got.position, want, atol=1e-5)


def test_curvature_of_an_arc_flips_at_each_block():
    angle = np.arange(12) * 0.1
    points = np.stack([1 - np.cos(angle), np.sin(angle)], -1)
    got = np.asarray(trajectory.extend(path(points), 10, reuse=5).position)
    step = np.diff(got, axis=0)
    bend = step[:-1, 0] * step[1:, 1] - step[:-1, 1] * step[1:, 0]
    sign = np.sign(np.round(bend, 5))
    # Frames 0..11 are given; blocks begin after 11 and 16, where the bend is zero.
    np.testing.assert_array_equal(sign[:10], -1)
    np.testing.assert_array_equal(sign[[10, 15]], 0)
    np.testing.assert_array_equal(sign[11:15], 1)
    np.testing.assert_array_equal(sign[16:], -1)
    np.testing.assert_allclose(
        np.linalg.norm(step, axis=-1), 2 * np.sin(0.05), atol=1e-5
    )


def test_extension_holds_the_facing():
    angles = np.linspace(-1.0, 1.0, 6)
    given = path(np.zeros((6, 2)), angles)
    held = trajectory.extend(given, 4, reuse=4)
    np.testing.assert_allclose(held.facing[6:], directions([1.0] * 4), atol=1e-6)


def test_extension_refuses_impossible_lengths():
    given = path(np.zeros((5, 2)))
    with pytest.raises(ValueError, match=r"reuse is 5, expected 1\.\.4"):
        trajectory.extend(given, 3, reuse=5)
    with pytest.raises(ValueError, match="num_frames is -1"):
        trajectory.extend(given, -1, reuse=2)


# --- blending --------------------------------------------------------------------


def test_blend_weights_are_those_published():
    zero, one = path(np.zeros((45, 2)), np.zeros(45)), path(np.ones((45, 2)))
    got = trajectory.blend(zero, one, bias_position=0.7, bias_facing=2.2)
    at = [0, 4, 14, 29, 44]
    np.testing.assert_allclose(
        got.position[at, 0], [0.016, 0.079, 0.247, 0.537, 1.0], atol=5.1e-4
    )
    got = trajectory.blend(zero, one, bias_position=2.2, bias_facing=2.2)
    np.testing.assert_allclose(
        got.position[at, 0], [0.048, 0.228, 0.590, 0.911, 1.0], atol=5.1e-4
    )


def test_blended_facing_is_unit_and_between():
    left, right = (path(np.zeros((9, 2)), np.full(9, a)) for a in (3.0, -2.8))
    got = trajectory.blend(left, right, bias_position=1.0, bias_facing=1.0)
    np.testing.assert_allclose(np.linalg.norm(got.facing, axis=-1), 1.0, atol=1e-6)
    turned = oracle.wrap(oracle.yaw(np.asarray(got.facing)) - 3.0)
    assert np.all(np.diff(turned) > 0) and turned[0] > 0
    np.testing.assert_allclose(turned[-1], 2 * np.pi - 5.8, atol=1e-6)


def test_blend_of_opposite_facings_and_its_gradient_are_finite():
    ahead, back = (path(np.zeros((4, 2)), np.full(4, a)) for a in (0.0, np.pi))

    def total(bias, facing):
        given = Trajectory(position=ahead.position, facing=facing)
        out = trajectory.blend(given, back, bias_position=bias, bias_facing=bias)
        return jnp.sum(out.facing[..., 0] + out.position[..., 0])

    # Bias 1 and frame 2 of 4: half and half, so the sum is zero.
    value, grads = jax.value_and_grad(total, (0, 1))(jnp.float32(1), ahead.facing)
    assert np.isfinite(value) and all(np.isfinite(g).all() for g in grads)


# --- frames ----------------------------------------------------------------------


def test_frames_are_rigid_and_invert():
    angles = np.tile(np.linspace(-3, 3, 7), (4, 1))
    given = path(np.random.default_rng(2).normal(size=(4, 7, 2)), angles)
    yaw = np.array([0.3, -2.0, 3.1, 1.5])
    frame = PlanarFrame(
        origin=jnp.asarray(np.arange(8.0).reshape(4, 2), jnp.float32),
        facing=jnp.asarray(directions(yaw)),
    )
    local = trajectory.to_local(given, frame)
    # SciPy's rotation about +y is the oracle for the sense of the turn.
    turn = Rotation.from_rotvec(np.outer(yaw, [0, 1, 0])).inv()
    for b in range(4):
        moved = np.asarray(given.position)[b] - np.asarray(frame.origin)[b]
        world = np.stack([moved[:, 0], np.zeros(7), moved[:, 1]], -1)
        np.testing.assert_allclose(
            local.position[b], turn[b].apply(world)[:, ::2], atol=1e-5
        )
        world = np.asarray(given.facing)[b] @ np.array([[1.0, 0, 0], [0, 0, 1.0]])
        np.testing.assert_allclose(
            local.facing[b], turn[b].apply(world)[:, ::2], atol=1e-6
        )
    own = Trajectory(position=frame.origin[:, None], facing=frame.facing[:, None])
    seen = trajectory.to_local(own, frame)
    np.testing.assert_allclose(seen.position, 0.0, atol=1e-6)
    np.testing.assert_allclose(seen.facing[:, 0], [[0, 1]] * 4, atol=1e-6)


# --- facing of a body ------------------------------------------------------------


def test_root_trajectory_is_that_of_full_kinematics():
    skeleton = biped(("Root", "Hips", "UpperLeg_L", "UpperLeg_R"))
    key_p, key_r = jax.random.split(jax.random.key(1))
    rot6d = jax.random.normal(key_r, (2, 5, 4, 6))
    motion = Motion(
        root_position=jax.random.normal(key_p, (2, 5, 3)), joint_rotation=rot6d
    )
    got = trajectory.root_trajectory(skeleton, motion)
    joints = np.asarray(tiny.positions(skeleton, motion))
    forward = np.cross(joints[..., 2, :] - joints[..., 3, :], [0, 1, 0])[..., ::2]
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    np.testing.assert_allclose(got.facing, forward, atol=1e-5)
    np.testing.assert_array_equal(got.position, motion.root_position[..., ::2])


def test_everything_is_finite_at_zero_vectors():
    zero = jnp.zeros(2)

    def total(facing, velocity, across):
        frame = PlanarFrame(origin=zero, facing=facing)
        command = Command(velocity=velocity, facing=facing, label=jnp.int32(0))
        plan = trajectory.desired_trajectory(
            frame, velocity, command, num_frames=3, fps=30.0
        )
        longer = trajectory.extend(plan, 2, reuse=2)
        front = facing_module.facing_from_across(across)
        return jnp.sum(longer.position) + jnp.sum(longer.facing) + jnp.sum(front)

    value, grads = jax.value_and_grad(total, (0, 1, 2))(zero, zero, jnp.zeros(3))
    assert np.isfinite(value) and all(np.isfinite(g).all() for g in grads)


def swaying_course():
    """Two seconds of a turning walk with a step's sway and swinging facings."""
    t = np.linspace(0.0, 2.0, 55)
    sway = 0.03 * np.sin(2 * np.pi * t)
    angle = 0.8 * t + 0.1 * np.sin(2 * np.pi * t)
    return trajectory.Trajectory(
        position=jnp.asarray(np.stack([0.4 * t**2 + sway, 1.2 * t], -1), jnp.float32),
        facing=jnp.asarray(np.stack([np.sin(angle), np.cos(angle)], -1), jnp.float32),
    )


def test_cubic_wishes_are_least_squares():
    course = swaying_course()
    found = trajectory.smooth_course(jax.random.key(0), course, last=9, cubic=1.0)
    t = np.arange(55.0)

    def fitted(values):
        return np.stack([np.polyval(np.polyfit(t, x, 3), t) for x in values.T], -1)

    path = fitted(np.float64(course.position))
    path += np.float64(course.position)[9] - path[9]
    np.testing.assert_allclose(found.position, path, atol=1e-4)
    facing = fitted(np.float64(course.facing))
    facing /= np.linalg.norm(facing, axis=-1, keepdims=True)
    np.testing.assert_allclose(found.facing, facing, atol=1e-4)


def test_so_many_wishes_are_cubic_and_others_as_published():
    course, keys = swaying_course(), jax.random.split(jax.random.key(1), 400)

    def wishes(cubic):
        make = lambda k: trajectory.smooth_course(k, course, last=9, cubic=cubic)  # noqa: E731
        return jax.jit(jax.vmap(make))(keys)

    published, some, every = wishes(0.0), wishes(0.3), wishes(1.0)
    cubic_path = np.isclose(some.position, every.position).all((1, 2))
    for name in ("position", "facing"):
        given, other, fit = (
            np.asarray(getattr(x, name)) for x in (some, published, every)
        )
        same, cubic = (np.isclose(given, x).all((1, 2)) for x in (other, fit))
        assert (same ^ cubic).all()
        assert abs(cubic.mean() - 0.3) < 0.08  # 3.5 deviations of a share of 400
    # Which wishes are cubic says nothing of how the others are smoothed.
    raw = np.isclose(published.position, course.position, atol=1e-6).all((1, 2))
    assert abs(raw[~cubic_path].mean() - 0.5) < 0.11  # 3.5 deviations of 280


def test_who_wants_less_than_two_centimeters_a_second_stands():
    speeds = np.array([0.0, 0.019, 0.021, 0.1], np.float32)
    turned = np.stack([0.6 * speeds, -0.8 * speeds], axis=-1)
    still = trajectory.is_still(jnp.asarray(turned))
    np.testing.assert_array_equal(still, [True, True, False, False])
