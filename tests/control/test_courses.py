import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.control import courses
from jaxmotion.motion import trajectory

FPS = 30.0


def commands(name, seconds=60.0, **changes):
    options = dict(seconds=seconds, fps=FPS, speed=1.5, label=3) | changes
    found = courses.course_commands(name, **options)
    return np.asarray(found.velocity), np.asarray(found.facing), np.asarray(found.label)


def degrees(direction):
    """From +z toward +x, in (-180, 180]."""
    return np.rad2deg(np.arctan2(direction[..., 0], direction[..., 1]))


@pytest.mark.parametrize("name", courses.COURSES)
def test_one_command_a_tick_with_unit_facing_and_the_speed_asked_for(name):
    velocity, facing, label = commands(name)
    assert velocity.shape == facing.shape == (1800, 2)
    np.testing.assert_array_equal(label, 3)
    np.testing.assert_allclose(np.linalg.norm(facing, axis=-1), 1.0, atol=1e-6)
    speed = np.linalg.norm(velocity, axis=-1)
    assert np.all((np.abs(speed - 1.5) < 1e-5) | (speed == 0))
    np.testing.assert_allclose(facing[0], [0.0, 1.0], atol=1e-6)
    # Directions are turned in steps: most ticks repeat the command before.
    changes = np.any(np.diff(np.concatenate([velocity, facing], -1), axis=0) != 0, -1)
    assert changes.any() == (name not in ("straight", "stand"))
    assert np.diff(np.flatnonzero(changes)).min(initial=60) >= 15


@pytest.mark.parametrize("name", courses.COURSES)
def test_a_course_that_ends_begins_again(name):
    length = sum(segment[0] for segment in courses.COURSES[name]())
    velocity, facing, _ = commands(name, seconds=2 * length)
    ticks = round(length * FPS)
    np.testing.assert_array_equal(velocity[:ticks], velocity[ticks:])
    np.testing.assert_array_equal(facing[:ticks], facing[ticks:])


def test_forward_faces_where_it_travels_and_turns_a_full_circle():
    velocity, facing, _ = commands("forward", seconds=33.0)
    np.testing.assert_allclose(velocity, 1.5 * facing, atol=1e-6)
    turns = np.diff(np.unwrap(degrees(facing), period=360))
    turns = turns[np.abs(turns) > 1].round().tolist()
    assert turns[:5] == [45, 45, -90, -45, 90]
    assert turns[5:17] == [30] * 12
    assert turns[17:] == [-90, -45, 90]


def test_strafe_moves_to_all_eight_sides_of_a_fixed_facing():
    velocity, facing, _ = commands("strafe", seconds=30.0)
    fixed = slice(0, round(18 * FPS))
    np.testing.assert_allclose(degrees(facing[fixed]), 0.0, atol=1e-4)
    sides = set(degrees(velocity[fixed]).round().astype(int) % 360)
    assert sides == {0, 45, 90, 135, 180, 225, 270, 315}
    turning = np.unwrap(degrees(facing[fixed.stop :]), period=360)
    assert turning[-1] - turning[0] == pytest.approx(345.0, abs=1e-3)


def test_stop_and_go_stands_two_seconds_of_five():
    velocity, _, _ = commands("stop_and_go", seconds=20.0)
    stands = np.linalg.norm(velocity, axis=-1) == 0
    assert stands.mean() == pytest.approx(0.4)
    assert not stands[: 3 * 30].any() and stands[3 * 30 : 5 * 30].all()


def test_straight_and_stand_are_one_command():
    velocity, facing, _ = commands("straight")
    np.testing.assert_array_equal(velocity, np.broadcast_to([0, 1.5], (1800, 2)))
    np.testing.assert_array_equal(facing, np.broadcast_to([0, 1.0], (1800, 2)))
    assert not commands("stand")[0].any()


