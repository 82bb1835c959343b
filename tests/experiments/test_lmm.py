"""experiments/baselines/lmm.py: what Learned Motion Matching is asked by."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import procedural, simulation
from jaxmotion.data.clips import clip_motion
from jaxmotion.motion.skeleton import joint_positions
from jaxmotion.systems.aamdm import data as aamdm_data


@pytest.fixture(scope="module")
def lmm(load):
    return load("baselines.lmm")


def test_feet_and_hips_are_those_of_the_clips(lmm):
    """Places and forward differences in the world, turned into the character's axes."""
    clips = procedural.make_clips(minutes=0.3)
    skeleton, fps = clips.skeleton, clips.fps
    data, names = aamdm_data.pose_data(clips, fps=fps)
    parts = []
    for name in names:
        motion = clip_motion(clips, clips.clip_names.index(name))
        bone = simulation.simulation_bone(skeleton, motion)
        x = np.asarray(joint_positions(skeleton, motion), np.float64)
        x = x[:, [*skeleton.feet, 0]]
        ahead = np.asarray(bone.facing, np.float64)
        aside = np.stack([ahead[:, 1], -ahead[:, 0]], -1)

        def seen(planar, aside=aside, ahead=ahead):
            return [np.sum(planar * axis[:, None], -1) for axis in (aside, ahead)]

        away = x[..., ::2] - np.asarray(bone.position, np.float64)[:, None]
        side, front = seen(away)
        place = np.stack([side, x[..., 1], front], -1)
        moved = np.diff(x, axis=0, append=2 * x[-1:] - x[-2:-1]) * fps
        side, front = seen(moved[..., ::2])
        speed = np.stack([side, moved[..., 1], front], -1)
        parts.append(np.concatenate([place[:, :2], speed], 1))
    whole = np.concatenate(parts)
    weights = np.array([0.75, 0.75, 1.0, 1.0, 1.0])[:, None]
    unit = whole.std(0).mean(-1, keepdims=True)
    expected = (weights * (whole - whole.mean(0)) / unit).reshape(len(whole), 15)
    found = np.asarray(jax.jit(lmm.own_features)(data, skeleton))
    # The pose's own velocities are central differences, and smooth the bone's path.
    assert np.abs(found - expected).mean() < 0.02
    assert np.corrcoef(found.ravel(), expected.ravel())[0, 1] > 0.999


def test_the_frame_that_fits_is_that_of_the_same_feet(lmm):
    """Of two frames of one path, for a projector that says nothing."""
    config = lmm.Config(features=4, width=8, queries=2, own=15)
    params = jax.tree.map(jnp.zeros_like, lmm.init(jax.random.key(0), config))
    path, feet = jnp.zeros((2, 2)), jnp.repeat(jnp.array([[-50.0], [50.0]]), 15, 1)
    rest = jnp.array([[1.0, 1.0], [3.0, 3.0]])
    database = jnp.concatenate([path, rest, feet], axis=1)
    for frame, error in zip(database, (0.5, 1.5), strict=True):
        windows = jnp.broadcast_to(frame, (5, 3, 19))
        _, told = lmm.loss(
            params, jax.random.key(1), windows, config=config, database=database
        )
        assert float(told["projection"]) == pytest.approx(error)
        assert float(told["reading"]) == pytest.approx(2500.0)
        assert float(told["value"]) == 0.0


@pytest.mark.parametrize(("own", "left"), [(0, 0.5), (15, 0.0)])
def test_asked_by_feet_the_frame_is_taken_whole(lmm, own, left):
    config = lmm.Config(features=4, width=8, queries=2, own=own, projections=1.0)
    params = jax.tree.map(jnp.zeros_like, lmm.init(jax.random.key(0), config))
    step = lmm.stepper(params, config=config)
    found = step.step(jax.random.key(1), jnp.ones(4), jnp.ones(2))
    np.testing.assert_array_equal(found, left * jnp.ones(4))
    np.testing.assert_array_equal(
        step.step(jax.random.key(1), jnp.ones(4)), jnp.ones(4)
    )
