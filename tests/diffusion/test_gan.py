"""Pairs and losses of denoising-diffusion GANs against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.diffusion import chain, gan, schedule
from tests import mostly_slow

NUMBER = 200_000


def coefficients(table, t):
    beta = np.float64(table.beta)
    alpha_bar = np.cumprod(1 - beta)
    return beta[t], alpha_bar[t - 1], alpha_bar[t]


@pytest.mark.parametrize("t", mostly_slow([1, 2, 5], [2]))
@pytest.mark.parametrize("make", [schedule.cosine_schedule, schedule.vp_schedule])
def test_pairs_have_the_joint_gaussian_of_the_chain(make, t):
    """Given x_0: means, variances and the covariance of x_{t-1} and x_t."""
    table = make(5)
    x_0 = jnp.full(NUMBER, 1.3)
    pair = gan.q_pair(table, jax.random.key(t), x_0, jnp.array(t))
    x_prev, x_t = (np.float64(x) for x in pair)
    beta, before, after = coefficients(table, t)
    error = 5 / np.sqrt(NUMBER)
    assert abs(x_prev.mean() - 1.3 * np.sqrt(before)) < error
    assert abs(x_t.mean() - 1.3 * np.sqrt(after)) < error
    assert abs(x_prev.var() - (1 - before)) < 2 * error
    assert abs(x_t.var() - (1 - after)) < 2 * error
    covariance = np.mean((x_prev - x_prev.mean()) * (x_t - x_t.mean()))
    assert abs(covariance - np.sqrt(1 - beta) * (1 - before)) < 2 * error


def test_each_sample_has_its_own_step():
    table, x_0 = schedule.cosine_schedule(4), jnp.ones((3, 2))
    key = jax.random.key(0)
    together = gan.q_pair(table, key, x_0, jnp.array([1, 2, 4]))
    for i, t in enumerate((1, 2, 4)):
        alone = gan.q_pair(table, jax.random.clone(key), x_0, jnp.array(t))
        for a, b in zip(together, alone, strict=True):
            np.testing.assert_allclose(a[i], b[i], rtol=1e-6)


@pytest.mark.parametrize("t", mostly_slow([1, 3], [3]))
def test_posterior_samples_have_the_posteriors_moments(t):
    """Oracle: Bayes' rule for the two Gaussians of x_{t-1}."""
    table = schedule.vp_schedule(4)
    x_0, x_t = jnp.full(NUMBER, 0.7), jnp.full(NUMBER, -0.4)
    x_prev = gan.posterior_sample(table, jax.random.key(1), x_0, x_t, jnp.array(t))
    beta, before, _ = coefficients(table, t)
    if t == 1:
        np.testing.assert_allclose(x_prev, x_0, rtol=1e-6)
        return
    precision = 1 / (1 - before) + (1 - beta) / beta
    mean = 0.7 * np.sqrt(before) / (1 - before) - 0.4 * np.sqrt(1 - beta) / beta
    error = 5 / np.sqrt(NUMBER)
    assert abs(np.float64(x_prev).mean() - mean / precision) < error
    assert abs(np.float64(x_prev).var() - 1 / precision) < 2 * error


def test_an_exact_generator_keeps_the_variance_of_the_data():
    """x_0 ~ N(1.5, 0.3): the ideal GAN draws x_0 from its law given x_t."""
    table, variance = schedule.cosine_schedule(3), 0.3

    def exact(key, x_t, t):
        alpha_bar = table.alpha_bar[t]
        precision = 1 / variance + alpha_bar / (1 - alpha_bar)
        mean = 1.5 / variance + jnp.sqrt(alpha_bar) * x_t / (1 - alpha_bar)
        noise = jax.random.normal(key, x_t.shape)
        return mean / precision + noise / jnp.sqrt(precision)

    step = chain.ancestral_step(table, exact)
    x = np.float64(chain.sample(step, jax.random.key(0), (NUMBER,), num_steps=3))
    assert abs(x.mean() - 1.5) < 5 * np.sqrt(variance / NUMBER)
    assert abs(x.var() - variance) < 5 * variance * np.sqrt(2 / NUMBER)


def test_losses_are_the_logarithms_of_probabilities():
    rng = np.random.default_rng(0)
    real, fake = rng.normal(size=(2, 50)) * 3
    sigmoid = lambda x: 1 / (1 + np.exp(-x))  # noqa: E731
    expected = -np.log(sigmoid(real)).mean() - np.log(1 - sigmoid(fake)).mean()
    as32 = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    found = gan.discriminator_loss(as32(real), as32(fake))
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    expected = -np.log(sigmoid(fake)).mean()
    np.testing.assert_allclose(gan.generator_loss(as32(fake)), expected, rtol=1e-5)
    undecided = gan.discriminator_loss(jnp.zeros(4), jnp.zeros(7))
    np.testing.assert_allclose(undecided, 2 * np.log(2), rtol=1e-6)


def test_relativistic_loss_is_the_logarithm_of_a_win():
    rng = np.random.default_rng(0)
    won, lost = rng.normal(size=(2, 50)) * 3
    expected = -np.log(1 / (1 + np.exp(lost - won))).mean()
    as32 = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    found = gan.relativistic_loss(as32(won), as32(lost))
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    # What all logits share says nothing.
    np.testing.assert_allclose(
        gan.relativistic_loss(as32(won) + 5, as32(lost) + 5), found, rtol=1e-5
    )


def test_losses_are_finite_for_certain_discriminators():
    certain = jnp.array([-1e4, 1e4])
    assert np.isfinite(gan.discriminator_loss(certain, certain))
    assert np.isfinite(jax.grad(gan.generator_loss)(certain)).all()


def test_r1_is_the_squared_gradient():
    """Logit w . x + |x|^2 has gradient w + 2 x."""
    rng = np.random.default_rng(1)
    x, w = rng.normal(size=(6, 3)), rng.normal(size=3)
    weights = jnp.asarray(w, jnp.float32)
    discriminate = lambda y: y @ weights + jnp.sum(y * y, axis=-1)  # noqa: E731
    expected = np.square(w + 2 * x).sum(axis=-1).mean()
    found = gan.r1_penalty(discriminate, jnp.asarray(x, jnp.float32))
    np.testing.assert_allclose(found, expected, rtol=1e-5)
