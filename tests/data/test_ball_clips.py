import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import ball_clips, clips_io
from jaxmotion.data.clips import clip_motion
from tests.data import samples


@pytest.fixture(scope="module")
def data():
    """A ball beside the eight clips of 3 to 10 frames."""
    clips = samples.clips()
    generator = np.random.default_rng(0)
    return ball_clips.ball_clips(
        clips,
        generator.normal(size=(clips.num_frames, 3)),
        generator.random((clips.num_frames, 2)) < 0.3,
        joints=(3, 5),
        radius=0.11,
    )


@pytest.fixture
def saved(tmp_path, data):
    ball_clips.save_ball_clips(tmp_path / "b.npz", data)
    return tmp_path / "b.npz"


def same(found, expected):
    assert (found.joints, found.radius) == (expected.joints, expected.radius)
    one, other = (jax.tree.flatten(x) for x in (found, expected))
    assert one[1] == other[1]
    for a, b in zip(one[0], other[0], strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def test_what_is_written_is_read(saved, data):
    same(ball_clips.load_ball_clips(saved), data)
    # Whatever reads clips reads the person.
    found = clips_io.load_clips(saved)
    np.testing.assert_array_equal(found.root_position, data.clips.root_position)
    assert found.clip_names == data.clips.clip_names


def test_clips_without_a_ball_are_refused(tmp_path, data):
    clips_io.save_clips(tmp_path / "c.npz", data.clips)
    with pytest.raises(ValueError, match="c.npz: field 'ball_position' is missing"):
        ball_clips.load_ball_clips(tmp_path / "c.npz")
    with pytest.raises(FileNotFoundError, match="gone.npz"):
        ball_clips.load_ball_clips(tmp_path / "gone.npz")


BAD = {
    "frames": (
        "ball_position",
        lambda x: x[:-1],
        r"has shape \(51, 3\), expected \(52, 3\)",
    ),
    "plane": ("ball_position", lambda x: x[:, :2], r"has shape \(52, 2\)"),
    "axes": ("ball_position", lambda x: x[0], "should have 2 axes of kind 'f'"),
    "nan": (
        "ball_position",
        lambda x: np.where(np.arange(52)[:, None] == 7, np.nan, x),
        "of frame 7 is .*nan.*expected numbers within",
    ),
    "touch": (
        "ball_touch",
        lambda x: x[:, :1],
        r"has shape \(52, 1\), expected \(52, 2\)",
    ),
    "numbers": (
        "ball_touch",
        lambda x: x.astype(float),
        "should have 2 axes of kind 'b'",
    ),
    "joint": ("ball_joints", lambda x: x + 1, r"is \(4, 6\), expected joints in 0..5"),
    "before": ("ball_joints", lambda x: x - 4, r"is \(-1, 1\), expected joints in"),
    "radius": ("ball_radius", lambda x: -x, "is -0.11, expected 0 < radius <= 10"),
    "infinite": (
        "ball_radius",
        lambda x: x * np.inf,
        "is inf, expected 0 < radius",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_fields_are_named(saved, case):
    field, change, message = BAD[case]
    with np.load(saved) as file:
        fields = dict(file)
    np.savez(saved, **{**fields, field: change(fields[field])})
    with pytest.raises(ValueError, match=f"b.npz: field '{field}' {message}"):
        ball_clips.load_ball_clips(saved)


def test_a_ball_that_nobody_may_touch_is_refused(data):
    with pytest.raises(ValueError, match="'ball_joints' is .*, expected joints"):
        ball_clips.ball_clips(
            data.clips,
            np.asarray(data.position),
            np.zeros((52, 0), bool),
            joints=(),
            radius=0.11,
        )


def test_clips_are_taken_with_their_ball(data):
    found = ball_clips.take_ball_clips(data, [5, 0])
    assert found.clips.clip_names == ("clip5", "clip0")
    # Clips of 3, 4, 5, ... frames: the sixth has frames 25 to 32.
    frames = [*range(25, 33), 0, 1, 2]
    np.testing.assert_array_equal(found.position, np.asarray(data.position)[frames])
    np.testing.assert_array_equal(found.touch, np.asarray(data.touch)[frames])
    np.testing.assert_array_equal(found.clips.offsets, [0, 8, 11])
    same(ball_clips.take_ball_clips(data, range(8)), data)
    for indices, message in (([8], "clip numbers 8..8"), ([], "no clips are left")):
        with pytest.raises(ValueError, match=message):
            ball_clips.take_ball_clips(data, indices)


def test_a_window_is_cut_from_person_and_ball(data):
    cut = jax.jit(ball_clips.cut_scene, static_argnums=2)
    # The third clip begins at frame 7.
    scene = cut(data, jnp.int32(8), 3)
    motion = clip_motion(data.clips, 2)
    np.testing.assert_array_equal(scene.motion.root_position, motion.root_position[1:4])
    np.testing.assert_array_equal(
        scene.motion.joint_rotation, motion.joint_rotation[1:4]
    )
    assert scene.motion.fps == data.clips.fps
    np.testing.assert_array_equal(scene.ball, data.position[8:11])
    assert scene.touch.dtype == jnp.float32
    np.testing.assert_array_equal(scene.touch, np.asarray(data.touch)[8:11])
    many = jax.vmap(lambda start: ball_clips.cut_scene(data, start, 3))
    starts = jnp.array([0, 8, 49])
    np.testing.assert_array_equal(many(starts).ball[1], scene.ball)
    np.testing.assert_array_equal(many(starts).ball[2], data.position[49:52])


def test_the_ball_is_kept_when_the_person_is_replaced(data):
    found = dataclasses.replace(data, clips=samples.clips())
    same(found, data)
