import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.diffusion import chain, guidance, schedule
from tests import tiny


def random(seed, shape=(5, 3)):
    return tiny.float32(np.random.default_rng(seed).normal(size=shape))


def network(key, x_t, t, cond):
    """Nonlinear in x and the condition; draws a latent."""
    latent = jax.random.normal(key, (3,))
    label = jax.nn.one_hot(cond["label"], 3)
    shift = cond["past"] + label + latent
    shift = shift.reshape((1,) * (x_t.ndim - 1) + (3,))
    shift = jnp.broadcast_to(shift, x_t.shape)
    return jnp.tanh(x_t + shift * t.astype(x_t.dtype))


COND = {"past": random(1, (3,)), "label": jnp.array(2)}
NULL = {"past": jnp.zeros(3), "label": jnp.array(2)}


@pytest.mark.parametrize("scale", [0.0, 0.5, 0.7, 1.0, 2.5])
def test_one_stacked_call_equals_two_calls_with_one_key(scale):
    guided = guidance.classifier_free(network, COND, NULL, scale)
    key, x, t = jax.random.key(0), random(0), jnp.array(3)
    cond, null = (
        np.float64(network(jax.random.clone(key), x, t, c)) for c in (COND, NULL)
    )
    expected = (1 - scale) * null + scale * cond
    np.testing.assert_allclose(guided(key, x, t), expected, atol=1e-6)


def test_the_network_is_called_once():
    calls = []

    def counted(key, x_t, t, cond):
        calls.append(x_t.shape)
        return network(key, x_t, t, cond)

    guided = guidance.classifier_free(counted, COND, NULL, 2.0)
    guided(jax.random.key(0), random(0), jnp.array(1))
    assert calls == [(5, 3)]


def test_a_network_sees_one_matrix_product_for_both_conditions():
    weight = random(2, (3, 3))

    def linear(key, x_t, t, cond):
        del key, t
        return (x_t + cond) @ weight

    guided = guidance.classifier_free(
        linear, random(3, (3,))[None], jnp.zeros((1, 3)), 2.0
    )
    program = jax.make_jaxpr(guided)(jax.random.key(0), random(0), jnp.array(1))
    assert str(program).count("dot_general") == 1


def test_guided_chain_jits_with_a_traced_scale():
    table = schedule.cosine_schedule(4)

    @jax.jit
    @chex.assert_max_traces(n=1)
    def run(key, scale, cond):
        denoise = guidance.classifier_free(network, cond, NULL, scale)
        step = chain.ancestral_step(table, denoise)
        return chain.reverse_chain(step, key, random(0), start=4)

    for scale in (0.5, 2.0):
        denoise = guidance.classifier_free(network, COND, NULL, scale)
        step = chain.ancestral_step(table, denoise)
        expected = chain.reverse_chain(step, jax.random.key(1), random(0), start=4)
        found = run(jax.random.key(1), jnp.array(scale), COND)
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_python_numbers_are_leaves():
    def plain(key, x_t, t, cond):
        del key, t
        return x_t * cond

    guided = guidance.classifier_free(plain, 2.0, 0.0, 1.5)
    found = guided(jax.random.key(0), jnp.ones(2), jnp.array(1))
    np.testing.assert_allclose(found, 3.0)


@pytest.mark.parametrize(
    ("null", "message"),
    [
        ({"past": jnp.zeros(3)}, "structure"),
        (NULL | {"past": jnp.zeros(4)}, r"null_cond\['past'\] is float32\[4\]"),
        (NULL | {"label": jnp.array(0.0)}, r"null_cond\['label'\] is float32"),
    ],
)
def test_conditions_that_differ(null, message):
    with pytest.raises(ValueError, match=message):
        guidance.classifier_free(network, COND, null, 1.0)


@pytest.mark.parametrize("t", [1, 3, 5])
def test_gradient_guidance_of_a_linear_denoiser(t):
    """Oracle in float64: x_0 = A x_t + b, J = |x_0 - g|^2 / 2."""
    rng = np.random.default_rng(0)
    a, b, g, x = rng.normal(size=(3, 3)), *rng.normal(size=(3, 3))
    table = schedule.cosine_schedule(5)
    as32 = lambda y: jnp.asarray(y, jnp.float32)  # noqa: E731
    denoise = lambda key, x_t, t: as32(a) @ x_t + as32(b)  # noqa: E731
    objective = lambda x_0: 0.5 * jnp.sum(jnp.square(x_0 - as32(g)))  # noqa: E731
    guided = guidance.gradient_guidance(table, denoise, objective, scale=0.3)
    x_0 = a @ x + b
    expected = x_0 - 0.3 * (1 - np.float64(table.beta[t])) * a.T @ (x_0 - g)
    found = guided(jax.random.key(0), as32(x), jnp.array(t))
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-6)


def test_gradient_guidance_passes_the_key_and_vanishes_with_its_scale():
    table = schedule.cosine_schedule(5)
    denoise = lambda key, x_t, t: jnp.tanh(x_t + jax.random.normal(key, (3,)))  # noqa: E731
    guided = guidance.gradient_guidance(table, denoise, jnp.sum, scale=0.0)
    key, x, t = jax.random.key(3), random(0, (3,)), jnp.array(2)
    expected = denoise(jax.random.clone(key), x, t)
    np.testing.assert_array_equal(guided(key, x, t), expected)
