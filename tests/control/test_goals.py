"""Goals on the ground: closed forms, walkers who obey, and a shipped model."""

import dataclasses
import functools
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmotion as jm
from jaxmotion.control import goals
from jaxmotion.motion.trajectory import Command

FPS = 30.0


def walker(position, velocity=(0.0, 0.0), facing=(0.0, 1.0)):
    made = [jnp.asarray(x, jnp.float32) for x in (position, velocity, facing)]
    return goals.Walker(position=made[0], velocity=made[1], facing=made[2])


def walk(wish, start, seconds, *, memory=0.0):
    """Who obeys as a character does: velocities follow with a half-life of 0.15 s."""

    @jax.jit
    def step(now, tick):
        own, memory = now
        velocity, memory = wish(own, memory, tick / FPS)
        keep = 0.5 ** (1 / (0.15 * FPS))
        velocity = keep * own.velocity + (1 - keep) * velocity
        position = own.position + velocity / FPS
        own = dataclasses.replace(own, position=position, velocity=velocity)
        return (own, memory), (position, velocity)

    ticks = jnp.arange(round(seconds * FPS))
    return map(np.asarray, jax.lax.scan(step, (start, memory), ticks)[1])


@pytest.mark.slow
def test_a_path_that_crosses_itself_is_walked_to_its_end():
    turn = np.linspace(0, 2 * np.pi, 80)
    points = 3.0 * np.stack([np.sin(2 * turn), 2 * np.sin(turn)], axis=1)
    path = goals.Path(points=jnp.asarray(points, jnp.float32), speed=jnp.full(80, 1.4))
    wish = lambda own, way, _: goals.pursue(path, own, way)  # noqa: E731
    positions, velocities = walk(wish, walker(points[0]), 40.0)
    fine = np.linspace(0, 79, 8000)
    fine = np.stack([np.interp(fine, np.arange(80), x) for x in points.T], axis=1)
    away = np.linalg.norm(positions[:, None] - fine[None], axis=-1)
    assert away.min(axis=1).mean() < 0.05 and away.min(axis=1).max() < 0.2
    # Forward all the way, once.
    place = away.argmin(axis=1)[30:-60]
    assert np.quantile(np.diff(place), 0.02) >= -2 and place[-1] > 7500
    assert np.linalg.norm(positions[-1] - points[-1]) < 0.1
    speed = np.linalg.norm(velocities, axis=1)
    assert abs(np.median(speed[60:-120]) - 1.4) < 0.05 and speed[-1] < 0.05


@pytest.mark.parametrize("speed, near", [(0.8, 0.35), (1.4, 0.53)])
def test_a_path_that_goes_back_the_way_it_came_is_walked_to_its_turning_point(
    speed, near
):
    """Points of the way back are as near as those of the way there."""
    points = jnp.array([[0.0, 0.0], [0.0, 5.0], [0.0, 0.0]])
    path = goals.Path(points=points, speed=jnp.full(3, speed))
    wish = lambda own, way, _: goals.pursue(path, own, way)  # noqa: E731
    positions, _ = walk(wish, walker([0.0, 0.0]), 20.0)
    assert np.linalg.norm(positions - np.array([0.0, 5.0]), axis=1).min() < near
    assert np.linalg.norm(positions[-1]) < 0.1


@pytest.mark.parametrize(
    "ahead, meters", [(0.1, goals.NEAREST), (0.35, 0.7), (0.8, 1.6)]
)
def test_who_is_beside_a_path_heads_for_it_as_far_ahead_as_he_looks(ahead, meters):
    path = goals.Path(
        points=jnp.array([[0.0, 0.0], [0.0, 9.0]]), speed=jnp.full(2, 2.0)
    )
    pursue = jax.jit(functools.partial(goals.pursue, ahead=ahead))
    velocity, way = pursue(path, walker((0.5, 2.0)), jnp.float32(2.0))
    assert float(way) == pytest.approx(2.0)
    heading = np.array([-0.5, meters]) / np.hypot(0.5, meters)
    np.testing.assert_allclose(velocity, 2.0 * heading, atol=1e-5)


