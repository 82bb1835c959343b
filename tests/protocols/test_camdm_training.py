"""A second training that starts from a first."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxmotion.learning import checkpoint
from jaxmotion.protocols import camdm_training
from jaxmotion.systems import camdm, camdm_model
from tests import tiny


@pytest.fixture
def first(tmp_path):
    clips = tiny.clips()
    model = camdm_model.Model(
        config=tiny.config(),
        bones=clips.skeleton,
        labels=clips.names("style"),
        source=clips.source,
    )
    params = tiny.random_params(camdm.init, model.config)
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
    with pytest.raises(ValueError, match=r"a\.npz.*another config"):
        camdm_training.continued(dataclasses.replace(model, config=config), path)
