"""A SMGDiff model as JSON."""

import copy
import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.systems.smgdiff import controller as smgdiff_controller
from jaxmotion.systems.smgdiff import model as smgdiff_model
from jaxmotion.systems.smgdiff import scene as smgdiff_scene
from jaxmotion.systems.smgdiff import trajectory as smgdiff_trajectory
from tests import ball_walker, tiny


@pytest.fixture(scope="module")
def model():
    scenes = [ball_walker.scene(16, speed=s) for s in (0.6, 1.2)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *scenes)
    representation = smgdiff_scene.fit(
        tiny.skeleton(), stacked, joints=(2, 4), radius=0.11
    )
    return smgdiff_model.Model(
        config=smgdiff_model.Config(
            num_features=representation.normalizer.mean.size, num_labels=2
        ),
        paths=smgdiff_trajectory.Config(num_labels=2),
        representation=representation,
        labels=("dribble", "stand"),
        speeds=(1.25, 0.0),
        source="made in the tests",
    )


def test_a_model_comes_back(model):
    value = json.loads(json.dumps(smgdiff_model.to_json(model)))
    found = smgdiff_model.from_json(value, where="here")
    assert found.config == model.config and found.paths == model.paths
    assert (found.labels, found.speeds) == (model.labels, model.speeds)
    for name in ("mean", "std"):
        np.testing.assert_array_equal(
            getattr(found.representation.normalizer, name),
            getattr(model.representation.normalizer, name),
        )
    assert found.representation.joints == (2, 4) and found.toe_height is None
    value["toe_height"] = 0.04
    assert smgdiff_model.from_json(value, where="here").toe_height == 0.04
    assert found.representation.skeleton.names == tiny.NAMES


def test_starts_come_back(model):
    scenes = [[ball_walker.scene(10, speed=s)] * 3 for s in (0.6, 0.0)]
    rows = [jax.tree.map(lambda *x: jnp.stack(x), *row) for row in scenes]
    starts = jax.tree.map(lambda *x: jnp.stack(x), *rows)
    whole = dataclasses.replace(model, starts=starts)
    value = json.loads(json.dumps(smgdiff_model.to_json(whole)))
    found = smgdiff_model.from_json(value, where="here").starts
    assert found.motion.fps == model.config.fps
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(starts), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    value["starts"]["ball"][0][0].pop()
    with pytest.raises(ValueError, match="here: field 'starts' is wrong"):
        smgdiff_model.from_json(value, where="here")
    states = smgdiff_controller.own_states(whole, np.array([0, 1, 1]), seed=0)
    np.testing.assert_allclose(states.past.ball[2], starts.ball[1, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("toe_height",), "low", "field 'toe_height' is 'low', expected meters"),
        (("system",), "camdm", "field 'system' is 'camdm', expected 'smgdiff'"),
        (("labels",), ["dribble"], "field 'config.num_labels' is 2, expected 1"),
        (("speeds",), [1.0], "field 'speeds' is 1, expected 2"),
        (("representation", "mean"), [0.0], "'representation': mean has 1 numbers"),
        (("config", "wings"), 2, "here.json: field 'config': has unknown .'wings'"),
        (("config", "width"), 10**9, "'config': width is 1000000000, expected a whole"),
        (("paths", "heads"), 0, "'paths': heads is 0, expected a whole number from 1"),
        (("paths", "num_steps"), 1.5, "'paths': num_steps is 1.5, expected a whole"),
        (("speeds",), [1.0, float("nan")], "'speeds': speed has nan, expected 0 to"),
        (("labels",), ["a", "a"], "'labels': .*expected a list of different names"),
        (("representation", "std"), 3, "'representation': std is 3, expected a list"),
        (("representation", "fps"), -1, "'representation': fps has -1"),
        (("representation", "joints"), [99], "joints is .99., expected numbers below"),
        (("representation",), [1], "'representation'"),
        (("representation", "skeleton", "parents"), [0, 0, 1, 0, 3], "representation"),
    ],
)
def test_what_is_wrong_is_named(model, path, value, message):
    whole = copy.deepcopy(smgdiff_model.to_json(model))
    place = whole
    for name in path[:-1]:
        place = place[name]
    place[path[-1]] = value
    with pytest.raises(ValueError, match=message):
        smgdiff_model.from_json(whole, where="here.json")


def test_a_missing_field_is_named(model):
    whole = smgdiff_model.to_json(model)
    del whole["speeds"]
    with pytest.raises(ValueError, match="here.json: field 'speeds' is missing"):
        smgdiff_model.from_json(whole, where="here.json")
