"""Losses on arrays against loops in float64."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.learning import losses


@pytest.fixture
def arrays():
    generator = np.random.default_rng(0)
    prediction, target = generator.normal(size=(2, 3, 5, 4))
    mask = generator.random((3, 5)) < 0.6
    return prediction, target, mask


def test_masked_mse(arrays):
    prediction, target, mask = arrays
    kept = [
        np.mean((prediction[b, f] - target[b, f]) ** 2)
        for b, f in np.ndindex(3, 5)
        if mask[b, f]
    ]
    found = losses.masked_mse(*(jnp.asarray(x) for x in arrays))
    np.testing.assert_allclose(found, np.mean(kept), rtol=1e-6)


def test_a_mask_for_all_samples(arrays):
    prediction, target, mask = arrays
    found = losses.masked_mse(
        jnp.asarray(prediction), jnp.asarray(target), jnp.asarray(mask[:1])
    )
    square = np.mean((prediction - target) ** 2, axis=(0, 2))
    np.testing.assert_allclose(found, square[mask[0]].mean(), rtol=1e-6)


def test_frames_that_do_not_count_do_not_matter(arrays):
    prediction, target, mask = (jnp.asarray(x) for x in arrays)
    changed = jnp.where(mask[..., None], prediction, 1e6)
    for loss in (losses.masked_mse, losses.velocity_loss):
        np.testing.assert_allclose(
            loss(changed, target, mask), loss(prediction, target, mask), rtol=1e-6
        )


def test_no_frame_that_counts_gives_zero(arrays):
    prediction, target, mask = (jnp.asarray(x) for x in arrays)
    assert losses.masked_mse(prediction, target, jnp.zeros_like(mask)) == 0


def test_velocity_loss(arrays):
    prediction, target, mask = arrays
    kept = []
    for b, f in np.ndindex(3, 4):
        if mask[b, f] and mask[b, f + 1]:
            moved = prediction[b, f + 1] - prediction[b, f]
            wanted = target[b, f + 1] - target[b, f]
            kept.append(np.mean((moved - wanted) ** 2))
    found = losses.velocity_loss(*(jnp.asarray(x) for x in arrays))
    np.testing.assert_allclose(found, np.mean(kept), rtol=1e-5)


def test_velocity_loss_does_not_see_a_constant(arrays):
    _, target, mask = (jnp.asarray(x) for x in arrays)
    found = losses.velocity_loss(target + 7.0, target, mask)
    np.testing.assert_allclose(found, 0.0, atol=1e-10)


def test_foot_slide_counts_standing_feet_only():
    generator = np.random.default_rng(1)
    feet = generator.normal(size=(2, 5, 2, 3))
    contact = generator.random((2, 5, 2)) < 0.5
    total, count = 0.0, 0
    for b, f, foot, axis in np.ndindex(2, 4, 2, 3):
        moved = feet[b, f + 1, foot, axis] - feet[b, f, foot, axis]
        total += moved**2 if contact[b, f, foot] else 0.0
        count += 1
    found = losses.foot_slide_loss(jnp.asarray(feet), jnp.asarray(contact))
    np.testing.assert_allclose(found, total / count, rtol=1e-5)
    last = jnp.asarray(contact).at[:, -1].set(~jnp.asarray(contact)[:, -1])
    np.testing.assert_array_equal(
        losses.foot_slide_loss(jnp.asarray(feet), last), found
    )
