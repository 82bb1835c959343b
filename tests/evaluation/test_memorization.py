import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import memorization


def made(number, seed, frames=5, joints=3):
    return np.random.default_rng(seed).normal(size=(number, frames, joints, 3))


def find(positions, windows, clip, num_clips):
    windows = jnp.asarray(windows, jnp.float32)
    return jax.jit(
        lambda x: memorization.nearest(
            x, lambda number: windows[number], jnp.asarray(clip), num_clips=num_clips
        )
    )(jnp.asarray(positions, jnp.float32))


@pytest.mark.parametrize("number", [7, 256, 300])  # less than a chunk, one, more
def test_the_two_nearest_clips_are_numpys(number):
    positions, windows = made(4, seed=0), made(number, seed=1)
    clip = np.sort(np.random.default_rng(2).integers(0, 6, number))
    gaps = positions[:, None] - windows[None]
    gaps = np.sqrt(np.mean(np.sum(gaps**2, axis=-1), axis=(-2, -1)))
    by_clip = [
        gaps[:, clip == c].min(axis=1) if (clip == c).any() else np.full(4, np.inf)
        for c in range(6)
    ]
    want = np.sort(by_clip, axis=0)[:2]
    got = find(positions, windows, clip, 6)
    np.testing.assert_allclose(np.stack([got.clip, got.other]), want, rtol=1e-4)


def test_a_distance_far_from_the_origin_is_right_to_millimeters():
    # Four meters away and some centimeters apart, as walks are.
    windows = made(20, seed=3) + np.array([0.0, 1.0, 4.0])
    positions = windows[:5] + 0.01 / np.sqrt(3)
    got = find(positions, windows, np.arange(20), 20)
    np.testing.assert_allclose(got.clip, 0.01, atol=2e-3)


def test_only_what_is_much_nearer_to_one_clip_is_a_copy():
    one, other = made(2, seed=4)
    gap = np.sqrt(np.mean(np.sum((one - other) ** 2, axis=-1)))
    parts = np.array([0.0, 0.2, 0.24, 0.26, 0.5, 0.8])  # a quarter is the third
    positions = one + parts[:, None, None, None] * (other - one)
    got = find(positions, [one, other, one], [0, 1, 0], 2)
    np.testing.assert_allclose(got.clip, gap * np.minimum(parts, 1 - parts), atol=2e-3)
    assert float(memorization.copied(got)) == pytest.approx(4 / 6)


def test_two_windows_of_one_clip_are_not_two_clips():
    one, other = made(2, seed=5)
    got = find(one[None], [one, one, other], [0, 0, 1], 2)
    assert got.clip[0] < 1e-3 and got.other[0] > 1.0
    alone = find(one[None], [one, one], [0, 0], 1)
    assert np.isinf(alone.other[0])
    assert float(memorization.copied(alone)) == 0  # nothing to compare it with


def test_a_motion_that_is_no_number_is_near_nothing_and_changes_no_other():
    one, other = made(2, seed=6)
    broken = one.copy()
    broken[2, 1, 0] = np.nan
    got = find([one, broken, other], [one, other], [0, 1], 2)
    assert np.isinf(got.clip[1]) and np.isinf(got.other[1])
    np.testing.assert_allclose(got.clip[::2], 0, atol=2e-3)
    assert float(memorization.copied(got)) == pytest.approx(2 / 3)
