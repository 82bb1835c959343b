"""The autoencoder's networks against plain NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.systems.aamdm import network as aamdm_network
from tests import tiny

ENCODER = aamdm_network.PoseEncoder(latent=3, width=8)
DECODER = aamdm_network.PoseDecoder(features=7, width=8)


def vectors(size, *batch, seed=0):
    values = np.random.default_rng(seed).normal(scale=2.0, size=(*batch, size))
    return tiny.float32(values)


def formula(params, x, layers, activation):
    x = np.float64(x)
    for i in range(layers):
        layer = params["params"][f"Dense_{i}"]
        x = x @ np.float64(layer["kernel"]) + np.float64(layer["bias"])
        x = activation(x) if i < layers - 1 else x
    return x


def elu(x):
    return np.where(x > 0, x, np.expm1(np.minimum(x, 0)))


def relu(x):
    return np.maximum(x, 0)


@pytest.mark.parametrize(
    ("net", "size", "layers", "activation"),
    [(ENCODER, 7, 4, elu), (DECODER, 5, 2, relu)],
)
def test_networks_are_the_formula(net, size, layers, activation):
    x = vectors(size, 20)
    params = tiny.random_params(net.init, x)
    assert len(params["params"]) == layers
    expected = formula(params, x, layers, activation)
    np.testing.assert_allclose(net.apply(params, x), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("net", "size", "layers"),
    [
        (aamdm_network.PoseEncoder(latent=52), 338, [338, 512, 512, 512, 52]),
        (aamdm_network.PoseDecoder(features=338), 64, [64, 512, 338]),
    ],
)
def test_default_sizes_are_those_of_learned_motion_matching(net, size, layers):
    shapes = jax.eval_shape(net.init, jax.random.key(0), jnp.zeros(size))["params"]
    found = [shapes[f"Dense_{i}"]["kernel"].shape for i in range(len(shapes))]
    assert found == list(zip(layers[:-1], layers[1:], strict=True))
