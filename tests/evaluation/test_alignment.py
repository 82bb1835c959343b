import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import alignment
from jaxmotion.motion import spring
from jaxmotion.motion.ground import angle_from_to


def directions(angles):
    angles = np.asarray(angles, np.float64)
    return jnp.asarray(np.stack([np.sin(angles), np.cos(angles)], -1), jnp.float32)


def test_heading_error_wraps():
    want = directions([3.1, -3.1, 0.0, 1.0])
    got = directions([-3.1, 3.1, 0.5, 0.2])
    gap = 2 * np.pi - 6.2
    np.testing.assert_allclose(
        angle_from_to(want, 3 * got), [gap, -gap, 0.5, -0.8], atol=1e-5
    )


def test_trajectory_error_of_a_known_path():
    # Walks at 1 m/s toward yaw -3.1, wanted 3.1; then stands; then is not wanted.
    fps, yaw = 30.0, -3.1
    speed = np.array([1.0] * 10 + [0.0] * 5 + [1.0] * 5 + [0.0])
    step = np.outer(speed, [np.sin(yaw), np.cos(yaw)]) / fps
    position = np.concatenate([[[0, 0]], np.cumsum(step, 0)])[:21]
    wanted = np.asarray(directions(np.full(21, 3.1))).copy()
    wanted[15:] = 0.0
    got = alignment.trajectory_error(
        jnp.asarray(wanted), jnp.asarray(position, jnp.float32), fps
    )
    np.testing.assert_allclose(got.error, 2 * np.pi - 6.2, atol=1e-4)
    np.testing.assert_allclose(got.used, 10 / 20)


def test_trajectory_error_of_a_character_at_rest_uses_nothing():
    got = alignment.trajectory_error(directions(np.zeros(5)), jnp.zeros((5, 2)), 30.0)
    np.testing.assert_array_equal(got, (0.0, 0.0))


def test_left_and_right_do_not_cancel():
    wanted = directions(np.zeros(10))
    facing = directions([0.5, -0.5] * 5)
    np.testing.assert_allclose(
        alignment.orientation_error(wanted, facing), 0.5, atol=1e-6
    )


def test_one_frame_is_refused():
    with pytest.raises(ValueError, match="expected at least 2"):
        alignment.trajectory_error(jnp.zeros((1, 2)), jnp.zeros((1, 2)), 30.0)


def test_the_commanded_path_is_where_the_springs_are():
    """A start, a stop and a turn, integrated from the velocity at each frame's end."""
    goals = np.repeat([[0.0, 1.4], [0.0, 0.0], [1.4, 0.0]], 60, axis=0)
    x = v = a = jnp.zeros(2)
    places, velocities = [], []
    for goal in jnp.asarray(goals, jnp.float32):
        x, v, a = spring.velocity_spring(x, v, a, goal, half_life=0.27, dt=1 / 30)
        places.append(x)
        velocities.append(v)
    found = alignment.commanded_path(jnp.stack(velocities), 30.0)
    np.testing.assert_allclose(found, jnp.stack(places), atol=2e-3)
    # Who goes on at one speed has gone a step after the first frame.
    steady = alignment.commanded_path(jnp.full((9, 2), 1.4), 30.0)
    line = np.arange(1, 10)[:, None] * [1.4, 1.4] / 30.0
    np.testing.assert_allclose(steady, line, rtol=1e-5)


def test_sway_does_not_count_but_a_side_step_and_a_lag_do():
    """Half a second of sway around a point 10 cm beside and 20 cm behind."""
    frame = np.arange(60)
    wanted = np.stack([0 * frame, frame / 30.0], axis=-1)
    sway = 0.03 * np.sin(2 * np.pi * frame / 17)  # the mean is of 17 frames
    path = wanted + np.array([0.1, -0.2]) + np.stack([sway, 0 * sway], axis=-1)
    both = (jnp.asarray(x, jnp.float32) for x in (path, wanted))
    found = alignment.path_offset(*both, reach=8)
    expected = np.broadcast_to([0.1, -0.2], (44, 2))
    np.testing.assert_allclose(found[8:-8], expected, atol=1e-5)
    assert found.shape == (60, 2)


def test_steady_speed_is_a_straight_walks_speed_to_its_ends():
    frame = np.arange(30)
    path = np.stack([0 * frame, frame * 1.2 / 30], axis=-1)
    stands = np.concatenate([path, np.repeat(path[-1:], 30, axis=0)])
    found = alignment.steady_speed(jnp.asarray(stands, jnp.float32), 30.0, reach=8)
    np.testing.assert_allclose(found[:21], 1.2, rtol=1e-4)
    # Halfway between walking and standing at the stop itself.
    np.testing.assert_allclose(found[29], 0.6, rtol=1e-4)
    np.testing.assert_allclose(found[38:], 0.0, atol=1e-5)


def test_creep_is_the_mean_over_parts_of_the_farthest_place():
    away = np.array([0, 1, 5, 2, 2, 2, 3, 2, 9])  # two parts of four, and a rest
    path = jnp.asarray(np.stack([away, 0 * away], axis=-1), jnp.float32)
    assert alignment.creep(path, length=4) == pytest.approx((5 + 1) / 2)
    with pytest.raises(ValueError, match="9 frames, expected 10 or more"):
        alignment.creep(path, length=10)


def test_reactions_are_timed_from_their_command():
    reached = np.zeros((2, 40), bool)
    reached[0, [3, 12, 13, 35]] = True
    reached[1, 25:] = True
    found = alignment.reaction(reached, [10, 20], [20, 30], 10.0)
    np.testing.assert_allclose(found.seconds, [[0.3, 1.0], [1.0, 0.6]])
    np.testing.assert_array_equal(found.obeyed, [[True, False], [False, True]])
