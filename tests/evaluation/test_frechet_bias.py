"""Gaussians whose distance is known: small subsets overstate it, the line does not."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import frechet, frechet_bias
from tests.reference import metrics as oracle

FEATURES, COUNT = 6, 240
SIZES = frechet_bias.subset_sizes(COUNT, number=6, least=40)
DEVIATION = np.linspace(0.5, 2.0, FEATURES).astype(np.float32)
SHIFT = 0.3
# Distance of N(SHIFT, DEVIATION^2) to N(0, 1) in each feature.
TRUE = float(np.sum(SHIFT**2 + (DEVIATION.astype(float) - 1.0) ** 2))
STANDARD = frechet.Moments(
    mean=jnp.zeros(FEATURES),
    covariance=jnp.eye(FEATURES),
    count=jnp.array(jnp.inf),
)


def draw(key, count=COUNT):
    x = jax.random.normal(key, (count, FEATURES))
    return SHIFT + x * jnp.asarray(DEVIATION)[None]


@functools.cache
def checks():
    """Estimates from 64 independent sets of samples."""

    def one(keys):
        key_data, key_subsets = keys
        return frechet_bias.frechet_bias(
            key_subsets, draw(key_data), STANDARD, sizes=SIZES, repeats=2
        )

    keys = jax.random.split(jax.random.key(0), (64, 2))
    return jax.jit(lambda keys: jax.lax.map(one, keys))(keys)


def z_score(values, expected):
    values = np.asarray(values, np.float64)
    return (values.mean() - expected) / (values.std(ddof=1) / np.sqrt(values.size))


def test_the_line_meets_the_true_distance():
    assert abs(z_score(checks().extrapolated, TRUE)) < 3.5


def test_distances_of_few_samples_are_too_large_by_c_over_n():
    found = checks()
    by_size = np.asarray(found.distances, np.float64).mean(-1)  # [sets, sizes]
    assert z_score(by_size[:, 0], TRUE) > 8
    assert z_score(by_size[:, -1], TRUE) > 2
    excess = by_size.mean(0) - TRUE
    # Six times as many samples have a sixth of the excess, as far as that can be told.
    error = by_size[:, -1].std(ddof=1) / np.sqrt(len(by_size))
    assert abs(excess[-1] - excess[0] * SIZES[0] / SIZES[-1]) < 4 * error
    slope = np.mean(found.slope)
    assert 0.7 * excess[0] * SIZES[0] < slope < 1.3 * excess[0] * SIZES[0]


def test_a_subset_of_all_samples_is_all_samples():
    """And the line is that of NumPy's least squares."""
    x = np.asarray(draw(jax.random.key(1)))
    other = np.random.default_rng(0).normal(size=(500, FEATURES)).astype(np.float32)
    found = frechet_bias.frechet_bias(
        jax.random.key(2),
        jnp.asarray(x),
        frechet.moments(jnp.asarray(other)),
        sizes=SIZES,
        repeats=3,
    )
    assert found.distances.shape == (6, 3)
    np.testing.assert_array_equal(found.sizes, SIZES)
    whole = oracle.frechet(x.astype(float), other.astype(float))
    np.testing.assert_allclose(found.distances[-1], whole, rtol=1e-4)
    assert np.unique(np.round(found.distances[0], 4)).size == 3
    inverse = np.repeat(1.0 / np.asarray(SIZES), 3)
    slope, start = np.polyfit(inverse, np.asarray(found.distances, float).ravel(), 1)
    np.testing.assert_allclose(found.extrapolated, start, rtol=1e-4)
    np.testing.assert_allclose(found.slope, slope, rtol=1e-3)


def test_subsets_are_as_numpys():
    """Means over random subsets agree; the generators do not."""
    x = np.asarray(draw(jax.random.key(3), 60))
    found = frechet_bias.frechet_bias(
        jax.random.key(4), jnp.asarray(x), STANDARD, sizes=(20, 60), repeats=200
    )
    rng = np.random.default_rng(5)
    expected = []
    for _ in range(200):
        chosen = x[rng.choice(60, 20, replace=False)].astype(float)
        values, vectors = np.linalg.eigh(np.cov(chosen, rowvar=False))
        root = np.sqrt(np.maximum(values, 0.0))
        expected.append(np.sum(chosen.mean(0) ** 2) + np.sum((root - 1.0) ** 2))
    got = np.asarray(found.distances[0], float)
    error = np.sqrt((np.var(got, ddof=1) + np.var(expected, ddof=1)) / 200)
    assert abs(got.mean() - np.mean(expected)) < 4 * error


def test_sizes_are_evenly_spaced():
    assert frechet_bias.subset_sizes(50_000, least=5_000)[:3] == (5000, 8214, 11429)
    assert frechet_bias.subset_sizes(50_000, least=5_000)[-1] == 50_000
    assert frechet_bias.subset_sizes(5, number=4, least=2) == (2, 3, 4, 5)


@pytest.mark.parametrize("given", [(10, 1, 2), (10, 5, 1), (10, 5, 7), (3, 2, 3)])
def test_sizes_that_do_not_fit_are_refused(given):
    count, number, least = given
    with pytest.raises(ValueError, match=f"{number} sizes from {least} to {count}"):
        frechet_bias.subset_sizes(count, number=number, least=least)


@pytest.mark.parametrize("sizes", [(5,), (5, 5), (1, 5), (5, 11)])
def test_subsets_that_do_not_fit_are_refused(sizes):
    with pytest.raises(ValueError, match="of 10 samples: expected"):
        frechet_bias.frechet_bias(
            jax.random.key(0), jnp.zeros((10, FEATURES)), STANDARD, sizes=sizes
        )


def test_subsets_have_their_size():
    """Distances of two of four numbers from a normal one are those of some pair."""
    x = np.array([0.0, 1.0, 10.0, 100.0], np.float32)
    normal = frechet.Moments(
        mean=jnp.zeros(1), covariance=jnp.ones((1, 1)), count=jnp.array(9.0)
    )
    found = frechet_bias.frechet_bias(
        jax.random.key(0), jnp.asarray(x[:, None]), normal, sizes=(2, 4), repeats=8
    ).distances
    pairs = [[a, b] for i, a in enumerate(x) for b in x[:i]]
    own = lambda x: np.mean(x) ** 2 + (np.std(x, ddof=1) - 1) ** 2  # noqa: E731
    known = np.array([own(pair) for pair in pairs])
    off = np.abs(np.asarray(found[0])[:, None] / known - 1).min(axis=1)
    assert off.max() < 1e-4
    np.testing.assert_allclose(found[1], own(x), rtol=1e-4)
