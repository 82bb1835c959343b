"""A model as a value: to JSON and back, from a run folder, and what may be wrong."""

import copy
import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxmotion.control import foot_lock
from jaxmotion.data import walker
from jaxmotion.learning import checkpoint, runs, training
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import training as camdm_training
from tests import samples, tiny


@pytest.fixture
def model(skeleton, config):
    return camdm_model.Model(
        config=config,
        skeleton=skeleton,
        labels=tiny.STYLES,
        source="tests (no license)",
    )


def test_json_and_back(model):
    text = json.dumps(camdm_model.to_json(model))
    found = camdm_model.from_json(json.loads(text), where="here")
    assert found.config == model.config
    assert hash(found.config) == hash(model.config)
    assert (found.labels, found.source) == (model.labels, model.source)
    for field in ("parents", "names", "feet"):
        assert getattr(found.skeleton, field) == getattr(model.skeleton, field)
    np.testing.assert_array_equal(found.skeleton.offsets, model.skeleton.offsets)


BAD = {
    "system": (lambda v: v.update(system="emdm"), "'system' is 'emdm'"),
    "no system": (lambda v: v.pop("system"), "'system' is None"),
    "unknown field": (
        lambda v: v["config"].update(size=3),
        "'config': has unknown.*size",
    ),
    "no config": (lambda v: v.pop("config"), "config"),
    "no skeleton": (lambda v: v.pop("skeleton"), "skeleton"),
    "no names": (lambda v: v["skeleton"].pop("names"), "names"),
    "no labels": (lambda v: v.pop("labels"), "labels"),
    "missing size": (lambda v: v["config"].pop("num_joints"), "num_joints"),
    "wrong parents": (
        lambda v: v["skeleton"].update(parents=[-1, 3, 1, 0, 3]),
        "parent of joint 1",
    ),
    "config that is a list": (
        lambda v: v.update(config=[1]),
        "'config': a JSON list, expected an object",
    ),
    "labels that are numbers": (
        lambda v: v.update(labels=[1, 2]),
        "'labels': .1, 2., expected a list of different names",
    ),
    "odd heads": (
        lambda v: v["config"].update(heads=3),
        r"width is 16, expected a multiple of heads \(3\)",
    ),
    **{
        f"{name} {value}": (
            lambda v, name=name, value=value: v["config"].update({name: value}),
            f"'config': {name} is .*, expected ",
        )
        for name, value in (
            ("num_steps", 0),
            ("num_steps", 8.0),
            ("num_steps", True),
            ("network", "x"),
            ("network", None),
            ("heads", 0),
            ("width", 10**9),
            ("width", "16"),
            ("depth", -1),
            ("future", 10**6),
            ("heading", "north"),
            ("rotation_layout", 3),
            ("norm", ["post"]),
            ("fps", -1.0),
            ("fps", float("nan")),
            ("dropout", float("inf")),
            ("dropout", 1.0),
            ("weight_foot", -1.0),
            ("weight_foot", 1e300),
            ("rotation_mean", 0.5),
            ("rotation_mean", [float("nan")]),
            ("token_margin", -1),
            ("token_window", "box"),
        )
    },
    "another skeleton": (
        lambda v: v["config"].update(num_joints=7),
        "'skeleton' has 5 entries, the config 7",
    ),
    "another style": (
        lambda v: v["labels"].append("sad"),
        "'labels' has 3 entries, the config 2",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_wrong_is_named_with_its_file(model, case):
    change, message = BAD[case]
    value = copy.deepcopy(camdm_model.to_json(model))
    change(value)
    with pytest.raises(ValueError, match=f"some/file.*{message}"):
        camdm_model.from_json(value, where="some/file")


def save_run(folder, model, params):
    state = training.init_train_state(params, optax.adam(1e-3))
    state = training.TrainState(
        step=jnp.int32(4),
        params=params,
        ema_params=jax.tree.map(lambda x: 2 * x, params),
        opt_state=state.opt_state,
    )
    run = runs.begin(
        folder,
        system="camdm",
        data=[],
        settings={},
        make=lambda: runs.Content(
            model=camdm_model.to_json(model), source="", split={}, files={}
        ),
    )
    value = dataclasses.asdict(model.config)
    runs.store(run, camdm_model.STAGE, state, model=value)


def test_a_run_gives_its_averaged_parameters(tmp_path, model, params):
    save_run(tmp_path, model, params)
    found, found_params = camdm_model.load(tmp_path)
    assert found.config == model.config
    jax.tree.map(
        lambda a, b: np.testing.assert_array_equal(a, 2 * b), found_params, params
    )


def test_an_exported_file(tmp_path, model, params):
    path = tmp_path / "model.npz"
    checkpoint.export_params(path, params, camdm_model.to_json(model), dtype=np.float32)
    found, found_params = camdm_model.load(path)
    assert found.labels == model.labels
    jax.tree.map(np.testing.assert_array_equal, found_params, params)


def test_a_file_may_visit_few_steps_and_offer_all(tmp_path, model, params):
    total = model.config.num_steps
    few = camdm_model.with_steps(model, (1, total))
    path = tmp_path / "model.npz"
    checkpoint.export_params(path, params, camdm_model.to_json(few))
    own = camdm_controller.load_character(path, control=camdm_controller.Control())
    tuning, scale = own.tuning, own.tuning.scale
    assert tuning.num_steps == tuple(range(1, total + 1)) and tuning.own_steps == 2
    assert own.method.steps == tuning.method(2, scale).steps == (1, total)
    assert tuning.method(1, scale).steps == (total,)
    assert tuning.method(total, scale).steps == tuple(range(1, total + 1))
    every = camdm_controller.load_character(path, steps=total)
    assert every.method.steps == tuple(range(1, total + 1))
    assert every.tuning.own_steps == total
    for wrong in (0, total + 1, True):
        with pytest.raises(ValueError, match=f"{wrong}.*, expected"):
            camdm_controller.load_character(path, steps=wrong)
    # The chain begins at the last step.
    with pytest.raises(ValueError, match=rf"in 1..{total}, the last {total}"):
        camdm_model.with_steps(model, (1, total - 1))
    # Files from before that field have students, who learned their own steps alone.
    value = camdm_model.to_json(few)
    del value["all_steps"]
    assert not camdm_model.from_json(value, where="here").all_steps
    value = camdm_model.to_json(few) | {"all_steps": 1}
    with pytest.raises(ValueError, match="here: field 'all_steps' is 1, expected true"):
        camdm_model.from_json(value, where="here")


def test_feet_are_locked_where_the_toes_of_its_data_rest(tmp_path):
    """The generated walker's toes rest at the height that its steps are made with."""
    raised = samples.clips()
    up = raised.root_position.at[:, 1].add(0.05)
    raised = dataclasses.replace(raised, root_position=up)
    found = [
        camdm_training.make_model(x, field="style").toe_height
        for x in (samples.clips(), raised)
    ]
    assert found == pytest.approx(
        [walker.TOE_HEIGHT, walker.TOE_HEIGHT + 0.05], abs=2e-3
    )
    model = dataclasses.replace(samples.run().model, toe_height=found[1])
    path = tmp_path / "model.npz"
    checkpoint.export_params(path, samples.run().params, camdm_model.to_json(model))
    character = camdm_controller.load_character(path)
    assert character.toe_height == found[1]
    assert foot_lock.lock_feet(character).method.lock.toe_height == found[1]
    # A file of before says nothing of it.
    old = {k: x for k, x in camdm_model.to_json(model).items() if k != "toe_height"}
    assert camdm_model.from_json(old, where="here").toe_height is None
    for wrong in (True, "high", float("nan"), 1e9):
        with pytest.raises(
            ValueError, match="here: field 'toe_height' is .*, expected"
        ):
            camdm_model.from_json(old | {"toe_height": wrong}, where="here")


def test_parameters_of_another_size_are_refused(tmp_path, model, params):
    """The JSON says depth 2, the parameters are of depth 1."""
    shallow = {k: v for k, v in params.items() if k != "layers_1"}
    assert len(shallow) < len(params)
    save_run(tmp_path / "run", model, shallow)
    path = tmp_path / "model.npz"
    checkpoint.export_params(path, shallow, camdm_model.to_json(model))
    for place in (tmp_path / "run", path):
        with pytest.raises(checkpoint.CheckpointError, match=str(place)):
            camdm_model.load(place)


def test_a_folder_without_a_model(tmp_path, model, params):
    for place in (tmp_path, tmp_path / "none"):
        with pytest.raises(FileNotFoundError, match=f"{place}.*expected a run folder"):
            camdm_model.load(place)
    save_run(tmp_path, model, params)
    shutil.rmtree(tmp_path / "motion")
    with pytest.raises(checkpoint.CheckpointError, match=str(tmp_path)):
        camdm_model.load(tmp_path)
    value = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps(value | {"system": "else"}))
    with pytest.raises(ValueError, match=f"{tmp_path}.*'system' is 'else'"):
        camdm_model.load(tmp_path)


def test_a_checkpoint_of_another_model_is_named(tmp_path, model, params):
    save_run(tmp_path, model, params)
    value = json.loads((tmp_path / "config.json").read_text())
    value["model"]["config"]["weight_foot"] = 7.0
    (tmp_path / "config.json").write_text(json.dumps(value))
    with pytest.raises(ValueError, match="motion: of another model: weight_foot is"):
        camdm_model.load(tmp_path)
