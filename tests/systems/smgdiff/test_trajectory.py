"""SMGDiff's trajectory generator: what it learns from, and the paths it makes."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.motion import trajectory
from jaxmotion.systems.smgdiff import trajectory as smgdiff_trajectory
from jaxmotion.systems.smgdiff.trajectory import Wish
from tests import tiny

CONFIG = smgdiff_trajectory.Config(
    num_labels=2,
    past=4,
    future=12,
    width=16,
    depth=1,
    heads=2,
    hidden=32,
    frames_per_token=2,
)


@pytest.fixture(scope="module")
def params():
    return tiny.random_params(smgdiff_trajectory.init, CONFIG, seed=1)


def wish(velocity=(0.3, 1.0)):
    still = trajectory.Trajectory(
        position=jnp.zeros((4, 2)), facing=jnp.tile(jnp.array([0.0, 1.0]), (4, 1))
    )
    return Wish(past=still, velocity=jnp.array(velocity), label=jnp.int32(0))


def test_the_wish_is_the_mean_velocity_of_what_happened():
    motion = tiny.walk(16, speed=1.2, turn=0.7, start=2.0)
    found, path = smgdiff_trajectory.example(
        tiny.skeleton(), motion, jnp.int32(1), config=CONFIG
    )
    place = np.float64(motion.root_position)[:, ::2]
    whole = np.linalg.norm(place[15] - place[3]) / (12 / 30)
    assert np.linalg.norm(found.velocity) == pytest.approx(whole, rel=1e-4)
    np.testing.assert_allclose(found.past.position[-1], 0.0, atol=1e-6)
    np.testing.assert_allclose(found.past.facing[-1], [0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(
        path.position[-1], np.asarray(found.velocity) * 12 / 30, atol=1e-5
    )


def test_the_second_target_is_where_he_was_by_then():
    config = dataclasses.replace(CONFIG, soon=5)
    motion = tiny.walk(16, speed=1.2, turn=0.7, start=2.0)
    wish, path = smgdiff_trajectory.example(
        tiny.skeleton(), motion, jnp.int32(1), config=config
    )
    np.testing.assert_allclose(wish.soon * 5 / 30, path.position[4], atol=1e-5)


def test_a_generator_of_two_targets_asks_for_both():
    config = dataclasses.replace(CONFIG, soon=5)
    drawn = tiny.random_params(smgdiff_trajectory.init, config, seed=1)
    generate = smgdiff_trajectory.sampler(drawn, config=config)
    with pytest.raises(ValueError, match="a wish without soon"):
        generate(jax.random.key(0), wish())
    found = [
        generate(jax.random.key(0), dataclasses.replace(wish(), soon=jnp.array(soon)))
        for soon in ([0.0, 0.0], [0.0, 1.0], [1.0, 0.0])
    ]
    for one, other in itertools.combinations(found, 2):
        assert np.abs(one.position - other.position).max() > 1e-3


@pytest.mark.parametrize("soon", [-1, 13])
def test_a_second_target_off_the_path_is_refused(soon):
    with pytest.raises(ValueError, match=f"soon is {soon}, expected 0..12"):
        dataclasses.replace(CONFIG, soon=soon)


@pytest.mark.parametrize("label", [-1, 2])
def test_an_unknown_skill_is_refused_or_when_compiled_the_nearest(params, label):
    generate = smgdiff_trajectory.sampler(params, config=CONFIG)
    ask = lambda skill: dataclasses.replace(wish(), label=jnp.int32(skill))  # noqa: E731
    run = jax.jit(lambda wanted: generate(jax.random.key(0), wanted).position)
    found = run(ask(label))
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(found, run(ask(np.clip(label, 0, 1))))
    with pytest.raises(ValueError, match=f"labels are in {label}..{label}, expected 0"):
        generate(jax.random.key(0), ask(label))


def test_a_straight_path_reaches_its_target():
    path = smgdiff_trajectory.straight(jax.random.key(0), wish(), future=30, fps=30.0)
    np.testing.assert_allclose(path.position[-1], [0.3, 1.0], atol=1e-6)
    steps = np.diff(np.asarray(path.position), axis=0)
    np.testing.assert_allclose(steps, np.tile(steps[:1], (29, 1)), atol=1e-6)
    np.testing.assert_allclose(np.hypot(*path.facing.T), 1.0, atol=1e-6)


def test_who_stands_goes_on_facing_as_before():
    path = smgdiff_trajectory.straight(
        jax.random.key(0), wish((0.0, 0.0)), future=5, fps=30.0
    )
    np.testing.assert_allclose(path.facing, np.tile([[0.0, 1.0]], (5, 1)), atol=1e-6)


@pytest.mark.parametrize("steps", [1, 3])
def test_generated_paths_have_unit_facings(params, steps):
    config = smgdiff_trajectory.Config(**{**vars(CONFIG), "num_steps": steps})
    params = tiny.random_params(smgdiff_trajectory.init, config, seed=1)
    path = jax.jit(smgdiff_trajectory.sampler(params, config=config))(
        jax.random.key(0), wish()
    )
    assert path.position.shape == (12, 2)
    np.testing.assert_allclose(np.hypot(*path.facing.T), 1.0, atol=1e-5)


def test_smooth_noise_is_a_walk_to_the_target_of_known_deviation():
    """Frames' deviations over draws are the series' in float64; the end stays."""
    config = dataclasses.replace(CONFIG, noise="bridge", num_steps=4, seconds=0.4)
    wanted = wish()
    decode, encode = smgdiff_trajectory.noise_space(wanted, config)
    z = jax.random.normal(jax.random.key(2), (20_000, 12, 4))
    x = np.asarray(jax.vmap(decode)(z), np.float64)
    part, n = np.arange(1, 13)[:, None] / 12, np.arange(1, 13)[None]
    sway = 0.25 * np.sqrt(
        (np.sin(np.pi * n * part)[:, :11] ** 2 / n[:, :11] ** 4).sum(1)
    )
    odd = 2 * n - 1
    turn = 0.5 * np.sqrt((np.sin(np.pi / 2 * odd * part) ** 2 / odd**4).sum(1))
    expected = np.stack([sway, sway, turn, turn], axis=-1)
    np.testing.assert_allclose(x.std(0)[:-1], expected[:-1], rtol=0.03)
    np.testing.assert_allclose(
        x[:, -1, :2], np.tile([0.12, 0.4], (20_000, 1)), atol=1e-5
    )
    straight = smgdiff_trajectory.straight(
        jax.random.key(0), wanted, future=12, fps=30.0
    )
    np.testing.assert_allclose(x.mean(0)[:, :2], straight.position, atol=0.01)
    back = np.asarray(jax.vmap(encode)(jnp.asarray(x, jnp.float32)))
    np.testing.assert_allclose(back[:, :11], z[:, :11], atol=2e-3)
    np.testing.assert_allclose(back[:, 11, 2:], z[:, 11, 2:], atol=2e-3)


def test_paths_from_smooth_noise_vary_and_end_at_the_target(params):
    config = dataclasses.replace(CONFIG, noise="bridge", num_steps=4, seconds=0.4)
    generate = smgdiff_trajectory.sampler(params, config=config)
    keys = jax.random.split(jax.random.key(0), 64)
    paths = jax.jit(jax.vmap(generate, (0, None)))(keys, wish())
    np.testing.assert_allclose(
        paths.position[:, -1], np.tile([0.12, 0.4], (64, 1)), atol=1e-5
    )
    assert np.asarray(paths.position[:, 5]).std(0).min() > 1e-4
    np.testing.assert_allclose(jnp.linalg.norm(paths.facing, axis=-1), 1.0, atol=1e-5)


@pytest.mark.slow
def test_training_makes_paths_of_what_was_seen():
    """Straight walks at two speeds: the error falls to a part of the first."""
    motions = [tiny.walk(16, speed=s, start=a) for s in (0.5, 1.5) for a in (0.0, 2.0)]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *motions), jnp.array([0, 0, 1, 1])
    loss = functools.partial(
        smgdiff_trajectory.loss, skeleton=tiny.skeleton(), config=CONFIG
    )

    def step(params, key):
        value, gradient = jax.value_and_grad(lambda p: loss(p, key, batch)[0])(params)
        return jax.tree.map(lambda a, g: a - 0.05 * g, params, gradient), value

    params = tiny.random_params(smgdiff_trajectory.init, CONFIG, seed=1)
    keys = jax.random.split(jax.random.key(0), 150)
    _, values = jax.jit(lambda p, k: jax.lax.scan(step, p, k))(params, keys)
    assert float(values[-20:].mean()) < 0.2 * float(values[:5].mean())
