"""The face: what a stranger types first, and what it says to wrong input."""

import csv
import dataclasses
import errno
import inspect
import os

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmotion as jm
from jaxmotion import face, files
from jaxmotion.control import goals, steering
from jaxmotion.data import bvh, bvh_text
from jaxmotion.diffusion import chain
from jaxmotion.motion import contact, trajectory
from jaxmotion.motion.skeleton import joint_positions
from tests import samples

NAN, INF = float("nan"), float("inf")
untyped = inspect.unwrap(jm.rollout)  # as without the tests' type checker


@pytest.fixture(scope="module")
def model():
    return jm.load("locomotion")


@pytest.fixture(scope="module")
def frames(model):
    """Characters steered from nothing, in six lines with `model`."""
    states = model.start(32)
    commands = jm.commands("figure_eight", model, 32, seconds=0.1, speed=1.4)
    return jm.rollout(model, jax.random.key(0), states, commands)


def test_many_characters_in_six_lines(model, frames):
    assert frames.root_position.shape == (32, 3, 3)
    assert np.isfinite(np.asarray(frames.joint_rotation)).all()
    assert frames.fps == 30.0 and frames.planned[:, 0].all()
    # They begin where they stand, each with noise of its own.
    assert np.abs(np.asarray(frames.root_position)[..., ::2]).max() < 0.3
    assert len(np.unique(np.asarray(frames.root_position)[:, -1], axis=0)) > 24


@pytest.mark.slow
def test_a_second_call_compiles_nothing(model, frames):
    """Other start poses, commands, labels, speeds, keys; and the model loaded again."""
    counted = steering._rollouts._cache_size()
    again = jm.load("locomotion")
    labels = np.arange(32) % 2
    states = again.start(32, labels=labels, seed=3)
    commands = jm.commands(
        "strafe", again, labels=labels, speed=np.linspace(0, 2, 32), seconds=0.1
    )
    other = jm.rollout(again, jax.random.key(7), states, commands)
    assert steering._rollouts._cache_size() == counted
    assert np.abs(other.root_position - frames.root_position).max() > 0.01


def test_a_list_of_segments_is_a_course(model):
    course = [(1.0, 0, 0, 0.5), (0.5, 90, 0, 1.0, "crouch")]
    found = jm.commands(course, model, 3)
    assert found.velocity.shape == (3, 45, 2)
    np.testing.assert_allclose(found.velocity[2, 0], [0.0, 0.5], atol=1e-6)
    np.testing.assert_allclose(found.velocity[2, 40], [1.0, 0.0], atol=1e-6)
    crouch = model.label("crouch")
    assert np.unique(found.label[:, :30]).tolist() == [0]
    assert np.unique(found.label[:, 30:]).tolist() == [crouch]


def test_a_run_starts_from_clips():
    """A model without poses of its own, whose styles the clips have too."""
    from jaxmotion.systems.camdm import controller

    run = samples.run()
    made = controller.character(run.params, run.model)
    states = made.start(clips=run.train, labels=["zombie", "neutral"])
    assert states.past.root_position.shape == (2, run.model.config.past, 3)
    names = (*run.train.names("style"), "none walks so")
    more = dataclasses.replace(run.train, label_names=(("style", names),))
    same = made.start(clips=more, labels=["zombie", "neutral"])
    assert jnp.array_equal(same.past.root_position, states.past.root_position)
    with pytest.raises(ValueError, match="no poses to start from: give clips"):
        made.start(2)
    other = dataclasses.replace(run.train, label_names=(("style", ("a", "b")),))
    with pytest.raises(ValueError, match=r"no label field \(of style\) has the styles"):
        made.start(clips=other)


