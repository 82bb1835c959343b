import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxmotion.evaluation import frechet
from tests.reference import metrics as oracle


def samples(seed, count, features, scale=1.0, shift=0.0):
    rng = np.random.default_rng(seed)
    mix = rng.normal(size=(features, features)) * scale
    return (rng.normal(size=(count, features)) @ mix + shift).astype(np.float32)


def fit(x):
    return frechet.moments(jnp.asarray(x))


def count_of(x, padding=0):
    """Rows, with others of no meaning after them, and how many count."""
    filled = np.pad(x, ((0, padding), (0, 0)), constant_values=7.0)
    return jnp.asarray(filled), jnp.asarray(len(x))


def test_moments_are_numpys():
    x = samples(0, 50, 4, shift=100.0)
    got = fit(x)
    np.testing.assert_allclose(got.mean, x.astype(np.float64).mean(0), rtol=1e-5)
    want = np.cov(x.astype(np.float64), rowvar=False)
    np.testing.assert_allclose(got.covariance, want, rtol=1e-3, atol=1e-3)
    assert got.count == 50


@pytest.mark.parametrize("features, count", [(3, 200), (32, 500)])
def test_distance_is_that_of_scipys_matrix_root(features, count):
    a = samples(2, count, features)
    b = samples(3, count + 7, features, scale=1.5, shift=0.3)
    want = oracle.frechet(a.astype(np.float64), b.astype(np.float64))
    got = frechet.frechet_distance(fit(a), fit(b))
    np.testing.assert_allclose(got, want, rtol=1e-4)
    back = frechet.frechet_distance(fit(b), fit(a))
    np.testing.assert_allclose(back, got, rtol=1e-4)
    rows = frechet.frechet_distance_of_rows(*count_of(a), *count_of(b))
    np.testing.assert_allclose(rows, want, rtol=2e-5)


def test_distance_of_one_feature_is_closed_form():
    a, b = np.array([[-1.0], [0], [1]]), np.array([[3.0], [5], [7]])
    got = frechet.frechet_distance(fit(a.astype(np.float32)), fit(b.astype(np.float32)))
    np.testing.assert_allclose(got, 5.0**2 + (1.0 - 2.0) ** 2, rtol=1e-6)


def test_distance_of_singular_covariances():
    # Fewer samples than features: SciPy's root is unsafe here.
    a, b = samples(4, 20, 64), samples(5, 20, 64, shift=0.1)
    want = oracle.frechet_of_rows(a, b)
    spread = np.var(a, axis=0).sum() + np.var(b, axis=0).sum()
    got = frechet.frechet_distance(fit(a), fit(b))
    np.testing.assert_allclose(got, want, atol=1e-3 * spread)
    got = frechet.frechet_distance_of_rows(*count_of(a, 3), *count_of(b, 9))
    np.testing.assert_allclose(got, want, rtol=1e-5)
    assert np.isnan(frechet.frechet_distance_of_rows(a, 1, b, 20))


def test_distance_of_covariances_without_a_direction_in_common():
    """Traces alone: the root of an eigenvalue that is a rounding error would show."""
    axes = np.linalg.qr(np.random.default_rng(7).normal(size=(64, 64)))[0]
    a, b = (
        frechet.Moments(
            mean=jnp.zeros(64),
            covariance=jnp.asarray(size * own @ own.T, jnp.float32),
            count=jnp.array(9.0),
        )
        for size, own in ((4.0, axes[:, :8]), (9.0, axes[:, 30:40]))
    )
    got = frechet.frechet_distance(a, b)
    np.testing.assert_allclose(got, 4.0 * 8 + 9.0 * 10, rtol=1e-5)


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


@pytest.mark.parametrize("features", [4, 24])
def test_distance_is_scipys_to_1e_5(features):
    """Given moments, so that only the distance itself is on trial."""
    rng = np.random.default_rng(features)
    made = []
    for _ in range(2):
        mix = rng.normal(size=(features, 3 * features)) / np.sqrt(features)
        covariance = np.float32(mix @ mix.T)
        mean = np.float32(rng.normal(size=features))
        made.append((mean, (covariance + covariance.T) / 2))
    got = frechet.frechet_distance(
        *(
            frechet.Moments(
                mean=jnp.asarray(m), covariance=jnp.asarray(c), count=jnp.array(9.0)
            )
            for m, c in made
        )
    )
    (m_a, c_a), (m_b, c_b) = [(m.astype(float), c.astype(float)) for m, c in made]
    root = scipy.linalg.sqrtm(c_a @ c_b).real
    want = np.sum((m_a - m_b) ** 2) + np.trace(c_a + c_b - 2 * root)
    np.testing.assert_allclose(got, want, rtol=1e-5)


def test_masked_moments_are_those_of_the_rows():
    x = samples(9, 40, 3, shift=5.0)
    mask = np.random.default_rng(0).uniform(size=40) < 0.4
    got = frechet.masked_moments(jnp.asarray(x), jnp.asarray(mask))
    kept = x[mask].astype(np.float64)
    np.testing.assert_allclose(got.mean, kept.mean(0), rtol=1e-5)
    want = np.cov(kept, rowvar=False)
    np.testing.assert_allclose(got.covariance, want, rtol=1e-4, atol=1e-4)
    assert got.count == mask.sum()
    one = frechet.masked_moments(jnp.asarray(x), jnp.arange(40) == 7)
    np.testing.assert_allclose(one.mean, x[7], rtol=1e-6)
    assert np.isnan(one.covariance).all()
