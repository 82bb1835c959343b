"""Turns and runs of a body whose course is planted, played faster."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import hasten, selection
from jaxmotion.data.clips import clips_from_motions
from jaxmotion.motion.skeleton import Motion
from tests import tiny

FPS = 60.0


def course(seconds, speed, turn):
    """A body that goes at a speed, m/s, and turns by `turn` degrees from 10 s on.

    It turns by 120 degrees per second.
    """
    time = np.arange(round(seconds * FPS)) / FPS
    heading = np.deg2rad(np.clip(120.0 * (time - 10.0), 0.0, turn))
    steps = speed / FPS * np.stack([np.sin(heading), 0 * time, np.cos(heading)], -1)
    position = np.cumsum(steps, axis=0) + [0.0, 0.9, 0.0]
    cos, sin, zero = np.cos(heading), np.sin(heading), 0 * time
    yaw = np.stack([cos, zero, -sin, zero, zero + 1, zero], axis=-1)
    number = tiny.clips().skeleton.num_joints
    still = np.tile([1.0, 0, 0, 0, 1, 0], (len(time), number - 1, 1))
    return Motion(
        root_position=jnp.asarray(position, jnp.float32),
        joint_rotation=jnp.asarray(np.concatenate([yaw[:, None], still], 1), "float32"),
        fps=FPS,
    )


def clips(**courses):
    return clips_from_motions(
        [course(*each) for each in courses.values()],
        tiny.clips().skeleton,
        names=list(courses),
        labels={"style": ["calm"] * len(courses)},
        label_names={"style": ("calm",)},
        source="made up",
    )


def test_a_stretch_reaches_a_second_beyond_what_counts():
    made = clips(turn=(20, 1.0, 270), run=(6, 2.5, 0), walk=(20, 1.0, 0))
    turns, runs = hasten.turns_and_runs(made)
    # At the ends of the turn, at 10 and 12.25 s, half of the second around is turned.
    ((clip, start, length),) = turns
    assert clip == 0
    assert start / FPS == pytest.approx(10.0 - 1.0, abs=0.04)
    assert (start + length) / FPS == pytest.approx(12.25 + 1.0, abs=0.04)
    assert runs == [(1, 0, round(6 * FPS))]


def test_shorter_stretches_are_none():
    turns, runs = hasten.turns_and_runs(clips(turn=(20, 1.0, 75), run=(3, 2.5, 0)))
    assert turns == runs == []
    assert hasten.hastened(clips(walk=(20, 1.0, 0)), 30.0) is None


def test_what_is_faster_has_the_same_poses_sooner():
    made = clips(turn=(20, 1.0, 270), run=(6, 2.5, 0))
    found = hasten.hastened(made, 30.0)
    assert found.fps == 30.0 and found.labels["style"].tolist() == [0, 0, 0]
    ((_, start, length),), _ = hasten.turns_and_runs(made)
    slow, fast, run = found.clip_names
    assert (slow, fast) == tuple(f"turn@{start}+{length}_x{x}" for x in (1.25, 1.5))
    assert run == f"run@0+{round(6 * FPS)}_x1.25"
    # Half again as fast at half the rate: every third frame.
    begin, end = np.asarray(found.offsets)[1:3]
    own = slice(start, start + length, 3)
    for name in ("root_position", "joint_rotation"):
        np.testing.assert_allclose(
            getattr(found, name)[begin:end], getattr(made, name)[own], atol=1e-6
        )
    steps = np.diff(np.asarray(found.root_position)[end:], axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=-1) * 30.0, 2.5 * 1.25, 1e-3)


def test_nothing_faster_of_what_is_held_out_is_trained_on():
    made = clips(a=(20, 1.0, 270), b=(20, 1.0, 270), c=(20, 1.0, 0))
    whole = selection.concatenate(
        [dataclasses.replace(x, fps=30.0) for x in (made, hasten.hastened(made, 30.0))]
    )
    assert whole.num_clips == 7
    splits = [selection.split_by_name(whole, ["a"])]
    splits += [
        selection.split_clips(whole, fraction=0.34, seed=seed) for seed in range(5)
    ]
    for train, held_out in splits:
        (name,) = held_out.clip_names
        assert name in "abc"
        assert not [x for x in train.clip_names if x.startswith(name)]
        assert train.num_clips == 7 - (1 if name == "c" else 3)