@pytest.mark.parametrize("suffix", ["bvh", "csv", "gif", "glb", "html", "npz"])
def test_each_suffix_is_written(model, frames, tmp_path, suffix):
    path = tmp_path / "deep" / f"walk.{suffix}"
    jm.save(path, model.skeleton, frames[0])
    joints = np.asarray(joint_positions(model.skeleton, frames[0].motion))
    if suffix == "bvh":
        _, motion = bvh.motion_from_bvh(bvh_text.read_bvh(path))
        assert motion.root_position.shape == (3, 3)
    elif suffix == "csv":
        head, *rows = csv.reader(path.read_text().splitlines())
        assert head[:2] == ["seconds", f"{model.skeleton.names[0]}.x"]
        found = np.array(rows, float)[:, 1:].reshape(joints.shape)
        np.testing.assert_allclose(found, joints, atol=1e-4)
    elif suffix == "npz":
        with np.load(path) as found:
            assert found["fps"] == 30.0
            np.testing.assert_array_equal(found["joint_position"], joints)
            assert found["names"].tolist() == list(model.skeleton.names)
            feet = jnp.asarray(joints[:, list(model.skeleton.feet)])
            contacts = contact.foot_contacts(feet, 30.0)
            np.testing.assert_array_equal(found["foot_contact"], contacts)
    else:
        assert path.stat().st_size > 1000


def test_a_view_lives_without_a_kernel(model, frames):
    """The whole page is in the cell's output, and nothing of it is elsewhere."""
    page = jm.show(model.skeleton, frames[0], title="a & b")._repr_html_()
    assert page.startswith("<iframe srcdoc=") and page.count("<iframe") == 1
    assert "&lt;script&gt;" in page and "<script" not in page
    assert "http://" not in page and "https://" not in page


def broken(frames):
    return dataclasses.replace(frames, root_position=frames.root_position + NAN)


def at(frames, fps):
    return dataclasses.replace(frames, fps=fps)


def flat(frames):
    """With a joint that is turned nowhere."""
    turns = frames.joint_rotation.at[2, 3].set(0.0)
    return dataclasses.replace(frames, joint_rotation=turns)


def told(model, states=None, **wrong):
    """A rollout whose commands are wrong in one field, or from given states."""
    commands = jm.commands("forward", model, 2, seconds=0.3)
    for name, value in wrong.items():
        object.__setattr__(commands, name, value)  # which no type checker sees
    states = model.start(2) if states is None else states
    return jm.rollout(model, jax.random.key(0), states, commands)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda m, f: jm.load("walk"), r"no such file.*\(.*locomotion.*, walker\)"),
        (lambda m, f: jm.commands("waltz", m, 2), "'waltz': there are straight"),
        (lambda m, f: jm.commands("forward", m, 3, speed=[1.0, 2.0]), r"\(2,\) for 3"),
        (lambda m, f: jm.commands("forward", m, 3, speed=-1.0), "-1.0 m/s"),
        (lambda m, f: jm.commands([], m, 3), "no segments"),
        (lambda m, f: jm.commands([(1, 0, 0)], m), "segment 0 of the course"),
        (lambda m, f: jm.commands([(1, NAN, 0, 1)], m), "finite and with positive"),
        (lambda m, f: jm.commands([(1, 0, 0, INF)], m), "finite and with positive"),
        (lambda m, f: jm.commands([(1e-3, 0, 0, 1)], m), "expected a tick or more"),
        (lambda m, f: jm.commands([(1, 0, 0, 1)], m, seconds=NAN), "nan s at 30"),
        (
            lambda m, f: untyped("walker", None, None),
            "a str, expected one of `load`",
        ),
        (lambda m, f: jm.commands("forward", m, 2, labels="x"), "unknown label 'x'"),
        (lambda m, f: m.start(0), "number of characters is 0"),
        (lambda m, f: m.start(3, labels=[0, 1]), "2 labels for 3 characters"),
        (lambda m, f: m.start(labels=[0, 7]), "labels are in 0..7, expected 0..1"),
        (lambda m, f: m.start(labels=0.5), "label is 0.5"),
        (
            lambda m, f: jm.rollout(
                m, jax.random.key(0), m.start(2), jm.commands("forward", m, 3)
            ),
            "2 states and commands for 3 characters",
        ),
        (
            lambda m, f: told(m, states=jm.load("walker").start(2)),
            "states are of another model",
        ),
        (lambda m, f: told(m, label=jnp.zeros((2, 9))), "expected whole numbers"),
        (lambda m, f: told(m, facing=jnp.zeros((2, 9, 3))), r"\(2, 9, 3\), expected"),
        (
            lambda m, f: told(m, velocity=jnp.zeros((2, 8, 2))),
            r"velocity has .*\(2, 8,",
        ),
        (lambda m, f: jm.save("a.fbx", m.skeleton, f[0]), "'.fbx', expected one of"),
        (lambda m, f: jm.save("a.bvh", m.skeleton, f), r"\(32, 3\): expected those"),
        (lambda m, f: jm.show(m.skeleton, f[0, 0]), "expected those of one"),
        (lambda m, f: jm.save("a.csv", m.skeleton, f[0, :0]), "0 frames: expected one"),
        (lambda m, f: jm.save("a.npz", m.skeleton, broken(f[0])), "that are finite"),
        (lambda m, f: jm.save("a.bvh", m.skeleton, f[0], roles={}), "expected `onto`"),
        (lambda m, f: jm.save("a.glb", m.skeleton, at(f[0], 0.0)), "0.0 frames per"),
        (lambda m, f: jm.save("a.bvh", m.skeleton, at(f[0], NAN)), "nan frames per"),
        (
            lambda m, f: jm.save("a.csv", jm.load("walker").skeleton, f[0]),
            r"a frame is \(24, 6\), expected that of the skeleton, \(22, 6\)",
        ),
        (
            lambda m, f: jm.save("a.glb", m.skeleton, flat(f[0])),
            "frame 2: the columns of '.*' are no rotation",
        ),
    ],
)
def test_wrong_input_is_one_clear_line(model, frames, call, message):
    with pytest.raises(ValueError, match=message) as found:
        call(model, frames)
    assert "\n" not in str(found.value)


