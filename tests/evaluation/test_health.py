"""A walker that lives, one that freezes, one that glides, and some that explode."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import health
from tests import tiny

FPS, FRAMES = 30.0, 300
BOUNDS = dict(fps=FPS, min_root=0.45, max_root=1.4)


@pytest.fixture(scope="module")
def alive():
    motion = tiny.walk(FRAMES, speed=1.0, turn=0.3)
    return np.asarray(tiny.positions(tiny.skeleton(), motion))


def told(speed=1.0):
    return jnp.full((FRAMES, 2), speed / np.sqrt(2))


def held(positions, start, end):
    """The pose of frame `start` until `end`, then the motion goes on from there."""
    keep = np.concatenate([np.arange(start), np.full(end - start, start)])
    rest = np.arange(start, FRAMES - (end - start))
    return positions[np.concatenate([keep, rest])]


def gliding(positions, start, end):
    """As `held`, but the statue goes on with the root."""
    local = held(positions - positions[:, :1], start, end)
    return local + positions[:, :1]


def diverged(positions):
    return bool(health.has_diverged(jnp.asarray(positions), **BOUNDS))


def frozen(positions, speed=1.0, **options):
    found = health.is_frozen(jnp.asarray(positions), told(speed), fps=FPS, **options)
    return bool(found)


def test_a_walker_is_healthy(alive):
    assert not diverged(alive)
    assert not frozen(alive)


@pytest.mark.parametrize("still", [held, gliding])
@pytest.mark.parametrize("start", [0, 45, 100, 170])
def test_four_seconds_of_standing_are_found_wherever_they_are(alive, still, start):
    assert frozen(still(alive, start, start + 125))


@pytest.mark.parametrize("still", [held, gliding])
def test_a_second_of_standing_is_not_yet_frozen(alive, still):
    assert not frozen(still(alive, 100, 130))
    assert frozen(still(alive, 100, 150), seconds=0.5)


def test_nobody_is_frozen_who_was_told_to_stand(alive):
    still = held(alive, 50, 250)
    assert not frozen(still, speed=0.0)
    assert not frozen(still, speed=0.29)
    assert frozen(still, speed=0.31)


def test_nobody_is_frozen_who_was_told_to_stand_for_a_part_of_a_window(alive):
    goes = (np.arange(FRAMES) // 30 % 2)[:, None]  # every other second
    still = jnp.asarray(held(alive, 0, 290))
    assert bool(health.is_frozen(still, told(), fps=FPS))
    assert not bool(health.is_frozen(still, told() * goes, fps=FPS))
    assert bool(health.is_frozen(still, told() * goes, fps=FPS, seconds=1.0))


def test_breathing_does_not_save_a_statue_but_walking_slowly_does(alive):
    wave = 0.02 * np.sin(np.arange(FRAMES) / FPS)[:, None, None]
    assert frozen(held(alive, 0, 250) + wave * (np.arange(5) > 0)[:, None])
    slow = tiny.walk(FRAMES, speed=0.3)
    assert not frozen(tiny.positions(tiny.skeleton(), slow))


def test_too_short_to_be_frozen_or_to_have_a_window(alive):
    still = np.repeat(alive[:1], FRAMES, axis=0)
    short = health.is_frozen(jnp.asarray(still[:50]), told()[:50], fps=FPS)
    assert not bool(short)
    with pytest.raises(ValueError, match="have no frame"):
        frozen(still, seconds=0.01)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_one_number_that_is_not_finite_is_divergence(alive, bad):
    broken = alive.copy()
    broken[123, 3, 1] = bad
    assert diverged(broken)


@pytest.mark.parametrize("height, expected", [(0.44, True), (0.46, False)])
def test_a_root_that_sinks_has_diverged(alive, height, expected):
    low = alive.copy()
    low[:, :, 1] += height - alive[:, 0, 1].min()
    assert diverged(low) == expected


@pytest.mark.parametrize("speed, expected", [(19.5, False), (20.5, True)])
def test_a_joint_that_flies_has_diverged(alive, speed, expected):
    still = np.repeat(alive[:1], FRAMES, axis=0).copy()
    still[200:, 2, 0] += speed / FPS
    assert diverged(still) == expected


def test_a_batch_is_checked_one_by_one(alive):
    broken = alive.copy()
    broken[7] = np.nan
    batch = jnp.asarray(np.stack([alive, broken, held(alive, 0, 200)]))
    found = health.has_diverged(batch, **BOUNDS)
    np.testing.assert_array_equal(found, [False, True, False])
    found = health.is_frozen(batch, jnp.broadcast_to(told(), (3, FRAMES, 2)), fps=FPS)
    np.testing.assert_array_equal(found, [False, False, True])


def test_frames_say_where_a_rollout_fails(alive):
    broken = alive.copy()
    broken[50, 1, 0] += 0.8  # there and back faster than the bound
    broken[200:, :, 1] -= 0.6
    broken[120, 4, 2] = np.nan
    found = health.diverged_frames(jnp.asarray(broken), **BOUNDS)
    expected = np.zeros(FRAMES, bool)
    expected[[50, 51, 120, 121]] = True
    expected[200:] = True
    np.testing.assert_array_equal(found, expected)
    still = held(alive, 100, 200)
    found = health.frozen_frames(jnp.asarray(still), told(), fps=FPS)
    # Windows of 60 frames: the statue fills the third alone.
    np.testing.assert_array_equal(np.flatnonzero(found), np.arange(120, 180))
