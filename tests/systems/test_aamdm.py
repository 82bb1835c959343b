"""AAMDM's transition and losses."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.diffusion import chain, schedule
from jaxmotion.systems import aamdm, aamdm_loss
from tests import tiny

pytestmark = pytest.mark.usefixtures("quick_compile")

CONFIG = aamdm.Config(features=3, latent=2, width=16, depth=2, window=4)


@functools.cache
def parameters():
    return tiny.random_params(aamdm.init, CONFIG)


def normal(*shape, seed=0):
    values = np.random.default_rng(seed).normal(size=shape)
    return jnp.asarray(values, jnp.float32)


@pytest.mark.parametrize(("drafts", "polishes"), [(3, 2), (5, 0), (0, 5), (1, 1)])
def test_drafts_come_before_polishes(drafts, polishes):
    """Each step, one by one, with the network that its number belongs to."""
    config = dataclasses.replace(CONFIG, drafts=drafts, polishes=polishes)
    params = tiny.random_params(aamdm.init, config)
    key, previous = jax.random.key(1), normal(3)
    found = jax.jit(aamdm.transition(params, config=config))(key, previous)

    key_start, key_chain = jax.random.split(jax.random.clone(key))
    x = jax.random.normal(key_start, (3,))
    for t in range(config.num_steps, 0, -1):
        name, make = ("generator", aamdm.draft), ("polisher", aamdm.polish)
        part = name if t > polishes else make
        denoise = part[1](params[part[0]], previous, config=config)
        step = chain.ancestral_step(config.table(), denoise)
        x = step(jax.random.fold_in(key_chain, t), x, jnp.array(t))
    np.testing.assert_allclose(found, x, rtol=1e-5, atol=1e-6)


def test_characters_batch_by_vmap_and_compile_once():
    step = aamdm.transition(parameters(), config=CONFIG)
    traced = chex.assert_max_traces(lambda *a: jax.vmap(step)(*a), n=1)
    run = jax.jit(traced)
    keys, previous = jax.random.split(jax.random.key(0), 4), normal(4, 3)
    together = run(keys, previous)
    run(jax.random.split(jax.random.key(9), 4), previous + 1)
    alone = jnp.stack([step(k, x) for k, x in zip(keys, previous, strict=True)])
    np.testing.assert_allclose(together, alone, rtol=1e-4, atol=1e-5)


def test_guidance_lowers_its_objective():
    step = aamdm.transition(parameters(), config=CONFIG)
    goal = jnp.array([0.5, -0.5, 1.0])
    objective = lambda x: 0.5 * jnp.sum(jnp.square(x - goal))  # noqa: E731

    @functools.partial(jax.jit, static_argnums=())
    def mean(scale):
        keys = jax.random.split(jax.random.key(0), 64)
        guided = lambda k: step(k, normal(3), objective=objective, scale=scale)  # noqa: E731
        return jnp.mean(jax.vmap(objective)(jax.vmap(guided)(keys)))

    assert mean(0.05) < mean(0.0)
    plain = jax.jit(step)(jax.random.key(5), normal(3))
    off = step(jax.random.key(5), normal(3), objective=objective, scale=0.0)
    np.testing.assert_allclose(off, plain, rtol=1e-5, atol=1e-6)


def test_polisher_loss_is_a_loop_over_its_own_predictions():
    windows, key = normal(6, 5, 3), jax.random.key(2)
    params = parameters()["polisher"]
    loss, terms = jax.jit(functools.partial(aamdm_loss.polisher_loss, config=CONFIG))(
        params, key, windows
    )
    key_t, key_noise = jax.random.split(jax.random.clone(key))
    t = jax.random.randint(key_t, (5, 6), 1, 6)
    noise = jax.random.normal(key_noise, windows.shape)
    own, errors, changes = windows[:, 0], [], []
    for i in range(1, 5):
        x_t = schedule.q_sample(CONFIG.table(), windows[:, i], t[i], noise[:, i])
        now = aamdm.network(CONFIG).apply({"params": params}, x_t, t[i], own)
        errors.append(np.abs(now - windows[:, i]))
        changes.append(np.abs(now - own - windows[:, i] + windows[:, i - 1]))
        own = now
    np.testing.assert_allclose(terms["value"], np.mean(errors), rtol=1e-4)
    np.testing.assert_allclose(terms["velocity"], np.mean(changes), rtol=1e-4)
    np.testing.assert_allclose(
        loss, np.mean(errors) + 0.1 * np.mean(changes), rtol=1e-4
    )


def test_each_player_moves_only_itself():
    params, windows = parameters(), normal(8, 3, 3)
    judge = functools.partial(aamdm_loss.discriminator_loss, config=CONFIG)
    make = functools.partial(aamdm_loss.generator_loss, config=CONFIG)
    given = params["discriminator"], params["generator"], jax.random.key(0), windows
    (loss, info), grad = jax.value_and_grad(judge, has_aux=True)(*given)
    expected = info["adversarial"] + 0.5 * CONFIG.weight_r1 * info["r1"]
    np.testing.assert_allclose(loss, expected, rtol=1e-6)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(grad))
    given = params["generator"], params["discriminator"], jax.random.key(0), windows
    _, grad = jax.value_and_grad(make, has_aux=True)(*given)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(grad))
    assert any(np.abs(x).max() > 0 for x in jax.tree.leaves(grad))