def test_figure_eight_is_a_circle_to_either_side():
    velocity, facing, _ = commands("figure_eight", seconds=15.0)
    np.testing.assert_allclose(velocity, 1.5 * facing, atol=1e-6)
    path = np.cumsum(velocity, axis=0) / FPS
    half = len(path) // 2
    # Both circles close where they began; one lies to either side.
    assert np.linalg.norm(path[[half - 1, -1]], axis=-1).max() < 0.1
    assert path[:half, 0].min() > -0.1 and path[:half, 0].max() > 3.0
    assert path[half:, 0].max() < 0.8 and path[half:, 0].min() < -2.0


def test_turn_around_goes_back_the_way_it_came():
    velocity, facing, _ = commands("turn_around", seconds=8.0)
    np.testing.assert_allclose(velocity, 1.5 * facing, atol=1e-6)
    assert set(np.abs(degrees(facing)).round().astype(int)) == {0, 180}
    np.testing.assert_allclose(velocity.sum(axis=0), 0.0, atol=1e-3)


def test_turn_on_the_spot_turns_a_full_circle_to_either_side():
    velocity, facing, _ = commands("turn_on_the_spot", seconds=16.0)
    assert not velocity.any()
    turned = np.unwrap(degrees(facing), period=360)
    assert turned.max() == pytest.approx(360) and turned.min() == pytest.approx(0)


def test_a_batch_has_each_ones_label_and_speed():
    labels, speeds = [0, 1, 1, 0], [0.5, 1.0, 1.5, 0.0]
    options = dict(seconds=4.0, fps=FPS)
    found = courses.course_batch("strafe", labels, speeds, **options)
    for i, (label, speed) in enumerate(zip(labels, speeds, strict=True)):
        one = courses.course_commands("strafe", speed=speed, label=label, **options)
        np.testing.assert_array_equal(found.velocity[i], one.velocity)
        np.testing.assert_array_equal(found.facing[i], one.facing)
        np.testing.assert_array_equal(found.label[i], one.label)
    with pytest.raises(ValueError, match="unknown course 'waltz'"):
        courses.course_batch("waltz", labels, speeds, **options)


@pytest.mark.parametrize(
    "bad, message",
    [
        (dict(name="waltz"), "'waltz': there are straight, stand, forward"),
        (dict(seconds=0.0), "0.0 s"),
        (dict(seconds=float("nan")), "nan s"),
        (dict(fps=-30.0), "-30.0 ticks"),
        (dict(speed=-1.0), "-1.0 m/s"),
        (dict(label=-1), "label is -1"),
    ],
)
def test_bad_arguments_are_named(bad, message):
    with pytest.raises(ValueError, match=message):
        commands(**(dict(name="forward") | bad))


@pytest.mark.parametrize("tenths", [1, 2, 7, 13])
def test_segments_change_in_the_tick_in_which_they_end(tenths):
    """At 30 per second, whatever sums of tenths of a second come to in floats."""
    segments = [(tenths / 10, 90.0 * (i % 2), 0.0, 1.0, i % 2) for i in range(10)]
    found = courses.segment_commands(segments, seconds=3.0 * tenths, fps=30.0)
    expected = np.repeat(np.arange(30) % 2, 3 * tenths)
    np.testing.assert_array_equal(found.label, expected)


def test_the_path_is_the_integral_of_the_velocity():
    time = np.arange(1, 91) / FPS
    velocity = np.stack([np.cos(time), np.sin(time)], axis=-1).astype(np.float32)
    found = trajectory.integrate_path(jnp.stack([velocity, 2 * velocity]), FPS)
    exact = np.stack([np.sin(time), 1 - np.cos(time)], axis=-1)
    # A sum of right ends is off by half a step at most.
    np.testing.assert_allclose(found[0], exact, atol=0.5 / FPS * 2)
    np.testing.assert_allclose(found[1], 2 * np.asarray(found[0]), rtol=1e-5)
    np.testing.assert_allclose(found[0, 0], velocity[0] / FPS, rtol=1e-6)
