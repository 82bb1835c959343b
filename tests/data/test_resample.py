import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from jaxmotion.data import resample
from jaxmotion.data.clips import clip_motion, clips_from_motions
from jaxmotion.motion.skeleton import Motion
from tests.data import samples


def quaternions(rot6d) -> Rotation:
    """SciPy's rotations of 6D columns."""
    x, y = np.asarray(rot6d, np.float64).reshape(-1, 2, 3).swapaxes(0, 1)
    return Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=-1))


def test_same_rate_is_the_same_motion():
    motion = samples.motion(5, 0)
    assert resample.resample(motion, 30.0) is motion


def test_half_and_quarter_rates_take_frames_unchanged():
    motion = samples.motion(9, 1, fps=120.0)
    for step in (2, 4):
        found = resample.resample(motion, 120.0 / step)
        assert found.fps == 120.0 / step
        np.testing.assert_array_equal(
            found.joint_rotation, motion.joint_rotation[::step]
        )
        np.testing.assert_array_equal(found.root_position, motion.root_position[::step])


@pytest.mark.parametrize(("fps", "count"), [(30.0, 13), (24.0, 10), (100.0, 41)])
def test_other_rates_equal_scipy_slerp_and_numpy_interp(fps, count):
    motion = samples.motion(11, 2, fps=25.0)
    found = resample.resample(motion, fps)
    times, new = np.arange(11) / 25.0, np.arange(count) / fps
    assert found.root_position.shape == (count, 3)
    assert new[-1] <= times[-1] + 1e-9 < new[-1] + 1 / fps
    for axis in range(3):
        expected = np.interp(new, times, np.asarray(motion.root_position[:, axis]))
        np.testing.assert_allclose(found.root_position[:, axis], expected, atol=2e-6)
    for joint in range(6):
        slerp = Slerp(times, quaternions(motion.joint_rotation[:, joint]))
        error = quaternions(found.joint_rotation[:, joint]) * slerp(new).inv()
        np.testing.assert_allclose(error.magnitude(), 0.0, atol=3e-6)


def test_up_and_down_again_returns_the_frames():
    motion = samples.motion(6, 3)
    up = resample.resample(motion, 120.0)
    assert up.root_position.shape[0] == 21
    again = resample.resample(up, 30.0)
    np.testing.assert_allclose(again.joint_rotation, motion.joint_rotation, atol=2e-6)
    np.testing.assert_allclose(again.root_position, motion.root_position, atol=1e-6)


def test_batches_equal_single_motions_and_one_frame_stays():
    parts = [samples.motion(4, seed) for seed in (4, 5)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)
    found = resample.resample(batch, 50.0)
    for i, part in enumerate(parts):
        single = resample.resample(part, 50.0)
        np.testing.assert_allclose(found.joint_rotation[i], single.joint_rotation)
        np.testing.assert_allclose(found.root_position[i], single.root_position)
    one = resample.resample(samples.motion(1, 6), 50.0)
    assert one.root_position.shape == (1, 3)


def test_nonsense_is_refused():
    motion = samples.motion(4, 7)
    for fps in (0.0, -30.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="fps should be positive"):
            resample.resample(motion, float(fps))
    for fps in (1.0, 3000.0):
        with pytest.raises(ValueError, match="factor of 16"):
            resample.resample(motion, fps)
    empty = Motion(root_position=jnp.zeros((0, 3)), joint_rotation=jnp.zeros((0, 6, 6)))
    with pytest.raises(ValueError, match="no frames"):
        resample.resample(empty, 60.0)


@pytest.mark.slow
@pytest.mark.parametrize("fps", [10.0, 12.5, 30.0, 50.0])
@pytest.mark.parametrize("part", [7, 1 << 16])
def test_clips_are_resampled_one_by_one(fps, part, monkeypatch):
    """Also those of one frame: none may take frames of its neighbors."""
    monkeypatch.setattr(resample, "_PART", part)
    motions = [samples.motion(n, i) for i, n in enumerate((1, 10, 1, 4, 10, 4))]
    given = clips_from_motions(
        motions,
        samples.skeleton(),
        names=[f"clip{i}" for i in range(6)],
        labels={"style": ["a", "b"] * 3},
        source="made up",
    )
    found = resample.resample_clips(given, fps)
    assert found.fps == fps and found.num_clips == 6
    assert found.clip_names == given.clip_names and found.source == given.source
    assert found.label_names == given.label_names
    np.testing.assert_array_equal(found.labels["style"], given.labels["style"])
    for i, motion in enumerate(motions):
        expected, own = resample.resample(motion, fps), clip_motion(found, i)
        if fps == 10.0:  # every third frame
            np.testing.assert_array_equal(own.joint_rotation, expected.joint_rotation)
        assert own.root_position.shape == expected.root_position.shape
        np.testing.assert_allclose(own.root_position, expected.root_position, atol=2e-6)
        np.testing.assert_allclose(
            own.joint_rotation, expected.joint_rotation, atol=5e-6
        )
        np.testing.assert_allclose(
            own.root_position[0], motion.root_position[0], atol=1e-6
        )


@pytest.mark.parametrize("fps", [0.0, -30.0, np.nan, np.inf, 1.0, 600.0])
def test_rates_that_clips_cannot_have_are_refused(fps):
    with pytest.raises(ValueError, match="fps is .*the clips have 30"):
        resample.resample_clips(samples.clips(), float(fps))


def test_slerp_of_equal_and_negated_quaternions():
    q = jnp.array([[1.0, 0, 0, 0], [0.6, 0.8, 0, 0]])
    t = jnp.array([0.3, 0.3])
    np.testing.assert_allclose(resample.slerp(q, q, t), q, atol=1e-7)
    np.testing.assert_allclose(resample.slerp(q, -q, t), q, atol=1e-7)
