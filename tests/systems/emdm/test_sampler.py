"""A model of actions as one file, and its motions."""

import copy
import dataclasses
import json

import chex
import jax
import numpy as np
import pytest

import jaxmotion as jm
from jaxmotion.control import sampling
from jaxmotion.learning import checkpoint
from jaxmotion.systems.emdm import features as emdm_features
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import sampler as emdm_sampler
from tests import tiny
from tests.systems.emdm.test_features import motions

ACTIONS = ("walk", "jump", "stand")


@pytest.fixture(scope="module")
def model():
    representation = emdm_features.fit(tiny.skeleton(), motions())
    config = emdm_model.Config(
        features=representation.num_features,
        frames=8,
        condition_size=3,
        num_steps=2,
        latent=4,
        width=32,
        depth=1,
        heads=2,
        hidden=32,
        discriminator_width=64,
    )
    return emdm_sampler.Model(
        config=config,
        representation=representation,
        labels=ACTIONS,
        source="made in the tests (no license)",
    )


@pytest.fixture(scope="module")
def params(model):
    return tiny.random_params(emdm_model.init, model.config)["generator"]


@pytest.fixture
def file(tmp_path, model, params):
    path = tmp_path / "actions.npz"
    checkpoint.export_params(path, params, emdm_sampler.to_json(model))
    return path


def test_a_file_gives_the_model_back(model, params, file):
    found, numbers = emdm_sampler.load(file)
    assert found.config == model.config
    assert (found.labels, found.source) == (ACTIONS, model.source)
    assert found.representation.fps == model.representation.fps
    assert found.representation.skeleton.names == tiny.NAMES
    for name in ("mean", "std"):
        np.testing.assert_array_equal(
            getattr(found.representation.normalizer, name),
            getattr(model.representation.normalizer, name),
        )
    jax.tree.map(
        lambda a, b: np.testing.assert_array_equal(a, np.asarray(b, np.float16)),
        numbers,
        params,
    )


BAD = {
    "system": (lambda v: v.update(system="camdm"), "'system' is 'camdm'"),
    "labels": (lambda v: v["labels"].pop(), "'config.condition_size' is 3, expected 2"),
    "texts": (lambda v: v["config"].update(condition="text"), "'text', expected 'act"),
    "features": (lambda v: v["config"].update(features=9), "features' is 9, expected"),
    "mean": (lambda v: v["representation"]["mean"].pop(), "mean has 35 numbers"),
    "std": (lambda v: v["representation"].pop("std"), "'std' is missing"),
    "fps": (lambda v: v["representation"].update(fps=0), "fps has 0, expected"),
    "skeleton": (lambda v: v["representation"].update(skeleton=3), "a JSON int"),
    "list": (lambda v: v.update(representation=[1]), "a JSON list"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_wrong_is_named_with_its_file(model, case):
    change, message = BAD[case]
    value = copy.deepcopy(json.loads(json.dumps(emdm_sampler.to_json(model))))
    change(value)
    with pytest.raises(ValueError, match=f"some/file.*{message}"):
        emdm_sampler.from_json(value, where="some/file")


def test_wrong_words_end_in_one_line(file):
    model = jm.load(file)
    key = jax.random.key(0)
    with pytest.raises(ValueError, match="unknown label 'fly': the model has walk"):
        jm.sample(model, key, "fly")
    with pytest.raises(ValueError, match="expected hip, knee and ankle"):
        jm.load(file, foot_lock=True)
    assert model.license is None and model.frames == 8


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(row="no_gan"), "holds one model, expected no row 'no_gan'"),
        (dict(row="ddim_10"), "samples 'ddpm_1000' otherwise: expected 'ddpm_1000'"),
        (dict(scale=float("nan")), "scale is nan, expected a finite number"),
    ],
)
def test_what_a_file_has_not_is_refused(file, options, message):
    with pytest.raises(ValueError, match=message):
        jm.load(file, **options)
    assert jm.load(file, scale=2.0).method.scale == 2.0


def test_a_training_starts_from_a_model_of_its_sizes(model, params, file):
    """Losses and noise may differ; what features mean may not."""
    other = dataclasses.replace(
        model.config,
        num_steps=5,
        weight_foot=300.0,
        discriminator_width=128,
        fade_geometry=True,
        weigh_levels="posterior",
        r1_every=4,
    )

    def scaled(factor):
        own = model.representation.normalizer
        normalizer = dataclasses.replace(own, std=factor * own.std)
        return dataclasses.replace(model.representation, normalizer=normalizer)

    # Another machine's statistics of the same data end in other digits.
    given = dict(config=other, representation=scaled(1.0 + 1e-6))
    got = emdm_sampler.start_of(file, dataclasses.replace(model, **given))
    chex.assert_trees_all_close(got, params, rtol=1e-3, atol=1e-3)
    wider = dataclasses.replace(model.config, width=64)
    for changes, message in (
        (dict(config=wider), "config.width is 32, given 64"),
        (dict(labels=ACTIONS[::-1]), "labels is .*walk.*, given .*stand"),
        (dict(representation=scaled(1.001)), "representation.std is .*given"),
    ):
        with pytest.raises(ValueError, match=f"{file}: expected .*{message}"):
            emdm_sampler.start_of(file, dataclasses.replace(model, **changes))


@pytest.mark.slow
def test_motions_by_the_face(file, tmp_path):
    """Each from the origin, the same in any batch, by one program per shape."""
    model = jm.load(file)
    labels = ["walk", "jump", "stand", "jump", "walk"]
    found = jm.sample(model, jax.random.key(0), labels)
    assert found.root_position.shape == (5, 8, 3)
    assert np.isfinite(np.asarray(found.joint_rotation)).all()
    counted = sampling._motions._cache_size()
    again = jm.sample(jm.load(file), jax.random.key(1), ["stand"] * 5)
    assert sampling._motions._cache_size() == counted
    assert np.abs(again.root_position - found.root_position).max() > 1e-3
    fewer = jm.sample(model, jax.random.key(0), labels[:2])
    np.testing.assert_allclose(fewer.root_position, found.root_position[:2], atol=1e-4)
    jm.save(tmp_path / "one.bvh", model.skeleton, found[0])
    assert (tmp_path / "one.bvh").read_text().startswith("HIERARCHY")
