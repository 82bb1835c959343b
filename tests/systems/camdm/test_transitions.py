"""Changes of style: what is commanded, and planted changes measured at their time."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.motion.skeleton import Motion
from jaxmotion.systems.camdm import transitions as camdm_transitions
from jaxmotion.systems.camdm.controller import Control
from tests import samples, tiny
from tests.reference import metrics as oracle

FPS = 30.0
EVALUATOR = style_evaluator.StyleEvaluator(
    params={},
    config=style_evaluator.Config(num_classes=2, num_joints=22, frames=60),
)
SETTINGS = dict(course="forward", before=1.0, replications=2, seed=0)


@pytest.fixture(scope="module")
def changes():
    """Two pairs of styles, twice."""
    return camdm_transitions.make_changes(samples.run(), limit=2.0, **SETTINGS)


def test_every_pair_is_commanded_in_every_replication(changes):
    assert changes.old.tolist() == [0, 1, 0, 1]
    assert changes.new.tolist() == [1, 0, 1, 0]
    assert changes.replication.tolist() == [0, 0, 1, 1]
    label = np.asarray(changes.commands.label)
    assert changes.tick == 30
    np.testing.assert_array_equal(label[:, :30], changes.old[:, None].repeat(30, 1))
    after = label.shape[1] - 30
    np.testing.assert_array_equal(label[:, 30:], changes.new[:, None].repeat(after, 1))
    # The last window is whole, centered 2 s after; 4 s are measured.
    assert after == max(60 + 30, 120)
    speed = np.linalg.norm(np.asarray(changes.commands.velocity), axis=-1)
    assert abs(speed[0, 5] - speed[1, 5]) > 0.01
    assert speed[0, -1] == pytest.approx(speed[1, 5], rel=1e-3)
    # Start poses differ between replications.
    root = np.asarray(changes.states.past.joint_rotation)
    assert np.abs(root[0] - root[2]).max() > 1e-3


def test_those_who_keep_their_style_are_told_nothing(changes):
    kept = camdm_transitions.without(changes)
    label = np.asarray(kept.commands.label)
    np.testing.assert_array_equal(label, changes.old[:, None].repeat(label.shape[1], 1))
    np.testing.assert_array_equal(kept.new, changes.new)


def planted(changes, delays):
    """The walker, a meter higher from so many frames after the command on."""
    frames = samples.walking(changes.old, seconds=5.0)
    frames = jax.tree.map(lambda x: x[:, : changes.commands.label.shape[1]], frames)
    ticks = np.arange(frames.root_position.shape[1])
    high = ticks >= changes.tick + np.asarray(delays, float)[:, None]
    lifted = frames.root_position + jnp.asarray(high[..., None] * [0, 10.0, 0])
    return dataclasses.replace(frames, root_position=lifted.astype(jnp.float32))


@pytest.fixture
def sees_height(monkeypatch):
    """An evaluator that finds the new style in windows that are high throughout."""

    def recognized(skeleton, found, evaluator):
        del skeleton, evaluator
        high = np.asarray(found.motion.root_position)[..., 1].min(axis=1) > 5
        return np.zeros((len(high), 2)), high.astype(np.float32)

    monkeypatch.setattr(style_evaluator, "features_and_hits", recognized)


@pytest.mark.slow
@pytest.mark.usefixtures("sees_height")
def test_planted_changes_are_found_at_their_time(changes):
    # All of a window must be high: its center is a second after the change.
    frames = planted(changes, [-30, 0, 2, np.inf])
    row = camdm_transitions.transition_row(
        samples.run(), frames, changes, EVALUATOR, height=0.05
    )
    # 2 frames are found at the next window, 3; the last one counts as the limit.
    assert row["success"].value == pytest.approx(75.0)
    assert row["success"].samples == 2
    seconds = [0.0, 1.0, 1.1, 2.0]
    assert row["transition_time"].value == pytest.approx(np.mean(seconds), abs=1e-5)
    frames_there = row["transition_frames"]
    assert frames_there.value == pytest.approx(30 * np.mean(seconds), abs=1e-3)
    assert set(camdm_transitions.MOTION) < set(row)
    assert row["foot_slide"].value >= 0
    # What CAMDM's release measures of changes of style, of the whole rollout.
    skeleton = samples.run().model.skeleton
    wanted = []
    for i in range(4):
        motion = Motion(
            root_position=frames.root_position[i],
            joint_rotation=frames.joint_rotation[i],
        )
        joints = tiny.positions(skeleton, motion)
        wanted.append(oracle.camdm_release(skeleton.names, joints))
    released = {name: row[f"{name}_camdm_release"] for name in wanted[0]}
    for name, cell in released.items():
        mean = np.mean([x[name] for x in wanted])
        assert cell.value == pytest.approx(mean, rel=1e-5) and cell.samples == 2
    assert not [name for name in row if name.startswith(("fid", "trajectory"))]


@pytest.mark.usefixtures("sees_height")
def test_windows_are_where_they_say(changes):
    run = samples.run()
    frames = planted(changes, [12, 12, 12, 12])
    found, centers = camdm_transitions.find_changes(
        run.model.skeleton, frames, changes, EVALUATOR, fps=FPS
    )
    np.testing.assert_allclose(centers, np.arange(0, 61, 3) / 30)
    np.testing.assert_array_equal(found, (centers >= 1.4)[None].repeat(4, 0))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"replications": 1}, "replications: 1, expected at least 2"),
        ({"before": 0.5}, "before: 0.5 s, expected at least 1"),
        ({"limit": -1.0}, "limit: -1.0 s"),
        ({"course": "zigzag"}, "zigzag"),
    ],
)
def test_what_is_wrong_is_named(wrong, message):
    with pytest.raises(ValueError, match=message):
        camdm_transitions.make_changes(samples.run(), **(SETTINGS | wrong))


@pytest.mark.slow
def test_rows_share_everything_but_the_run_time(monkeypatch, changes):
    """Each row gets its control; the last one's serve for those who keep the style."""
    given = []

    made_with = camdm_transitions.camdm_controller.character

    def character(params, model, *, control):
        given.append(control)
        return made_with(params, model, control=control)

    def rollouts(character, key, states, commands, **rest):
        control, label = given.pop(), np.asarray(commands.label)
        given.append((control, key, bool((label[:, 0] == label[:, -1]).all())))
        return planted(changes, [0, 0, 0, 0])

    monkeypatch.setattr(camdm_transitions.camdm_controller, "character", character)
    monkeypatch.setattr(camdm_transitions.steering, "steered_rollouts", rollouts)
    monkeypatch.setattr(
        style_evaluator,
        "features_and_hits",
        lambda b, w, r: (None, np.ones(len(w.label))),
    )
    seen, a, b = [], Control(guided_plans=0), Control(guided_plans=2)
    rows = camdm_transitions.evaluate_transitions(
        samples.run(), changes, {"a": a, "b": b}, EVALUATOR, report=seen.append
    )
    told = [(control, kept) for control, _, kept in given]
    assert told == [(a, False), (b, False), (b, True)]
    assert len({jax.random.key_data(key).tobytes() for _, key, _ in given}) == 1
    assert seen == ["a", "b"]
    names = list(rows)
    assert names[:2] == ["a", "b"] and "mistake" in names[2]
    assert all(row["success"].value == 100.0 for row in rows.values())
