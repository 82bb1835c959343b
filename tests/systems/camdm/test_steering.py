import copy
import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.control import courses, steering
from jaxmotion.data import selection, windows
from jaxmotion.motion import skeleton, trajectory
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import model as camdm_model
from tests import samples

LABELS = np.array([0, 1, 1, 0])


@pytest.fixture(scope="module")
def run():
    return samples.run()


def test_data_windows_are_the_clips_frames(run):
    clips = run.train
    found = windows.eval_windows(clips, stride=30, field="style")
    # Clips of 120 frames: windows at 0, 30 and 60.
    count = 3 * clips.num_clips
    assert found.motion.root_position.shape == (count, 60, 3)
    assert found.velocity.shape == found.facing.shape == (count, 60, 2)
    roots = np.asarray(clips.root_position)
    for window in range(count):
        clip, start = divmod(window, 3)
        begin = int(clips.offsets[clip]) + 30 * start
        np.testing.assert_array_equal(
            found.motion.root_position[window], roots[begin : begin + 60]
        )
        assert found.group[window] == clip
        assert found.label[window] == clips.labels["style"][clip]


def test_what_is_wanted_of_a_clip_is_its_own_path_smoothed(run):
    found = windows.eval_windows(run.train, stride=60, field="style")
    path = np.asarray(found.motion.root_position, float)[..., ::2]
    # Over most of a window the wanted path goes where the walker goes.
    wanted = np.asarray(found.velocity, float)[:, 10:50].sum(axis=1) / 30.0
    walked = path[:, 50] - path[:, 10]
    assert np.abs(wanted - walked).max() < 0.15
    np.testing.assert_allclose(np.linalg.norm(found.facing, axis=-1), 1.0, atol=1e-5)
    # It is smoother than the walk itself: no sway, no steps.
    rough = np.diff(path, 2, axis=1)[:, 15:45] * 30.0
    smooth = np.diff(np.asarray(found.velocity), axis=1)[:, 15:45]
    assert np.abs(smooth).mean() < 0.7 * np.abs(rough).mean()


def test_rollout_windows_leave_out_the_start_and_keep_their_owner():
    frames = samples.walking(LABELS, seconds=7.0)
    found = windows.rollout_windows(frames, jnp.asarray(LABELS), skip=60)
    assert found.motion.root_position.shape == (8, 60, 3)  # 150 frames hold two
    for window in range(8):
        owner, part = divmod(window, 2)
        begin = 60 + 60 * part
        assert found.group[window] == owner
        assert found.label[window] == LABELS[owner]
        for got, of in (
            (found.motion.joint_rotation, frames.joint_rotation),
            (found.velocity, frames.desired_velocity),
            (found.facing, frames.desired_facing),
        ):
            np.testing.assert_array_equal(got[window], of[owner, begin : begin + 60])


def test_rollouts_too_short_to_measure_are_named():
    frames = samples.walking(LABELS[:1], seconds=3.9)
    with pytest.raises(ValueError, match=r"3\.9 s are too short.*at least 4 s"):
        windows.rollout_windows(frames, jnp.asarray([0]), skip=60)
    windows.check_ticks(120, fps=30.0, skip=60)


def test_style_speeds_are_medians_within_clips(run):
    clips = run.train
    found = selection.label_speeds(clips, field="style")
    steps = {0: [], 1: []}
    for clip in range(clips.num_clips):
        own = slice(int(clips.offsets[clip]), int(clips.offsets[clip + 1]))
        path = np.asarray(clips.root_position, float)[own, ::2]
        speed = np.linalg.norm(np.diff(path, axis=0), axis=-1) * 30.0
        steps[int(clips.labels["style"][clip])] += speed.tolist()
    np.testing.assert_allclose(found, [np.median(steps[i]) for i in (0, 1)], rtol=1e-4)


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


def test_a_chunk_that_does_not_divide_is_made_smaller(run):
    _, whole = steered(None)
    _, parts = steered(3)  # of four characters: two at a time
    np.testing.assert_allclose(parts.root_position, whole.root_position, atol=1e-4)
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
