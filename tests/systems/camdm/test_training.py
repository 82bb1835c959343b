"""Run folders of CAMDM, how presets are trained, and trainings from another's end."""

import contextlib
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxmotion.data import clips_io
from jaxmotion.diffusion import chain
from jaxmotion.learning import checkpoint, loop, runs
from jaxmotion.systems.camdm import evaluation as camdm_evaluation
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import training as camdm_training
from tests import samples, tiny


def saved(folder, **changes):
    """A run folder as training leaves it; its clips are gone."""
    run, data = samples.run(), folder / "clips.npz"
    clips_io.save_clips(data, samples.clips())
    chosen = dict(label="style", held_out=0.3, mirrored=True) | changes
    record = camdm_training.prepare(
        folder / "run", data, make=lambda clips: run.model, settings={}, **chosen
    )
    state = {"ema_params": run.params}
    config = dataclasses.asdict(run.model.config)
    runs.store(record, camdm_model.STAGE, state, model=config)
    data.unlink()
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


def test_styles_that_cannot_be_evaluated_are_named(folder, tmp_path, capsys):
    saved(tmp_path, held_out=0.3)
    assert "no held-out clip" not in capsys.readouterr().out
    clips = samples.clips()
    held = [name for name in clips.clip_names if name.startswith("neutral")]
    saved(tmp_path / "named", held_out_clips=tuple(held[:1]))
    assert "no held-out clip of style zombie has 60 frames" in capsys.readouterr().out


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


def test_a_folder_that_is_no_run_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=f"{tmp_path}.*camdm.py train"):
        camdm_training.load_run(tmp_path)


def test_clips_that_do_not_fit_the_model_make_no_run(tmp_path):
    clips_io.save_clips(tmp_path / "tiny.npz", tiny.clips())
    with pytest.raises(ValueError, match="do not fit the model: joints"):
        camdm_training.prepare(
            tmp_path / "run",
            tmp_path / "tiny.npz",
            label="style",
            held_out=0.5,
            make=lambda clips: samples.run().model,
            settings={},
        )
    assert not (tmp_path / "run").exists()


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
    with pytest.raises(ValueError, match="unknown label 'sad': the model has neutral"):
        camdm_evaluation.steer_one(run, "sad", course="forward", seconds=1.0)
    with pytest.raises(ValueError, match="unknown label 'glad'"):
        camdm_evaluation.steer_one(
            run, "zombie", to_style="glad", course="forward", seconds=1.0
        )


@pytest.mark.slow
def test_samplers_of_one_model_are_scored_alike():
    """The same sampler twice has the same row but for its time; another has not."""
    run = samples.run()
    steps = tuple(range(1, run.model.config.num_steps + 1))
    own, other = (chain.ancestral_step, steps), (chain.ddim_step, steps[-1:])
    rows, report = camdm_evaluation.evaluate_samplers(
        run,
        {"own": own, "again": own, "other": other},
        rollouts=4,
        seconds=5.0,
        evaluator_steps=2,
    )
    times = [rows[name].pop("plan_time").value for name in ("own", "again", "other")]
    assert min(times) > 0
    assert rows["own"] == rows["again"]
    assert rows["own"]["jerk"].value != rows["other"]["jerk"].value
    assert rows["own"]["network_calls"].value == len(steps)
    assert rows["other"]["network_calls"].value == 1
    assert list(report["health"]) == ["own", "again", "other"]


# --- from the end of another ------------------------------------------------------


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


def test_only_what_has_no_parameters_is_new(first):
    model, params, path = first
    new = dict(
        weight_foot=7.0,
        attention="prefix",
        noise_levels=2,
        own_levels=0.5,
        seam_half_life=15.0,
    )
    config = dataclasses.replace(model.config, rotation_mean=(1.0,), **new)
    wanted = dataclasses.replace(model, config=config, source="mine")
    found, loaded = camdm_training.continued(wanted, path)
    assert found.config == dataclasses.replace(model.config, **new)
    assert found.source == "mine"
    for a, b in zip(jax.tree.leaves(loaded), jax.tree.leaves(params), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-3)  # exported as float16


def test_another_network_is_refused(first):
    model, _, path = first
    config = dataclasses.replace(model.config, width=2 * model.config.width)
    with pytest.raises(ValueError, match=r"a\.npz.*to train: config\."):
        camdm_training.continued(dataclasses.replace(model, config=config), path)


# --- presets -----------------------------------------------------------------------


@pytest.mark.slow
def test_the_papers_preset_is_unclipped_adamw_at_its_rate(first, tmp_path, monkeypatch):
    """Two steps of it are optax's AdamW on the gradients, which exceed the norm 1."""
    model = first[0]
    config = dataclasses.replace(model.config, weight_data=100.0, dropout=0.0)
    paper = camdm_training.FITTING["paper"]
    assert (paper["learning_rate"], paper["batch"]) == (1e-4, 512)
    data = tmp_path / "clips.npz"
    clips_io.save_clips(data, tiny.clips())
    run = camdm_training.prepare(
        tmp_path / "run",
        data,
        label="style",
        held_out=0.5,
        make=lambda clips: dataclasses.replace(model, config=config),
        settings={},
    )
    given = {}

    def watched(chunk, state, key, data, *, loop):
        given.update(chunk=chunk, state=state, key=key, data=data)
        raise KeyboardInterrupt

    monkeypatch.setattr(loop, "train", watched)
    budget = runs.Budget(steps=10, chunk=1, final=0.1, **paper | dict(batch=4))
    with contextlib.suppress(KeyboardInterrupt):
        camdm_training.train(run, budget)
    state, key, data = (given[name] for name in ("state", "key", "data"))
    before = jax.tree.map(np.asarray, state.params)
    adam = optax.scale_by_adam()
    expected = adam.init(before)
    for step in range(2):
        # The gradients, from the first moment: mu = 0.9 mu + 0.1 g.
        state, info = given["chunk"](state, key, data)
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
