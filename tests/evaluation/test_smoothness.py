import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import smoothness


@pytest.mark.parametrize("fps", [20.0, 60.0])
def test_polynomial_motion_has_its_derivatives(fps):
    t = np.arange(12) / fps
    fall = np.stack([2 * t, -4.905 * t**2, 0 * t], -1)[:, None]
    cubic = np.stack([t**3, 0 * t, 0 * t], -1)[:, None]
    fall, cubic = (jnp.asarray(x, jnp.float32) for x in (fall, cubic))
    np.testing.assert_allclose(smoothness.acceleration(fall, fps), 9.81, rtol=2e-3)
    np.testing.assert_allclose(smoothness.jerk(cubic, fps), 6.0, rtol=2e-2)
    np.testing.assert_allclose(smoothness.jerk(fall, fps), 0.0, atol=0.1)


def test_means_are_over_frames_and_joints_but_not_clips():
    x = np.random.default_rng(0).normal(size=(2, 9, 4, 3)).astype(np.float32)
    a, j = np.diff(x, 2, axis=1) * 900, np.diff(x, 3, axis=1) * 27000
    want = [np.linalg.norm(d.astype(float), axis=-1).mean((1, 2)) for d in (a, j)]
    np.testing.assert_allclose(
        smoothness.acceleration(jnp.asarray(x), 30.0), want[0], rtol=1e-4
    )
    np.testing.assert_allclose(
        smoothness.jerk(jnp.asarray(x), 30.0), want[1], rtol=1e-4
    )


def test_too_few_frames_are_refused():
    with pytest.raises(ValueError, match="3 frames, expected at least 4"):
        smoothness.jerk(jnp.zeros((3, 1, 3)), 30.0)