@pytest.mark.parametrize("name", files.SHIPPED)
def test_shipped_models_say_what_they_are(name):
    """Each has a card that states its license, and is at most 6 MB."""
    model, path = jm.load(name), files.SHIPPED[name]
    assert model.license == "Apache-2.0" and model.source and model.fps >= 20
    card = path.with_suffix(".md").read_text()
    assert card.startswith(f"# {path.name}") and "Apache-2.0" in card
    assert path.stat().st_size <= 6e6
    # What a notebook prints of it: a line, not its parameters.
    assert model.source in repr(model) and len(repr(model)) < 400


@pytest.mark.slow
def test_a_rollout_may_be_part_of_a_compiled_program():
    """Labels cannot be checked in there; all else is as outside."""
    model, key = jm.load("walker"), jax.random.key(0)
    states, commands = model.start(2), jm.commands("forward", model, 2, seconds=0.5)
    frames = jax.jit(lambda *given: jm.rollout(model, *given))(key, states, commands)
    chex.assert_trees_all_close(
        frames, jm.rollout(model, key, states, commands), atol=1e-5
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted({*files.SHIPPED} - {"actions"}))
def test_every_character_is_steered_in_double_precision(name):
    """Who turns on 64 bits for other work gets them, and no error of a scan's types."""
    with jax.enable_x64(True):
        model = jm.load(name)
        states = model.start(2)
        commands = jm.commands("straight", model, 2, seconds=0.2, speed=1.0)
        frames = jm.rollout(model, jax.random.key(0), states, commands)
        assert frames.root_position.dtype == jnp.float64
        assert np.isfinite(np.asarray(frames.joint_rotation)).all()


@pytest.mark.slow
def test_players_are_drawn_each_with_his_ball(tmp_path):
    model = jm.load("dribble")
    commands = jm.commands("forward", model, 2, seconds=0.2)
    frames = jm.rollout(model, jax.random.key(0), model.start(2), commands)
    for name in ("a.gif", "a.html"):
        jm.save(tmp_path / name, model.skeleton, frames)
        assert (tmp_path / name).stat().st_size > 1000
    assert "<iframe" in jm.show(model.skeleton, frames)._repr_html_()


def walked(number, **told):
    """Walkers that are told a goal."""
    model = jm.load("walker")
    return jm.rollout(model, jax.random.key(0), model.start(number), **told)


