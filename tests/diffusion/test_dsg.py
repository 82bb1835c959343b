"""Guidance on the sphere of the noise: eq. 13-15 of SMGDiff."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.diffusion import chain, guidance, schedule
from tests import mostly_slow, tiny
from tests.reference import diffusion as reference
from tests.reference import smgdiff as oracle

T, SHAPE = 8, (5, 3)
N = 15
TABLE = reference.coefficients(reference.cosine_betas(T))
STEPS = range(1, T + 1)
clone = jax.random.clone


def random(seed, shape=SHAPE):
    return tiny.float32(np.random.default_rng(seed).normal(size=shape))


GOAL = random(10)


def network(key, x_t, t):
    """Nonlinear, deterministic, and different at every step."""
    del key
    return jnp.tanh(1.3 * x_t + 0.1 * t.astype(x_t.dtype))


def distance(x_0):
    return 0.5 * jnp.sum(jnp.square(x_0 - GOAL))


def nothing(x_0):
    """A gate that is closed: no gradient anywhere."""
    return jnp.sum(jnp.where(x_0 > 100.0, x_0, 0.0))


def dsg(objective=distance, denoise=network, **options):
    return guidance.dsg_step(schedule.cosine_schedule(T), denoise, objective, **options)


def by_hand(key, x_t, t):
    """Mean, gradient at x_t and noise of a step, in float64."""
    x_t = np.float64(x_t)
    x_0 = np.tanh(1.3 * x_t + 0.1 * t)
    mean = TABLE["c1"][t - 1] * x_0 + TABLE["c2"][t - 1] * x_t
    gradient = 1.3 * (1 - x_0**2) * (x_0 - np.float64(GOAL))
    noise = jax.random.normal(jax.random.split(clone(key))[1], x_t.shape)
    return mean, gradient, np.float64(noise) * (t > 1)


def published(key, x_t, t, rate, last_sigma=None):
    mean, gradient, noise = by_hand(key, x_t, t)
    sigma = oracle.dsg_deviation(TABLE["v"], t, last_sigma)
    return oracle.dsg_update(mean, sigma, gradient, noise, rate)


@pytest.mark.parametrize("rate", mostly_slow([0.0, 0.2, 0.5, 1.0], [0.5]))
@pytest.mark.parametrize("last_sigma", [None, 0.02])
def test_the_step_is_the_published_update(rate, last_sigma):
    step = dsg(rate=rate, last_sigma=last_sigma)
    for t in STEPS:
        key, x_t = jax.random.key(t), random(t)
        expected = published(key, x_t, t, rate, last_sigma)
        found = step(key, x_t, jnp.array(t))
        np.testing.assert_allclose(found, expected, atol=5e-6, err_msg=str(t))


def test_the_papers_rate_is_the_default():
    key, x_t = jax.random.key(0), random(0)
    expected = published(key, x_t, 4, oracle.RATE)
    np.testing.assert_allclose(dsg()(key, x_t, jnp.array(4)), expected, atol=5e-6)


@pytest.mark.parametrize("rate", [0.1, 0.5, 1.0])
def test_the_step_ends_on_the_sphere(rate):
    step = dsg(rate=rate)
    for t in STEPS:
        key, x_t = jax.random.key(t), random(t)
        moved = (
            np.float64(step(clone(key), x_t, jnp.array(t))) - by_hand(key, x_t, t)[0]
        )
        # The variance of eq. 7 of Ho et al., and at the last step that of t = 2.
        radius = np.sqrt(N * TABLE["v"][max(t, 2) - 1])
        np.testing.assert_allclose(oracle.length(moved), radius, rtol=2e-6)


@pytest.mark.parametrize("t", mostly_slow(range(2, T + 1), [2]))
def test_the_ends_of_the_rate_are_the_noise_and_the_descent(t):
    key, x_t = jax.random.key(t), random(t)
    mean, gradient, noise = by_hand(key, x_t, t)
    for rate, along in ((0.0, noise), (1.0, -gradient)):
        moved = np.float64(dsg(rate=rate)(clone(key), x_t, jnp.array(t))) - mean
        cosine = np.sum(moved * along) / oracle.length(moved) / oracle.length(along)
        assert cosine > 1 - 1e-6


def test_the_last_step_is_descent_whatever_the_rate_and_the_key():
    x_t = random(1)
    mean, gradient, _ = by_hand(jax.random.key(0), x_t, 1)
    step = -np.sqrt(N * TABLE["v"][1]) * gradient / oracle.length(gradient)
    for seed, rate in enumerate((0.05, 0.5, 1.0)):
        found = dsg(rate=rate)(jax.random.key(seed), x_t, jnp.array(1))
        np.testing.assert_allclose(found, mean + step, atol=2e-6)


def test_a_last_step_without_length_returns_the_prediction_exactly():
    x_t, t = random(2), jnp.array(1)
    expected = network(None, x_t, t)
    for step in (dsg(last_sigma=0.0), dsg(rate=0.0)):
        np.testing.assert_array_equal(step(jax.random.key(0), x_t, t), expected)


def test_only_the_last_step_is_shortened():
    key, x_t = jax.random.key(3), random(3)
    for t in STEPS:
        one, other = (
            step(clone(key), x_t, jnp.array(t))
            for step in (dsg(), dsg(last_sigma=0.02))
        )
        if t > 1:
            np.testing.assert_array_equal(one, other)
        else:
            moved = np.float64(other) - by_hand(key, x_t, 1)[0]
            np.testing.assert_allclose(
                oracle.length(moved), 0.02 * np.sqrt(N), rtol=1e-5
            )


@pytest.mark.parametrize("rate", [0.0, 0.5, 1.0])
def test_nothing_to_guide_is_the_ancestral_step(rate):
    plain = chain.ancestral_step(schedule.cosine_schedule(T), network)
    for t in STEPS:
        key, x_t = jax.random.key(t), random(t)
        found = dsg(nothing, rate=rate)(clone(key), x_t, jnp.array(t))
        expected = plain(clone(key), x_t, jnp.array(t))
        np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize("scale", [1e-30, 1e-6, 1e6, 1e30])
def test_the_objectives_scale_is_no_matter(scale):
    """Also where the gradient's squares leave the range of float32."""
    for t in (1, 2, T):
        key, x_t = jax.random.key(t), random(t)
        found = dsg(lambda x: scale * distance(x))(clone(key), x_t, jnp.array(t))
        expected = dsg()(clone(key), x_t, jnp.array(t))
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_gradient_of_one_number_is_followed():
    """The whole length goes where the gradient is; all else takes its mean."""
    step = dsg(lambda x: x[2, 1], rate=1.0)
    x_t = random(4)
    mean, _, _ = by_hand(jax.random.key(0), x_t, 3)
    mean[2, 1] -= np.sqrt(N * TABLE["v"][2])
    found = step(jax.random.key(0), x_t, jnp.array(3))
    np.testing.assert_allclose(found, mean, atol=5e-6)


