"""AAMDM's networks against plain NumPy, and what they depend on."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.networks import blocks, mlp
from tests import tiny

NET = mlp.ConditionedMlp(
    features=3, num_steps=4, width=16, depth=3, time_width=8, groups=4
)
DISCRIMINATOR = mlp.PairDiscriminator(num_steps=4, width=16, depth=2, time_width=8)


def vectors(number, *batch):
    rng = np.random.default_rng(number)
    return [
        jnp.asarray(rng.normal(size=(*batch, 3)), jnp.float32) for _ in range(number)
    ]


@functools.cache
def parameters(adversary):
    x, y, z = vectors(3)
    given = (x, y, jnp.array(1), z) if adversary else (x, jnp.array(1), y, z)
    return tiny.random_params((DISCRIMINATOR if adversary else NET).init, *given)


def dense(layer, x):
    return x @ np.float64(layer["kernel"]) + np.float64(layer["bias"])


def silu(x):
    return x / (1 + np.exp(-x))


def time_code(params, t):
    code = np.float64(blocks.sinusoidal_positions(4, 8))[t - 1]
    layers = params["TimeEmbedding_0"]
    return dense(layers["out"], silu(dense(layers["hidden"], code)))


def test_network_is_the_formula():
    params = parameters(False)["params"]
    x, c, z = vectors(3)
    given = np.concatenate([*map(np.float64, (x, c)), time_code(params, 2), z])
    h = silu(dense(params["Dense_0"], given))
    for i in (1, 2):
        h = dense(params[f"Dense_{i}"], np.concatenate([h, given]))
        groups = h.reshape(4, 4)
        mean, var = groups.mean(1, keepdims=True), groups.var(1, keepdims=True)
        h = ((groups - mean) / np.sqrt(var + 1e-6)).reshape(16)
        norm = params[f"GroupNorm_{i - 1}"]
        h = silu(h * np.float64(norm["scale"]) + np.float64(norm["bias"]))
    expected = dense(params["Dense_3"], np.concatenate([h, given]))
    found = jax.jit(NET.apply)(parameters(False), x, jnp.array(2), c, z)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_discriminator_is_the_formula():
    params = parameters(True)["params"]
    x, y, c = vectors(3)
    h = np.concatenate([*map(np.float64, (x, y, c)), time_code(params, 3)])
    for i in (0, 1):
        h = dense(params[f"Dense_{i}"], h)
        h = np.where(h > 0, h, 0.2 * h)
    expected = dense(params["Dense_2"], h)[0]
    found = jax.jit(DISCRIMINATOR.apply)(parameters(True), x, y, jnp.array(3), c)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("adversary", [False, True])
def test_a_batch_is_its_samples(adversary):
    net, params = (DISCRIMINATOR if adversary else NET), parameters(adversary)
    x, y, z = vectors(3, 2, 5)
    t = jnp.arange(10).reshape(2, 5) % 4 + 1
    order = (x, y, t, z) if adversary else (x, t, y, z)
    together = jax.jit(net.apply)(params, *order)
    alone = jax.jit(jax.vmap(jax.vmap(lambda *a: net.apply(params, *a))))(*order)
    np.testing.assert_allclose(together, alone, rtol=1e-4, atol=1e-5)
