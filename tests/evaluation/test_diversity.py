import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import diversity
from tests.reference import metrics as oracle


def test_diversity_is_an_unbiased_mean_over_different_pairs():
    # Few samples, where pairs of a sample with itself would lower the mean by 1/5.
    x = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    want = oracle.mean_pair_distance(x.astype(np.float64))
    pairs = 20_000
    got = diversity.diversity(jax.random.key(0), jnp.asarray(x), num_pairs=pairs)
    gaps = np.linalg.norm(x[:, None] - x[None], axis=-1)
    error = gaps[~np.eye(5, dtype=bool)].std() / np.sqrt(pairs)
    assert abs(float(got) - want) < 4 * error


def test_pairs_are_never_of_one_sample():
    x = jnp.array([[0.0], [1.0]])
    got = diversity.diversity(jax.random.key(1), x, num_pairs=100)
    np.testing.assert_allclose(got, 1.0)


def test_multimodality_ignores_differences_between_conditions():
    x = jnp.array([[[0.0], [1.0]], [[100.0], [103.0]]])
    got = diversity.multimodality(jax.random.key(2), x, num_pairs=10)
    np.testing.assert_allclose(got, (1.0 + 3.0) / 2)


def test_intra_style_variance_is_numpys():
    x = np.random.default_rng(1).normal(size=(6, 4, 3, 3)).astype(np.float32)
    want = np.var(x.astype(np.float64), axis=0, ddof=1).sum(-1).mean()
    got = diversity.intra_style_variance(jnp.asarray(x))
    np.testing.assert_allclose(got, want, rtol=1e-5)
    same = jnp.broadcast_to(jnp.asarray(x[:1]), x.shape)
    np.testing.assert_allclose(diversity.intra_style_variance(same), 0.0, atol=1e-12)


def repeated(metric, x, *, pairs, number=3000):
    """Mean over many draws, and the error of that mean."""
    keys = jax.random.split(jax.random.key(4), number)
    found = jax.vmap(lambda k: metric(k, jnp.asarray(x), num_pairs=pairs))(keys)
    return float(found.mean()), float(found.std(ddof=1)) / np.sqrt(number)


def test_distance_of_joints_is_the_mean_over_pairs_frames_and_joints():
    x = np.random.default_rng(5).normal(size=(4, 3, 2, 3)).astype(np.float32)
    gaps = np.linalg.norm(x[:, None].astype(float) - x[None], axis=-1)
    gaps = gaps[~np.eye(4, dtype=bool)].mean((-1, -2))
    pairs = 20_000
    got = diversity.joint_distance(jax.random.key(0), jnp.asarray(x), num_pairs=pairs)
    assert abs(float(got) - gaps.mean()) < 4 * gaps.std() / np.sqrt(pairs)
    apart = jnp.zeros((2, 5, 7, 3)).at[1].add(jnp.array([0.0, 0.3, 0.4])[None, None])
    got = diversity.joint_distance(jax.random.key(1), apart, num_pairs=33)
    np.testing.assert_allclose(got, 0.5, rtol=1e-6)


def test_single_samples_are_refused():
    with pytest.raises(ValueError, match="1 samples, expected at least 2"):
        diversity.diversity(jax.random.key(0), jnp.zeros((1, 3)), num_pairs=2)
    with pytest.raises(ValueError, match="1 repeats, expected at least 2"):
        diversity.intra_style_variance(jnp.zeros((1, 2, 2, 3)))
