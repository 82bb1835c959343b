import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import alignment


def directions(angles):
    angles = np.asarray(angles, np.float64)
    return jnp.asarray(np.stack([np.sin(angles), np.cos(angles)], -1), jnp.float32)


def test_heading_error_wraps():
    want = directions([3.1, -3.1, 0.0, 1.0])
    got = directions([-3.1, 3.1, 0.5, 0.2])
    gap = 2 * np.pi - 6.2
    np.testing.assert_allclose(
        alignment.heading_error(want, 3 * got), [gap, -gap, 0.5, -0.8], atol=1e-5
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