def shifted(shift):
    """The network with a parameter, for derivatives through a chain."""
    return lambda key, x_t, t: network(key, x_t, t) * jnp.exp(shift)


@jax.jit
def end(shift, active, rate):
    step = dsg(lambda x_0: active * distance(x_0), shifted(shift), rate=rate)
    x = chain.reverse_chain(step, jax.random.key(0), random(0), start=2)
    return jnp.sum(x**2)


slope_of_end = jax.jit(jax.grad(end))


@pytest.mark.parametrize(
    ("active", "rate"), [(1.0, 0.0), (1.0, 0.5), (1.0, 1.0), (0.0, 0.5)]
)
def test_gradients_through_a_guided_chain(active, rate):
    slope = slope_of_end(0.3, active, rate)
    up, down = (end(0.3 + d, active, rate) for d in (0.01, -0.01))
    assert jnp.abs(slope) > 0.1
    np.testing.assert_allclose(slope, (up - down) / 0.02, rtol=1e-2)


@jax.jit
@functools.partial(jax.value_and_grad, argnums=(0, 2))
def size_and_slopes(x_t, t, rate, active, last_sigma):
    step = dsg(lambda x: active * distance(x), rate=rate, last_sigma=last_sigma)
    return jnp.sum(step(jax.random.key(0), x_t, t) ** 2)


@pytest.mark.parametrize("active", [0.0, 1.0])
@pytest.mark.parametrize("last_sigma", [0.0, 0.2])
def test_values_and_derivatives_are_finite_everywhere(active, last_sigma):
    """Also where there is no gradient, no noise, or no length to go."""
    for t in STEPS:
        for rate in (0.0, 0.5, 1.0):
            # Far out the tanh is flat, and its gradient vanishes.
            for x_t in (random(t), 1e3 * random(t), jnp.zeros(SHAPE)):
                found = size_and_slopes(x_t, jnp.array(t), rate, active, last_sigma)
                leaves = jax.tree.leaves(found)
                assert all(bool(jnp.isfinite(leaf).all()) for leaf in leaves), (t, rate)