@pytest.mark.slow
def test_who_is_told_one_path_starts_at_its_first_point():
    path = jm.path([(1, 2), (1, 5), (3, 5)], speed=(1.2, 1.2, 0.8))
    frames = walked(2, goal=path, seconds=0.2)
    assert frames.root_position.shape[:2] == (2, 6)
    np.testing.assert_allclose(frames.root_position[:, 0, ::2], [(1, 2)] * 2, atol=0.1)


@pytest.mark.slow
def test_goals_are_told_in_a_line(model, monkeypatch):
    """A place each, from a place each; and what is not told follows from the goal."""
    place = jm.place([(2, 3), (0, 3)], facing=(90, 0), seconds=4.0)
    np.testing.assert_allclose(place.facing, [(1, 0), (0, 1)], atol=1e-6)
    frames = walked(2, goal=place, places=[(0, 0), (5, 5)], seconds=0.2, labels=0)
    np.testing.assert_allclose(
        frames.root_position[:, 0, ::2], [(0, 0), (5, 5)], atol=0.1
    )
    # Less than a meter at 1 m/s, and two seconds.
    near = jm.path([[(0, 0), (0, 0.7)], [(0, 0), (0.4, 0)]], speed=1.0)
    commands, asked = jm.commands("forward", jm.load("walker"), 2, seconds=0.1), {}
    with monkeypatch.context() as patch:
        patch.setattr(
            goals, "goal_rollouts", lambda *given, **more: asked.update(more) or frames
        )
        walked(2, goal=near)
    assert asked["seconds"] == 3
    for wrong, message in (
        ({}, "expected commands, or a goal"),
        ({"seconds": 3.0}, "and its options, found seconds"),
        ({"goal": near, "chunk": 2}, "no chunk"),
        ({"goal": jm.place([(0, 1)] * 3, seconds=1.0)}, "3 goals for 2 characters"),
        ({"goal": near, "circle": 2}, "no option circle; goals take seconds"),
        ({"goal": near, "seconds": 0.0}, "seconds is 0.0, expected a tick"),
        ({"goal": near, "commands": commands}, "commands with a Path: only leaders"),
        (
            {"goal": goals.Follow(leader=jnp.array([0, 7]), distance=jnp.ones(2))}
            | {"commands": commands},
            r"leaders are in 0..7, expected 0..1",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            walked(2, **wrong)
    with pytest.raises(ValueError, match="goal is a list, expected one of `path`"):
        inspect.unwrap(face._go)(model, None, None, [(0, 1)], None)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jm.path([(0, 0)]), r"shape \(1, 2\), expected two or more"),
        (lambda: jm.path([0, 1]), "expected two or more"),
        (lambda: jm.path([(0, 0), (0, 0), (1, 0)]), "two points in a row"),
        (lambda: jm.path([(0, 0), (0, float("nan"))]), "not finite"),
        (lambda: jm.path([(0, 0), (0, INF)]), "not finite"),
        (lambda: jm.path([(0, 0), (0, 1)], speed=-1), "speed is -1"),
        (lambda: jm.path([(0, 0), (0, 1)], speed=INF), "speed is inf"),
        (lambda: jm.place((0, 1), facing=NAN, seconds=2.0), "facing is nan"),
        (lambda: jm.place((0, 1), seconds=INF), "seconds is inf"),
        (lambda: jm.path([(0, 0), (0, 1)], speed=(1, 1, 1)), "one per point"),
        (lambda: jm.place((0, 0, 1), seconds=2.0), r"expected \(x, z\)"),
        (lambda: jm.place((0, 1), seconds=-2.0), "seconds is -2"),
        (lambda: jm.place((0, 1), facing=(0, 1), seconds=2.0), "facing of shape"),
    ],
)
def test_wrong_goals_are_told_in_one_line(make, message):
    with pytest.raises(ValueError, match=message) as error:
        make()
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_paths_and_places_are_reached(model):
    """By the ends of what a goal takes: three characters on a path, two at places."""
    path = jm.path([(0, 0), (0, 3), (2, 4)], speed=1.3)
    frames = jm.rollout(model, jax.random.key(0), model.start(3), goal=path)
    end = np.asarray(frames.root_position)[:, -1, ::2]
    assert np.linalg.norm(end - [2, 4], axis=1).max() < 0.3
    place = jm.place([(2, 3), (-1, 2)], facing=(90, 0), seconds=4.5)
    frames = jm.rollout(model, jax.random.key(0), model.start(2), goal=place)
    end = np.asarray(frames.root_position)[:, -1, ::2]
    assert np.linalg.norm(end - [(2, 3), (-1, 2)], axis=1).max() < 0.3
    facing = trajectory.root_trajectory(model.skeleton, frames.motion).facing[:, -1]
    assert np.min(np.sum(facing * np.array([(1, 0), (0, 1)]), axis=-1)) > 0.85


