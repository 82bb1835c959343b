"""Moments of chunks that are never all in memory, against float64 of all at once."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import frechet, streaming

MIX = np.array([[0.1, 0.0, 0.0], [0.05, 0.08, 0.0], [-0.02, 0.03, 0.06]], np.float32)
MEAN = np.array([1e3, -1e3, 0.0], np.float32)


def chunk(i, *, size=1000, drift=0.0):
    """Of correlated features far from zero, whose mean may drift with the chunks."""
    key = jax.random.fold_in(jax.random.key(0), i)
    x = jax.random.normal(key, (size, 3))
    x = jnp.matmul(x, MIX.T, precision="highest")
    return x + MEAN[None] + drift * i.astype(jnp.float32)


def together(number, **options):
    """All chunks as float64; each from the same compiled function."""
    make = jax.jit(functools.partial(chunk, **options))
    return np.concatenate([np.asarray(make(jnp.int32(i))) for i in range(number)])


def streamed(number, **options):
    make = functools.partial(chunk, **options)
    run = lambda: streaming.streaming_moments(make, num_chunks=number)  # noqa: E731
    return jax.jit(run)()


def test_a_million_samples_far_from_zero():
    """Mean 1000, deviation 0.1: both survive float32."""
    x = together(1000).astype(np.float64)
    got = streamed(1000)
    assert got.count == len(x) == 1_000_000
    # Half of a float32's last place at 1000 is 3e-5.
    np.testing.assert_allclose(got.mean, x.mean(0), atol=4e-5)
    expected = np.cov(x, rowvar=False)
    np.testing.assert_allclose(got.covariance, expected, rtol=0, atol=5e-8)
    # Sums of squares in float32 are off by more than the variance itself.
    naive = np.mean(np.float32(x) ** 2, axis=0) - np.mean(np.float32(x), axis=0) ** 2
    assert np.abs(naive - np.diag(expected)).max() > 0.01


def test_a_mean_that_drifts():
    """Chunks unlike the first one: 0.01 a chunk, so that the drift is the deviation."""
    x = together(300, size=50, drift=0.01).astype(np.float64)
    got = streamed(300, size=50, drift=0.01)
    deviation = x.std(0)
    np.testing.assert_allclose(got.mean, x.mean(0), atol=1e-4 * deviation.max())
    expected = np.cov(x, rowvar=False)
    np.testing.assert_allclose(got.covariance, expected, rtol=1e-5)


def test_one_chunk_and_the_distance_of_streams():
    got, want = streamed(1, size=40), frechet.moments(chunk(jnp.int32(0), size=40))
    np.testing.assert_allclose(got.covariance, want.covariance, rtol=2e-3, atol=1e-6)
    np.testing.assert_allclose(got.mean, want.mean, rtol=1e-6)
    x = together(20, size=40).astype(np.float64)
    other = frechet.Moments(
        mean=jnp.asarray(MEAN) + 0.5, covariance=jnp.eye(3), count=jnp.array(9.0)
    )
    got = frechet.frechet_distance(streamed(20, size=40), other)
    root = np.sqrt(np.linalg.eigvalsh(np.cov(x, rowvar=False)))
    want = np.sum((x.mean(0) - MEAN - 0.5) ** 2) + np.sum((root - 1.0) ** 2)
    np.testing.assert_allclose(got, want, rtol=1e-3)


def test_memory_does_not_grow_with_the_chunks():
    def temporary(number):
        make = functools.partial(chunk, size=1000)
        run = jax.jit(lambda: streaming.streaming_moments(make, num_chunks=number))
        return run.lower().compile().memory_analysis().temp_size_in_bytes

    few, many = temporary(10), temporary(1000)
    assert 0 < many < few + 100_000


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="0 chunks"):
        streaming.streaming_moments(chunk, num_chunks=0)
    with pytest.raises(ValueError, match="1 samples, expected at least 2"):
        streaming.streaming_moments(lambda i: jnp.zeros((1, 3)), num_chunks=2)
