"""Spaces of frames: what a channel of one means, and the way back."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.systems.aamdm import embedding as aamdm_embedding
from jaxmotion.systems.aamdm import space as aamdm_space
from tests import person, tiny

CONFIG = aamdm_embedding.Config(num_joints=6, latent=4, width=16)
LENGTHS = (70, 40)
SIZE = CONFIG.num_features
KINDS = ("embedded", "full_pose")


@functools.cache
def walks():
    """Poses and paths of two clips that are far from each other."""
    own = np.random.default_rng(0)
    size = SIZE + 12
    spread = own.uniform(0.05, 3.0, size)
    steps = [spread * own.normal(size=(length, size)) for length in LENGTHS]
    clips = [np.cumsum(x, axis=0) + 50.0 * i for i, x in enumerate(steps)]
    both = person.float32(np.concatenate(clips))
    return both[:, :SIZE], both[:, SIZE:]


def neighbors():
    """All frames but the last of each clip."""
    first, second = LENGTHS
    found = [*range(first - 1), *range(first, first + second - 1)]
    return jnp.asarray(found, jnp.int32)


@functools.cache
def space_of(kind):
    poses, paths = walks()
    own = None
    if kind == "embedded":
        own = aamdm_space.Autoencoder(
            params=tiny.random_params(aamdm_embedding.init, CONFIG),
            statistics=aamdm_embedding.fit_statistics(poses, paths, config=CONFIG),
            config=CONFIG,
        )
    return aamdm_space.fit_space(poses, paths, neighbors(), autoencoder=own)


def frames_of(kind):
    return np.float64(aamdm_space.to_frames(space_of(kind), *walks()))


@pytest.mark.parametrize("kind", KINDS)
def test_frames_have_unit_variance_over_the_data(kind):
    found = frames_of(kind)
    size = 12 + (4 if kind == "embedded" else SIZE)
    assert found.shape == (sum(LENGTHS), size)
    assert space_of(kind).num_features == size
    np.testing.assert_allclose(found.mean(0), 0.0, atol=1e-3)
    np.testing.assert_allclose(found.std(0), 1.0, rtol=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_paths_come_back_from_frames(kind):
    paths = walks()[1]
    frames = aamdm_space.to_frames(space_of(kind), *walks())
    found = aamdm_space.to_paths(space_of(kind), frames)
    np.testing.assert_allclose(found, paths, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(
        aamdm_space.to_paths(space_of(kind), frames[7]), paths[7], rtol=1e-4, atol=1e-3
    )


def test_poses_come_back_from_frames_of_full_poses():
    poses = walks()[0]
    frames = aamdm_space.to_frames(space_of("full_pose"), *walks())
    found = aamdm_space.to_poses(space_of("full_pose"), frames)
    np.testing.assert_allclose(found, poses, rtol=1e-4, atol=1e-3)


def test_poses_of_embedded_frames_are_the_decoders():
    own = space_of("embedded").autoencoder
    use = (own.params, own.statistics)
    embedded = aamdm_embedding.encode(*use, *walks(), config=CONFIG)
    expected = aamdm_embedding.decode(*use, embedded, config=CONFIG)
    frames = aamdm_space.to_frames(space_of("embedded"), *walks())
    found = aamdm_space.to_poses(space_of("embedded"), frames)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize("kind", KINDS)
def test_change_is_the_deviation_of_neighbors_within_clips(kind):
    found = frames_of(kind)
    clips = np.split(found, [LENGTHS[0]])
    steps = np.concatenate([np.diff(clip, axis=0) for clip in clips])
    expected = np.sqrt(np.mean(steps**2, axis=0))
    np.testing.assert_allclose(space_of(kind).change, expected, rtol=1e-3)
    # A jump between the clips would show.
    across = np.sqrt(np.mean(np.diff(found, axis=0) ** 2, axis=0))
    assert np.any(across[:12] > 1.1 * expected[:12])


@pytest.mark.parametrize("kind", KINDS)
def test_bounds_leave_out_half_a_per_cent_at_each_end(kind):
    space, found = space_of(kind), frames_of(kind)
    low, high = np.quantile(found, [0.005, 0.995], axis=0)
    np.testing.assert_allclose(space.low, low, atol=1e-3)
    np.testing.assert_allclose(space.high, high, atol=1e-3)
    for shape in ((), (2, 3)):
        middle = jnp.broadcast_to((space.low + space.high) / 2, (*shape, len(low)))
        for offset, expected in ((0.0, middle), (99.0, space.high), (-99.0, space.low)):
            kept = aamdm_space.keep_within(space, middle + offset)
            assert kept.shape == middle.shape
            np.testing.assert_array_equal(kept, np.broadcast_to(expected, kept.shape))


def test_channels_that_hardly_vary_are_not_blown_up():
    poses, paths = walks()
    tiny_change = 1e-6 * jnp.arange(sum(LENGTHS))
    poses = poses.at[:, 5].set(0.4 + tiny_change).at[:, 6].set(2.0)
    space = aamdm_space.fit_space(poses, paths, neighbors(), autoencoder=None)
    frames = aamdm_space.to_frames(space, poses, paths)
    assert np.abs(frames[:, 12 + 5]).max() < 0.2
    np.testing.assert_allclose(frames[:, 12 + 6], 0.0, atol=1e-3)
    assert np.isfinite(frames).all() and np.all(space.change >= 0.99e-4)
    found = aamdm_space.to_poses(space, frames)
    np.testing.assert_allclose(found, poses, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_spaces_pass_through_jit(kind):
    space = space_of(kind)
    eager = aamdm_space.to_frames(space, *walks())
    compiled = jax.jit(aamdm_space.to_frames)(space, *walks())
    np.testing.assert_allclose(compiled, eager, rtol=1e-3, atol=1e-4)
