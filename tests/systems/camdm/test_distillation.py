"""A student of CAMDM: its loss, its run folder, and how it samples."""

import dataclasses
import functools
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import clips_io, windows
from jaxmotion.learning import checkpoint, runs, training
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import distillation as camdm_distillation
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import training as camdm_training
from tests import mostly_slow, tiny

CONFIG = tiny.config(depth=1)
T = CONFIG.num_steps


def teacher():
    return tiny.random_params(camdm_model.init, CONFIG)


def batch(walker, size=4):
    index = windows.window_index(walker, CONFIG.window)
    motion, clip = windows.sample_windows(jax.random.key(0), walker, index, batch=size)
    return motion, walker.labels["style"][clip]


def loss_of(walker, **options):
    return functools.partial(
        camdm_distillation.loss,
        teacher=teacher(),
        skeleton=walker.skeleton,
        config=CONFIG,
        **options,
    )


@pytest.mark.slow
@pytest.mark.parametrize("target", mostly_slow(["chain", "consistency"], ["chain"]))
def test_the_teacher_teaches_itself_nothing_at_the_last_step(walker, target):
    """A chain of one step ends in the teacher's prediction."""
    config = dataclasses.replace(CONFIG, num_steps=1)
    params = tiny.random_params(camdm_model.init, config)
    loss = functools.partial(
        camdm_distillation.loss,
        teacher=params,
        skeleton=walker.skeleton,
        config=config,
        steps=(1,),
        target=target,
    )
    given = jax.random.key(1), batch(walker)
    _, terms = jax.jit(loss)(params, *given)
    for name in ("data", "velocity", "position", "position_velocity"):
        np.testing.assert_allclose(terms[name], 0.0, atol=1e-9)
    other = jax.tree.map(lambda x: x + 0.05, params)
    _, terms = jax.jit(loss)(other, jax.random.clone(given[0]), given[1])
    assert terms["data"] > 1e-4 and terms["position"] > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("target", ["chain", "consistency"])
def test_a_short_training_comes_closer_to_the_teacher(walker, target):
    loss = loss_of(walker, steps=(2, T), target=target)
    optimizer = training.make_optimizer("adamw", learning_rate=3e-3)
    update = jax.jit(training.make_update(loss, optimizer))
    state, data = training.init_train_state(teacher(), optimizer), batch(walker)
    losses = []
    for i in range(30):
        state, info = update(state, jax.random.fold_in(jax.random.key(2), i), data)
        losses.append(float(info["loss"]))
    assert np.mean(losses[-5:]) < 0.7 * np.mean(losses[:5])
    # The exact targets, and for both the step that a plan begins with.
    exact = jax.jit(loss_of(walker, steps=(T,)))
    off = [exact(p, jax.random.key(3), data)[0] for p in (teacher(), state.params)]
    assert off[1] < 0.9 * off[0]


@pytest.fixture(scope="module")
def taught(tmp_path_factory):
    """A teacher's run folder."""
    folder = tmp_path_factory.mktemp("distillation")
    clips = tiny.clips()
    clips_io.save_clips(folder / "clips.npz", clips)
    model = camdm_model.Model(
        config=CONFIG,
        skeleton=clips.skeleton,
        labels=clips.names("style"),
        source=clips.source,
    )
    run = camdm_training.prepare(
        folder / "teacher",
        folder / "clips.npz",
        label="style",
        held_out=0.5,
        make=lambda clips: model,
        settings={},
    )
    config = dataclasses.asdict(CONFIG)
    runs.store(run, camdm_model.STAGE, {"ema_params": teacher()}, model=config)
    (folder / "clips.npz").unlink()
    return folder / "teacher"


def prepare(folder, source, **changes):
    options = dict(steps=(2, T), target="chain", mirrored=False, balance=0.0)
    return camdm_distillation.prepare(folder, source, **options | changes)


BUDGET = runs.Budget(steps=4, batch=2, chunk=1, save_every=2, warmup=1)


@pytest.fixture(scope="module")
def student(taught):
    """A student's run folder."""
    folder = taught.with_name("student")
    camdm_distillation.train(*prepare(folder, taught), BUDGET)
    return folder