@pytest.mark.slow
def test_a_path_is_pursued_from_where_a_walker_comes_to():
    """As by one who stands where he will be when it shows."""
    path = goals.Path(
        points=jnp.array([[0.0, 0.0], [0.0, 9.0]]), speed=jnp.full(2, 1.0)
    )
    start, velocity = np.array([0.5, 2.0]), np.array([0.8, 1.2])
    then = walker(start + goals.LAG * velocity)
    found = goals.pursue(path, walker(start, velocity), jnp.float32(1.8))
    expected = goals.pursue(path, then, jnp.float32(1.8))
    np.testing.assert_allclose(found[0], expected[0], atol=1e-5)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-5)
    assert float(found[1]) == pytest.approx(2.0 + 1.2 * goals.LAG, abs=0.02)


@pytest.mark.parametrize("seconds", [4.0, 6.0, 12.0])
def test_a_place_is_reached_at_its_time(seconds):
    place = goals.Place(
        position=jnp.array([3.0, -4.0]),
        facing=jnp.array([1.0, 0.0]),
        seconds=jnp.float32(seconds),
    )
    wish = lambda own, memory, now: (goals.arrive(place, own, now)[0], memory)  # noqa: E731
    positions, velocities = walk(wish, walker((0.0, 0.0)), seconds + 2.0)
    away = np.linalg.norm(positions - np.array([3.0, -4.0]), axis=1)
    first = np.argmax(away < 0.15) / FPS
    assert abs(first - seconds) < 0.6 and away[-1] < 0.1
    speed = np.linalg.norm(velocities, axis=1)
    # Nobody creeps for twelve seconds: he waits, then walks.
    assert speed.max() > 0.9 * goals.SLOWEST and speed.max() <= goals.FASTEST
    end = walker(positions[-1], velocities[-1])
    _, facing = goals.arrive(place, end, jnp.float32(seconds + 2.0))
    np.testing.assert_allclose(facing, [1.0, 0.0], atol=1e-6)


