import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import procedural, rolling
from jaxmotion.data.clips import take_clips
from jaxmotion.data.gaits import GAITS
from jaxmotion.motion.skeleton import Motion
from tests.data.test_procedural import fk

FRICTION = 0.8


def cases(count=200):
    """Displacements and times: about half of the balls stop on the way."""
    generator = np.random.default_rng(0)
    seconds = generator.uniform(0.2, 2.0, count)
    limit = FRICTION * seconds**2 / 2
    distance = limit * np.exp(generator.normal(0.0, 1.0, count))
    yaw = generator.uniform(-np.pi, np.pi, count)
    way = distance[:, None] * np.stack([np.sin(yaw), np.cos(yaw)], -1)
    return way, seconds, distance >= limit


def test_a_ball_moves_as_the_equation_of_friction_says():
    """Against the equation v' = -a, v >= 0, integrated in small steps."""
    way, seconds, _ = cases()
    distance = np.linalg.norm(way, axis=-1)
    steps = 4000
    dt = seconds / steps
    speed = rolling.start_speed(distance, seconds, FRICTION)
    path, v = [np.zeros_like(seconds)], speed
    for _ in range(steps):
        slower = np.maximum(v - FRICTION * dt, 0.0)
        path.append(path[-1] + dt * (v + slower) / 2)
        v = slower
    times = np.linspace(0.0, 1.0, 41) * seconds[:, None]
    found = rolling.roll(way, seconds, FRICTION, times)
    expected = np.stack(path[:: steps // 40], -1)
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), expected, atol=1e-6)
    # Straight on, and neither beside nor behind the line.
    np.testing.assert_allclose(
        found, expected[..., None] * (way / distance[:, None])[:, None], atol=1e-6
    )


def test_a_ball_is_where_it_should_be_in_time_and_lies_if_it_is_early():
    way, seconds, rolls = cases()
    times = np.stack([0 * seconds, 0.999 * seconds, seconds], -1)
    start, before, end = rolling.roll(way, seconds, FRICTION, times).swapaxes(0, 1)
    np.testing.assert_array_equal(start, 0.0)
    np.testing.assert_allclose(end, way, rtol=1e-12)
    lag = np.linalg.norm(way - before, axis=-1)
    assert rolls.any() and not rolls.all()
    assert (lag[rolls] > 1e-8).all()
    np.testing.assert_allclose(lag[~rolls & (lag < 1e-7)], 0.0, atol=1e-12)


def test_friction_takes_the_energy():
    way, seconds, rolls = cases()
    leaves, arrives = rolling.end_velocities(way, seconds, FRICTION)
    lost = (np.sum(leaves**2, -1) - np.sum(arrives**2, -1)) / 2
    np.testing.assert_allclose(lost, FRICTION * np.linalg.norm(way, axis=-1))
    assert (arrives[~rolls] == 0).all()
    # They are the slopes of the path at its ends.
    tiny = 1e-6
    times = np.stack([0 * seconds + tiny, seconds - tiny], -1)
    path = rolling.roll(way, seconds, FRICTION, times)
    np.testing.assert_allclose(path[:, 0] / tiny, leaves, atol=1e-5)
    np.testing.assert_allclose((way - path[:, 1]) / tiny, arrives, atol=1e-5)


def test_a_ball_that_goes_nowhere_lies():
    zero, one = np.zeros((1, 2)), np.ones(1)
    assert (rolling.roll(zero, one, FRICTION, np.ones((1, 3))) == 0).all()
    for velocity in rolling.end_velocities(zero, one, FRICTION):
        assert (velocity == 0).all()


def test_the_distance_to_a_leg_is_that_to_its_nearest_point():
    generator = np.random.default_rng(1)
    legs = generator.normal(size=(5, 3, 2, 3))
    legs[0, 0, 1] = legs[0, 0, 0]
    ball = 2 * generator.normal(size=(4, 5, 3))
    part = np.linspace(0.0, 1.0, 2001)[:, None]
    points = legs[..., :1, :] + part * (legs[..., 1:, :] - legs[..., :1, :])
    away = np.linalg.norm(points - ball[..., None, None, :], axis=-1)
    found = rolling.leg_distances(ball, legs)
    np.testing.assert_allclose(found, away.min(axis=(-1, -2)), atol=1e-3)


def test_one_foot_below_the_ground_does_not_lower_it():
    heights = np.full((200, 2), 0.04)
    heights[:, 1] = 0.3
    heights[3, 0] = -0.5
    standing = heights < 0.1
    assert rolling.ground_height(heights, standing) == pytest.approx(0.04)
    assert rolling.ground_height(heights, np.zeros_like(standing)) == 0.04


@pytest.fixture(scope="module")
def walks():
    return procedural.make_clips(
        seed=3, minutes=0.4, gaits={"neutral": GAITS["neutral"]}, clip_seconds=8.0
    )


def test_a_body_is_the_legs_of_its_clip(walks):
    found = rolling.bodies(walks, thickness=0.03)
    assert len(found) == walks.num_clips == 3
    a, b = 240, 480
    motion = Motion(
        root_position=walks.root_position[a:b], joint_rotation=walks.joint_rotation[a:b]
    )
    joints = fk(motion)
    body = found[1]
    assert abs(body.ground) < 1e-4
    named = [walks.skeleton.index(f"Left{name}") for name in ("ToeBase", "Foot", "Leg")]
    toe, ankle, knee = joints[:, named].swapaxes(0, 1)
    np.testing.assert_allclose(body.toes[:, 0], toe, atol=1e-6)
    np.testing.assert_allclose(body.legs[:, 0], np.stack([toe, ankle], 1), atol=1e-6)
    np.testing.assert_allclose(body.legs[:, 2], np.stack([ankle, knee], 1), atol=1e-6)
    np.testing.assert_allclose(body.root, joints[:, 0, ::2], atol=1e-6)
    middle = (toe[2:] - toe[:-2])[:, ::2] * 15
    np.testing.assert_allclose(body.velocity[1:-1, 0], middle, atol=1e-4)


def test_a_body_does_not_depend_on_the_other_clips(walks):
    alone = rolling.bodies(take_clips(walks, [1]), thickness=0.03)[0]
    among = rolling.bodies(walks, thickness=0.03)[1]
    for field in dataclasses.fields(rolling.Body):
        a, b = getattr(alone, field.name), getattr(among, field.name)
        np.testing.assert_allclose(a, b, atol=1e-4, err_msg=field.name)
    # The first clip ends elsewhere than the second begins: no foot flies between them.
    assert np.linalg.norm(among.velocity, axis=-1).max() < 10.0


def test_bad_clips_are_refused(walks):
    short = dataclasses.replace(walks, offsets=jnp.array([0, 1, 720]))
    with pytest.raises(ValueError, match="neutral_000 has one frame"):
        rolling.bodies(short, thickness=0.03)
    skeleton = dataclasses.replace(walks.skeleton, feet=())
    with pytest.raises(ValueError, match="'feet' of the skeleton is empty"):
        rolling.bodies(dataclasses.replace(walks, skeleton=skeleton), thickness=0.03)
