"""Characters of CAMDM, started and steered, and how labels are named."""

import copy
import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from jaxmotion.control import courses, frame, rollout, steering
from jaxmotion.data import selection, windows
from jaxmotion.diffusion import chain
from jaxmotion.motion import skeleton, trajectory
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import model as camdm_model
from tests import samples, tiny

LABELS = np.array([0, 1, 1, 0])


@pytest.fixture(scope="module")
def run():
    return samples.run()


def test_a_style_without_clips_has_no_speed_and_no_start(run):
    lonely = dataclasses.replace(
        run.train, labels={"style": jnp.zeros_like(run.train.labels["style"])}
    )
    assert selection.label_speeds(lonely, field="style")[1] == 0.0
    with pytest.raises(ValueError, match="no clip of style 'zombie' to start from"):
        camdm_controller.start_states(lonely, run.model, LABELS, field="style", seed=0)


def test_characters_start_at_the_origin_facing_ahead_in_poses_of_the_data(run):
    states = camdm_controller.start_states(
        run.held_out, run.model, LABELS, field="style", seed=2
    )
    past = states.past
    assert past.root_position.shape == (4, run.model.config.past, 3)
    path = trajectory.root_trajectory(run.model.skeleton, past)
    np.testing.assert_allclose(path.position[:, -1], 0.0, atol=1e-5)
    facing = np.broadcast_to([0.0, 1.0], (4, 2))
    np.testing.assert_allclose(path.facing[:, -1], facing, atol=1e-5)
    # Joint rotations below the root are untouched: each pose is one of the clips'.
    known = np.asarray(run.held_out.joint_rotation)[:, 1:]
    owner = np.repeat(
        np.asarray(run.held_out.labels["style"]), np.diff(run.held_out.offsets)
    )
    for label, pose in zip(LABELS, np.asarray(past.joint_rotation), strict=True):
        far = np.abs(known[owner == label] - pose[-1, 1:]).max(axis=(1, 2))
        assert far.min() < 1e-5
    heights = np.asarray(run.held_out.root_position)[:, 1]
    assert np.all(past.root_position[..., 1] <= heights.max() + 1e-6)


