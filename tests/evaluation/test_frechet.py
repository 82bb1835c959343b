import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import frechet
from tests.reference import metrics as oracle


def samples(seed, count, features, scale=1.0, shift=0.0):
    rng = np.random.default_rng(seed)
    mix = rng.normal(size=(features, features)) * scale
    return (rng.normal(size=(count, features)) @ mix + shift).astype(np.float32)


def fit(x):
    return frechet.moments(jnp.asarray(x))


def test_moments_are_numpys():
    x = samples(0, 50, 4, shift=100.0)
    got = fit(x)
    np.testing.assert_allclose(got.mean, x.astype(np.float64).mean(0), rtol=1e-5)
    want = np.cov(x.astype(np.float64), rowvar=False)
    np.testing.assert_allclose(got.covariance, want, rtol=1e-3, atol=1e-3)
    assert got.count == 50


def test_merged_moments_are_those_of_all():
    x = samples(1, 90, 5, shift=3.0)
    parts = [fit(x[:20]), fit(x[20:50]), fit(x[50:])]
    got = frechet.merge(frechet.merge(parts[0], parts[1]), parts[2])
    want = fit(x)
    np.testing.assert_allclose(got.mean, want.mean, rtol=1e-5)
    np.testing.assert_allclose(got.covariance, want.covariance, rtol=1e-4, atol=1e-4)
    assert got.count == 90


@pytest.mark.parametrize("features, count", [(3, 200), (32, 500)])
def test_distance_is_that_of_scipys_matrix_root(features, count):
    a = samples(2, count, features)
    b = samples(3, count + 7, features, scale=1.5, shift=0.3)
    want = oracle.frechet(a.astype(np.float64), b.astype(np.float64))
    got = frechet.frechet_distance(fit(a), fit(b))
    np.testing.assert_allclose(got, want, rtol=1e-4)
    back = frechet.frechet_distance(fit(b), fit(a))
    np.testing.assert_allclose(back, got, rtol=1e-4)
    release = frechet.frechet_distance_camdm_release(fit(a), fit(b))
    np.testing.assert_allclose(release, want / features, rtol=1e-4)


def test_distance_of_one_feature_is_closed_form():
    a, b = np.array([[-1.0], [0], [1]]), np.array([[3.0], [5], [7]])
    got = frechet.frechet_distance(fit(a.astype(np.float32)), fit(b.astype(np.float32)))
    np.testing.assert_allclose(got, 5.0**2 + (1.0 - 2.0) ** 2, rtol=1e-6)


def test_distance_of_singular_covariances():
    # Fewer samples than features: SciPy's root is unsafe here, so the oracle is the
    # nuclear norm of the two centred data matrices, without any covariance.
    a, b = samples(4, 20, 64), samples(5, 20, 64, shift=0.1)
    a64, b64 = (x.astype(np.float64) for x in (a, b))
    centred = [(x - x.mean(0)) / np.sqrt(19) for x in (a64, b64)]
    cross = np.linalg.svd(centred[0] @ centred[1].T, compute_uv=False).sum()
    spread = sum((x**2).sum() for x in centred)
    want = ((a64.mean(0) - b64.mean(0)) ** 2).sum() + spread - 2 * cross
    got = frechet.frechet_distance(fit(a), fit(b))
    np.testing.assert_allclose(got, want, atol=1e-3 * spread)


def test_distance_to_itself_is_zero_and_never_negative():
    x = samples(6, 100, 16)
    spread = float(np.trace(np.cov(x, rowvar=False)))
    got = frechet.frechet_distance(fit(x), fit(x))
    assert 0 <= got < 1e-4 * spread
    constant = fit(np.ones((4, 3), np.float32))
    assert frechet.frechet_distance(constant, constant) == 0.0


def test_one_sample_has_no_covariance():
    with pytest.raises(ValueError, match="1 samples, expected at least 2"):
        frechet.moments(jnp.zeros((1, 3)))


def test_distance_maps_over_a_batch_of_styles():
    a, b = (jnp.asarray(samples(s, 60, 3).reshape(3, 20, 3)) for s in (7, 8))
    made = [jax.vmap(frechet.moments)(x) for x in (a, b)]
    got = jax.vmap(frechet.frechet_distance)(*made)
    want = [oracle.frechet(np.float64(a[i]), np.float64(b[i])) for i in range(3)]
    np.testing.assert_allclose(got, want, rtol=1e-3)
