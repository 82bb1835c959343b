"""R-precision and the matching distance against loops, ties included."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import matching
from tests.reference import matching as oracle


def pairs(count, noise=1.0, size=6):
    generator = np.random.default_rng(0)
    text = generator.normal(size=(count, size))
    motion = text + noise * generator.normal(size=(count, size))
    return text.astype(np.float32), motion.astype(np.float32)


@pytest.mark.parametrize("noise", [0.1, 1.0, 10.0])
def test_r_precision_is_the_loops(noise):
    text, motion = pairs(23, noise)
    got = matching.r_precision(jnp.asarray(text), jnp.asarray(motion), top=4, pool=5)
    want = oracle.r_precision(*(x.astype(np.float64) for x in (text, motion)), 4, 5)
    assert got.shape == (4,)
    np.testing.assert_allclose(got, want, atol=1e-6)


def test_ties_count_by_chance():
    """Two motions of a pool are equal, and in another all embeddings are."""
    text, motion = pairs(10)
    motion[1] = motion[3]
    text[5:], motion[5:] = text[5], motion[5]
    got = matching.r_precision(jnp.asarray(text), jnp.asarray(motion), top=5, pool=5)
    want = oracle.r_precision(*(x.astype(np.float64) for x in (text, motion)), 5, 5)
    np.testing.assert_allclose(got, want, atol=1e-6)
    same = jnp.ones((64, 3))
    np.testing.assert_allclose(
        matching.r_precision(same, same), np.arange(1, 4) / 32, rtol=1e-6
    )


def test_motions_are_ranked_for_a_sentence_and_not_the_reverse():
    text = jnp.array([[0.0], [1.0]])
    motion = jnp.array([[0.9], [5.0]])  # each sentence is nearest to motion 0
    got = matching.r_precision(text, motion, top=1, pool=2)
    np.testing.assert_allclose(got, [0.5])
    got = matching.r_precision(motion, text, top=1, pool=2)
    np.testing.assert_allclose(got, [0.5])
    text = jnp.array([[0.0], [4.0]])
    motion = jnp.array([[1.0], [1.5]])
    np.testing.assert_allclose(matching.r_precision(text, motion, top=1, pool=2), [1.0])
    np.testing.assert_allclose(matching.r_precision(motion, text, top=1, pool=2), [0.5])


def test_rows_beyond_the_last_pool_are_left_out():
    text, motion = map(jnp.asarray, pairs(70))
    got = matching.r_precision(text, motion)
    np.testing.assert_array_equal(got, matching.r_precision(text[:64], motion[:64]))
    other = motion.at[64:].set(text[64:])
    np.testing.assert_array_equal(got, matching.r_precision(text, other))


def test_pools_of_chance():
    text, _ = pairs(3200)
    got = matching.r_precision(jnp.asarray(text), jnp.asarray(text[::-1].copy()))
    chance = np.arange(1, 4) / 32
    error = np.sqrt(chance * (1 - chance) / 3200)
    assert np.all(np.abs(got - chance) < 5 * error)


def test_broken_embeddings_do_not_score():
    text, motion = map(jnp.asarray, pairs(10))
    got = matching.r_precision(text, motion.at[3, 0].set(jnp.nan), top=2, pool=5)
    assert np.isnan(got).all()


def test_matching_distance_is_the_loops():
    text, motion = pairs(9)
    got = matching.matching_distance(jnp.asarray(text), jnp.asarray(motion))
    want = oracle.matching_distance(text.astype(np.float64), motion.astype(np.float64))
    np.testing.assert_allclose(got, want, rtol=1e-6)


def test_bad_input_is_named():
    x = jnp.zeros((31, 3))
    with pytest.raises(ValueError, match="31 samples, expected at least a pool of 32"):
        matching.r_precision(x, x)
    with pytest.raises(ValueError, match=r"top 6, expected 1\.\.5"):
        matching.r_precision(x, x, top=6, pool=5)
    with pytest.raises(ValueError, match="top 0"):
        matching.r_precision(x, x, top=0)