def test_a_steered_model_is_not_sampled(model):
    with pytest.raises(ValueError, match="expected `rollout`"):
        jm.sample(model, jax.random.key(0))
    with pytest.raises(ValueError, match="chunks of 0 motions"):
        jm.sample(jm.load("actions"), jax.random.key(0), chunk=0)


def test_an_option_of_another_system_is_named():
    message = "no option held, scal; a model of camdm takes control, step, steps"
    with pytest.raises(ValueError, match="locomotion: " + message):
        jm.load("locomotion", held=True, scal=2.0)
    with pytest.raises(ValueError, match="step is 'ddim', expected a function"):
        jm.load("locomotion", step="ddim")
    with pytest.raises(ValueError, match="foot_lock is 'yes', expected a FootLock"):
        inspect.unwrap(jm.load)("locomotion", foot_lock="yes")


def test_a_system_that_nobody_knows_is_named(tmp_path):
    (tmp_path / "config.json").write_text('{"system": "mdm"}')
    with pytest.raises(ValueError, match="'mdm', expected one of camdm, aamdm"):
        jm.load(tmp_path)


def test_frames_are_indexed_and_never_looped_over(frames):
    assert frames[3].root_position.shape == (3, 3)
    assert frames[:2, 1].joint_rotation.shape[:1] == (2,)
    with pytest.raises(TypeError, match="not iterable"):
        iter(frames)


@pytest.mark.slow
def test_shipped_models_lock_their_feet_unless_told_otherwise(model):
    """Told to stand, toes stay where they are on the ground; else they creep."""
    free = jm.load("locomotion", foot_lock=False, step=chain.dpm_solver_step)
    assert free.method.step is chain.dpm_solver_step
    moved = []
    for each in (model, free):
        commands = jm.commands("stand", each, 2, seconds=1.0)
        frames = jm.rollout(each, jax.random.key(0), each.start(2), commands)
        joints = joint_positions(each.skeleton, frames.motion)
        toes = np.asarray(joints)[:, 15:, list(each.skeleton.feet), ::2]
        moved.append(np.linalg.norm(toes - toes[:, :1], axis=-1).max())
    assert moved[0] < 1e-4 < 2e-3 < moved[1], moved


@pytest.mark.slow
@pytest.mark.parametrize("suffix", sorted(face.SAVERS))
def test_a_full_disk_leaves_the_file_that_was_there(
    model, frames, suffix, tmp_path, monkeypatch
):
    def full(number):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / f"walk{suffix}"
    path.write_bytes(b"before")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=f"No space left.*walk{suffix}"):
        jm.save(path, model.skeleton, frames[0, :2])
    assert [x.name for x in tmp_path.iterdir()] == [path.name]
    assert path.read_bytes() == b"before"


def test_a_comma_in_a_joints_name_is_no_column(model, frames, tmp_path):
    names = ("hips, of a rig", *model.skeleton.names[1:])
    skeleton = dataclasses.replace(model.skeleton, names=names)
    jm.save(tmp_path / "a.csv", skeleton, frames[0, :2])
    head, first, *_ = (tmp_path / "a.csv").read_text().splitlines()
    assert head.startswith("seconds,hips_ of a rig.x,")
    assert head.count(",") == first.count(",") == 3 * skeleton.num_joints
