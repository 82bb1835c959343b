"""The metrics of a walker whose contacts, path and facing are known."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import gaits, procedural
from jaxmotion.evaluation import locomotion
from jaxmotion.motion import skeleton, trajectory

FRAMES, WINDOW, FPS, SPEED = 300, 60, 30.0, 1.2
BONES = procedural.walker_skeleton()
HEIGHT = procedural.TOE_HEIGHT + 0.0005


def windows(x):
    x = x[60:]
    return x.reshape(len(x) // WINDOW, WINDOW, *x.shape[1:])


@functools.cache
def walker():
    """Straight along +z, facing so; the first two seconds are left out."""
    ahead = jnp.tile(jnp.array([[0.0, 1.0]]), (FRAMES, 1))
    commands = procedural.Command(
        velocity=SPEED * ahead, facing=ahead, label=jnp.zeros(FRAMES, jnp.int32)
    )
    motion = procedural.walk(commands, gaits.GAITS["neutral"], seed=4).motion
    motion = jax.tree.map(windows, motion)
    return motion, windows(commands.velocity), windows(commands.facing)


run = jax.jit(functools.partial(locomotion.locomotion_metrics, contact_height=HEIGHT))


def measure(motion=None, velocity=None, facing=None):
    """As NumPy arrays, one value a window."""
    given = (motion, velocity, facing)
    pairs = zip(given, walker(), strict=True)
    chosen = [known if value is None else value for value, known in pairs]
    return jax.tree.map(np.asarray, run(BONES, *chosen))


def carried(speed):
    """The walker on a conveyor belt that runs along +z."""
    motion = walker()[0]
    time = jnp.arange(WINDOW)[None, :, None] / FPS
    shift = time * jnp.array([[[0.0, 0.0, speed]]])
    return dataclasses.replace(motion, root_position=motion.root_position + shift)


def test_planted_feet_do_not_slide():
    found = measure()
    np.testing.assert_array_equal(found["skate_ratio"], 0.0)
    # What is left is the first frame of each swing, which starts on the ground.
    assert found["slide_speed"].max() < 0.06
    # Each foot stands a bit more than half of the time.
    assert 1.0 < found["slide_seconds"].min() and found["slide_seconds"].max() < 3.0


def test_carried_feet_slide_as_fast_as_they_are_carried():
    at_rest = measure()["slide_speed"]
    np.testing.assert_allclose(measure(carried(0.6))["slide_speed"], 0.6, atol=0.05)
    assert measure(carried(0.6))["skate_ratio"].min() > 0.9
    assert np.all(measure(carried(0.1))["slide_speed"] > at_rest + 0.04)


def test_who_goes_and_faces_where_it_should_has_a_small_error():
    found = measure()
    assert found["orientation_error"].max() < np.deg2rad(8)
    assert found["trajectory_error"].max() < np.deg2rad(15)
    np.testing.assert_array_equal(found["trajectory_used"], 1.0)


@pytest.mark.parametrize("angle", [0.5, -1.5, 3.0])
def test_turning_what_was_wanted_adds_its_angle(angle):
    turned = jnp.array([jnp.sin(angle), jnp.cos(angle)])
    shape = (4, WINDOW, 2)
    found = measure(
        velocity=jnp.broadcast_to(SPEED * turned, shape),
        facing=jnp.broadcast_to(turned, shape),
    )
    np.testing.assert_allclose(found["orientation_error"], abs(angle), atol=0.06)
    np.testing.assert_allclose(found["trajectory_error"], abs(angle), atol=0.15)


def test_directions_at_rest_do_not_count():
    found = measure(velocity=jnp.zeros((4, WINDOW, 2)))
    np.testing.assert_array_equal(found["trajectory_used"], 0.0)
    np.testing.assert_array_equal(found["trajectory_error"], 0.0)


def test_metrics_do_not_depend_on_where_it_walks_nor_in_which_direction():
    yaw = 2.1
    c, s = np.cos(yaw), np.sin(yaw)
    turn = jnp.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], jnp.float32)
    motion, velocity, facing = walker()
    rotated = motion.joint_rotation.reshape(*motion.joint_rotation.shape[:-1], 2, 3)
    rotated = rotated.at[:, :, 0].set(rotated[:, :, 0] @ turn.T)
    moved = skeleton.Motion(
        root_position=motion.root_position @ turn.T + jnp.array([[[3.0, 0.0, -2.0]]]),
        joint_rotation=rotated.reshape(motion.joint_rotation.shape),
        fps=FPS,
    )
    flat = turn[::2, ::2]
    found = measure(moved, velocity @ flat.T, facing @ flat.T)
    for name, expected in measure().items():
        np.testing.assert_allclose(
            found[name], expected, rtol=2e-2, atol=2e-3, err_msg=name
        )


def test_shaking_shows_in_acceleration_and_jerk():
    motion = walker()[0]
    shake = 0.002 * (-1.0) ** jnp.arange(WINDOW)[None, :, None] * jnp.ones((1, 1, 3))
    shaken = dataclasses.replace(motion, root_position=motion.root_position + shake)
    calm, found = measure(), measure(shaken)
    # Second difference of a +-h zigzag is 4 h fps^2 on each axis.
    added = 4 * 0.002 * FPS**2 * np.sqrt(3)
    assert np.all(found["acceleration"] > 0.7 * added)
    assert np.all(found["jerk"] > 2 * calm["jerk"])


def test_every_metric_is_one_finite_number_a_window():
    for name, value in measure().items():
        assert value.shape == (4,), name
        assert np.isfinite(value).all(), name


def test_smoothing_is_a_product_with_the_matrix():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(3, 5, 2)).astype(np.float32)
    matrix = rng.normal(size=(5, 5)).astype(np.float32)
    found = trajectory.smooth(jnp.asarray(x), jnp.asarray(matrix))
    expected = np.stack([matrix.astype(float) @ part for part in x])
    np.testing.assert_allclose(found, expected, atol=1e-5)
