"""experiments/next_frame.py: what is left, what a perfect discriminator would see."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from jaxmotion.systems.aamdm import data as aamdm_data
from tests.reference import diffusion


def test_a_perfect_discriminator_as_an_integral(load):
    """One channel: the densities of x_{t-1} given x_t, integrated."""
    left = np.random.default_rng(0).normal(0.0, 0.4, (20_000, 1))
    found = load("next_frame").perfect_loss(left, 5, seed=0, draws=40_000)
    variance, alpha_bar = left.var(), np.cumprod(1 - diffusion.cosine_betas(5))
    assert found[0] == 0.0
    for t in range(2, 6):
        before, now = alpha_bar[t - 2], alpha_bar[t - 1]
        beta = 1 - now / before
        known = 1 / (1 / variance + now / (1 - now))
        own = beta * (1 - before) / (1 - now)
        more = (np.sqrt(before) * beta / (1 - now)) ** 2 * known
        real, fake = (scipy.stats.norm(0, x**0.5) for x in (own + more, own))

        def loss(x, real=real, fake=fake):
            p, q = real.pdf(x), fake.pdf(x)
            return -p * np.log(p / (p + q)) - q * np.log(q / (p + q))

        end = 8 * np.sqrt(own + more)
        expected, _ = scipy.integrate.quad(loss, -end, end, limit=200)
        np.testing.assert_allclose(found[t - 1], expected, atol=0.015)


def test_without_anything_new_there_is_nothing_to_tell_apart(load):
    left = 1e-6 * np.random.default_rng(0).normal(size=(500, 3))
    found = load("next_frame").perfect_loss(left, 4, seed=0)
    np.testing.assert_allclose(found[1:], 2 * np.log(2), atol=1e-3)


@pytest.mark.parametrize("given", [1, 3])
def test_examples_lie_within_clips(load, given):
    frames = np.cumsum(np.arange(24.0).reshape(12, 2), axis=0)
    data = aamdm_data.PoseData(
        poses=jnp.zeros((12, 2)),
        paths=jnp.zeros((12, 12)),
        offsets=jnp.array([0, 7, 12]),
        fps=60.0,
    )
    size = np.array([2.0, 4.0])
    state, change, now = load("next_frame").examples(frames, data, given, size)
    assert now.tolist() == [*range(given - 1, 6), *range(7 + given - 1, 11)]
    np.testing.assert_allclose(frames[now] + change * size, frames[now + 1])
    assert state.shape == (len(now), 2 * given)
    for back in range(1, given):
        part = state[:, 2 * back : 2 * back + 2] * size
        np.testing.assert_allclose(part, frames[now - back + 1] - frames[now - back])
