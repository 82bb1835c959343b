"""The recurrent evaluator against its units' equations, and what it depends on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluators.network import ActionClassifier
from tests import tiny

BATCH, FRAMES, CHANNELS, HIDDEN = 3, 5, 6, 4


@pytest.fixture(scope="module")
def net():
    return ActionClassifier(num_classes=3, num_features=2, hidden=HIDDEN)


@pytest.fixture(scope="module")
def inputs():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(BATCH, FRAMES, CHANNELS))
    state = rng.normal(size=(BATCH, 2, HIDDEN))
    return jnp.asarray(x, jnp.float32), jnp.asarray(state, jnp.float32)


@pytest.fixture(scope="module")
def variables(net, inputs):
    return tiny.random_params(net.init, *inputs)


def affine(x, layer):
    return x @ np.asarray(layer["kernel"], np.float64) + np.asarray(
        layer.get("bias", 0)
    )


def gated_unit(h, x, cell):
    """Cho et al. 2014, with the reset gate after the recurrent product (as PyTorch)."""
    sigmoid = lambda y: 1 / (1 + np.exp(-y))  # noqa: E731
    reset = sigmoid(affine(x, cell["ir"]) + affine(h, cell["hr"]))
    update = sigmoid(affine(x, cell["iz"]) + affine(h, cell["hz"]))
    new = np.tanh(affine(x, cell["in"]) + reset * affine(h, cell["hn"]))
    return (1 - update) * new + update * h


@pytest.fixture(scope="module")
def apply(net):
    return jax.jit(net.apply)


def test_the_equations(apply, inputs, variables):
    found_features, found_logits = apply(variables, *inputs)
    params = variables["params"]
    for x, (lower, upper), features, logits in zip(
        *(np.asarray(y, np.float64) for y in inputs),
        found_features,
        found_logits,
        strict=True,
    ):
        for frame in x:
            lower = gated_unit(lower, frame, params["lower"]["cell"])
            upper = gated_unit(upper, lower, params["upper"]["cell"])
        expected = np.tanh(affine(upper, params["feature"]))
        np.testing.assert_allclose(features, expected, atol=1e-5)
        np.testing.assert_allclose(logits, affine(expected, params["out"]), atol=1e-5)


def test_published_sizes():
    """Twelve classes, 24 joints: the parameters of PyTorch's layers less the second
    biases of the reset and update gates, which add to the first."""
    net = ActionClassifier(num_classes=12)
    x = jax.ShapeDtypeStruct((2, 60, 72), "float32")
    state = jax.ShapeDtypeStruct((2, 2, 128), "float32")
    key = jax.eval_shape(lambda: jax.random.key(0))
    (features, logits), variables = jax.eval_shape(net.init_with_output, key, x, state)
    assert features.shape == (2, 30)
    assert logits.shape == (2, 12)
    lower = 3 * (72 * 128 + 128 * 128 + 2 * 128)
    upper = 3 * (128 * 128 + 128 * 128 + 2 * 128)
    rest = 128 * 30 + 30 + 30 * 12 + 12
    count = sum(x.size for x in jax.tree.leaves(variables))
    assert count == lower + upper + rest - 2 * 2 * 128


def test_samples_are_independent(apply, inputs, variables):
    x, state = inputs
    features, logits = apply(variables, x, state)
    alone = apply(variables, x[1:2], state[1:2])
    np.testing.assert_allclose(alone[0][0], features[1], atol=1e-6)
    np.testing.assert_allclose(alone[1][0], logits[1], atol=1e-6)


def test_both_states_and_the_order_of_frames_matter(apply, inputs, variables):
    x, state = inputs
    plain, _ = apply(variables, x, state)
    for layer in range(2):
        other, _ = apply(variables, x, state.at[:, layer].add(1.0))
        assert np.abs(other - plain).max() > 1e-3
    backwards, _ = apply(variables, x[:, ::-1], state)
    assert np.abs(backwards - plain).max() > 1e-3
