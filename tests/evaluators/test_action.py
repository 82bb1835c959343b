"""The action evaluator sees the path too, repeats by its key, and learns."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluators import action as action_evaluator
from tests import tiny

CONFIG = action_evaluator.Config(num_classes=2, num_joints=5, num_features=6, hidden=8)


classify = jax.jit(action_evaluator.classify, static_argnames="config")


@pytest.fixture(scope="module")
def params():
    return tiny.random_params(action_evaluator.init, CONFIG)


def test_the_key_alone_decides_the_states(params):
    x = jnp.asarray(np.random.default_rng(0).normal(size=(4, 6, 15)), jnp.float32)

    def recognize(seed, **changes):
        config = dataclasses.replace(CONFIG, **changes)
        return classify(params, jax.random.key(seed), x, config=config)

    for first, second in zip(recognize(0), recognize(0), strict=True):
        np.testing.assert_array_equal(first, second)
    assert np.abs(recognize(0)[0] - recognize(1)[0]).max() > 1e-2
    still = recognize(0, state_scale=0.0), recognize(1, state_scale=0.0)
    np.testing.assert_array_equal(still[0][0], still[1][0])
    zeros = jnp.zeros((4, 2, CONFIG.hidden))
    expected, _ = CONFIG.network.apply({"params": params}, x, zeros)
    np.testing.assert_allclose(still[0][0], expected, atol=1e-6)


def test_states_are_standard_normal(params):
    """A layer's state shows where the update gate keeps all of it (bias of 50)."""
    count = 4000
    kept = jax.tree.map(jnp.zeros_like, params)
    for layer in ("lower", "upper"):
        kept[layer]["cell"]["iz"]["bias"] += 50.0
    # The six features read the first six numbers of the upper state, scaled down so
    # that tanh is linear.
    kept["feature"]["kernel"] += 1e-3 * jnp.eye(CONFIG.hidden)[:, :6]
    x = jnp.ones((count, 3, 15))
    for scale in (1.0, 0.5):
        found, _ = classify(
            kept,
            jax.random.key(2),
            x,
            config=dataclasses.replace(CONFIG, state_scale=scale),
        )
        state = np.asarray(found, np.float64) * 1e3 / scale
        assert abs(state.mean()) * np.sqrt(state.size) < 4
        assert abs(state.var() - 1) / np.sqrt(2 / state.size) < 4
        correlation = np.corrcoef(state.T)[np.triu_indices(6, 1)]
        assert np.abs(correlation).max() * np.sqrt(count) < 4.5


def test_the_loss_is_the_cross_entropy(params):
    x = jnp.asarray(np.random.default_rng(1).normal(size=(6, 4, 15)), jnp.float32)
    labels = np.array([0, 1, 1, 0, 1, 0])
    loss, info = jax.jit(action_evaluator.loss, static_argnames="config")(
        params, jax.random.key(1), (x, jnp.asarray(labels)), config=CONFIG
    )
    _, logits = classify(params, jax.random.key(1), x, config=CONFIG)
    logits = np.asarray(logits, np.float64)
    chance = np.exp(logits) / np.exp(logits).sum(axis=-1, keepdims=True)
    expected = -np.mean(np.log(chance[np.arange(6), labels]))
    np.testing.assert_allclose(loss, expected, rtol=1e-4)
    np.testing.assert_allclose(
        info["accuracy"], np.mean(logits.argmax(-1) == labels), rtol=1e-6
    )


@pytest.mark.slow
def test_it_learns_to_tell_two_actions(skeleton):
    """Left turns from right turns; every second walk is held out."""
    walks = [
        tiny.walk(12, turn=turn, speed=speed, fps=15.0)
        for speed in np.linspace(0.5, 1.5, 24)
        for turn in (-0.8, 0.8)
    ]
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *walks)
    x = tiny.positions(skeleton, together).reshape(48, 12, 15)
    train, held_out = (
        x.reshape(12, 2, 2, 12, 15)[:, i].reshape(24, 12, 15) for i in range(2)
    )
    labels = jnp.tile(jnp.arange(2), 12)
    params, info = action_evaluator.train(
        jax.random.key(0),
        train,
        labels,
        config=CONFIG,
        num_steps=40,
        batch=16,
        learning_rate=1e-2,
    )
    assert info["loss"].shape == (40,)
    assert info["loss"][-10:].mean() < info["loss"][:3].mean()
    _, logits = action_evaluator.classify(
        params, jax.random.key(1), held_out, config=CONFIG
    )
    assert np.mean(logits.argmax(-1) == labels) > 0.8
