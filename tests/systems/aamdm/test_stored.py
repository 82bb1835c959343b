"""AAMDM's character as one file."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.control import foot_lock
from jaxmotion.learning import checkpoint
from jaxmotion.systems.aamdm import controller as aamdm_controller
from jaxmotion.systems.aamdm import model as aamdm_model
from jaxmotion.systems.aamdm import space as aamdm_space
from jaxmotion.systems.aamdm import stored as aamdm_stored
from tests import person, tiny
from tests.systems.aamdm import test_space
from tests.systems.aamdm.test_space import frames_of, space_of


@pytest.fixture(scope="module")
def model():
    space = space_of("embedded")
    return aamdm_stored.Model(
        config=aamdm_model.Config(features=space.num_features, width=8, depth=1),
        skeleton=person.skeleton(),
        space=space,
        source="made in the tests (no license)",
        noise_half_life=0.5,
        starts=jnp.asarray(frames_of("embedded")[:3], jnp.float32),
        toe_height=0.04,
    )


@pytest.fixture(scope="module")
def networks(model):
    return tiny.random_params(aamdm_model.init, model.config)


@pytest.fixture
def file(tmp_path, model, networks):
    aamdm_stored.export(tmp_path / "fast.npz", model, networks)
    return tmp_path / "fast.npz"


def test_a_file_gives_the_character_back(model, networks, file):
    found, numbers = aamdm_stored.load(file)
    assert found.config == model.config and found.noise_half_life == 0.5
    assert found.skeleton.names == person.NAMES and found.source == model.source
    assert sorted(numbers) == ["generator", "polisher"]
    for name in numbers:
        jax.tree.map(
            lambda a, b: np.testing.assert_array_equal(a, np.asarray(b, np.float16)),
            numbers[name],
            networks[name],
        )
    np.testing.assert_allclose(found.starts, model.starts, atol=1e-5)
    # What encodes and decodes frames is there; numbers of the space are as they were.
    for name in ("change", "low", "high"):
        np.testing.assert_array_equal(
            getattr(found.space, name), getattr(model.space, name)
        )
    poses = aamdm_space.to_poses(found.space, model.starts)
    expected = aamdm_space.to_poses(model.space, model.starts)
    np.testing.assert_allclose(poses, expected, atol=2e-2)
    given = test_space.walks()
    np.testing.assert_allclose(
        aamdm_space.to_frames(found.space, *given),
        aamdm_space.to_frames(model.space, *given),
        atol=2e-2,
    )


def test_a_file_without_an_encoder_is_a_character(tmp_path, model, networks, file):
    old = tmp_path / "old.npz"
    aamdm_stored.export(old, model, networks, encoder=False)
    assert old.stat().st_size < file.stat().st_size
    found, _ = aamdm_stored.load(old)
    assert sorted(found.autoencoder.params) == ["decoder"]
    np.testing.assert_array_equal(
        *(
            aamdm_space.to_poses(x.space, model.starts)
            for x in (found, aamdm_stored.load(file)[0])
        )
    )


def test_characters_start_in_its_frames(model, file):
    character = aamdm_controller.load_character(file)
    states = character.start(5)
    assert foot_lock.lock_of(character).toe_height == 0.04
    assert character.method.memory.half_life == 0.5
    assert states.noise.shape[:2] == (5, 5)
    rows = np.asarray(model.starts)
    for frame in np.asarray(states.frame):
        assert np.abs(rows - frame).max(axis=1).min() < 1e-4
    assert (
        aamdm_controller.load_character(file, noise_half_life=0.0).method.memory is None
    )


def test_it_may_do_without_drafts(file):
    """In as many steps as are polished; the live page offers both."""
    for held, own in ((False, 5), (True, 2)):
        character = aamdm_controller.load_character(file, held=held)
        tuning = character.tuning
        assert (tuning.num_steps, tuning.own_steps) == ((2, 5), own)
        assert tuning.method(own, tuning.scale) == character.method
        assert character.method.held == held


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: v.update(toe_height=True), "'toe_height' is True, expected meters"),
        (lambda v: v.update(system="camdm"), "'system' is 'camdm', expected 'aamdm'"),
        (lambda v: v["space"]["low"].pop(), "'space': low has"),
        (lambda v: v["space"].pop("mean"), "'space': 'mean' is missing"),
        (lambda v: v["statistics"].pop("path"), "statistics: field 'path' is missing"),
        (lambda v: v["starts"]["frames"].clear(), "'starts': has shapes"),
        (lambda v: v.update(noise_half_life=-1), "'noise_half_life': noise_half_life"),
        (lambda v: v["embedding"].update(latent=9), "'config.features' has 16"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, file, change, message):
    params, value = checkpoint.import_params(file)
    value = json.loads(json.dumps(value))
    change(value)
    path = tmp_path / "wrong.npz"
    checkpoint.export_params(path, params, value)
    with pytest.raises(ValueError, match=f"wrong.npz.*{message}"):
        aamdm_stored.load(path)
