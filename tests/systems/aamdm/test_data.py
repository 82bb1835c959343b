"""Frames of clips for AAMDM: what is left out, held out, and windowed."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import simulation
from jaxmotion.data.clips import clip_motion
from jaxmotion.motion import path_features, pose
from jaxmotion.systems.aamdm import data as aamdm_data
from tests import person

LENGTHS = (400, 90, 250)


def counted(lengths=LENGTHS, fps=60.0):
    """Frames that hold their clip and their number."""
    clip = np.repeat(np.arange(len(lengths)), lengths)
    number = np.concatenate([np.arange(n) for n in lengths])
    return aamdm_data.PoseData(
        poses=person.float32(np.stack([clip, number], axis=-1)),
        paths=person.float32(np.tile(number[:, None], 12)),
        offsets=jnp.asarray(np.cumsum([0, *lengths]), jnp.int32),
        fps=fps,
    )


def parts(data):
    """Clip and numbers of the frames of each part."""
    offsets = np.asarray(data.offsets)
    assert offsets[0] == 0 and offsets[-1] == data.num_frames
    np.testing.assert_array_equal(data.paths[:, 0], data.poses[:, 1])
    found = []
    for a, b in zip(offsets[:-1], offsets[1:], strict=True):
        clip, number = np.asarray(data.poses[a:b]).T
        assert len(set(clip)) == 1, "a part with frames of two clips"
        np.testing.assert_array_equal(np.diff(number), 1)
        found.append((int(clip[0]), int(number[0]), int(number[-1]) + 1))
    return found


@pytest.mark.parametrize("fps", [30.0, 60.0])
def test_ends_are_held_out_behind_a_second(fps):
    train, held_out = aamdm_data.split_ends(counted(fps=fps), 0.2)
    gap = int(fps)
    expected = [(0, 0, 320 - gap), (1, 0, 72 - gap), (2, 0, 200 - gap)]
    assert parts(train) == expected
    assert parts(held_out) == [(0, 320, 400), (1, 72, 90), (2, 200, 250)]
    assert train.fps == held_out.fps == fps


def test_of_loops_nothing_is_held_out():
    """What their ends show was seen before."""
    train, held_out = aamdm_data.split_ends(
        counted(fps=30.0), 0.2, whole=(False, False, True)
    )
    assert parts(train) == [(0, 0, 290), (1, 0, 42), (2, 0, 250)]
    assert parts(held_out) == [(0, 320, 400), (1, 72, 90)]
    with pytest.raises(ValueError, match="long enough"):
        aamdm_data.split_ends(counted(), 0.2, whole=(True, True, True))


def test_a_clip_without_room_for_the_gap_is_in_neither_part():
    train, held_out = aamdm_data.split_ends(counted(), 0.5)
    assert [part[0] for part in parts(train)] == [0, 2]
    assert [part[0] for part in parts(held_out)] == [0, 2]


@pytest.mark.parametrize("fraction", [0.0, 1.0, -0.2, float("nan")])
def test_fractions_out_of_range_are_refused(fraction):
    with pytest.raises(ValueError, match="between 0 and 1, found"):
        aamdm_data.split_ends(counted(), fraction)


@pytest.mark.parametrize(
    ("lengths", "fraction"), [((60, 61), 0.1), ((70, 65), 0.2), ((400, 90), 0.001)]
)
def test_parts_are_never_empty(lengths, fraction):
    with pytest.raises(ValueError, match="long enough"):
        aamdm_data.split_ends(counted(lengths), fraction)


@pytest.mark.parametrize(("length", "stride"), [(2, 1), (90, 1), (100, 7)])
def test_windows_start_where_they_fit_into_a_clip(length, stride):
    found = aamdm_data.starts(counted(), length, stride=stride)
    expected, first = [], 0
    for frames in LENGTHS:
        expected += range(first, first + frames - length + 1, stride)
        first += frames
    assert found.tolist() == expected


def test_windows_longer_than_every_clip_are_refused():
    assert aamdm_data.starts(counted(), 400).tolist() == [0]
    with pytest.raises(ValueError, match="401 frames.*longest has 400"):
        aamdm_data.starts(counted(), 401)


def ahead(speeds, turn=0.0):
    """Path features of a bone that goes straight at these speeds, third by third."""
    points = np.stack([np.zeros(3), np.cumsum(speeds) / 3], axis=-1)
    facings = person.directions(turn * np.array([1 / 3, 2 / 3, 1.0]))
    return np.concatenate([points.ravel(), facings.ravel()])


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0])
def test_windows_of_rare_speeds_and_turns_start_more_often(power):
    kinds = {
        (0, 900): ahead([1.4, 1.4, 1.4]),
        (900, 960): ahead([3.4, 3.4, 3.4]),
        (960, 980): ahead([1.4, 1.0, 0.1]),
        (980, 1000): ahead([1.4, 1.4, 1.4], turn=-2.0),
    }
    paths = np.concatenate([np.tile(x, (b - a, 1)) for (a, b), x in kinds.items()])
    data = dataclasses.replace(counted((1000,)), paths=person.float32(paths))
    found = np.asarray(aamdm_data.balanced_starts(data, 1, power=power))
    times = np.bincount(found, minlength=1000)
    sizes = np.array([b - a for a, b in kinds])
    shares = np.array([times[a:b].sum() for a, b in kinds]) / found.size
    expected = sizes ** (1 - power) / (sizes ** (1 - power)).sum()
    np.testing.assert_allclose(shares, expected, atol=2e-3)
    # Within a class all windows stand equally often.
    assert all(np.ptp(times[a:b]) <= 1 for a, b in kinds)


def test_balanced_windows_fit_into_a_clip():
    every = set(aamdm_data.starts(counted(), 90).tolist())
    found = aamdm_data.balanced_starts(counted(), 90, power=0.5).tolist()
    assert set(found) <= every and len(found) > len(every)
    with pytest.raises(ValueError, match="401 frames"):
        aamdm_data.balanced_starts(counted(), 401, power=0.5)


def test_parts_are_taken_in_order():
    found = aamdm_data.take(counted(), [(410, 420), (5, 8)])
    assert parts(found) == [(1, 10, 20), (0, 5, 8)]


def test_data_pass_through_jit():
    data = jax.jit(lambda x: x)(counted())
    assert data.fps == 60.0 and data.num_frames == sum(LENGTHS)


# --- from clips --------------------------------------------------------------------


def test_frames_are_the_pose_vectors_of_each_clip_alone():
    clips = person.clips((79, 40, 79))
    data, names = aamdm_data.pose_data(clips, fps=60.0)
    assert names == ("clip0", "clip2")
    assert data.offsets.tolist() == [0, 79, 158]
    assert data.fps == 60.0 and data.poses.shape == (158, 98)
    for i, (a, b) in ((0, (0, 79)), (2, (79, 158))):
        motion = clip_motion(clips, i)
        bone = simulation.simulation_bone(clips.skeleton, motion)
        poses = pose.pose_vectors(clips.skeleton, motion, bone)
        paths = path_features.path_features(bone, fps=60.0)
        np.testing.assert_allclose(data.poses[a:b], poses, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(data.paths[a:b], paths, rtol=1e-5, atol=1e-5)


def test_slower_clips_are_resampled():
    data, _ = aamdm_data.pose_data(person.clips((40,), fps=30.0), fps=60.0)
    assert data.num_frames == 79
    same, _ = aamdm_data.pose_data(person.clips((79,)), fps=60.0)
    layout = pose.pose_layout(6)
    inside = slice(20, -20)
    for name, start, stop in layout.fields[:2]:
        np.testing.assert_allclose(
            data.poses[inside, start:stop],
            same.poses[inside, start:stop],
            atol=0.02,
            err_msg=name,
        )


def test_clips_too_short_to_resample_are_left_out_as_well():
    _, names = aamdm_data.pose_data(person.clips((40, 1), fps=30.0), fps=60.0)
    assert names == ("clip0",)


def test_what_cannot_be_described_is_named():
    with pytest.raises(ValueError, match="no clip has 61 frames at 60"):
        aamdm_data.pose_data(person.clips((60, 30)), fps=60.0)
    with pytest.raises(ValueError, match="cannot be resampled to 24"):
        aamdm_data.pose_data(person.clips((80,)), fps=24.0)
    chestless = person.clips((80,), names=(*person.NAMES[:5], "Belly"))
    with pytest.raises(ValueError, match="no chest joint.*Belly"):
        aamdm_data.pose_data(chestless, fps=60.0)
