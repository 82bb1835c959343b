"""Noise as data: a function of its tape is the function of its key."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.diffusion import chain, schedule
from jaxmotion.diffusion.noise import draw_noise, with_noise

TABLE = schedule.cosine_schedule(4)
SHAPE = (3, 2)
WEIGHTS = jnp.asarray(np.random.default_rng(0).normal(size=(4, 2)), jnp.float32)


def network(key, x_t, t):
    """A small MLP that draws a latent, as a denoising-diffusion GAN does."""
    latent = jax.random.normal(key, (2,))
    seen = jnp.concatenate([x_t, jnp.broadcast_to(latent, x_t.shape)], axis=-1)
    return jnp.tanh(seen @ WEIGHTS) / t


def sampler(factory=chain.ancestral_step, denoise=network):
    """`sample(key, offset)`, jitted within as a network's functions are."""

    @jax.jit
    def sample(key, offset):
        key_used, _ = jax.random.split(key)
        step = factory(TABLE, denoise)
        return offset + chain.sample(step, key_used, SHAPE, num_steps=4)

    return sample


def test_a_tape_gives_what_the_key_gives():
    sample, offset = sampler(), jnp.ones(SHAPE)
    tape = draw_noise(sample, jax.random.key(3), offset)
    start, (latents, noises) = tape
    assert (start.shape, latents.shape, noises.shape) == (SHAPE, (4, 2), (4, *SHAPE))
    found = with_noise(sample)(tape, offset)
    np.testing.assert_allclose(found, sample(jax.random.key(3), offset), atol=1e-6)


@pytest.mark.slow
def test_a_tape_is_the_noise_of_the_rules_for_keys():
    """x_T from the first half of the key, step t from `fold_in` of the second."""
    key, rule = jax.random.key(3), jax.random.clone(jax.random.key(3))
    start, (latents, noises) = draw_noise(sampler(), key, jnp.zeros(SHAPE))
    first, second = jax.random.split(jax.random.split(rule)[0])
    np.testing.assert_allclose(start, jax.random.normal(first, SHAPE), atol=1e-6)
    for row, t in enumerate((4, 3, 2, 1)):
        denoise, step = jax.random.split(jax.random.fold_in(second, t))
        latent, noise = jax.random.normal(denoise, (2,)), jax.random.normal(step, SHAPE)
        np.testing.assert_allclose(latents[row], latent, atol=1e-6)
        np.testing.assert_allclose(noises[row], noise, atol=1e-6)


@pytest.mark.slow
def test_samplers_are_compared_noise_by_noise():
    """DDIM with eta 1 is the ancestral sampler: the same noise, the same sample."""
    offset = jnp.zeros(SHAPE)
    ddim = sampler(lambda table, net: chain.ddim_step(table, net, eta=1.0))
    tape = draw_noise(sampler(), jax.random.key(0), offset)
    found, expected = (with_noise(f)(tape, offset) for f in (ddim, sampler()))
    np.testing.assert_allclose(found, expected, atol=1e-5)
    other = jax.tree.map(lambda x: x + 0.1, tape)
    assert np.abs(with_noise(ddim)(other, offset) - expected).max() > 1e-3


@pytest.mark.slow
def test_characters_by_vmap():
    """Tapes stack as any arrays do."""
    keys, offsets = jax.random.split(jax.random.key(1), 3), jnp.ones((3, *SHAPE))
    sample = sampler()
    tapes = jax.vmap(lambda k, x: draw_noise(sample, k, x))(keys, offsets)
    found = jax.vmap(with_noise(sample))(tapes, offsets)
    for i in range(3):
        one = sample(jax.random.clone(keys)[i], offsets[i])
        np.testing.assert_allclose(found[i], one, atol=1e-6)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda key, x: x + jax.random.uniform(key), "into 'random_bits'"),
        (
            lambda key, x: jax.random.normal(jax.random.fold_in(key, x[0].astype(int))),
            "depends on data",
        ),
        (
            lambda key, x: jax.lax.cond(
                x[0] > 0, lambda k: jax.random.normal(k), lambda k: 0.0, key
            ),
            "into 'cond'",
        ),
    ],
)
def test_what_is_no_tape_of_normal_noise_is_named(function, message):
    with pytest.raises(ValueError, match=message):
        draw_noise(function, jax.random.key(0), jnp.ones(2))


def test_a_tape_of_other_shapes_is_named():
    tape = (jnp.zeros((2, 2)), (jnp.zeros((4, 2)), jnp.zeros((4, *SHAPE))))
    with pytest.raises(ValueError, match=r"\(2, 2\).*expected.*\(3, 2\)"):
        with_noise(sampler())(tape, jnp.zeros(SHAPE))
