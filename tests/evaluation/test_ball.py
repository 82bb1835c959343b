"""Planted touches, distances and depths come back at their size."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import ball as measure

FPS, RADIUS = 30.0, 0.11


def as32(*arrays):
    return tuple(jnp.asarray(x, jnp.float32) for x in arrays)


def kicked(frames, kicks, *, distance, speed=3.0, far=2.0):
    """A ball that is kicked along z in some frames, by the second of two feet.

    In the frame of a kick the foot is at `distance` (one for each kick), otherwise both
    are `far` away. Friction does not exist.
    """
    velocity = np.zeros((frames, 3))
    for n, kick in enumerate(kicks):
        velocity[kick:, 2] = speed * (n + 1)
    ball = np.cumsum(np.roll(velocity, 1, axis=0) / FPS, axis=0)
    ball[:, 1] = RADIUS
    feet = ball[:, None] + np.array([[-far, 0.0, 0.0], [0.0, far, 0.0]])
    for kick, near in zip(kicks, distance, strict=True):
        feet[kick, 1] = ball[kick] + near * np.array([0.6, 0.0, -0.8])
    return as32(ball, feet)


def test_a_kick_is_one_event_in_its_frame():
    ball, _ = kicked(40, (5, 17, 18, 30), distance=(0.15,) * 4)
    events = measure.touch_events(ball, FPS, threshold=2.0)
    np.testing.assert_array_equal(np.flatnonzero(events.active), [5, 17, 18, 30])
    # Two kicks in a row cannot be told from a long one.
    np.testing.assert_array_equal(np.flatnonzero(events.starts), [5, 17, 30])


def test_the_threshold_is_an_acceleration_and_exclusive():
    # From rest to 1/16 m a frame: 2 m/s^2 at 4 * sqrt(2) fps; powers of two are exact.
    step = 1 / 16
    ball = np.zeros((6, 3))
    ball[3:, 0] = step * np.arange(1, 4)
    (ball,) = as32(ball)
    for fps, threshold, count in (
        (8.0, 4.0, 0),
        (8.0, 3.99, 1),
        (16.0, 15.99, 1),
        (16.0, 16.0, 0),
    ):
        events = measure.touch_events(ball, fps, threshold=threshold)
        assert int(events.starts.sum()) == count, (fps, threshold)


def test_a_resting_and_a_steadily_rolling_ball_are_not_touched():
    still = np.broadcast_to([0.3, RADIUS, -0.2], (50, 3))
    rolling = still + np.arange(50)[:, None] / FPS * np.array([1.5, 0.0, 2.0])
    joints = np.broadcast_to([0.3, 0.5, -0.2], (2, 50, 1, 3))
    ball, joints = as32(np.stack([still, rolling]), joints)
    assert not measure.touch_events(ball, FPS, threshold=0.5).active.any()
    total, count = measure.foot_ball_distance(ball, joints, FPS, threshold=0.5)
    np.testing.assert_array_equal(total, 0.0)
    np.testing.assert_array_equal(count, 0.0)
    assert measure.ground_penetration(ball, radius=RADIUS).largest.max() < 1e-4


def test_planted_distances_come_back_and_misses_are_counted():
    kicks, distances = (4, 15, 26, 37), (0.12, 0.15, 0.17, 0.9)
    ball, feet = kicked(45, kicks, distance=distances)
    total, count = measure.foot_ball_distance(ball, feet, FPS, threshold=2.0)
    assert count == 4
    np.testing.assert_allclose(total, sum(distances), rtol=1e-5)
    for max_distance, missed in ((0.11, 4), (0.16, 2), (0.2, 1), (1.0, 0)):
        found = measure.touch_count(
            ball, feet, FPS, threshold=2.0, max_distance=max_distance
        )
        np.testing.assert_allclose(found, (4, missed, 45 / 30 / 60), rtol=1e-6)


def test_a_foot_may_be_a_frame_late_and_no_more():
    def total(shift):
        ball, feet = kicked(30, (12,), distance=(0.14,))
        return measure.foot_ball_distance(
            ball,
            jnp.roll(feet - ball[:, None], shift, 0) + ball[:, None],
            FPS,
            threshold=2.0,
        ).total

    np.testing.assert_allclose([total(s) for s in (-1, 0, 1)], 0.14, rtol=1e-5)
    np.testing.assert_allclose([total(s) for s in (-2, 2)], 2.0, rtol=1e-5)


def test_events_with_one_frame_between_share_it():
    """Both events may use the frame between them; neither may use the other's."""
    ball, feet = kicked(20, (8, 10), distance=(0.3, 0.5))
    between = feet.at[9, 1].set(ball[9] + jnp.array([0.2, 0.0, 0.0]))
    found = [
        measure.foot_ball_distance(ball, joints, FPS, threshold=2.0)
        for joints in (feet, between)
    ]
    np.testing.assert_allclose(found, [(0.8, 2), (0.4, 2)], rtol=1e-5)


