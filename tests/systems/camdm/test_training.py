"""How presets are trained, and a second training that starts from a first."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxmotion.learning import checkpoint
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import training as camdm_training
from tests import tiny


@pytest.fixture
def first(tmp_path):
    clips = tiny.clips()
    model = camdm_model.Model(
        config=tiny.config(),
        skeleton=clips.skeleton,
        labels=clips.names("style"),
        source=clips.source,
    )
    params = tiny.random_params(camdm_model.init, model.config)
    path = tmp_path / "a.npz"
    checkpoint.export_params(path, params, camdm_model.to_json(model))
    return model, params, path


def test_only_the_weights_are_new(first):
    model, params, path = first
    config = dataclasses.replace(model.config, weight_foot=7.0, rotation_mean=(1.0,))
    wanted = dataclasses.replace(model, config=config, source="mine")
    found, loaded = camdm_training.continued(wanted, path)
    assert found.config == dataclasses.replace(model.config, weight_foot=7.0)
    assert found.source == "mine"
    for a, b in zip(jax.tree.leaves(loaded), jax.tree.leaves(params), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-3)  # exported as float16


def test_another_network_is_refused(first):
    model, _, path = first
    config = dataclasses.replace(model.config, width=2 * model.config.width)
    with pytest.raises(ValueError, match=r"a\.npz.*to train: config\."):
        camdm_training.continued(dataclasses.replace(model, config=config), path)


# --- presets -----------------------------------------------------------------------


def test_the_papers_preset_is_unclipped_adamw_at_its_rate(first, tmp_path):
    """Two steps of it are optax's AdamW on the gradients, which exceed the norm 1."""
    model = first[0]
    config = dataclasses.replace(model.config, weight_data=100.0, dropout=0.0)
    paper = camdm_training.FITTING["paper"]
    assert (paper["learning_rate"], paper["batch"]) == (1e-4, 512)
    run, state, key, data = camdm_training.start(
        tiny.clips(),
        dataclasses.replace(model, config=config),
        tmp_path,
        field="style",
        num_steps=10,
        chunk=1,
        **paper | dict(batch=4),
    )
    before = jax.tree.map(np.asarray, state.params)
    adam = optax.scale_by_adam()
    expected = adam.init(before)
    for step in range(2):
        # The gradients, from the first moment: mu = 0.9 mu + 0.1 g.
        state, info = run(state, key, data)
        mu = optax.tree.get(state.opt_state, "mu")
        old = optax.tree.get(expected, "mu")
        grads = jax.tree.map(lambda a, b: (a - 0.9 * b) / 0.1, mu, old)
        norm = np.sqrt(sum(jnp.vdot(g, g) for g in jax.tree.leaves(grads)))
        np.testing.assert_allclose(norm, info["grad_norm"][0], rtol=1e-4)
        assert norm > 2.0
        change, expected = adam.update(grads, expected)
        rate = 1e-4 * (0.1 + 0.9 * 0.5 * (1 + np.cos(np.pi * step / 10)))
        for new, old, way in zip(
            *map(jax.tree.leaves, (state.params, before, change)), strict=True
        ):
            np.testing.assert_allclose(new - old, -rate * way, atol=3e-7)
        for kept, new in zip(
            *map(jax.tree.leaves, (state.ema_params, state.params)), strict=True
        ):
            np.testing.assert_allclose(kept, new, atol=1e-9)
        before = jax.tree.map(np.asarray, state.params)