def test_starts_are_of_the_label_and_drawn_evenly():
    labels = np.tile([1, 0, 2], 1000)
    starts = {"own": jnp.arange(12.0).reshape(3, 4), "more": jnp.ones((3, 4, 5))}
    chosen = steering.chosen_starts(starts, labels, tuple("abc"), seed=1)
    assert chosen["more"].shape == (3000, 5)
    own = np.asarray(chosen["own"], int)
    np.testing.assert_array_equal(own // 4, labels)
    counts = np.bincount(own, minlength=12)
    assert scipy.stats.chisquare(counts).pvalue > 0.01
    other = steering.chosen_starts(starts, labels, tuple("abc"), seed=2)["own"]
    assert 0.7 < np.mean(other != own) < 0.8  # three in four
    with pytest.raises(ValueError, match="labels are in 1..3, expected 0..2"):
        steering.chosen_starts(starts, np.array([1, 3]), tuple("abc"), seed=1)


@pytest.mark.parametrize("library", [np, jnp])
def test_states_of_another_model_are_told_however_a_model_starts(library):
    """Starts may compute with NumPy what JAX gave, which cannot be traced."""

    def starts(labels, seed):
        places = library.asarray(jnp.zeros((len(labels), 3)) + seed)
        return {"place": jnp.asarray(places)}

    character = steering.Character(
        skeleton=tiny.skeleton(),
        labels=(),
        fps=30.0,
        source="tests",
        params={},
        method=lambda params: None,
        starts=starts,
    )
    steering.check_states(character, character.start(2))
    with pytest.raises(ValueError, match="states are of another model"):
        steering.check_states(character, {"place": jnp.zeros((2, 4))})


def test_characters_start_in_poses_of_the_models_own(run):
    """Through JSON, as an exported model has them."""
    past = run.model.config.past
    starts = jax.vmap(jax.vmap(lambda start: windows.cut(run.train, start, past)))(
        jnp.array([[0, 20], [50, 70]])
    )
    value = camdm_model.to_json(dataclasses.replace(run.model, starts=starts))
    model = camdm_model.from_json(json.loads(json.dumps(value)), where="here")
    states = camdm_controller.own_states(model, LABELS, seed=1)
    path = trajectory.root_trajectory(model.skeleton, states.past)
    np.testing.assert_allclose(path.position[:, -1], 0.0, atol=1e-5)
    np.testing.assert_allclose(path.facing[:, -1, 1], 1.0, atol=1e-5)
    # Rotations below the root tell whose pose it is.
    own = np.asarray(starts.joint_rotation)[..., 1:, :]
    for label, pose in zip(LABELS, states.past.joint_rotation[:, :, 1:], strict=True):
        assert min(np.abs(pose - known).max() for known in own[label]) < 1e-4
    with pytest.raises(ValueError, match="labels are in 0..2, expected 0..1"):
        camdm_controller.own_states(model, np.array([0, 2]))
    with pytest.raises(ValueError, match="no poses to start from: give clips"):
        camdm_controller.own_states(run.model, LABELS)
    for change, message in (
        (lambda v: v["starts"]["root_position"].pop(), "'starts' has shapes"),
        (lambda v: v["starts"].pop("joint_rotation"), "'starts' is wrong"),
        (
            lambda v: v["starts"]["root_position"][0][0][0].__setitem__(0, np.nan),
            "'starts' has numbers that are not within",
        ),
    ):
        bad = copy.deepcopy(value)
        change(bad)
        with pytest.raises(ValueError, match=f"here: field {message}"):
            camdm_model.from_json(bad, where="here")


def test_labels_by_name_and_by_index():
    names = ("calm", "brisk")
    find = functools.partial(steering.label_indices, names)
    assert find().tolist() == [0] and find("brisk", 3).tolist() == [1, 1, 1]
    assert find(["brisk", 0]).tolist() == find(np.array([1, 0])).tolist() == [1, 0]
    assert steering.label_indices((), None, 2).tolist() == [0, 0]
    for args, message in (
        (("sad",), "unknown label 'sad': the model has calm, brisk"),
        ((2,), r"labels are in 2..2, expected 0..1 \(calm, brisk\)"),
        ((["calm"], 2), "1 labels for 2 characters"),
        ((["calm"] * 3, 2), "3 labels for 2 characters"),
        ((0.5,), "label is 0.5, expected a name or an index"),
        (("calm", 0), "number of characters is 0"),
    ):
        with pytest.raises(ValueError, match=message):
            find(*args)


def test_labels_within_compiled_code_pass_as_they_are():
    def find(labels, number=None, names=("calm", "brisk")):
        indices = functools.partial(steering.label_array, names, number=number)
        return jax.jit(indices)(labels).tolist()

    assert find(np.array([1, 0])) == find(np.array([1, 0]), 2) == [1, 0]
    assert find(1) == [1] and find(1, 3) == [1, 1, 1]
    assert find(np.array([1, 0]), names=()) == [0, 0]
    for labels, number, message in (
        (np.ones(2), None, r"labels are float32\[2\], expected whole numbers"),
        (np.ones((1, 1), int), None, r"labels are int32\[1, 1\], expected whole"),
        (np.array([1, 0]), 3, "2 labels for 3 characters"),
    ):
        with pytest.raises(ValueError, match=message):
            find(labels, number)


@functools.cache
def steered(chunk):
    run = samples.run()
    states = camdm_controller.start_states(
        run.held_out, run.model, LABELS, field="style", seed=2
    )
    commands = courses.course_batch(
        "forward", LABELS, np.full(4, 1.0), seconds=1.2, fps=30.0
    )
    frames = steering.steered_rollouts(
        camdm_controller.character(run.params, run.model),
        jax.random.key(5),
        states,
        commands,
        chunk=chunk,
    )
    return states, frames


@pytest.mark.slow
def test_rollouts_show_a_frame_a_tick_from_where_they_start(run):
    _, frames = steered(None)
    assert frames.root_position.shape == (4, 36, 3)
    assert frames.joint_rotation.shape == (4, 36, run.model.skeleton.num_joints, 6)
    assert frames.planned[:, 0].all() and frames.planned.mean() < 0.3
    assert np.isfinite(np.asarray(frames.root_position)).all()
    # The springs take up the commanded 1 m/s along +z, whatever the start pose did.
    gap = np.asarray(frames.desired_velocity) - np.array([0.0, 1.0])
    gap = np.linalg.norm(gap, axis=-1)
    assert gap[:, -1].max() < 0.1 < 0.5 < gap[:, 0].min()


@pytest.mark.slow
def test_the_step_of_the_chain_is_the_users_choice(run):
    """DDIM of full noise is the default; of two steps DPM-Solver++ is DDIM without."""
    start = camdm_controller.start_states
    states = start(run.held_out, run.model, LABELS[:2], field="style", seed=2)
    commands = courses.course_batch(
        "forward", LABELS[:2], np.ones(2), seconds=0.1, fps=30.0
    )

    def rotations(**step):
        made = camdm_controller.character(run.params, run.model, **step)
        key = jax.random.key(5)
        found = steering.steered_rollouts(made, key, states, commands)
        assert np.isfinite(found.joint_rotation).all()
        return found.joint_rotation

    default = rotations()
    counted = steering._rollouts._cache_size()
    np.testing.assert_array_equal(rotations(step=chain.ancestral_step), default)
    assert steering._rollouts._cache_size() == counted
    noisy = rotations(step=functools.partial(chain.ddim_step, eta=1.0))
    np.testing.assert_allclose(noisy, default, atol=1e-4)
    ddim = rotations(step=chain.ddim_step)
    assert np.abs(ddim - default).max() > 0.01
    np.testing.assert_allclose(rotations(step=chain.dpm_solver_step), ddim, atol=1e-4)


@pytest.mark.slow
def test_a_second_call_compiles_nothing(run):
    """Other commands, start poses and keys of the same shapes."""
    steered(None)
    counted = steering._rollouts._cache_size()
    states = camdm_controller.start_states(
        run.held_out, run.model, LABELS, field="style", seed=9
    )
    commands = courses.course_batch(
        "strafe", LABELS, np.full(4, 0.5), seconds=1.2, fps=30.0
    )
    steering.steered_rollouts(
        camdm_controller.character(run.params, run.model),
        jax.random.key(7),
        states,
        commands,
    )
    assert steering._rollouts._cache_size() == counted


@pytest.mark.slow
def test_a_chunk_that_does_not_divide_is_made_smaller():
    _, whole = steered(None)
    _, parts = steered(3)  # of four characters: two at a time
    np.testing.assert_allclose(parts.root_position, whole.root_position, atol=1e-4)


def test_the_calmest_of_many_are_kept():
    """Characters who sway by different widths; the state is width and tick."""
    one = skeleton.Skeleton(offsets=jnp.zeros((1, 3)), parents=(-1,), names=("root",))
    width = jnp.array([0.3, 0.1, 0.4, 0.0, 0.5, 0.2, 0.8, 0.7])

    def advance(state, command):
        width, tick = state
        shown = frame.Frame(
            root_position=jnp.array([0.0, 1.0, 0.0]).at[0].set(width * (tick % 2)),
            joint_rotation=jnp.array([[1.0, 0.0, 0.0, 0.0, 1.0, 0.0]]),
            desired_velocity=command.velocity,
            desired_facing=command.facing,
            planned=jnp.zeros((), bool),
            fps=30.0,
        )
        return (width, tick + 1), shown

    sways = rollout.Controller(
        plan_level=lambda state, command: jnp.zeros((), jnp.int32),
        plans=(),
        advance=advance,
    )
    character = steering.Character(
        skeleton=one,
        labels=(),
        fps=30.0,
        source="tests",
        params={},
        method=lambda params: sways,
        starts=lambda labels, seed: None,
    )
    states = width, jnp.zeros(8, jnp.int32)
    keep = functools.partial(
        steering.calmest, character, states, np.zeros(8, int), past=5, seconds=1.0
    )
    (kept, ticks), frames = keep(number=3)
    np.testing.assert_allclose(kept, [0.0, 0.1, 0.2], rtol=1e-6)
    np.testing.assert_array_equal(ticks, 30)
    assert frames.root_position.shape == (3, 5, 3)
    with pytest.raises(ValueError, match="starts is 9, expected 1 to 8"):
        keep(number=9)


def test_chunks_of_nobody_are_refused():
    with pytest.raises(ValueError, match="chunks of 0 characters"):
        steered(0)


@pytest.mark.parametrize("label", [-1, 2])
def test_a_style_that_the_model_has_not_is_refused(run, label):
    message = rf"labels are in {min(label, 0)}..{max(label, 1)}, expected 0..1 \("
    labels = np.array([0, 1, label])
    with pytest.raises(ValueError, match=message):
        camdm_controller.start_states(
            run.train, run.model, labels, field="style", seed=0
        )
    both, speeds = labels[:2], np.ones(2)
    good = courses.course_batch("forward", both, speeds, seconds=1.0, fps=30.0)
    bad = dataclasses.replace(good, label=good.label.at[0, 3].set(label))
    states = camdm_controller.start_states(
        run.train, run.model, both, field="style", seed=0
    )
    with pytest.raises(ValueError, match=message):
        steering.steered_rollouts(
            camdm_controller.character(run.params, run.model),
            jax.random.key(0),
            states,
            bad,
        )


def test_the_walker_as_a_rollout_goes_where_its_command_says():
    frames = samples.walking(LABELS[:2], seconds=6.0)
    motion = skeleton.Motion(
        root_position=frames.root_position, joint_rotation=frames.joint_rotation
    )
    assert motion.root_position.shape == (2, 180, 3)
    asked = np.asarray(trajectory.integrate_path(frames.desired_velocity, 30.0))[:, -1]
    walked = np.asarray(frames.root_position)[:, -1, ::2]
    assert np.linalg.norm(asked - walked, axis=-1).max() < 0.4