def test_joints_that_are_nowhere_miss():
    ball, feet = kicked(20, (8,), distance=(0.1,))
    found = measure.touch_count(
        ball, feet * jnp.inf, FPS, threshold=2.0, max_distance=0.2
    )
    assert (found.touches, found.missed) == (1, 1)


def bounce():
    """A ball that falls from 1.5 m, bounces once at frame 15 and rises again."""
    t = (np.arange(31) - 15) / FPS
    height = RADIUS + 5.0 * np.abs(t) - 0.5 * 9.81 * t**2
    return np.stack([0 * t, height, 0.7 * t], axis=-1)


def test_flight_is_an_event_below_gravity_and_a_bounce_above():
    (ball,) = as32(bounce())
    low = measure.touch_events(ball, FPS, threshold=2.0)
    assert int(low.starts.sum()) == 1 and int(low.active.sum()) == 29
    high = measure.touch_events(ball, FPS, threshold=12.0)
    np.testing.assert_array_equal(np.flatnonzero(high.active), [15])


def test_acceleration_of_an_untouched_ball():
    ball, joints = as32(bounce(), np.full((31, 2, 3), 50.0))
    # 28 frames of gravity and one of the bounce: 2 * 5 m/s less gravity, in a frame.
    total, count = measure.untouched_acceleration(ball, joints, FPS, max_distance=0.2)
    assert count == 29
    expected = 28 * 9.81 + (2 * 5.0 * FPS - 9.81)
    np.testing.assert_allclose(total, expected, rtol=1e-4)
    # A joint at the bounce takes out that frame and its neighbors, and no more.
    near = joints.at[15, 0].set(ball[15] + jnp.array([0.0, 0.15, 0.0]))
    total, count = measure.untouched_acceleration(ball, near, FPS, max_distance=0.2)
    assert count == 26
    np.testing.assert_allclose(total / count, 9.81, rtol=1e-3)
    total, count = measure.untouched_acceleration(ball, near, FPS, max_distance=0.1)
    assert count == 29
    found = measure.untouched_acceleration(ball, joints, FPS, max_distance=100.0)
    np.testing.assert_array_equal(found, (0.0, 0.0))


@pytest.mark.parametrize("ground", [0.0, 0.4])
def test_a_ball_sunk_by_13_mm(ground):
    height = np.full(40, RADIUS + ground + 0.2)
    height[10:20] = RADIUS + ground - 0.013
    height[30:40] = RADIUS + ground - 0.004
    (ball,) = as32(np.stack([height * 3, height, height - 1], -1))
    found = measure.ground_penetration(ball, radius=RADIUS, ground=ground)
    np.testing.assert_allclose(found, (17 / 4, 13.0), rtol=1e-4)
    np.testing.assert_array_equal(
        measure.ground_penetration(ball, radius=0.05, ground=ground), (0.0, 0.0)
    )


def test_joints_inside_the_ball():
    ball, feet = kicked(20, (5, 12), distance=(0.09, 0.102))
    found = measure.joint_penetration(ball, feet, radius=RADIUS)
    np.testing.assert_allclose(found, (28 / 20, 20.0), rtol=1e-4)
    # The deepest joint of a frame counts, not their sum.
    both = feet.at[5, 0].set(ball[5] + jnp.array([0.0, 0.1, 0.0]))
    np.testing.assert_allclose(
        measure.joint_penetration(ball, both, radius=RADIUS), found, rtol=1e-4
    )


