import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import contact
from tests.reference import metrics as oracle


def clip(seed, frames=40):
    rng = np.random.default_rng(seed)
    feet = rng.normal(size=(frames, 2, 3)) * [0.02, 0.01, 0.02]
    feet[..., 1] = np.abs(feet[..., 1])
    root = np.cumsum(rng.normal(size=(frames, 3)) * 0.03, axis=0)
    return feet.astype(np.float32), root.astype(np.float32)


def test_slide_distance_is_that_of_the_definition():
    feet, _ = clip(0)
    want = oracle.slide(feet.astype(np.float64), 30.0, 0.01)
    got = contact.slide_distance(jnp.asarray(feet), 30.0)
    np.testing.assert_allclose(got, want, rtol=1e-5)


def test_slide_distance_does_not_depend_on_the_frame_rate():
    def slid(fps):
        t = np.arange(int(2 * fps) + 1) / fps
        feet = np.stack([0.3 * t, 0 * t, 0.4 * t], -1)[:, None]
        return contact.slide_distance(jnp.asarray(feet, jnp.float32), fps)

    for fps in (20.0, 60.0):
        np.testing.assert_allclose(slid(fps), (0.5, 2.0), rtol=1e-5)


def test_feet_in_the_air_slide_for_no_time():
    feet = jnp.ones((5, 2, 3))
    np.testing.assert_array_equal(contact.slide_distance(feet, 30.0), (0.0, 0.0))


def test_skate_ratio_counts_frames_with_any_low_fast_foot():
    # Steps of 0.02 m at 30 fps are 0.6 m/s. Foot 0 slides in steps 0-1; foot 1 moves
    # in steps 1-3, but is high from frame 3 on, so that only its step 1 counts.
    x0 = np.cumsum([0, 0.02, 0.02, 0, 0, 0])
    x1 = np.cumsum([0, 0, 0.02, 0.02, 0.02, 0])
    height = np.array([0, 0, 0, 0.1, 0.1, 0.1])
    feet = np.stack(
        [np.stack([x0, 0 * x0, 0 * x0], -1), np.stack([0 * x1, height, x1], -1)], 1
    )
    feet = jnp.asarray(feet, jnp.float32)
    np.testing.assert_allclose(contact.skate_ratio(feet, 30.0), 2 / 5)
    np.testing.assert_allclose(contact.skate_ratio(feet, 20.0), 0.0)
    both = contact.skate_ratio(jnp.stack([feet, 0 * feet]), 30.0)
    np.testing.assert_allclose(both, [2 / 5, 0.0])


def test_legs_cross_as_often_as_the_left_foot_passes_the_right_one():
    """A left foot that goes 10 cm to either side of the right one, twice a second."""
    seconds = np.arange(60) / 30.0 + 0.01
    for turn in (0.0, 1.0, 2.5):
        facing = np.array([np.sin(turn), np.cos(turn)])
        left = np.array([facing[1], 0.0, -facing[0]])
        feet = np.zeros((60, 2, 3))
        feet[:, 0] = 0.1 * np.cos(4 * np.pi * seconds)[:, None] * left
        feet = jnp.asarray(feet + [1.0, 0.0, 2.0], jnp.float32)
        facings = jnp.asarray(np.tile(facing, (60, 1)), jnp.float32)
        times = contact.leg_crossings(feet, facings, 30.0)
        np.testing.assert_allclose(times, 4 / (59 / 30) * 60, rtol=1e-5)
        assert contact.leg_crossings(feet, facings, 30.0, margin=0.11) == 0


def test_feet_side_by_side_do_not_cross_whichever_way_they_face():
    """Hips' own rule: ahead is the way across from right to left, turned by up."""
    feet = jnp.zeros((5, 2, 3)).at[:, 0, 0].set(0.2)  # the left one toward +x
    ahead = jnp.tile(jnp.array([0.0, 1.0]), (5, 1))
    steps = feet.at[2:4, 0, 0].set(-0.2)
    assert contact.leg_crossings(feet, ahead, 30.0) == 0
    assert contact.leg_crossings(steps, ahead, 30.0) == 60 * 30 / 4
    assert contact.leg_crossings(steps, -ahead, 30.0) == 60 * 30 / 4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate", "frames"), [(1.0, 120), (1.6, 60), (2.5, 60), (1.0, 9000)]
)
def test_strides_are_counted_whichever_way_one_goes(rate, frames):
    """Feet swing against each other with one harmonic, while the body goes on."""
    time = np.arange(frames) / 60.0
    turn = 2 * np.pi * rate * time
    ahead = 0.4 * np.sin(turn) + 0.1 * np.sin(2 * turn + 1.0)
    way = np.array([0.6, 0.8])
    body = (3.0 * time)[:, None] * way
    feet = np.zeros((frames, 2, 3))
    for foot, sign in enumerate((0.5, -0.5)):
        feet[:, foot, ::2] = body + sign * ahead[:, None] * way
    facing = jnp.tile(jnp.asarray(way, jnp.float32), (frames, 1))
    found = contact.stride_rate(jnp.asarray(feet, jnp.float32), facing, 60.0)
    assert abs(found - rate) < 0.05


