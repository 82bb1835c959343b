"""Frozen evaluators: their file, what they fit, and that they score as when trained."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import clips_io
from jaxmotion.data.windows import eval_windows
from jaxmotion.evaluators import frozen as evaluators
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.learning import checkpoint
from jaxmotion.learning.fingerprint import fingerprint
from jaxmotion.systems.camdm import evaluation as camdm_evaluation
from jaxmotion.systems.emdm import action_evaluation as emdm_action_evaluation
from jaxmotion.systems.emdm import data as emdm_data
from jaxmotion.systems.smgdiff import data as smgdiff_data
from jaxmotion.systems.smgdiff import evaluation as smgdiff_evaluation
from jaxmotion.systems.smgdiff import training as smgdiff_training
from tests import ball_walker, samples, tiny

KINDS = ("style", "action", "ball")
FRAMES = 12


def same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(one, other)


# --- the file ----------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_loaded_is_what_was_saved(tmp_path, kind):
    saved, path = samples.evaluator(kind), tmp_path / "below" / "e.npz"
    evaluators.save(path, saved)
    found = evaluators.load(path)
    assert [file.name for file in path.parent.iterdir()] == ["e.npz"]
    same(found.params, saved.params)
    assert found.path == path and found.config == saved.config
    assert evaluators.to_json(found) == evaluators.to_json(saved)
    for field in dataclasses.fields(saved):
        if field.name not in ("params", "path"):
            assert getattr(found, field.name) == getattr(saved, field.name)
    assert fingerprint(found.params) == fingerprint(saved.params)
    # What the ball adds is three channels, as of a joint.
    joints = {"ball": 6}.get(kind, 5)
    assert found.config.num_joints == joints and found.config.num_classes == 2


BAD_FIELDS = {
    "format": "jaxmotion-clips",
    "version": 2,
    "kind": "dance",
    "config": {"num_classes": 2, "num_joints": 5, "hidden": 64},
    "labels": "calm",
    "joints": None,
    "fps": "30",
    "frames": 8.5,
    "clips": 3,
    "updates": None,
    "accuracy": None,
    "fingerprint": "f" * 12,
}


@pytest.mark.parametrize("field", BAD_FIELDS)
def test_a_field_that_is_wrong_is_named_with_the_file(tmp_path, field):
    made, path = samples.evaluator(), tmp_path / "e.npz"
    value = evaluators.to_json(made) | {field: BAD_FIELDS[field]}
    checkpoint.export_params(path, made.params, value, dtype=np.float32)
    with pytest.raises(ValueError, match=f"{path}: field '{field}'"):
        evaluators.load(path)


def test_other_parameters_than_were_frozen_are_refused(tmp_path):
    made, path = samples.evaluator(), tmp_path / "e.npz"
    value = evaluators.to_json(made)
    # Rounded to three digits they would score otherwise.
    checkpoint.export_params(path, made.params, value, dtype=np.float16)
    with pytest.raises(ValueError, match=f"{path}: field 'fingerprint'"):
        evaluators.load(path)
    wide = samples.evaluator(labels=("calm", "brisk", "limp")).params
    checkpoint.export_params(path, wide, value, dtype=np.float32)
    with pytest.raises(ValueError, match=f"{path}: parameters of another model"):
        evaluators.load(path)


def test_files_that_are_no_evaluators_are_named(tmp_path):
    path = tmp_path / "e.npz"
    with pytest.raises(ValueError, match=str(path)):
        evaluators.load(path)
    clips_io.save_clips(path, tiny.clips())
    with pytest.raises(ValueError, match=f"{path}: field 'config' is missing"):
        evaluators.load(path)
    evaluators.save(path, samples.evaluator())
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=f"{path}: not an export"):
        evaluators.load(path)


# --- whom it fits ------------------------------------------------------------------

RUN = dict(
    kind="action", labels=("calm", "brisk"), joints=tiny.NAMES, fps=30.0, frames=8
)


@pytest.mark.parametrize(
    ("field", "other"),
    [
        ("kind", "style"),
        ("labels", ("brisk", "calm")),
        ("labels", ("calm", "brisk", "limp")),
        ("joints", tiny.NAMES[:-1]),
        ("fps", 15.0),
        ("frames", 60),
    ],
)
def test_what_does_not_fit_a_run_is_named(tmp_path, field, other):
    path = tmp_path / "e.npz"
    evaluators.save(path, samples.evaluator())
    loaded = evaluators.load(path)
    assert evaluators.params_for(loaded, **RUN) is loaded.params
    with pytest.raises(ValueError) as error:
        evaluators.params_for(loaded, **RUN | {field: other})
    for word in (str(path), repr(field), repr(RUN[field]), repr(other)):
        assert word in str(error.value)


def test_without_an_evaluator_there_are_no_parameters():
    assert evaluators.params_for(None, **RUN) is None


def test_camdm_refuses_one_that_does_not_fit_before_any_training(capsys):
    call = dict(course="forward", rollouts=2, seconds=4.0)
    wrong = samples.evaluator("style", labels=samples.STYLES, frames=60)
    with pytest.raises(ValueError, match="does not fit the run: field 'joints'"):
        camdm_evaluation.evaluate_run(samples.run(), evaluator=wrong, **call)
    assert capsys.readouterr().out == ""


# --- what tables say ---------------------------------------------------------------


def test_tables_say_who_scored(tmp_path):
    made, path = samples.evaluator(), tmp_path / "e.npz"
    evaluators.save(path, made)
    name = fingerprint(made.params)
    here = evaluators.describe(made.params, reference="abc")
    assert here == dict(fingerprint=name, reference_clips="abc", origin="trained here")
    text = evaluators.note(here)
    assert name in text and "trained here" in text and "abc" in text
    frozen = evaluators.describe(made.params, evaluators.load(path), reference="abc")
    assert frozen["fingerprint"] == name and frozen["origin"] == "e.npz"
    assert frozen["evaluator_clips"] == made.clips and frozen["evaluator_seed"] == 3
    assert f"{name} (e.npz)" in evaluators.note(frozen)


def test_the_fingerprint_of_clips_is_of_what_is_learnt_from():
    clips = tiny.clips()
    name = evaluators.clips_fingerprint(clips, "style")
    more = clips.labels | {"mood": jnp.zeros(clips.num_clips, jnp.int32)}
    renamed = dataclasses.replace(clips, labels=more, source="elsewhere")
    assert evaluators.clips_fingerprint(renamed, "style") == name
    turned = clips.labels | {"style": 1 - clips.labels["style"]}
    moved = clips.root_position.at[3, 1].add(1e-6)
    for changes in (dict(labels=turned), dict(root_position=moved)):
        other = dataclasses.replace(clips, **changes)
        assert evaluators.clips_fingerprint(other, "style") != name
    data = ball_walker.clips(20)
    lifted = dataclasses.replace(data, position=data.position.at[0, 1].add(0.01))
    names = {
        evaluators.clips_fingerprint(x, "skill") for x in (data, data.clips, lifted)
    }
    assert len(names) == 3


# --- training, and use -------------------------------------------------------------


@pytest.mark.slow
def test_an_evaluator_of_styles_scores_from_its_file_as_when_it_was_trained(tmp_path):
    clips = tiny.clips(60)
    made = camdm_evaluation.train_style(
        clips, clips, field="style", num_steps=1, seed=0
    )
    assert (made.kind, made.frames, made.updates) == ("style", 60, 1)
    assert made.labels == clips.names("style") and made.joints == tiny.NAMES
    assert made.accuracy in (0.0, 0.25, 0.5, 0.75, 1.0)  # of four windows
    assert made.clips == evaluators.clips_fingerprint(clips, "style")
    evaluators.save(tmp_path / "e.npz", made)
    windows = eval_windows(clips, stride=60, field="style")
    found = []
    for one in (made, *(evaluators.load(tmp_path / "e.npz") for _ in range(2))):
        evaluator = style_evaluator.StyleEvaluator(params=one.params, config=one.config)
        found.append(
            style_evaluator.features_and_hits(clips.skeleton, windows, evaluator)
        )
    assert found[0][0].shape == (4, 512) and np.ptp(found[0][0]) > 0.1
    same(found[1], found[0])
    same(found[2], found[0])
    assert float(np.mean(found[0][1])) == made.accuracy


@pytest.fixture(scope="module")
def actions(tmp_path_factory):
    """A run of actions without models."""
    folder = tmp_path_factory.mktemp("run")
    clips_io.save_clips(folder / "clips.npz", tiny.clips(40))
    return emdm_data.prepare(
        folder / "run",
        (folder / "clips.npz",),
        task="action",
        field="style",
        merge={},
        least=1,
        fps=tiny.clips(40).fps,
        frames=8,
        held_out=0.5,
    )


@pytest.mark.slow
def test_an_evaluator_of_actions_is_the_one_that_a_run_trains(actions, tmp_path):
    made = emdm_action_evaluation.train_action(
        actions.train, actions.held_out, field="style", num_steps=3, seed=0
    )
    evaluators.save(tmp_path / "e.npz", made)
    loaded = evaluators.load(tmp_path / "e.npz")
    call = dict(num_steps=3, seed=0)
    load = emdm_action_evaluation.load_evaluator
    same(load(actions, evaluator=loaded, **call), made.params)
    assert not (actions.record.folder / "evaluator").exists()
    same(load(actions, **call), made.params)
    assert 0.0 <= made.accuracy <= 1.0 and made.frames == 8
    # Twice from the file, and once from the run's folder: the same judgment.
    frozen = evaluators.load(tmp_path / "e.npz")
    wanted = jnp.repeat(jnp.arange(2), 4)
    positions = emdm_action_evaluation.real_positions(
        jax.random.key(1), wanted, actions.held_out
    )
    first, second, third = (
        emdm_action_evaluation.moments(params, actions)(jax.random.key(2), positions)
        for params in (loaded.params, frozen.params, load(actions, **call))
    )
    same(second, first)
    same(third, first)
    other = dataclasses.replace(loaded, frames=9)
    with pytest.raises(ValueError, match="e.npz.*field 'frames' is 9, expected 8"):
        load(actions, evaluator=other, **call)


@pytest.fixture(scope="module")
def ball():
    """Clips with a ball in two parts, a model for them, and a trained evaluator."""
    train, held_out = smgdiff_data.split(ball_walker.clips(60), fraction=0.3)
    model = smgdiff_training.make_model(train, sizes=dict(future=FRAMES))
    made = smgdiff_evaluation.train_ball(
        train, held_out, frames=FRAMES, num_steps=20, seed=0
    )
    return train, held_out, model, made


def setting_of(ball, evaluator):
    train, held_out, model, _ = ball
    return smgdiff_evaluation.make_setting(
        train,
        held_out,
        model,
        number=600,
        replications=2,
        evaluator_steps=20,
        seed=0,
        evaluator=evaluator,
    )


@pytest.mark.slow
def test_the_same_evaluator_gives_the_same_numbers(ball, tmp_path):
    path = tmp_path / "e.npz"
    evaluators.save(path, ball[-1])
    settings = [setting_of(ball, evaluators.load(path)) for _ in range(2)]
    # As a table with the same seed trains it for itself.
    for found in (*settings, setting_of(ball, None)):
        same(found.evaluator.params, ball[-1].params)
    first, second = (smgdiff_evaluation.score_real(x) for x in settings)
    for one, other in zip(first, second, strict=True):
        assert {"fid", "skill_accuracy"} < set(one) == set(other)
        assert [float(v) for v in one.values()] == [float(v) for v in other.values()]


@pytest.mark.slow
def test_skills_with_a_ball_are_recognized(ball):
    assert ball[-1].accuracy > 0.9  # a ball at hand, or thirty meters away
    assert ball[-1].config.num_joints == len(ball[-1].joints) + 1
    wrong = dataclasses.replace(ball[-1], frames=45)
    with pytest.raises(ValueError, match="field 'frames' is 45, expected 12"):
        setting_of(ball, wrong)
