"""Motions as EMDM's features: units, the way back, and joints for the losses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.motion import features, rotation, skeleton
from jaxmotion.systems.emdm import features as emdm_features
from tests import tiny
from tests.reference import motion as reference

JOINTS = len(tiny.NAMES)
ROOT = slice(6 * JOINTS, 6 * JOINTS + 3)


def motions():
    """Walks at three speeds, from the origin and facing ahead."""
    parts = [tiny.walk(20, speed=s, turn=0.5 * s, start=s) for s in (0.5, 1.0, 1.5)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *parts)
    return features.to_first_pose(tiny.skeleton(), stacked)


def way(motion):
    """The root's: steps on the ground, the first from the origin, and heights."""
    root = np.float64(motion.root_position)
    steps = np.diff(root, axis=-2, prepend=np.zeros_like(root[..., :1, :]))
    return np.stack([steps[..., 0], root[..., 1], steps[..., 2]], axis=-1)


@pytest.fixture(scope="module")
def representation():
    return emdm_features.fit(tiny.skeleton(), motions())


def test_features_are_rows_of_rotations_and_the_way_of_the_root(representation):
    found = emdm_features.to_features(motions(), representation)
    assert found.shape == (3, 20, 36) and representation.num_features == 36
    mean, std = (
        np.float64(getattr(representation.normalizer, n)) for n in ("mean", "std")
    )
    raw = np.float64(found) * std + mean
    matrices = rotation.matrix_from_rot6d(motions().joint_rotation)
    rows = np.asarray(matrices)[..., :2, :].reshape(3, 20, 30)
    np.testing.assert_allclose(raw[..., :30], rows, atol=1e-5)
    np.testing.assert_allclose(raw[..., ROOT], way(motions()), atol=1e-5)
    np.testing.assert_allclose(raw[..., 33:], 0.0, atol=1e-6)


def test_units_are_one_for_all_rotations_and_one_for_each_root_channel(representation):
    given = motions()
    matrices = rotation.matrix_from_rot6d(given.joint_rotation)
    rows = np.float64(matrices)[..., :2, :].reshape(-1, 30)
    root = way(given).reshape(-1, 3)
    std = np.asarray(representation.normalizer.std)
    np.testing.assert_allclose(std[:30], np.mean(rows.std(0)), rtol=1e-4)
    np.testing.assert_allclose(std[ROOT], np.maximum(root.std(0), 0.01), rtol=1e-4)
    np.testing.assert_array_equal(std[33:], 1.0)
    mean = np.asarray(representation.normalizer.mean)
    np.testing.assert_allclose(mean[:30], rows.mean(0), atol=1e-5)
    np.testing.assert_allclose(mean[ROOT], root.mean(0), atol=1e-5)
    np.testing.assert_array_equal(mean[33:], 0.0)
    assert representation.fps == given.fps


def test_deviations_have_a_floor():
    given = motions()
    still = dataclasses.replace(
        given,
        root_position=jnp.zeros_like(given.root_position).at[..., 1].set(1.0),
        joint_rotation=jnp.broadcast_to(
            given.joint_rotation[:1, :1], given.joint_rotation.shape
        ),
    )
    for options, floor in (({}, 0.01), ({"floor": 0.5}, 0.5)):
        found = emdm_features.fit(tiny.skeleton(), still, **options)
        np.testing.assert_allclose(found.normalizer.std[:33], floor, rtol=1e-6)
        x = emdm_features.to_features(still, found)
        np.testing.assert_allclose(x, 0.0, atol=1e-4)


@pytest.mark.parametrize("batched", [True, False])
def test_features_become_the_motion_again(representation, batched):
    given = motions() if batched else jax.tree.map(lambda x: x[1], motions())
    x = emdm_features.to_features(given, representation)
    back = emdm_features.to_motion(x, representation)
    np.testing.assert_allclose(back.root_position, given.root_position, atol=1e-5)
    np.testing.assert_allclose(back.joint_rotation, given.joint_rotation, atol=1e-5)
    assert back.fps == given.fps == representation.fps
    again = emdm_features.to_features(back, representation)
    np.testing.assert_allclose(again, x, atol=1e-3)


