import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from jaxmotion.evaluation import statistics


@pytest.mark.parametrize("level", [0.5, 0.95, 0.99])
@pytest.mark.parametrize("count", [2, 5, 20, 3000])
def test_student_interval_is_scipys(count, level):
    x = np.random.default_rng(count).normal(2.0, 3.0, count).astype(np.float32)
    got = statistics.confidence_interval(jnp.asarray(x), level=level)
    x = x.astype(np.float64)
    error = x.std(ddof=1) / np.sqrt(count)
    want = scipy.stats.t.interval(level, count - 1, loc=x.mean(), scale=error)
    np.testing.assert_allclose(got.estimate, x.mean(), rtol=1e-4)
    width = want[1] - want[0]
    np.testing.assert_allclose((got.low, got.high), want, atol=2e-3 * width)


def test_student_interval_holds_the_mean_as_often_as_it_says():
    x = jax.random.normal(jax.random.key(0), (500, 4))
    ends = [statistics.confidence_interval(row, level=0.9)[1:] for row in x]
    low, high = np.transpose(ends)
    rate = np.mean((low <= 0) & (high >= 0))
    assert abs(rate - 0.9) < 4 * np.sqrt(0.09 / 500)


@pytest.mark.parametrize("size", [10, 60])
@pytest.mark.parametrize("count", [6, 20])
def test_draws_of_the_same_things_hold_the_mean_as_often_as_they_say(size, count):
    """Of 120 things: without their part, intervals of halves hold it in 60 or 38 %."""
    generator, hits, plain = np.random.default_rng(0), 0, 0
    for _ in range(400):
        things = generator.normal(size=120)
        draws = [generator.permutation(things)[:size].mean() for _ in range(count)]
        found = statistics.confidence_interval(jnp.asarray(draws), part=size / 120)
        hits += found.low <= 0 <= found.high
        plain_one = statistics.confidence_interval(jnp.asarray(draws))
        plain += plain_one.low <= 0 <= plain_one.high
    assert abs(hits / 400 - 0.95) < 4 * np.sqrt(0.05 * 0.95 / 400)
    assert size == 10 or plain / 400 < 0.7


def test_bootstrap_of_a_mean_is_near_its_student_interval():
    x = np.random.default_rng(1).normal(size=200)
    got = statistics.bootstrap_interval(x, np.mean, seed=2, num_resamples=2000)
    want = statistics.confidence_interval(jnp.asarray(x, jnp.float32))
    assert got.estimate == x.mean()
    width = want.high - want.low
    # The ends of 2000 percentiles scatter by about 3 % of the width.
    np.testing.assert_allclose(got[1:], want[1:], atol=0.1 * width)
    assert statistics.bootstrap_interval(x, np.mean, seed=2, num_resamples=2000) == got


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="1 samples, expected at least 2"):
        statistics.confidence_interval(jnp.zeros(1))
    with pytest.raises(ValueError, match="1 samples, expected at least 2"):
        statistics.bootstrap_interval(np.zeros(1), np.mean, seed=0)


def test_moments_of_parts_are_those_of_the_whole():
    """Far from zero, where sums of squares would lose all digits in float32."""
    rng = np.random.default_rng(3)
    x = (1e4 + rng.normal(size=(1000, 2, 3))).astype(np.float32)
    parts = [statistics.spread(part) for part in np.split(x, [1, 10, 400])]
    found = functools.reduce(statistics.merge, parts)
    whole = x.astype(np.float64)
    assert found.count == 1000 and np.isnan(parts[0].variance).all()
    np.testing.assert_allclose(found.mean, whole.mean(0), rtol=1e-14)
    np.testing.assert_allclose(found.variance, whole.var(0, ddof=1), rtol=1e-9)
    one = statistics.spread(whole[:, 0, 0])
    ends = scipy.stats.t.interval(0.9, 999, one.mean, np.sqrt(one.variance / 1000))
    np.testing.assert_allclose(one.half_width(level=0.9), np.ptp(ends) / 2)
