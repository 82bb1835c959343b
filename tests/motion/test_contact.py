import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.motion import contact


def test_contacts_of_a_foot_that_stands_then_moves():
    # One foot at 30 fps: still for 3 frames, then 0.02 m a frame (0.6 m/s), then still.
    x = np.cumsum([0, 0, 0, 0.02, 0.02, 0, 0])
    feet = np.stack([x, 0 * x + 0.03, 0 * x], -1)[:, None]
    got = contact.foot_contacts(jnp.asarray(feet, jnp.float32), 30.0, max_speed=0.3)
    np.testing.assert_array_equal(got[:, 0], [1, 1, 0, 0, 1, 1, 1])


def test_thresholds_are_per_second_and_in_meters():
    x = np.arange(8)[:, None, None] * np.array([0.005, 0.0, 0.0])
    feet = jnp.asarray(x, jnp.float32)
    assert contact.foot_contacts(feet, 30.0).all()  # 0.15 m/s
    assert not contact.foot_contacts(feet, 120.0).any()  # 0.6 m/s
    high = feet.at[..., 1].set(0.06)
    assert contact.foot_contacts(high, 30.0).all()
    assert not contact.foot_contacts(high, 30.0, max_height=0.05).any()


def test_vertical_speed_counts_and_batches_broadcast():
    rising = np.arange(5)[:, None, None] * np.array([0.0, 0.02, 0.0])
    feet = jnp.asarray(np.stack([rising, 0 * rising]), jnp.float32)
    got = contact.foot_contacts(feet, 30.0)
    assert got.shape == (2, 5, 1)
    assert not got[0].any() and got[1].all()


def test_one_frame_has_no_speed():
    with pytest.raises(ValueError, match="1 frames, expected at least 2"):
        contact.foot_contacts(jnp.zeros((1, 2, 3)), 30.0)