@pytest.mark.slow
def test_a_student_is_a_run_like_others_and_visits_its_own_steps(student, taught):
    run = camdm_training.load_run(student)
    assert run.model.steps == (2, T)
    first = camdm_training.load_run(taught)
    assert run.model.config == first.model.config and first.model.steps is None
    for part in ("train", "held_out"):
        assert getattr(run, part).clip_names == getattr(first, part).clip_names
    character = camdm_controller.load_character(student)
    assert character.method.steps == (2, T)
    assert character.tuning.num_steps == (1, 2)
    scale = character.tuning.scale
    assert character.tuning.method(1, scale).steps == (T,)
    assert character.tuning.method(2, scale).steps == (2, T)
    one = camdm_controller.load_character(student, steps=(T,))
    assert one.method.steps == (T,)
    with pytest.raises(ValueError, match=r"steps are \(2,\), expected .* the last 4"):
        camdm_controller.load_character(student, steps=(2,))


def test_an_export_keeps_the_steps(student, tmp_path):
    model, params = camdm_model.load(student)
    value = camdm_model.to_json(model)
    checkpoint.export_params(tmp_path / "a.npz", params, value)
    assert camdm_model.load(tmp_path / "a.npz")[0].steps == (2, T)
    for steps in ([2], [0, T], [T, T], ["4"], "4", [True, T], [], T):
        broken = value | {"steps": steps}
        with pytest.raises(
            ValueError, match=r"file: field 'steps': steps are .*1\.\.4"
        ):
            camdm_model.from_json(broken, where="file")


def test_another_training_that_starts_from_a_student_visits_all_steps(student):
    model, _ = camdm_model.load(student)
    wanted = dataclasses.replace(model, steps=None)
    found, _ = camdm_training.continued(wanted, student)
    assert found.steps is None


@pytest.mark.slow
def test_a_plan_of_one_step_is_one_prediction(student):
    """Of the noise that `chain.sample` draws."""
    model, params = camdm_model.load(student)
    config = model.config
    generator = np.random.default_rng(0)
    draw = lambda *shape: jnp.asarray(generator.normal(size=shape), jnp.float32)  # noqa: E731
    condition = camdm_model.Condition(
        past=draw(config.past, config.num_features),
        trajectory=camdm_model.trajectory.Trajectory(
            position=draw(config.future, 2),
            facing=jnp.tile(jnp.array([0.0, 1.0]), (config.future, 1)),
        ),
        label=jnp.array(1),
        keep_past=jnp.array(True),
    )
    key = jax.random.key(5)
    found = camdm_model.sampler(params, config=config, steps=(T,))(
        jax.random.clone(key), condition
    )
    noise = jax.random.normal(
        jax.random.split(key)[0], (config.future, config.num_features)
    )
    expected = jax.jit(camdm_model.network(config).apply)(
        {"params": params}, noise, jnp.array(T), *condition.arguments(config)
    )
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.slow
def test_a_training_that_was_stopped_goes_on_as_if_it_had_not_been(
    student, taught, tmp_path
):
    folder = tmp_path / "student"
    shutil.copytree(student, folder)
    checkpoints = folder / camdm_model.STAGE / "checkpoints"
    place = runs.load(folder).checkpoints(camdm_model.STAGE)
    assert place == checkpoints and checkpoint.latest_step(place) == 4
    (stopped,) = [path for path in checkpoints.iterdir() if path.name == "4"]
    shutil.rmtree(stopped)
    assert checkpoint.latest_step(place) == 2
    camdm_distillation.train(*prepare(folder, taught), BUDGET)
    _, found = camdm_model.load(folder)
    _, expected = camdm_model.load(student)
    for a, b in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_is_wrong_is_named_and_leaves_nothing(student, taught, tmp_path):
    for change, message in (
        (dict(steps=(2, 3)), r"steps are \(2, 3\), expected .* the last 4"),
        (dict(steps=(T, 2)), "expected increasing ones"),
        (dict(steps=()), "expected increasing ones"),
    ):
        with pytest.raises(ValueError, match=message):
            prepare(tmp_path / "out", taught, **change)
    with pytest.raises(ValueError, match="made otherwise: target is 'chain', given"):
        prepare(student, taught, target="consistency")
    with pytest.raises(ValueError, match="give --data and --held-out-clips"):
        prepare(tmp_path / "out", Path("locomotion"))
    assert not (tmp_path / "out").exists()


def test_another_teacher_is_refused(student, taught, tmp_path):
    """One whose clips are the same but whose parameters are not."""
    other = tmp_path / "teacher"
    shutil.copytree(taught, other)
    shutil.rmtree(other / camdm_model.STAGE)
    params = jax.tree.map(lambda x: x + 0.1, teacher())
    config = dataclasses.asdict(CONFIG)
    runs.store(
        runs.load(other), camdm_model.STAGE, {"ema_params": params}, model=config
    )
    with pytest.raises(ValueError, match="made otherwise: teacher is '"):
        prepare(student, other)