def test_any_features_become_rotations(representation):
    x = jax.random.normal(jax.random.key(0), (4, 36)) * 3.0
    made = emdm_features.to_motion(x, representation)
    columns = np.asarray(made.joint_rotation).reshape(4, JOINTS, 2, 3)
    gram = columns @ columns.swapaxes(-1, -2)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(2), gram.shape), atol=1e-5)


def world(given):
    """Joint positions by products of 4x4 matrices."""
    roots = np.float64(given.root_position)
    matrices = np.float64(rotation.matrix_from_rot6d(given.joint_rotation))
    out = np.empty((*roots.shape[:-1], JOINTS, 3))
    for index in np.ndindex(roots.shape[:-1]):
        transforms = reference.world_transforms(
            np.array(tiny.OFFSETS), tiny.PARENTS, roots[index], matrices[index]
        )
        out[index] = transforms[:, :3, 3]
    return out


@pytest.mark.parametrize("relative", [True, False])
def test_joints_are_in_the_world_or_around_the_root(representation, relative):
    given = jax.tree.map(lambda x: x[:, ::5], motions())
    geometry = emdm_features.geometry(representation, relative=relative)
    found = geometry.positions(emdm_features.to_features(given, representation))
    expected = world(given)
    if relative:
        expected = expected - np.float64(given.root_position)[..., None, :]
        np.testing.assert_array_equal(found[..., 0, :], 0.0)
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_only_in_the_world_does_the_root_s_way_count(representation):
    x = emdm_features.to_features(motions(), representation)
    moved = x.at[..., ROOT].add(1.0)
    for relative in (True, False):
        geometry = emdm_features.geometry(representation, relative=relative)
        gap = np.abs(geometry.positions(moved) - geometry.positions(x)).max()
        assert gap < 1e-6 if relative else gap > 0.01


def test_feet_and_channels(representation):
    geometry = emdm_features.geometry(representation, relative=True)
    # Toes and what they hang on, left before right.
    assert geometry.feet == (1, 2, 3, 4)
    kept = np.arange(36)[geometry.channels]
    np.testing.assert_array_equal(kept, np.arange(30))
    assert geometry.fps == 30.0 and geometry.contact_speed == 0.2


@pytest.mark.slow
@pytest.mark.parametrize("relative", [True, False])
def test_positions_have_the_gradient_of_finite_differences(representation, relative):
    geometry = emdm_features.geometry(representation, relative=relative)
    rng = np.random.default_rng(0)
    x = emdm_features.to_features(motions(), representation)[0, :2]
    x = x + jnp.asarray(0.3 * rng.normal(size=x.shape), jnp.float32)
    weights = jnp.asarray(rng.normal(size=(2, JOINTS, 3)), jnp.float32)
    value = jax.jit(lambda x: jnp.sum(weights * geometry.positions(x)))
    slope = np.asarray(jax.jit(jax.grad(value))(x))
    for direction in rng.normal(size=(4, *x.shape)):
        step = jnp.asarray(1e-2 * direction, jnp.float32)
        found = np.sum(slope * direction)
        expected = (float(value(x + step)) - float(value(x - step))) / 2e-2
        np.testing.assert_allclose(found, expected, rtol=1e-2, atol=2e-3)
    zero = jax.grad(value)(jnp.zeros_like(x))
    assert np.isfinite(zero).all()


def test_a_representation_goes_through_jit(representation):
    again = jax.jit(lambda r: jax.tree.map(lambda x: 1.0 * x, r))(representation)
    assert again.fps == 30.0 and again.skeleton.names == tiny.NAMES
    assert isinstance(again.skeleton, skeleton.Skeleton)
