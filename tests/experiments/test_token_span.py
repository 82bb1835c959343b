"""experiments/token_span.py: what is projected away, by singular values."""

import numpy as np
import pytest


def test_as_many_channels_as_features_lose_nothing(load):
    frames = np.random.default_rng(0).normal(size=(50, 12, 3))
    for own, margin in ((1, 0), (3, 0), (3, 2)):
        found = load("token_span").projected(
            frames, frames, own=own, margin=margin, channels=3 * (own + 2 * margin)
        )
        np.testing.assert_allclose(found, frames, atol=1e-5)


def test_what_is_left_is_in_the_smallest_singular_values(load):
    """Without shared frames: the mean square of the singular values not kept."""
    frames = np.random.default_rng(1).normal(size=(400, 4, 3)) * [3.0, 1.0, 0.2]
    found = load("token_span").projected(frames, frames, own=2, margin=0, channels=4)
    tokens = frames.reshape(-1, 6)
    values = np.linalg.svd(tokens - tokens.mean(axis=0), compute_uv=False)
    expected = np.sum(values[4:] ** 2) / frames.size
    np.testing.assert_allclose(np.mean((found - frames) ** 2), expected, rtol=1e-4)


@pytest.mark.parametrize("text", ["5", "0+1", "a+b", "7+1"])
def test_a_layout_that_is_none_is_named(load, text):
    with pytest.raises(ValueError, match="--layouts"):
        load("token_span").layout_of(text, 60)
