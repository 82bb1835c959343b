"""The embedded space: what is scaled how, and the autoencoder's loss in NumPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.learning import training
from jaxmotion.systems.aamdm import embedding as aamdm_embedding
from tests import mostly_slow, person, tiny
from tests.reference import pose as reference

CONFIG = aamdm_embedding.Config(num_joints=6, latent=4, width=16)
FIELDS = dict(
    position=18,
    rotation=36,
    velocity=18,
    angular_velocity=18,
    root_velocity=3,
    root_angular_velocity=3,
    contact=2,
)
SLICES = dict(
    zip(
        FIELDS,
        map(slice, np.cumsum([0, *FIELDS.values()]), np.cumsum([*FIELDS.values()])),
        strict=True,
    )
)
SIZE = sum(FIELDS.values())


def drawn(*shape, seed=0):
    """Vectors whose channels have means and deviations of their own."""
    own = np.random.default_rng(seed)
    mean, spread = own.normal(size=shape[-1]), own.uniform(0.05, 3.0, shape[-1])
    return person.float32(mean + spread * own.normal(size=shape))


@functools.cache
def fitted():
    """Parameters and statistics."""
    statistics = aamdm_embedding.fit_statistics(
        drawn(200, SIZE), drawn(200, 12, seed=1), config=CONFIG
    )
    return tiny.random_params(aamdm_embedding.init, CONFIG, seed=2), statistics


@functools.cache
def batch():
    return drawn(3, 2, SIZE, seed=3), drawn(3, 2, 12, seed=4)


def loss_of(params, statistics, batch, config=CONFIG):
    return aamdm_embedding.loss(
        params,
        jax.random.key(0),
        batch,
        statistics=statistics,
        parents=person.PARENTS,
        config=config,
    )


# --- sizes and statistics ----------------------------------------------------------


def test_22_joints_have_the_papers_64_channels():
    config = aamdm_embedding.Config(num_joints=22)
    assert (config.num_features, config.num_embedded) == (338, 64)
    assert (CONFIG.num_features, CONFIG.num_embedded) == (SIZE, 16)


def test_poses_are_scaled_channel_by_channel_for_the_decoder():
    own = fitted()[1].pose
    poses = np.float64(drawn(200, SIZE))
    np.testing.assert_allclose(own.mean, poses.mean(0), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(own.std, poses.std(0), rtol=1e-4)


def test_poses_are_scaled_kind_by_kind_for_the_encoder():
    own = fitted()[1].group
    poses = np.float64(drawn(200, SIZE))
    np.testing.assert_allclose(own.mean, poses.mean(0), rtol=1e-4, atol=1e-5)
    for where in SLICES.values():
        np.testing.assert_allclose(own.std[where], own.std[where][0], rtol=1e-6)


def test_the_deviation_of_a_kind_is_that_of_all_its_numbers():
    own = fitted()[1].group
    poses = np.float64(drawn(200, SIZE))
    for name, where in SLICES.items():
        expected = poses[:, where].std()
        np.testing.assert_allclose(own.std[where], expected, rtol=1e-3, err_msg=name)


def test_paths_have_one_deviation_for_positions_and_one_for_facings():
    own = fitted()[1].path
    paths = np.float64(drawn(200, 12, seed=1))
    np.testing.assert_allclose(own.mean, paths.mean(0), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(own.std[:6], paths[:, :6].std(0).mean(), rtol=1e-4)
    np.testing.assert_allclose(own.std[6:], paths[:, 6:].std(0).mean(), rtol=1e-4)


def test_constant_channels_stay_finite():
    still, path = jnp.ones((50, SIZE)), jnp.ones((50, 12))
    statistics = aamdm_embedding.fit_statistics(still, path, config=CONFIG)
    for own in (statistics.pose, statistics.group, statistics.path):
        assert np.all(np.asarray(own.std) >= 0.99e-4)
        np.testing.assert_allclose(own.mean, 1.0, rtol=1e-6)
    params = fitted()[0]
    embedded = aamdm_embedding.encode(params, statistics, still, path, config=CONFIG)
    found = aamdm_embedding.decode(params, statistics, embedded, config=CONFIG)
    np.testing.assert_allclose(found, still, atol=1e-2)


# --- encode and decode -------------------------------------------------------------


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_embedded_vectors_begin_with_the_path_in_meters(shape):
    params, statistics = fitted()
    poses, paths = drawn(*shape, SIZE, seed=5), drawn(*shape, 12, seed=6)
    embedded = aamdm_embedding.encode(params, statistics, poses, paths, config=CONFIG)
    assert embedded.shape == (*shape, 16)
    np.testing.assert_array_equal(embedded[..., :12], paths)
    found = aamdm_embedding.decode(params, statistics, embedded, config=CONFIG)
    assert found.shape == (*shape, SIZE)


def test_the_latent_knows_the_pose_and_not_the_path():
    params, statistics = fitted()
    poses, paths = batch()
    encode = functools.partial(
        aamdm_embedding.encode, params, statistics, config=CONFIG
    )
    latent = encode(poses, paths)[..., 12:]
    np.testing.assert_array_equal(encode(poses, paths + 1.0)[..., 12:], latent)
    assert np.abs(encode(poses + 1.0, paths)[..., 12:] - latent).min() > 1e-3


def test_scales_stand_before_the_encoder_and_around_the_decoder():
    """A change of units in the data changes the poses' units and nothing else."""
    params = fitted()[0]
    poses, paths = drawn(200, SIZE), drawn(200, 12, seed=1)
    factor, shift = 7.0, 3.0

    def through(poses, paths):
        statistics = aamdm_embedding.fit_statistics(poses, paths, config=CONFIG)
        embedded = aamdm_embedding.encode(
            params, statistics, poses, paths, config=CONFIG
        )
        return embedded, aamdm_embedding.decode(
            params, statistics, embedded, config=CONFIG
        )

    embedded, found = through(poses, paths)
    other, scaled = through(factor * poses + shift, factor * paths - shift)
    np.testing.assert_allclose(other[:, 12:], embedded[:, 12:], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(scaled, factor * found + shift, rtol=1e-2, atol=2e-2)


# --- the loss ----------------------------------------------------------------------


def parts_of(vector):
    """A pose vector's channels, and its joints in the character's axes."""
    parts = {name: vector[where] for name, where in SLICES.items()}
    matrices = reference.character_matrices(
        person.PARENTS,
        parts["position"].reshape(6, 3),
        parts["rotation"].reshape(6, 6),
    )
    parts["character_position"] = matrices[:, :3, 3]
    parts["character_rotation"] = matrices[:, :3, :2]
    return parts


# Weights of the value, and of its change per second.
WEIGHTS = dict(
    position=(75.0, 10.0),
    rotation=(10.0, 1.75),
    velocity=(10.0, 0.0),
    angular_velocity=(1.25, 0.0),
    root_velocity=(2.0, 0.0),
    root_angular_velocity=(2.0, 0.0),
    contact=(2.0, 0.0),
    character_position=(15.0, 2.0),
    character_rotation=(5.0, 0.75),
)


def expected_terms(found, poses, latent, fps):
    """Sections 3.1 of the paper and 2.4 of our facts, pair by pair and part by part."""
    value = change = 0.0
    for pair, own in zip(np.float64(poses), np.float64(found), strict=True):
        rows = [[parts_of(vector) for vector in x] for x in (own, pair)]
        errors = [{k: a[k] - b[k] for k in a} for a, b in zip(*rows, strict=True)]
        for name, (weight, rate) in WEIGHTS.items():
            first, second = (error[name] for error in errors)
            value += weight * (np.abs(first).mean() + np.abs(second).mean()) / 2
            change += rate * np.abs((second - first) / (1 / fps)).mean()
    z = np.float64(latent)
    regular = 0.1 * np.abs(z).mean() + 0.1 * (z**2).mean()
    regular += 0.01 * np.abs((z[:, 1] - z[:, 0]) / (1 / fps)).mean()
    return value / len(poses), change / len(poses), regular


@pytest.mark.parametrize("fps", mostly_slow([60.0, 30.0], [60.0]))
def test_loss_is_that_of_the_definition(fps):
    config = aamdm_embedding.Config(num_joints=6, latent=4, width=16, fps=fps)
    params, statistics = fitted()
    poses, paths = batch()
    loss, terms = loss_of(params, statistics, (poses, paths), config)
    embedded = aamdm_embedding.encode(params, statistics, poses, paths, config=config)
    found = aamdm_embedding.decode(params, statistics, embedded, config=config)
    expected = expected_terms(found, poses, embedded[..., 12:], fps)
    for name, wanted in zip(("value", "change", "latent"), expected, strict=True):
        np.testing.assert_allclose(terms[name], wanted, rtol=1e-3)
    np.testing.assert_allclose(loss, sum(expected), rtol=1e-3)


@pytest.fixture
def reconstruct(monkeypatch):
    """Puts vectors in the decoder's place."""

    def plant(vectors):
        monkeypatch.setattr(aamdm_embedding, "decode", lambda *a, **k: vectors)

    return plant


def test_a_perfect_reconstruction_costs_its_latent_alone(reconstruct):
    reconstruct(batch()[0])
    loss, terms = loss_of(*fitted(), batch())
    assert terms["value"] == 0.0 and terms["change"] == 0.0
    assert loss == terms["latent"] > 0.0


def test_a_root_beside_its_place_moves_all_joints_but_no_rate(reconstruct):
    poses = batch()[0]
    reconstruct(poses.at[..., 0].add(0.3))
    terms = loss_of(*fitted(), batch())[1]
    # One of 18 local coordinates, and every third coordinate of the character.
    np.testing.assert_allclose(terms["value"], 0.3 * (75 / 18 + 15 / 3), rtol=1e-4)
    np.testing.assert_allclose(terms["change"], 0.0, atol=2e-3)
    reconstruct(poses.at[:, 1, 0].add(0.3))
    terms = loss_of(*fitted(), batch())[1]
    np.testing.assert_allclose(terms["value"], 0.15 * (75 / 18 + 15 / 3), rtol=1e-4)
    np.testing.assert_allclose(terms["change"], 18.0 * (10 / 18 + 2 / 3), rtol=1e-4)


@pytest.mark.parametrize(
    ("field", "weight"),
    [
        ("velocity", 10.0),
        ("angular_velocity", 1.25),
        ("root_velocity", 2.0),
        ("root_angular_velocity", 2.0),
        ("contact", 2.0),
    ],
)
def test_each_field_has_its_weight(reconstruct, field, weight):
    reconstruct(batch()[0].at[..., SLICES[field]].add(0.2))
    terms = loss_of(*fitted(), batch())[1]
    np.testing.assert_allclose(terms["value"], 0.2 * weight, rtol=1e-4)
    np.testing.assert_allclose(terms["change"], 0.0, atol=1e-5)


def test_gradients_are_finite_and_reach_every_layer():
    params, statistics = fitted()
    still = jnp.ones((3, 2, SIZE)), jnp.ones((3, 2, 12))
    gradient = jax.jit(jax.grad(lambda p, b: loss_of(p, statistics, b)[0]))
    for given in (batch(), still):
        for leaf in jax.tree.leaves(gradient(params, given)):
            assert np.isfinite(leaf).all()
            assert np.abs(leaf).max() > 0


@pytest.mark.slow
def test_training_on_a_few_poses_lowers_the_loss():
    poses, paths = batch()
    statistics = fitted()[1]
    loss = functools.partial(
        aamdm_embedding.loss,
        statistics=statistics,
        parents=person.PARENTS,
        config=CONFIG,
    )
    optimizer = training.make_optimizer("adamw", learning_rate=1e-2, num_steps=150)
    run = training.train_chunk(
        training.make_update(loss, optimizer),
        lambda key, data: data,
        num_steps=150,
    )
    params = tiny.random_params(aamdm_embedding.init, CONFIG, seed=8)
    state = training.init_train_state(params, optimizer)
    _, info = run(state, jax.random.key(0), (poses, paths))
    assert np.all(np.isfinite(info["loss"]))
    assert info["value"][-1] < 0.5 * info["value"][0]


# --- slow toes ---------------------------------------------------------------------


@jax.jit
def error_of_feet(found, poses):
    return aamdm_embedding.foot_error(
        found, poses, parents=person.PARENTS, feet=person.FEET, config=CONFIG
    )


def toe_velocities(vectors):
    """World velocities of the toes from frame to frame, in the former's bone axes."""
    rows = []
    for before, after in zip(vectors, vectors[1:], strict=False):
        origin, facing = reference.advance(
            np.zeros(2),
            np.array([0.0, 1.0]),
            after[SLICES["root_velocity"]],
            after[SLICES["root_angular_velocity"]],
            60.0,
        )
        bone = reference.bone_matrix(origin, facing)
        here, there = (
            parts_of(vector)["character_position"][list(person.FEET)]
            for vector in (before, after)
        )
        there = there @ bone[:3, :3].T + bone[:3, 3]
        rows.append((there - here) * 60.0)
    return np.array(rows)


def near_poses(seed):
    """Two windows of poses that hardly change, of which some toes are slow."""
    own = np.random.default_rng(seed)
    first = np.float64(drawn(2, 1, SIZE, seed=seed))
    size = np.array([0.1, 3.0])[:, None, None]
    windows = first + size * 0.004 * own.normal(size=(2, 5, SIZE))
    for name in ("root_velocity", "root_angular_velocity"):
        windows[..., SLICES[name]] = own.normal(size=(2, 5, 3)) * size / 3
    return windows


def test_errors_of_slow_toes_are_those_of_the_definition():
    poses, found = near_poses(7), near_poses(8)
    found[0] = poses[0] + 0.001 * np.random.default_rng(9).normal(size=poses[0].shape)
    recorded, own = (np.stack([toe_velocities(w) for w in x]) for x in (poses, found))
    slow = np.linalg.norm(recorded, axis=-1) < 1.0
    assert 0.2 < slow.mean() < 0.8
    expected = (np.abs(own - recorded) * slow[..., None]).mean()
    result = error_of_feet(person.float32(found), person.float32(poses))
    np.testing.assert_allclose(result, expected, rtol=2e-3)


def test_toes_that_stand_as_recorded_cost_nothing_and_fast_ones_never_do():
    poses = person.float32(near_poses(7))
    assert error_of_feet(poses, poses) == 0.0
    fast = poses.at[..., SLICES["root_velocity"]].add(90.0)
    assert error_of_feet(poses, fast) == 0.0
    assert error_of_feet(fast, poses) > 1.0


def test_gradients_of_slow_toes_are_finite():
    poses = person.float32(near_poses(7))
    slope = jax.jit(jax.grad(error_of_feet))
    assert np.isfinite(slope(poses, poses)).all()
    found = slope(person.float32(near_poses(8)), poses)
    assert np.isfinite(found).all() and np.abs(found).sum() > 0
