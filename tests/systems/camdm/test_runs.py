import dataclasses

import jax
import numpy as np
import pytest

from jaxmotion.data import clips_io
from jaxmotion.learning import checkpoint
from jaxmotion.systems.camdm import evaluation as camdm_evaluation
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import training as camdm_training
from tests import samples, tiny

EXPERIMENT = {
    "contents": [],
    "label": "style",
    "labels": [],
    "held_out": 0.3,
    "held_out_clips": [],
}


def saved(folder, experiment=None, clips=None):
    """A run folder as training leaves it, and its clips beside it."""
    run, data = samples.run(), folder / "clips.npz"
    clips_io.save_clips(data, samples.clips() if clips is None else clips)
    if experiment is None:
        experiment = EXPERIMENT | {"data": str(data)}
    config = camdm_model.to_json(run.model) | {"experiment": experiment}
    state = {"ema_params": run.params}
    checkpoint.save(folder / "run" / "checkpoints", 1, state, config)
    return folder / "run"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("runs"))


def test_a_run_comes_back_with_its_model_parameters_and_split(folder):
    found, made = camdm_training.load_run(folder), samples.run()
    assert found.model.labels == made.model.labels
    assert found.model.config == made.model.config
    assert found.field == "style"
    pairs = zip(
        jax.tree.leaves((found.params, found.held_out.root_position)),
        jax.tree.leaves((made.params, made.held_out.root_position)),
        strict=True,
    )
    for a, b in pairs:
        np.testing.assert_array_equal(a, b)
    names = set(found.train.clip_names) | set(found.held_out.clip_names)
    assert len(names) == samples.clips().num_clips
    assert not set(found.train.clip_names) & set(found.held_out.clip_names)


def test_other_clips_of_the_same_kind_may_be_given(folder, tmp_path):
    clips_io.save_clips(tmp_path / "more.npz", samples.clips(minutes=0.8))
    found = camdm_training.load_run(folder, tmp_path / "more.npz")
    assert found.train.num_clips + found.held_out.num_clips == 12


def test_clips_of_another_character_are_refused(folder, tmp_path):
    clips_io.save_clips(tmp_path / "tiny.npz", tiny.clips())
    with pytest.raises(ValueError, match="do not fit the model: joints"):
        camdm_training.load_run(folder, tmp_path / "tiny.npz")


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(fps=60.0), r"fps 60.0, expected 30.0"),
        (dict(label_names=(("style", ("a", "b")),)), r"names of 'style' .*expected"),
    ],
)
def test_what_differs_is_named(change, message):
    run = samples.run()
    other = dataclasses.replace(run.train, **change)
    with pytest.raises(ValueError, match=message):
        camdm_model.check_clips(run.model, other, "style")
    camdm_model.check_clips(run.model, run.train, "style")


def test_missing_data_are_named(folder, tmp_path):
    with pytest.raises(OSError, match="gone.npz"):
        camdm_training.load_run(folder, tmp_path / "gone.npz")


def test_a_folder_without_checkpoints_is_named(tmp_path):
    with pytest.raises(checkpoint.CheckpointError, match=str(tmp_path)):
        camdm_training.load_run(tmp_path)


def test_a_run_of_another_script_is_named(tmp_path):
    foreign = saved(tmp_path, experiment={"label": "style"})
    with pytest.raises(ValueError, match="lacks contents, data, held_out.*train"):
        camdm_training.load_run(foreign)


def test_contents_narrow_the_clips_where_they_have_such_a_field(tmp_path):
    clips = samples.clips()
    content = np.arange(clips.num_clips) % 2
    clips = dataclasses.replace(
        clips,
        labels=clips.labels | {"content": jax.numpy.asarray(content, "int32")},
        label_names=(*clips.label_names, ("content", ("walk", "run"))),
    )
    path = tmp_path / "c.npz"
    clips_io.save_clips(path, clips)
    train, held_out = camdm_training.split_data(path, ("walk",), "style", 0.4)
    for part in (train, held_out):
        np.testing.assert_array_equal(part.labels["content"], 0)
    both = camdm_training.split_data(path, (), "style", 0.4)
    assert sum(part.num_clips for part in both) == clips.num_clips
    with pytest.raises(ValueError, match="unknown content 'fly'"):
        camdm_training.split_data(path, ("fly",), "style", 0.4)
    with pytest.raises(ValueError, match="unknown label field 'mood'"):
        camdm_training.split_data(path, (), "mood", 0.4)


def test_speeds_of_a_course_are_the_styles_or_the_one_asked_for():
    run, labels = samples.run(), np.array([1, 0, 1])
    own, commands = camdm_evaluation.course_of_run(
        run, "forward", labels, seconds=2.0, speed=None
    )
    assert own[0] == own[2] != own[1]
    given, commands = camdm_evaluation.course_of_run(
        run, "forward", labels, seconds=2.0, speed=0.7
    )
    np.testing.assert_array_equal(given, 0.7)
    speed = np.linalg.norm(commands.velocity, axis=-1)
    np.testing.assert_allclose(speed, 0.7, rtol=1e-5)
    np.testing.assert_array_equal(commands.label[:, 0], labels)


def test_what_is_wrong_is_found_before_any_training():
    run = samples.run()
    options = dict(course="forward", rollouts=2, seconds=6.0)
    for change, message in (
        (dict(seconds=3.0), "too short to measure"),
        (dict(course="waltz"), "unknown course 'waltz'"),
    ):
        with pytest.raises(ValueError, match=message):
            camdm_evaluation.evaluate_run(run, **(options | change))
    with pytest.raises(ValueError, match="unknown style 'sad': the model has neutral"):
        camdm_evaluation.steer_one(run, "sad", course="forward", seconds=1.0)
    with pytest.raises(ValueError, match="unknown style 'glad'"):
        camdm_evaluation.steer_one(
            run, "zombie", to_style="glad", course="forward", seconds=1.0
        )