def sliding(speed, height, frames=5):
    """Two feet: one slides along the ground at a height, one stands still beside it."""
    along = speed * np.arange(frames) / 60.0
    moving = np.stack([0.6 * along, np.full(frames, height), 0.8 * along], -1)
    standing = np.broadcast_to([0.3, 0.0, 0.0], (frames, 3))
    return jnp.asarray(np.stack([moving, standing], 1), jnp.float32)


# At half the height H a foot skates by 2 - sqrt(2) = 0.586 of its speed.
@pytest.mark.parametrize(
    ("speed", "height", "skates"),
    [
        (0.21, 0.0, 1.0),
        (0.19, 0.0, 0.0),
        (0.21, -0.01, 1.0),
        (0.35, 0.0125, 1.0),
        (0.33, 0.0125, 0.0),
        (9.0, 0.025, 0.0),
        (9.0, 0.4, 0.0),
    ],
)
def test_frames_skate_by_speed_and_height(speed, height, skates):
    feet = sliding(speed, height)
    assert contact.skating_frame_ratio(feet, 60.0) == skates
    slower = contact.skating_frame_ratio(feet, 30.0, min_speed=0.1)
    assert slower == skates
    twice = feet * jnp.array([1.0, 2.0, 1.0]).reshape(1, 1, 3)
    assert contact.skating_frame_ratio(twice, 60.0, height=0.05) == skates


def test_skating_frames_are_those_of_the_definition():
    rng = np.random.default_rng(4)
    feet = rng.normal(size=(3, 50, 2, 3)) * [0.01, 0.02, 0.01]
    feet = np.cumsum(feet, axis=1) * [1.0, 0.5, 1.0]
    expected = []
    for rollout in feet:
        skating = 0
        for now, after in zip(rollout[:-1], rollout[1:], strict=True):
            for foot in range(2):
                dx, _, dz = (after - now)[foot] * 30.0
                part = min(max(now[foot, 1] / 0.025, 0.0), 1.0)
                if np.hypot(dx, dz) * (2.0 - 2.0**part) > 0.2:
                    skating += 1
                    break
        expected.append(skating / 49)
    found = contact.skating_frame_ratio(jnp.asarray(feet, jnp.float32), 30.0)
    assert 0.1 < min(expected) and max(expected) < 1.0
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_one_frame_is_refused():
    for measure in (contact.slide_distance, contact.skating_frame_ratio):
        with pytest.raises(ValueError, match="expected at least 2"):
            measure(jnp.zeros((1, 2, 3)), 30.0)


def test_a_swinging_foot_is_as_high_as_drawn_frame_by_frame():
    """One foot swings at three times the body's speed in half of the frames."""
    generator = np.random.default_rng(0)
    fps, frames, body = 30.0, 60, 1.2
    swings = generator.random((2, frames, 2)) < 0.5
    step = np.where(swings, 3.0 * body, 0.2) / fps
    height = generator.uniform(0.0, 0.3, step.shape)
    feet = np.stack([np.zeros(step.shape), height, np.cumsum(step, axis=1)], axis=-1)
    found = contact.swing_height(
        jnp.asarray(feet), jnp.full((2, frames), body), fps, ground=0.02
    )
    for window in range(2):
        high = height[window, 1:][swings[window, 1:]] - 0.02
        np.testing.assert_allclose(found.median[window], np.median(high), atol=1e-6)
        low = np.percentile(high, 10)
        np.testing.assert_allclose(found.low[window], low, atol=1e-6)
        assert found.seconds[window] == pytest.approx(high.size / fps)
    # Of a body that stands a foot swings from 0.3 m/s on.
    for speed, seconds in ((0.0, 0.0), (0.25, 0.0), (0.35, 2 * (frames - 1) / fps)):
        moved = np.zeros((2, frames, 2, 3))
        moved[..., 1], moved[..., 2] = 0.1, speed / fps * np.arange(frames)[:, None]
        still = contact.swing_height(
            jnp.asarray(moved), jnp.zeros((2, frames)), fps, ground=0.0
        )
        np.testing.assert_allclose(still.seconds, seconds, rtol=1e-6)
        np.testing.assert_allclose(still.median, 0.1 * (seconds > 0), rtol=1e-6)
