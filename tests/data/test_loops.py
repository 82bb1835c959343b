"""Strides that go on, of a runner who repeats himself exactly."""

import dataclasses

import numpy as np
import pytest

from jaxmotion.data import loops
from jaxmotion.data.clips import clip_motion, clips_from_motions
from jaxmotion.motion.skeleton import Motion
from tests import tiny

FPS, PERIOD = 60.0, 40
TURN = 0.2  # radians per second


def runner(seconds=8.0, *, speed=3.0, longer=0.0):
    """Runs on a circle; each second swings legs by a part `longer` further."""
    time = np.arange(round(seconds * FPS)) / FPS
    yaw, phase = TURN * time, 2 * np.pi * np.arange(len(time)) / PERIOD
    root = np.stack([np.cos(yaw), 0.0 * yaw, -np.sin(yaw)], axis=-1) * -speed / TURN
    root[:, 1] = 1.0 + 0.04 * np.cos(2 * phase)
    turns = np.broadcast_to(np.eye(3), (len(time), 5, 3, 3)).copy()
    turns[:, 0] = tiny._yaw(yaw)
    swing = 0.5 * (1.0 + longer * time) * np.sin(phase)
    turns[:, 1], turns[:, 3] = tiny._pitch(swing), tiny._pitch(-swing)
    return Motion(
        root_position=tiny.float32(root),
        joint_rotation=tiny.float32(tiny._columns(turns)),
        fps=FPS,
    )


def clips(**motions):
    return clips_from_motions(
        list(motions.values()),
        tiny.skeleton(),
        names=list(motions),
        labels={"style": ["calm"] * len(motions)},
        label_names={"style": tiny.STYLES},
    )


def strides(motion):
    made = clips(one=motion)
    facing = loops.hip_facing(made.skeleton, made.joint_rotation)
    return loops.find_strides(loops.all_joints(made), np.asarray(facing), fps=FPS)


def test_strides_of_a_circle_are_whole_periods_and_turn_as_it_does():
    found = strides(runner())
    assert 5 < len(found) <= 10
    for stride in found:
        assert stride.frames in (PERIOD, 2 * PERIOD)
        assert stride.difference < 1e-3
        assert abs(stride.turn - TURN * stride.frames / FPS) < 1e-4
        assert abs(stride.speed - 3.0) < 0.02
    starts = np.sort([stride.start for stride in found])
    assert np.diff(starts).min() > 0.3 * FPS


def test_what_repeats_itself_goes_on_as_it_did():
    motion = runner()
    stride = min(strides(motion), key=lambda x: x.start)
    found = loops.repeat_stride(motion, stride, frames=200)
    part = slice(stride.start, stride.start + 200)
    root = np.asarray(motion.root_position[part], np.float64)
    root -= root[0] * [1, 0, 1]
    np.testing.assert_allclose(found.root_position, root, atol=2e-3)
    np.testing.assert_allclose(
        found.joint_rotation, motion.joint_rotation[part], atol=1e-3
    )


def test_no_seam_where_ends_differ():
    motion = runner(longer=0.05)
    stride = strides(motion)[0]
    assert stride.difference > 0.005
    found = loops.repeat_stride(motion, stride, frames=5 * stride.frames)
    part = np.asarray(motion.joint_rotation[stride.start :][: stride.frames])
    cut = np.concatenate([part] * 5)

    def roughest(rot6d):
        return np.abs(np.diff(np.asarray(rot6d)[:, 1], n=2, axis=0)).max()

    assert roughest(found.joint_rotation) < 1.2 * roughest(part)
    assert roughest(cut) > 2.0 * roughest(part)


@pytest.mark.slow
def test_copies_go_at_their_rates_and_keep_labels():
    made = clips(run=runner(), walk=runner(speed=1.4))
    found = loops.with_loops(made, seconds=30.0)
    assert found.clip_names[:2] == ("run", "walk")
    rates = {name.split("x")[1] for name in found.clip_names[2:]}
    # 1.5 strides per second; faster ones than 1.85 would be no person's.
    assert rates == {"0.85", "1", "1.12"}
    for clip, name in enumerate(found.clip_names[2:], 2):
        motion = clip_motion(found, clip)
        moved = np.linalg.norm(np.diff(motion.root_position[:, ::2], axis=0), axis=-1)
        assert abs(moved.mean() * FPS - 3.0 * float(name.split("x")[1])) < 0.02
    assert set(np.asarray(found.labels["style"]).tolist()) == {0}
    lengths = list(zip(found.clip_names, np.diff(found.offsets).tolist(), strict=True))
    for rate in rates:
        assert len({n for name, n in lengths[2:] if name.endswith(f"x{rate}")}) == 1


@pytest.mark.slow
def test_each_speed_is_learned_from_for_as_long():
    run, walk, jog = runner(20.0, speed=3.2), runner(speed=1.4), runner(speed=2.2)
    found = loops.with_loops(clips(run=run, walk=walk, jog=jog), seconds=12.0)
    shown = np.zeros(4)
    for name, frames in zip(found.clip_names, np.diff(found.offsets), strict=True):
        take, _, rate = name.partition("x")
        speed = {"r": 3.2, "w": 1.4, "j": 2.2}[take[0]] * float(rate or 1)
        if speed > 2.0:
            # Loops are learned from whole.
            learned = frames / FPS if rate else 0.9 * frames / FPS - 1.0
            shown[int(2 * (speed - 2.0))] += learned
    # Averaged speeds are lower in the third of a second at the ends of a take; lengths
    # are whole frames. At 3.2 m/s there are 17 s already.
    np.testing.assert_allclose(shown[[0, 1, 3]], 12.0, atol=0.7)
    assert shown[2] == pytest.approx(0.9 * 20.0 - 1.0)
    with pytest.raises(ValueError, match="nothing to add: .* for 3 s already"):
        loops.with_loops(clips(jog=runner(20.0, speed=2.1)), seconds=3.0)


@pytest.mark.slow
def test_what_training_holds_out_is_in_no_loop():
    motion = runner(12.0)
    root = np.array(motion.root_position)
    root[:480, ::2] = root[480, ::2]
    late = clips(late=dataclasses.replace(motion, root_position=tiny.float32(root)))
    assert loops.with_loops(late, seconds=30.0, held_out=0.0).num_clips > 1
    with pytest.raises(ValueError, match="no clip has a stride"):
        loops.with_loops(late, seconds=3.0)


def test_nobody_who_runs_is_one_line():
    with pytest.raises(ValueError, match="no clip has a stride at 1.9 m/s or more"):
        loops.with_loops(clips(walk=runner(speed=1.4), short=runner(1.0)), seconds=3.0)
