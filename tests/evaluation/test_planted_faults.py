"""Faults of known size, planted in the motion of a skeleton, are measured at that size.

Unlike the tests of single metrics these go through rotations and forward kinematics, as
rollouts do.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import health, locomotion, plausibility
from jaxmotion.motion import skeleton
from tests import tiny

FPS, FRAMES = 30.0, 91
TIME = np.arange(FRAMES) / FPS
BONES = tiny.skeleton()
ALONG = np.array([0.6, 0.0, 0.8])
AHEAD = np.array([0.0, 0.0, 1.0])


def body(path, yaw=0.0):
    """Upright with the toes on the ground where the path has y = 0; meters, radians."""
    path = np.asarray(path, np.float64) + np.array([0.0, 0.9, 0.0])
    angle = np.broadcast_to(yaw, len(path))
    zero = 0 * angle
    turn = np.stack([np.cos(angle), zero, -np.sin(angle), zero, zero + 1, zero], -1)
    still = np.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    rotation = np.tile(still, (len(path), len(tiny.NAMES), 1))
    rotation[:, 0] = turn
    return skeleton.Motion(
        root_position=jnp.asarray(path, jnp.float32),
        joint_rotation=jnp.asarray(rotation, jnp.float32),
        fps=FPS,
    )


def toward(angle, speed=1.0):
    """Ground directions (x, z) of one angle a frame, or the same for all."""
    angle = np.broadcast_to(angle, FRAMES)
    found = speed * np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    return jnp.asarray(found, jnp.float32)


run = jax.jit(functools.partial(locomotion.locomotion_metrics, contact_height=0.01))


def measure(motion, velocity=None, facing=None):
    """Metrics of one window."""
    wanted = [toward(0.0) if x is None else x for x in (velocity, facing)]
    given = jax.tree.map(lambda x: x[None], (motion, *wanted))
    return {name: float(value[0]) for name, value in run(BONES, *given).items()}


def toes(motion):
    positions = tiny.positions(BONES, motion)
    return positions, positions[:, jnp.array(BONES.feet)]


@pytest.mark.parametrize("slide", [2.0, 5.0, 60.0])
def test_a_foot_slide_in_centimeters_a_second(slide):
    motion = body(slide / 100 * TIME[:, None] * ALONG, yaw=0.4)
    found = measure(motion)
    assert 100 * found["slide_speed"] == pytest.approx(slide, rel=1e-3)
    assert found["slide_seconds"] == pytest.approx(2 * 3.0, rel=1e-5)
    assert found["skate_ratio"] == (slide > 50)
    skated = float(plausibility.skating(toes(motion)[1]))
    assert skated == pytest.approx(10 * slide / FPS, rel=1e-3)


def test_a_body_that_is_lifted_does_not_slide():
    """Slides at 40 cm/s for a third of the time, and is carried 10 cm high then."""
    path = 0.4 * TIME[:, None] * ALONG
    path[30:, 1] = 0.1
    found = measure(body(path))
    assert 100 * found["slide_speed"] == pytest.approx(40.0, rel=1e-3)
    assert found["slide_seconds"] == pytest.approx(2 * 1.0, rel=1e-5)


@pytest.mark.parametrize("jerk", [20.0, 300.0])
def test_a_jerk(jerk):
    """All joints of a body that is accelerated evenly more have that jerk."""
    found = measure(body(jerk / 6 * TIME[:, None] ** 3 * ALONG, yaw=1.0))
    assert found["jerk"] == pytest.approx(jerk, rel=0.02)
    mean = jerk * TIME[1:-1].mean()
    assert found["acceleration"] == pytest.approx(mean, rel=0.01)


@pytest.mark.parametrize("degrees", [12.0, -75.0, 170.0])
def test_an_error_of_heading(degrees):
    """Walks and faces along a yaw of 3 (near the seam), and was told another."""
    yaw, off = 3.0, np.deg2rad(degrees)
    walked = body(TIME[:, None] * np.array([np.sin(yaw), 0.0, np.cos(yaw)]), yaw=yaw)
    wanted = toward(yaw + off)
    found = measure(walked, wanted, wanted)
    assert np.rad2deg(found["trajectory_error"]) == pytest.approx(abs(degrees), abs=0.1)
    assert np.rad2deg(found["orientation_error"]) == pytest.approx(
        abs(degrees), abs=0.1
    )
    # To either side in turn it is as large.
    sides = toward(0.3 + off / 4 * (-1.0) ** np.arange(FRAMES))
    found = measure(body(TIME[:, None] * AHEAD, yaw=0.3), facing=sides)
    error = np.rad2deg(found["orientation_error"])
    assert error == pytest.approx(abs(degrees) / 4, abs=0.1)


@pytest.mark.parametrize("height", [-0.03, 0.08])
def test_a_height_in_millimeters(height):
    path = np.zeros((FRAMES, 3))
    path[:30, 1] = height
    positions, _ = toes(body(path))
    measures = plausibility.penetration, plausibility.floating
    mean = 1000 * abs(height) * 30 / FRAMES
    expected = [mean, 0.0] if height < 0 else [0.0, mean]
    found = [float(m(positions)) for m in measures]
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_rollouts_that_freeze_and_diverge_at_known_times():
    """Six rollouts of a minute: one is a statue from 24 s on, and one sinks at 40 s."""
    frames = 1800
    alive = np.asarray(tiny.positions(BONES, tiny.walk(frames, turn=0.1)))
    statue, sunk = alive.copy(), alive.copy()
    statue[720:] = statue[720]
    sunk[1200:, :, 1] -= 0.6
    positions = jnp.asarray(np.stack([alive, statue, alive, sunk, alive, alive]))
    wanted = jnp.broadcast_to(jnp.array([0.0, 1.0]), (6, frames, 2))
    frozen = health.frozen_frames(positions, wanted, fps=FPS)
    diverged = health.diverged_frames(positions, fps=FPS, min_root=0.45, max_root=1.4)
    np.testing.assert_array_equal(np.flatnonzero(frozen.any(-1)), [1])
    np.testing.assert_array_equal(np.flatnonzero(diverged.any(-1)), [3])
