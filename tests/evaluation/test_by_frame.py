"""Roughness by place: planted jumps show where they were planted, and only there."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np

from jaxmotion.evaluation import by_frame, smoothness
from jaxmotion.motion.skeleton import Motion
from tests import tiny


def still(frames):
    motion = tiny.walk(1)
    return Motion(
        root_position=jnp.repeat(motion.root_position, frames, axis=0),
        joint_rotation=jnp.repeat(motion.joint_rotation, frames, axis=0),
        fps=30.0,
    )


def test_frames_since_the_last_plan():
    planned = jnp.array([[0, 1, 0, 0, 1, 0], [1, 0, 0, 0, 0, 0]], bool)
    expected = [[-1, 0, 1, 2, 0, 1], [0, 1, 2, 3, 4, 5]]
    np.testing.assert_array_equal(by_frame.frames_since(planned), expected)


def test_what_is_left_out_may_be_no_number():
    values, place = jnp.array([jnp.nan, 2.0, 4.0, jnp.inf]), jnp.array([-1, 0, 0, 3])
    sums = by_frame.place_sums(values, place, num_places=2)
    np.testing.assert_array_equal(sums, [[6.0, 0.0], [2.0, 0.0]])


def test_a_jump_at_a_border_shows_in_three_frames(skeleton):
    """1 cm sideways between frames 4 and 5 of each ten: jerk 1:2:1, slide in one."""
    motion = still(40)
    hops = jnp.asarray((np.arange(40) + 5) // 10 * 0.01, jnp.float32)
    motion = dataclasses.replace(
        motion, root_position=motion.root_position.at[:, 0].add(hops)
    )
    found = by_frame.by_frame(
        tiny.positions(skeleton, motion),
        skeleton.feet,
        jnp.arange(40) % 10,
        30.0,
        num_places=10,
        contact_height=1.0,
    )
    jerk = np.zeros(10)
    jerk[5:8] = np.array([1, 2, 1]) * 0.01 * 30**3
    np.testing.assert_allclose(found["jerk"], jerk, rtol=1e-3, atol=1.0)
    slide = np.zeros(10)
    slide[5] = 0.01 * 30
    np.testing.assert_allclose(found["foot_slide"], slide, atol=1e-4)


def test_the_mean_over_places_is_the_metric(skeleton):
    motion = tiny.walk(33, turn=0.5)
    positions = tiny.positions(skeleton, motion)
    found = by_frame.by_frame(
        positions,
        skeleton.feet,
        jnp.zeros(33, jnp.int32),
        30.0,
        num_places=2,
        contact_height=0.0,
    )
    np.testing.assert_allclose(
        found["jerk"][0], smoothness.jerk(positions, 30.0), rtol=1e-5
    )
    # No frame stands at place 1, and no toe is ever below zero.
    assert np.isnan(found["jerk"][1]) and np.isnan(found["foot_slide"]).all()
    text = by_frame.to_markdown({"row": found})
    assert "| row, jerk, m/s³ |" in text and "| – |" in text
    assert by_frame.to_json({"row": found})["row"]["jerk"][1] is None


def test_sums_of_parts_add_up_to_those_of_the_whole():
    generator = np.random.default_rng(0)
    values = jnp.asarray(generator.normal(size=(4, 20)), jnp.float32)
    weights = jnp.asarray(generator.random((4, 20)), jnp.float32)
    place = jnp.asarray(generator.integers(-1, 4, (4, 20)))
    sums = functools.partial(by_frame.place_sums, num_places=3)
    whole = sums(values, place, weights=weights)
    parts = [sums(values[i], place[i], weights=weights[i]) for i in range(4)]
    np.testing.assert_allclose(sum(parts), whole, rtol=1e-4, atol=1e-5)
    own = np.asarray(place) == 2
    expected = (np.asarray(values) * weights)[own].sum(), np.asarray(weights)[own].sum()
    np.testing.assert_allclose(whole[:, 2], expected, rtol=1e-4)