def scene(seed, shape=(), frames=40, joints=3):
    """A ball that jerks about, with pauses, and joints near it."""
    rng = np.random.default_rng(seed)
    jerk = rng.normal(size=(*shape, frames, 3)) * 4 / FPS**2
    jerk *= rng.uniform(size=(*shape, frames, 1)) < 0.5
    ball = np.cumsum(np.cumsum(jerk, -2), -2) + rng.normal(size=3)
    offset = rng.normal(size=(*shape, frames, joints, 3)) * 0.2
    return as32(ball, ball[..., None, :] + offset)


EACH = {
    "distance": lambda b, j: measure.foot_ball_distance(b, j, FPS, threshold=5.0),
    "count": lambda b, j: measure.touch_count(
        b, j, FPS, threshold=5.0, max_distance=0.15
    ),
    "free": lambda b, j: measure.untouched_acceleration(b, j, FPS, max_distance=0.1),
    "inside": lambda b, j: measure.joint_penetration(b, j, radius=RADIUS),
}


def loops(ball, joints):
    """The figures of EACH in loops over frames, events and joints."""
    frames = len(ball)
    pull, near = np.zeros(frames), np.empty(frames)
    for f in range(frames):
        near[f] = min(np.sqrt(np.sum((joint - ball[f]) ** 2)) for joint in joints[f])
        if 0 < f < frames - 1:
            second = ball[f + 1] - 2 * ball[f] + ball[f - 1]
            pull[f] = np.sqrt(np.sum((second * FPS**2) ** 2))
    events, f = [], 0
    while f < frames:
        first = f
        while f < frames and pull[f] > 5.0:
            f += 1
        if f > first:
            events.append(min(near[first - 1 : f + 1]))
        f += 1
    free = [pull[f] for f in range(1, frames - 1) if all(near[f - 1 : f + 2] > 0.1)]
    depth = [1000 * max(RADIUS - d, 0.0) for d in near]
    missed = sum(d > 0.15 for d in events)
    return {
        "distance": (sum(events), len(events)),
        "count": (len(events), missed, frames / FPS / 60),
        "free": (sum(free), len(free)),
        "inside": (np.mean(depth), max(depth)),
    }


@pytest.mark.parametrize("seed", range(5))
def test_loops_find_the_same(seed):
    ball, joints = scene(seed, frames=60)
    expected = loops(np.float64(ball), np.float64(joints))
    assert 3 < expected["count"][1] < expected["count"][0]
    assert 0 < expected["free"][1] < 58
    for name, function in EACH.items():
        found = function(ball, joints)
        np.testing.assert_allclose(found, expected[name], rtol=2e-3, err_msg=name)


@pytest.mark.parametrize("name", EACH)
def test_where_on_the_ground_and_which_way_is_no_matter(name):
    ball, joints = scene(7)
    c, s = 0.6, 0.8
    turn = jnp.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    shift = jnp.array([1.5, 0.0, -2.0])
    moved = [x @ turn.T + jnp.broadcast_to(shift, x.shape) for x in (ball, joints)]
    np.testing.assert_allclose(EACH[name](*moved), EACH[name](ball, joints), rtol=2e-3)


@pytest.mark.parametrize("name", EACH)
def test_batches_vmap_and_parts_of_a_program_agree(name):
    ball, joints = scene(8, (2, 3))
    whole = EACH[name](ball, joints)
    mapped = jax.vmap(jax.vmap(EACH[name]))(ball, joints)
    within = jax.jit(lambda b, j: EACH[name](b[1, 2], j[1, 2]))(ball, joints)
    for a, b, one in zip(whole, mapped, within, strict=True):
        assert a.shape == (2, 3)
        np.testing.assert_allclose(b, a, rtol=1e-5)
        np.testing.assert_allclose(one, a[1, 2], rtol=1e-4)


def test_clips_are_joined_by_adding():
    kicks = kicked(30, (9, 20), distance=(0.1, 0.3))
    quiet = kicked(30, (), distance=())
    both = [jnp.stack(pair) for pair in zip(kicks, quiet, strict=True)]
    found = measure.foot_ball_distance(*both, FPS, threshold=2.0)
    total, count = jax.tree.map(jnp.sum, found)
    np.testing.assert_allclose(total / count, 0.2, rtol=1e-5)


def test_two_frames_have_no_acceleration():
    with pytest.raises(ValueError, match="2 frames of a ball, expected at least 3"):
        measure.touch_events(jnp.zeros((2, 3)), FPS, threshold=2.0)
