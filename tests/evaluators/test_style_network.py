"""The evaluator's shapes, and that a window's result is its own."""

import functools

import jax
import numpy as np

from jaxmotion.evaluators.network import WindowClassifier
from tests import tiny


def test_shapes_and_independence_of_the_batch():
    net = WindowClassifier(num_classes=3, num_features=8)
    x = jax.random.normal(jax.random.key(0), (4, 6, 15))
    variables = tiny.random_params(net.init, x)
    apply = jax.jit(net.apply)
    features, logits = apply(variables, x)
    assert features.shape == (4, 8)
    assert logits.shape == (4, 3)
    alone = apply(variables, x[2:3])
    np.testing.assert_allclose(alone[0][0], features[2], atol=1e-5)
    np.testing.assert_allclose(alone[1][0], logits[2], atol=1e-5)


def test_default_feature_width_is_512():
    net = WindowClassifier(num_classes=100)
    x = jax.ShapeDtypeStruct((2, 60, 45), "float32")
    key = jax.eval_shape(lambda: jax.random.key(0))
    shapes = jax.eval_shape(net.init_with_output, key, x)
    features, logits = shapes[0]
    assert features.shape == (2, 512)
    assert logits.shape == (2, 100)


def test_time_matters():
    net = WindowClassifier(num_classes=2, num_features=4)
    x = jax.random.normal(jax.random.key(0), (1, 6, 15))
    variables = tiny.random_params(net.init, x)
    apply = jax.jit(net.apply)
    _, forwards = apply(variables, x)
    _, backwards = apply(variables, x[:, ::-1])
    assert np.abs(forwards - backwards).max() > 1e-3


def test_dropout_needs_training():
    net = WindowClassifier(num_classes=2, num_features=4)
    x = jax.random.normal(jax.random.key(0), (1, 6, 15))
    variables = tiny.random_params(net.init, x)
    apply = jax.jit(functools.partial(net.apply, train=True))
    draw = lambda seed: apply(variables, x, rngs={"dropout": jax.random.key(seed)})  # noqa: E731
    np.testing.assert_array_equal(draw(0)[1], draw(0)[1])
    assert np.abs(draw(0)[1] - draw(1)[1]).max() > 1e-3