def test_a_goal_that_is_reached_stays_finite():
    """The gradient of |x - goal|^2 at the goal itself."""
    t = jnp.array(1)
    reached = network(None, random(0), t)
    step = dsg(lambda x: jnp.sum(jnp.square(x - reached)))
    np.testing.assert_array_equal(step(jax.random.key(0), random(0), t), reached)


def test_end_two_is_what_the_formulas_say():
    """Six ancestral steps, then two guided ones; the noises are those of the keys."""
    table, key, start = schedule.cosine_schedule(T), jax.random.key(21), random(21)

    @jax.jit
    def run(key, x):
        plain = chain.ancestral_step(table, network)
        x = chain.reverse_chain(plain, clone(key), x, start=T, stop=2)
        return chain.reverse_chain(dsg(), key, x, start=2)

    expected = np.float64(start)
    for t in range(T, 0, -1):
        key_t = jax.random.fold_in(clone(key), t)
        mean, gradient, noise = by_hand(key_t, expected, t)
        if t > 2:
            expected = mean + np.sqrt(TABLE["v"][t - 1]) * noise
        else:
            sigma = oracle.dsg_deviation(TABLE["v"], t)
            expected = oracle.dsg_update(mean, sigma, gradient, noise)
    np.testing.assert_allclose(run(key, start), expected, atol=2e-5)


def test_a_stochastic_network_is_called_once_and_keeps_its_key():
    calls = []

    def noisy(key, x_t, t):
        calls.append(t)
        return network(None, x_t, t) + 0.2 * jax.random.normal(key, x_t.shape)

    key, x_t, t = jax.random.key(6), random(6), jnp.array(3)
    found = dsg(nothing, noisy)(clone(key), x_t, t)
    assert len(calls) == 1
    plain = chain.ancestral_step(schedule.cosine_schedule(T), noisy)
    np.testing.assert_allclose(found, plain(clone(key), x_t, t), atol=1e-6)


def test_rate_and_last_sigma_may_be_traced_and_compile_once():
    @jax.jit
    @chex.assert_max_traces(n=1)
    def run(key, rate, last_sigma):
        step = dsg(rate=rate, last_sigma=last_sigma)
        return chain.reverse_chain(step, key, random(0), start=2)

    for rate, last_sigma in ((0.2, 0.1), (0.7, 0.0)):
        step = dsg(rate=rate, last_sigma=last_sigma)
        expected = chain.reverse_chain(step, jax.random.key(1), random(0), start=2)
        found = run(jax.random.key(1), jnp.array(rate), jnp.array(last_sigma))
        np.testing.assert_allclose(found, expected, atol=2e-6)


MEAN, VARIANCE = 1.5, 0.3


def test_guidance_lowers_the_objective_and_the_noise_alone_does_not():
    """Samples of a Gaussian, drawn toward a point at two deviations; paired z-scores.

    The last step has no length, so that what is seen comes from the step before.
    """
    betas = reference.cosine_betas(T)
    lines = [
        [reference.exact_denoiser(betas, i, x, MEAN, VARIANCE)[0] for x in (0.0, 1.0)]
        for i in range(T)
    ]
    zero, one = jnp.asarray(np.transpose(lines), jnp.float32)
    denoise = lambda key, x_t, t: zero[t - 1] + (one - zero)[t - 1] * x_t  # noqa: E731
    goal = MEAN + 2 * np.sqrt(VARIANCE)
    objective = lambda x: 0.5 * jnp.mean(jnp.square(x - goal))  # noqa: E731
    plain = chain.ancestral_step(schedule.cosine_schedule(T), denoise)

    def gain(key, rate):
        """By how much two guided steps end lower than two plain ones do."""
        guided = dsg(objective, denoise, rate=rate, last_sigma=0.0)
        key_start, key = jax.random.split(key)
        x = jax.random.normal(key_start, (16,))
        x = chain.reverse_chain(plain, clone(key), x, start=T, stop=3)
        without, given = (
            objective(chain.reverse_chain(step, clone(key), x, start=3))
            for step in (plain, guided)
        )
        return without - given

    @jax.jit
    def z_score(rate):
        keys = jax.random.split(jax.random.key(5), 2000)
        gains = jax.vmap(gain, (0, None))(keys, rate)
        return gains.mean() / gains.std() * jnp.sqrt(len(gains))

    assert z_score(0.2) > 10 and z_score(0.5) > 10
    # The step's length alone has the same second moment as Gaussian noise.
    assert abs(z_score(0.0)) < 4
