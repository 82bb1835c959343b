"""Planted depths, heights and slides come back in millimeters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import plausibility


def body(lowest):
    """Three joints a frame whose lowest, not always the same one, has that height."""
    lowest = np.asarray(lowest, np.float64)
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(len(lowest), 3, 3))
    positions[..., 1] = lowest[:, None] + rng.uniform(0.1, 1.5, (len(lowest), 3))
    which = rng.integers(0, 3, len(lowest))
    positions[np.arange(len(lowest)), which, 1] = lowest
    return jnp.asarray(positions, jnp.float32)


HEIGHTS = [0.0, -0.02, 0.004, -0.004, 0.03, 0.0, -0.1, 0.05]
MEASURES = [(plausibility.penetration, 15.0), (plausibility.floating, 10.0)]


@pytest.mark.parametrize(("measure", "expected"), MEASURES)
def test_planted_heights(measure, expected):
    """120 mm below and 80 mm above in 8 frames; 4 mm are within the tolerance."""
    np.testing.assert_allclose(measure(body(HEIGHTS)), expected, rtol=1e-5)


@pytest.mark.parametrize(("measure", "expected"), MEASURES)
def test_the_ground_is_an_argument(measure, expected):
    raised = body(np.array(HEIGHTS) + 0.042)
    np.testing.assert_allclose(measure(raised, ground=0.042), expected, rtol=1e-4)


def test_the_tolerance_drops_frames_and_takes_nothing_off():
    low = body([-0.006, -0.02])
    np.testing.assert_allclose(plausibility.penetration(low), 13.0, rtol=1e-5)
    for tolerance, expected in ((0.01, 10.0), (0.0, 13.0), (0.03, 0.0)):
        found = plausibility.penetration(low, tolerance=tolerance)
        np.testing.assert_allclose(found, expected, rtol=1e-5)
        found = plausibility.floating(body([0.006, 0.02]), tolerance=tolerance)
        np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_only_one_of_the_two_at_a_time():
    assert plausibility.floating(body([-0.3, -0.2])) == 0.0
    assert plausibility.penetration(body([0.3, 0.2])) == 0.0


def sliding(steps, heights):
    """One foot that moves by so many meters along (3, 4), at those heights."""
    along = np.concatenate([[0.0], np.cumsum(steps)])
    foot = np.stack([0.6 * along, np.asarray(heights), 0.8 * along], axis=-1)
    return jnp.asarray(foot[:, None], jnp.float32)


def test_a_planted_slide():
    """Steps of 10, 20, 30 and 40 mm; the foot leaves the ground in the fourth frame."""
    foot = sliding([0.01, 0.02, 0.03, 0.04], [0.0, 0.004, -0.2, 0.006, 0.0])
    np.testing.assert_allclose(plausibility.skating(foot), 15.0, rtol=1e-5)
    found = plausibility.skating(foot, tolerance=0.01)
    np.testing.assert_allclose(found, 25.0, rtol=1e-5)
    raised = foot + jnp.array([0, 0.042, 0]).reshape(1, 1, 3)
    assert plausibility.skating(raised) == 0.0
    found = plausibility.skating(raised, ground=0.042)
    np.testing.assert_allclose(found, 15.0, rtol=1e-5)


def test_feet_are_averaged_over_their_contacts():
    """A foot that slides 12 mm four times, and one that stands in the last two."""
    slides = sliding([0.012] * 4, [0.0] * 5)
    stands = sliding([0.5, 0.5, 0.5, 0.0], [1.0, 1.0, 1.0, 0.0, 0.0])
    feet = jnp.concatenate([slides, stands], axis=1)
    np.testing.assert_allclose(plausibility.skating(feet), 48 / 5, rtol=1e-5)


def test_vertical_motion_is_no_skating_and_feet_in_the_air_do_not_touch():
    assert plausibility.skating(sliding([0.0, 0.0], [0.004, 0.0, -0.5])) == 0.0
    assert plausibility.skating(sliding([1.0, 1.0], [0.5, 0.5, 0.5])) == 0.0


@pytest.mark.parametrize(
    "measure",
    [plausibility.penetration, plausibility.floating, plausibility.skating],
)
def test_batch_axes(measure):
    rng = np.random.default_rng(1)
    x = jnp.asarray(rng.normal(size=(2, 3, 20, 2, 3)) * 0.02, jnp.float32)
    found = measure(x)
    assert found.shape == (2, 3)
    for index in np.ndindex(2, 3):
        np.testing.assert_allclose(found[index], measure(x[index]), rtol=1e-5)
    np.testing.assert_allclose(jax.vmap(measure)(x), found, rtol=1e-5)
    assert np.min(found) > 0


def test_one_frame_has_no_displacement():
    with pytest.raises(ValueError, match="expected at least 2"):
        plausibility.skating(jnp.zeros((1, 2, 3)))


@pytest.mark.parametrize("height, expected", [(0.25, 100.0), (0.2501, 0.0)])
def test_a_foot_at_the_tolerance_touches(height, expected):
    feet = jnp.array([[[0.0, height, 0.0]], [[0.1, height, 0.0]]])
    found = plausibility.skating(feet, tolerance=0.25)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
