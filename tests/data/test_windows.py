"""Windows lie within one clip, are drawn uniformly, and short clips are named."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import selection, windows
from jaxmotion.data.clips import clip_motion
from tests import samples

LABELS = np.array([0, 1, 1, 0])


@pytest.fixture(scope="module")
def run():
    return samples.run()


@pytest.mark.parametrize("stride", [1, 3])
def test_all_windows_and_no_other(walker, stride):
    length = 20
    index = windows.window_index(walker, length, stride=stride)
    expected = []
    for clip in range(walker.num_clips):
        first, end = (int(x) for x in walker.offsets[clip : clip + 2])
        start = first
        while start + length <= end:
            expected.append((start, clip))
            start += stride
    found = list(zip(index.starts.tolist(), index.clips.tolist(), strict=True))
    assert found == expected
    assert index.length == length


@pytest.mark.parametrize(
    ("length", "stride", "starts", "owners"),
    [
        (3, 1, [0, 1, 2, 7, 8], [0, 0, 0, 2, 2]),
        (3, 2, [0, 2, 7], [0, 0, 2]),
        (2, 3, [0, 3, 5, 7], [0, 0, 1, 2]),
        (5, 1, [0], [0]),
        (6, 1, [], []),
    ],
)
def test_starts_leave_out_what_is_too_short(length, stride, starts, owners):
    """Clips of five, two and four frames."""
    offsets = np.array([0, 5, 7, 11])
    found = windows.window_starts(offsets, length, stride=stride)
    assert [x.tolist() for x in found] == [starts, owners]


def test_a_window_as_long_as_the_shortest_clip(walker):
    index = windows.window_index(walker, 80)
    assert np.bincount(index.clips).tolist() == [1, 6, 11, 16]


def test_a_clip_that_is_too_short_is_named_or_skipped(walker):
    with pytest.raises(
        ValueError, match="walk0 has 80 frames, a window needs 90.*2 of 4"
    ):
        windows.window_index(walker, 90)
    index = windows.window_index(walker, 90, short="skip")
    assert sorted(set(index.clips.tolist())) == [2, 3]
    with pytest.raises(ValueError, match="walk0 has 80 frames.*4 of 4"):
        windows.window_index(walker, 500, short="skip")


def test_drawn_windows_are_the_clips_frames(walker):
    index = windows.window_index(walker, 20)
    sample = jax.jit(windows.sample_windows, static_argnames="batch")
    motion, clips = sample(jax.random.key(0), walker, index, batch=64)
    assert motion.root_position.shape == (64, 20, 3)
    assert motion.fps == walker.fps
    for i in range(64):
        whole = clip_motion(walker, int(clips[i]))
        same = np.all(whole.root_position == motion.root_position[i, :1], axis=-1)
        start = int(np.flatnonzero(same)[0])
        for field in ("root_position", "joint_rotation"):
            np.testing.assert_array_equal(
                getattr(motion, field)[i], getattr(whole, field)[start : start + 20]
            )


def test_starts_are_drawn_uniformly(walker):
    index = windows.window_index(walker, 78)
    count, number = 2000, index.starts.shape[0]
    sample = jax.jit(windows.sample_windows, static_argnames="batch")
    _, clips = sample(jax.random.key(1), walker, index, batch=count)
    chances = np.bincount(index.clips) / number
    for n, p in zip(np.bincount(clips, minlength=4), chances, strict=True):
        assert abs(n - count * p) / np.sqrt(count * p * (1 - p)) < 4.0


def test_cut_takes_a_traced_start(walker):
    cut = jax.jit(windows.cut, static_argnames="length")
    for start in (0, 85, 300):
        motion = cut(walker, jnp.int32(start), length=20)
        np.testing.assert_array_equal(
            motion.root_position, walker.root_position[start : start + 20]
        )


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


@pytest.fixture
def one_stop(walker):
    """Everyone goes straight on at 1.3 m/s, but for a stop in the last clip."""
    steps = np.full(walker.num_frames, 1.3 / walker.fps)
    steps[int(walker.offsets[-1]) - 45 :] = 0.0
    root = np.asarray(walker.root_position).copy()
    root[:, 0], root[:, 2] = 0.0, np.cumsum(steps)
    turned = jnp.broadcast_to(walker.joint_rotation[:1], walker.joint_rotation.shape)
    return dataclasses.replace(
        walker, root_position=jnp.asarray(root), joint_rotation=turned
    )


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0])
def test_rare_windows_stand_more_often_in_a_balanced_index(one_stop, power):
    index = windows.window_index(one_stop, 40)
    balanced, shares = windows.balance(one_stop, index, last=9, power=power)
    assert abs(balanced.starts.size - 2 * index.starts.size) <= 1
    # Walking on, stopping, standing; and two between them, at the borders of a speed.
    assert 3 <= len(shares) <= 8
    np.testing.assert_allclose(shares.sum(axis=0), 1.0)
    counts = shares[:, 0] * index.starts.size
    weights = counts ** (1 - power)
    np.testing.assert_allclose(shares[:, 1], weights / weights.sum(), atol=0.02)
    # Within a class all windows stand equally often, each with its own clip.
    times = np.bincount(balanced.starts, minlength=one_stop.num_frames)
    start = int(one_stop.offsets[0])
    walking = times[start : start + 20]
    assert walking.max() - walking.min() <= 1
    owner = dict(zip(index.starts.tolist(), index.clips.tolist(), strict=True))
    found = zip(balanced.starts.tolist(), balanced.clips.tolist(), strict=True)
    assert all(owner[start] == clip for start, clip in found)
    still = int(one_stop.offsets[-1]) - 41
    assert (times[still] > 2) == (power > 0)