@pytest.mark.parametrize("coast", [0.1, 0.4])
def test_a_place_is_approached_from_where_a_walker_comes_to(coast):
    """As by one who stands there."""
    velocity = np.array([0.9, -0.7])
    place = goals.Place(
        position=jnp.array([3.0, -4.0]),
        facing=jnp.array([1.0, 0.0]),
        seconds=jnp.float32(5.0),
    )
    now, then = walker((0.4, 1.0), velocity), walker((0.4, 1.0) + coast * velocity)
    found, _ = goals.arrive(place, now, jnp.float32(0.0), coast=coast)
    expected, _ = goals.arrive(place, then, jnp.float32(0.0))
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_nobody_who_moves_creeps_and_who_stands_too_far_off_starts_anew():
    def told(away, speed):
        place = goals.Place(
            position=jnp.array([away, 0.0]),
            facing=jnp.array([0.0, 1.0]),
            seconds=jnp.float32(0.0),
        )
        velocity = np.array([speed, 0.0])
        start = walker((0.0, 0.0), velocity, (0.0, 1.0))
        found = goals.arrive(place, start, jnp.float32(1.0), coast=0.0)
        return np.concatenate(found)

    np.testing.assert_allclose(told(0.1, 0.5), [goals.CREEP, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(told(0.04, 0.5), [0, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(told(0.09, 0.0), [0, 0, 0, 1], atol=1e-6)
    slow = 0.14 / goals.ARRIVE
    np.testing.assert_allclose(told(0.14, 0.0), [slow, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(told(0.22, 0.0), [goals.SLOWEST, 0, 1, 0], atol=1e-6)


@pytest.mark.parametrize("distance, speed", [(4.0, 1.2), (0.6, 1.2), (0.2, 0.7)])
def test_the_time_to_a_place_is_that_of_the_speeds_on_the_way(distance, speed):
    left = np.linspace(0.0, distance, 200_001)[1:]
    law = np.maximum(np.minimum(speed, left / goals.ARRIVE), goals.CREEP)
    found = goals._seconds_to(jnp.float32(distance), jnp.float32(speed))
    np.testing.assert_allclose(found, np.sum(left[0] / law), rtol=1e-3)


def test_who_cannot_come_in_time_runs():
    place = goals.Place(
        position=jnp.array([0.0, 30.0]),
        facing=jnp.array([0.0, 1.0]),
        seconds=jnp.float32(1.0),
    )
    velocity, _ = goals.arrive(place, walker((0.0, 0.0)), jnp.float32(0.0))
    np.testing.assert_allclose(velocity, [0.0, goals.FASTEST], rtol=1e-3)


def test_a_follower_keeps_his_distance():
    def wish(own, memory, now):
        leader = walker((0.0, 0.0))
        where = jnp.stack([jnp.sin(0.3 * now) * 4.0, 1.2 * jnp.minimum(now, 10.0)])
        pace = jnp.stack([jnp.cos(0.3 * now) * 1.2, 1.2 * (now < 10.0)])
        leader = dataclasses.replace(leader, position=where, velocity=pace)
        return goals.follow(leader, own, jnp.float32(1.5)), memory

    positions, _ = walk(wish, walker((0.0, -4.0)), 10.0)
    now = np.arange(300) / FPS
    leader = np.stack([np.sin(0.3 * now) * 4.0, 1.2 * now], axis=1)
    away = np.linalg.norm(positions - leader, axis=1)[150:]
    assert np.abs(away - 1.5).max() < 0.45
    still = goals.follow(walker((0.0, 1.5)), walker((0.0, 0.0)), jnp.float32(1.5))
    np.testing.assert_array_equal(still, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("number", [2, 8])
def test_walkers_who_change_places_do_not_touch(number):
    """In circles far from each other, since how one comes out hangs on last digits."""
    circles = 5
    turn = np.linspace(0, 2 * np.pi, number, endpoint=False)
    turn = turn + 1e-3 * np.random.default_rng(0).normal(size=(circles, number))
    start = 4.0 * np.stack([np.sin(turn), np.cos(turn)], axis=-1)
    middle = 100.0 * np.arange(circles)[:, None, None]
    from_, to = ((middle + sign * start).reshape(-1, 2) for sign in (1.0, -1.0))

    def wish(own, memory, _):
        gap = jnp.asarray(to, jnp.float32) - own.position
        far = jnp.linalg.norm(gap, axis=1, keepdims=True)
        wanted = 1.3 * gap / jnp.maximum(far, 1.0)
        return goals.avoid(wanted, own), memory

    facing = (to - from_) / 8.0
    positions, _ = walk(wish, walker(from_, 0.0 * from_, facing), 16.0)
    assert np.linalg.norm(positions[-1] - to, axis=1).max() < 0.4
    own = positions.reshape(-1, circles, number, 2)
    gaps = np.linalg.norm(own[..., :, None, :] - own[..., None, :, :], axis=-1)
    nearest = (gaps + 10.0 * np.eye(number)).min(axis=(0, 2, 3))
    # Of two in every circle; of eight on average, and each at least so far.
    least = 1.6 if number == 2 else 1.2
    assert nearest.mean() > 1.6 * goals.RADIUS and nearest.min() > least * goals.RADIUS


def test_nobody_walks_through_a_circle():
    circles = jnp.array([[0.1, 3.0, 0.8]])

    def wish(own, memory, _):
        gap = jnp.array([[0.0, 6.0]]) - own.position
        far = jnp.linalg.norm(gap, axis=1, keepdims=True)
        return goals.avoid(1.3 * gap / jnp.maximum(far, 1.0), own, circles), memory

    start = walker([[0.0, 0.0]], [[0.0, 0.0]], [[0.0, 1.0]])
    positions, _ = walk(wish, start, 10.0)
    away = np.linalg.norm(positions[:, 0] - np.array([0.1, 3.0]), axis=1)
    assert away.min() > 0.8 + 0.5 * goals.RADIUS
    assert np.linalg.norm(positions[-1, 0] - np.array([0.0, 6.0])) < 0.2


def test_two_who_meet_give_way_to_the_right():
    """Who goes along +z has -x to his right."""
    wanted = jnp.array([[0.0, 1.2], [0.0, -1.2]])
    both = walker([[0.0, 0.0], [0.0, 3.0]], wanted, wanted / 1.2)
    found = np.asarray(jax.jit(goals.avoid)(wanted, both))
    assert found[0, 0] < -0.05 and found[1, 0] > 0.05
    np.testing.assert_allclose(found[1], -found[0], atol=1e-5)


@pytest.mark.parametrize("away, turns", [(5.5, True), (9.0, False)])
def test_who_sets_out_reckons_with_the_others_half(away, turns):
    """At 1.2 m/s he meets who does as he does within 3 s if 7.9 m are between them."""
    wanted = jnp.array([[0.0, 1.2], [0.0, 0.0]])
    both = walker([[0.0, 0.0], [0.0, away]], np.zeros((2, 2)), [[0.0, 1.0]] * 2)
    found = jax.jit(goals.avoid)(wanted, both)
    assert bool(jnp.any(found[0] != wanted[0])) == turns


def test_alone_nobody_leaves_his_way():
    wanted = jnp.array([[1.0, 0.5], [0.0, 0.0]])
    far = walker([[0.0, 0.0], [50.0, 0.0]], np.zeros((2, 2)), [[0.0, 1.0]] * 2)
    np.testing.assert_array_equal(jax.jit(goals.avoid)(wanted, far), wanted)


def test_small_differences_are_not_told():
    make = lambda velocity, facing=(0.0, 1.0): Command(  # noqa: E731
        velocity=jnp.array([velocity]),
        facing=jnp.array([facing]),
        label=jnp.zeros(1, jnp.int32),
    )
    told = make((0.0, 1.0))
    same = functools.partial(goals.hold, told)
    assert same(make((0.05, 1.05))).velocity.tolist() == [[0.0, 1.0]]
    for other in (make((0.0, 1.3)), make((0.3, 1.0)), make((0.0, 0.0))):
        found = same(other)
        np.testing.assert_array_equal(found.velocity, other.velocity)
    turned = make((0.0, 1.0), (1.0, 0.0))
    np.testing.assert_array_equal(same(turned).facing, turned.facing)
    styled = dataclasses.replace(told, label=jnp.ones(1, jnp.int32))
    np.testing.assert_array_equal(same(styled).label, [1])


@pytest.mark.slow
def test_numbers_of_goals_and_characters_agree():
    model = jm.load("walker")
    place = goals.Place(
        position=jnp.zeros((3, 2)), facing=jnp.ones((3, 2)), seconds=jnp.ones(3)
    )
    with pytest.raises(ValueError, match="3 goals for 2 characters"):
        goals.goal_rollouts(
            model, jax.random.key(0), model.start(2), place, seconds=1.0
        )


@pytest.mark.parametrize("name", ["places", "circles"])
def test_shapes_of_places_and_circles_are_told(name):
    """Without the tests' type checker."""
    model = jm.load("walker")
    place = goals.Place(
        position=jnp.zeros((2, 2)), facing=jnp.ones((2, 2)), seconds=jnp.ones(2)
    )
    roll = inspect.unwrap(goals.goal_rollouts)
    given = {"seconds": 1.0, name: jnp.zeros((2, 4))}
    with pytest.raises(ValueError, match=rf"{name} of shape \(2, 4\), expected"):
        roll(model, jax.random.key(0), model.start(2), place, **given)
    given[name] = jnp.full((2, 2 if name == "places" else 3), jnp.nan)
    with pytest.raises(ValueError, match=f"{name} are not all finite: .*nan"):
        roll(model, jax.random.key(0), model.start(2), place, **given)


@pytest.mark.slow
def test_one_distance_serves_all_who_follow():
    model = jm.load("walker")
    commands = jm.commands("straight", model, 2, seconds=0.5)
    roll = functools.partial(
        jm.rollout, model, jax.random.key(0), model.start(2), commands=commands
    )
    leader = jnp.array([0, 0])
    each, one = (
        roll(goal=goals.Follow(leader=leader, distance=distance))
        for distance in (jnp.array([1.5, 1.5]), jnp.array(1.5))
    )
    np.testing.assert_array_equal(one.root_position, each.root_position)


def test_leaders_need_commands_of_all_characters_and_seconds():
    model = jm.load("walker")
    goal = goals.Follow(leader=jnp.array([0, 0]), distance=jnp.array([1.5, 1.5]))
    roll = functools.partial(
        goals.goal_rollouts, model, jax.random.key(0), model.start(2), goal, seconds=1.0
    )
    with pytest.raises(ValueError, match="1 leaders without commands"):
        roll()
    short = jm.commands("straight", model, 2, seconds=0.5)
    with pytest.raises(ValueError, match=r"shape \(2, 15\), expected \(2, 30\)"):
        roll(commands=short)


@pytest.mark.parametrize("leader, message", [(2, "0..2"), (-1, "-1..0")])
def test_leaders_are_characters(leader, message):
    model = jm.load("walker")
    goal = goals.Follow(leader=jnp.array([0, leader]), distance=jnp.array([1.5, 1.5]))
    with pytest.raises(ValueError, match=rf"leaders are in {message}, expected 0..1"):
        goals.goal_rollouts(
            model,
            jax.random.key(0),
            model.start(2),
            goal,
            seconds=0.1,
            commands=jm.commands("straight", model, 2, seconds=0.1),
        )


def test_swaying_hips_are_averaged_over_a_fifth_of_a_second():
    """Half of a new speed after 0.1 s, three quarters after 0.2 s."""
    found = [0.0]
    for _ in range(6):
        found.append(goals.averaged(found[-1], 1.0, 30.0))
    np.testing.assert_allclose([found[3], found[6]], [0.5, 0.75], rtol=1e-6)


@pytest.mark.slow
def test_a_leader_is_steered_and_followed():
    model = jm.load("walker")
    goal = goals.Follow(leader=jnp.array([0, 0]), distance=jnp.array([0.0, 1.5]))
    frames = goals.goal_rollouts(
        model,
        jax.random.key(0),
        model.start(2),
        goal,
        seconds=8.0,
        places=jnp.array([[0.0, 0.0], [0.0, -1.5]]),
        commands=jm.commands("straight", model, 2, seconds=8.0, speed=1.2),
    )
    walked = np.asarray(frames.root_position)[:, 120:, ::2]
    assert walked[0, -1, 1] == pytest.approx(1.2 * 8.0, abs=1.0)
    gap = np.linalg.norm(walked[0] - walked[1], axis=-1)
    assert np.abs(gap - 1.5).max() < 0.4


@pytest.mark.slow
@pytest.mark.parametrize("name", ["locomotion", "locomotion_fast", "dribble", "walker"])
def test_shipped_models_reach_their_places(name):
    """Also that a character's way does not depend on who walks elsewhere."""
    model, far = jm.load(name), np.array([[2.0, 3.0], [-2.0, 2.0]])
    place = goals.Place(
        position=jnp.asarray(far, jnp.float32),
        facing=jnp.array([[0.0, 1.0]] * 2),
        seconds=jnp.array([5.0, 5.0]),
    )
    roll = functools.partial(goals.goal_rollouts, seconds=8.0)
    frames = roll(model, jax.random.key(0), model.start(2), place)
    end = np.asarray(frames.root_position[:, -1, ::2])
    assert np.linalg.norm(end - far, axis=1).max() < 0.4
    moved = roll(
        model,
        jax.random.key(0),
        model.start(2),
        dataclasses.replace(place, position=place.position + jnp.array([[5.0, 1.0]])),
        places=jnp.array([[5.0, 1.0]] * 2),
    )
    shift = np.asarray(moved.root_position - frames.root_position)[..., ::2]
    np.testing.assert_allclose(
        shift, np.broadcast_to([5.0, 1.0], shift.shape), atol=0.02
    )
