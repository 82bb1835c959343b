"""Windows lie within one clip, are drawn uniformly, and short clips are named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import windows
from jaxmotion.data.clips import clip_motion


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
    """Of clips of five, two and four frames."""
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
