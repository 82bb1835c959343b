"""EMDM's method: sampling against oracles, conditions, and what is refused."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.diffusion import chain
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import training as emdm_training
from tests import mostly_slow, tiny
from tests.reference import diffusion
from tests.reference import emdm as reference

CONFIG = emdm_model.Config(
    features=3,
    frames=6,
    condition_size=4,
    num_steps=4,
    latent=5,
    width=16,
    depth=1,
    heads=2,
    hidden=16,
    discriminator_width=128,
)
DDPM = dataclasses.replace(CONFIG, latent=0, schedule="cosine", num_steps=20)
SHAPE = (6, 3)


@functools.cache
def parameters(config=CONFIG):
    return tiny.random_params(emdm_model.init, config)["generator"]


def one_condition(config=CONFIG, *, length=6, seed=0):
    """A condition without a batch axis."""
    vector = np.random.default_rng(seed).normal(size=config.condition_size)
    return emdm_model.Condition(
        vector=jnp.asarray(vector, jnp.float32),
        keep=jnp.array(True),
        mask=jnp.arange(6) < length,
    )


def dropped(condition):
    return dataclasses.replace(condition, keep=jnp.array(False))


@functools.cache
def jitted(config=CONFIG, **kind):
    """The sampler as one program."""
    return jax.jit(emdm_model.sampler(parameters(config), config=config, **kind))


def predictor(config, condition):
    """`(x_t, t, latent) -> x_0`: the network by itself, counted from 1."""
    net = emdm_model.generator(config)
    mask = condition.mask | (not config.mask_frames)

    @jax.jit
    def predict(x_t, t, latent):
        given = x_t, t, condition.vector, condition.keep, mask, latent
        return net.apply({"params": parameters(config)}, *given)

    def call(x_t, t, latent):
        x_t = jnp.asarray(x_t, jnp.float32)
        return np.float64(predict(x_t, jnp.array(t), latent))

    return call


def draws(key, num_steps, latent):
    """x_T, and latents and noises by step, as the rules for keys say."""
    key_start, key_chain = jax.random.split(key)
    latents, noises = {}, {}
    for t in range(1, num_steps + 1):
        key_denoise, key_noise = jax.random.split(jax.random.fold_in(key_chain, t))
        latents[t] = jax.random.normal(key_denoise, (latent,)) if latent else None
        noises[t] = np.float64(jax.random.normal(key_noise, SHAPE))
    return np.float64(jax.random.normal(key_start, SHAPE)), latents, noises


# --- sampling ----------------------------------------------------------------------


@pytest.mark.parametrize("num_steps", mostly_slow([1, 4], [4]))
@pytest.mark.parametrize("mask_frames", [True, False])
def test_sampling_is_algorithm_2(num_steps, mask_frames):
    """Oracle: its schedule, its posterior and its loop around the network."""
    config = dataclasses.replace(CONFIG, num_steps=num_steps, mask_frames=mask_frames)
    condition = one_condition(length=4)
    found = jitted(config)(jax.random.key(5), condition)
    x, latents, noises = draws(jax.random.key(5), num_steps, config.latent)
    predict = predictor(config, condition)
    expected = reference.sample(
        lambda x_t, t: predict(x_t, t + 1, latents[t + 1]),
        reference.vp_variances(num_steps),
        x,
        [noises[t + 1] for t in range(num_steps)],
    )
    assert found.shape == SHAPE
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


def test_schedules_are_the_papers():
    found = CONFIG.table()
    np.testing.assert_allclose(found.beta[1:], reference.vp_variances(4), rtol=1e-5)
    found = DDPM.table()
    np.testing.assert_allclose(found.beta[1:], diffusion.cosine_betas(20), rtol=1e-4)


def test_a_schedule_may_be_told():
    left = (0.9, 0.5, 0.2, 4e-5)
    table = dataclasses.replace(CONFIG, alpha_bar=left).table()
    np.testing.assert_allclose(table.alpha_bar, (1.0, *left), rtol=1e-3)


def test_a_key_and_a_condition_give_one_motion():
    sample, condition = jitted(), one_condition()
    first = sample(jax.random.key(0), condition)
    np.testing.assert_array_equal(sample(jax.random.key(0), condition), first)
    for key, other in ((1, condition), (0, one_condition(seed=1))):
        assert np.abs(sample(jax.random.key(key), other) - first).max() > 1e-3


@pytest.mark.parametrize("masked", [True, False])
def test_the_length_matters_only_with_a_mask(masked):
    config = dataclasses.replace(CONFIG, mask_frames=masked)
    short, whole = (
        jitted(config)(jax.random.key(0), one_condition(length=n)) for n in (3, 6)
    )
    assert (np.abs(short - whole)[:3].max() > 1e-4) == masked


def test_guidance_1_is_none_and_0_is_the_null_condition():
    """The latents of the guided chains are those of the plain ones."""
    sample, condition = jitted(), one_condition()
    guided = lambda scale: sample(  # noqa: E731
        jax.random.key(2), condition, scale=jnp.float32(scale)
    )
    plain = sample(jax.random.key(2), condition)
    null = sample(jax.random.key(2), dropped(condition))
    assert np.abs(plain - null).max() > 1e-2
    np.testing.assert_allclose(guided(1.0), plain, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(guided(0.0), null, rtol=1e-4, atol=1e-5)


def test_guidance_extrapolates_with_one_latent():
    """With T = 1 a sample is the prediction itself."""
    config = dataclasses.replace(CONFIG, num_steps=1)
    condition = one_condition()
    found = jitted(config)(jax.random.key(2), condition, scale=jnp.float32(2.5))
    x, latents, _ = draws(jax.random.key(2), 1, config.latent)
    expected = reference.guided(
        lambda x_t, t, latent, c: predictor(config, c)(x_t, t + 1, latent),
        x,
        0,
        latents[1],
        condition,
        dropped(condition),
        2.5,
    )
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


def test_steps_of_ddim_are_those_of_guided_diffusion():
    assert emdm_training.ddim_steps(1000, 10) == tuple(range(1, 1000, 100))
    assert emdm_training.ddim_steps(20, 20) == tuple(range(1, 21))
    assert emdm_training.ddim_steps(7, 1) == (1,)
    for count in (3, 0, -1, 2000):
        with pytest.raises(ValueError, match=f"{count} steps.*the 1000"):
            emdm_training.ddim_steps(1000, count)


def test_ddim_follows_x_T_and_tells_the_network_the_old_step():
    """Nothing but x_T comes from the key: the oracle draws no noise."""
    steps = emdm_training.ddim_steps(20, 5)
    condition = one_condition(length=4)
    found = jitted(DDPM, step=chain.ddim_step, steps=steps)(
        jax.random.key(1), condition
    )
    x, _, _ = draws(jax.random.key(1), 5, 0)
    alpha_bar = np.cumprod(1 - diffusion.cosine_betas(20))[np.array(steps) - 1]
    betas = 1 - alpha_bar / np.append(1.0, alpha_bar[:-1])
    predict = predictor(DDPM, condition)
    for i in reversed(range(5)):
        x_0 = predict(x, steps[i], None)
        x = diffusion.ddim(betas, i, x_0, x, np.zeros(SHAPE), 0.0)
    np.testing.assert_allclose(found, x, rtol=1e-3, atol=1e-3)


def test_a_denoiser_without_latent_samples_as_ddpm():
    condition = one_condition()
    found = jitted(DDPM)(jax.random.key(4), condition)
    x, _, noises = draws(jax.random.key(4), 20, 0)
    predict = predictor(DDPM, condition)
    expected = reference.sample(
        lambda x_t, t: predict(x_t, t + 1, None),
        diffusion.cosine_betas(20),
        x,
        [noises[t + 1] for t in range(20)],
    )
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("scale", [None, 2.0])
def test_motions_from_nothing(scale):
    config = dataclasses.replace(CONFIG, condition="none", condition_size=0)
    condition = one_condition(config)
    found = jitted(config)(jax.random.key(0), condition, scale=scale)
    assert found.shape == SHAPE and np.isfinite(found).all()
    plain = jitted(config)(jax.random.key(0), dropped(condition))
    np.testing.assert_allclose(found, plain, rtol=1e-4, atol=1e-5)


def test_motions_batch_by_vmap():
    conditions = emdm_model.make_condition(jnp.eye(4)[:3], (6, 2, 4), config=CONFIG)
    keys = jax.random.split(jax.random.key(0), 3)
    together = jax.jit(jax.vmap(emdm_model.sampler(parameters(), config=CONFIG)))(
        jax.random.clone(keys), conditions
    )
    for i, key in enumerate(keys):
        alone = jitted()(key, jax.tree.map(lambda x, i=i: x[i], conditions))
        np.testing.assert_allclose(together[i], alone, rtol=1e-4, atol=1e-4)


# --- networks and conditions -------------------------------------------------------


def test_networks_have_the_sizes_of_the_configuration():
    made = jax.eval_shape(lambda k: emdm_model.init(k, CONFIG), jax.random.key(0))
    assert set(made) == {"generator", "discriminator"}
    assert made["generator"]["embed_condition"]["kernel"].shape == (4, 16)
    first = made["discriminator"]["layers_0"]["kernel"]
    assert first.shape == (2 * 18 + 128 + 4, 128)
    blind = dataclasses.replace(CONFIG, discriminator_condition=False)
    made = jax.eval_shape(lambda k: emdm_model.init(k, blind), jax.random.key(0))
    assert made["discriminator"]["layers_0"]["kernel"].shape == (2 * 18 + 128, 128)
    made = jax.eval_shape(lambda k: emdm_model.init(k, DDPM), jax.random.key(0))
    assert set(made) == {"generator"} and "embed_latent" not in made["generator"]
    whole = emdm_model.generator(emdm_model.Config(features=150))
    sizes = whole.width, whole.depth, whole.heads, whole.hidden, whole.dropout
    assert sizes == (1024, 12, 32, 1024, 0.1)
    assert (whole.num_steps, whole.latent, whole.frames) == (10, 64, 60)


@pytest.mark.slow
def test_both_networks_are_drawn_from_the_key():
    init = jax.jit(lambda key: emdm_model.init(key, CONFIG))
    made, same, other = (init(jax.random.key(seed)) for seed in (0, 0, 1))
    for name in ("generator", "discriminator"):
        first, again, new = (m[name]["out"]["kernel"] for m in (made, same, other))
        np.testing.assert_array_equal(first, again)
        assert np.abs(first - new).max() > 1e-3


def test_the_discriminator_sees_the_condition_or_nothing():
    vector = jnp.eye(4)[:3]
    seen = emdm_model.discriminator_condition(vector, config=CONFIG)
    np.testing.assert_array_equal(seen, vector)
    blind = dataclasses.replace(CONFIG, discriminator_condition=False)
    assert emdm_model.discriminator_condition(vector, config=blind).shape == (3, 0)


def test_conditions_have_lengths():
    made = emdm_model.make_condition(jnp.eye(4)[:3], (6, 1, 4), config=CONFIG)
    np.testing.assert_array_equal(made.vector, np.eye(4)[:3])
    np.testing.assert_array_equal(made.keep, [True] * 3)
    np.testing.assert_array_equal(made.mask.sum(1), [6, 1, 4])
    np.testing.assert_array_equal(made.mask[2], [1, 1, 1, 1, 0, 0])
    whole = emdm_model.make_condition(jnp.eye(4)[:3], config=CONFIG)
    assert whole.mask.shape == (3, 6) and whole.mask.all()


def test_unknown_actions_are_refused_or_when_compiled_the_nearest():
    make = jax.jit(emdm_model.action_vectors, static_argnums=1)
    found = make(jnp.array([-1, 0, 3, 4]), 4)
    np.testing.assert_array_equal(found, np.eye(4)[[0, 0, 3, 3]])
    np.testing.assert_array_equal(
        emdm_model.action_vectors(jnp.arange(4), 4), np.eye(4)
    )
    for action in (-1, 4):
        with pytest.raises(ValueError, match=f"actions are in .*{action}.*0..3"):
            emdm_model.action_vectors(jnp.array([2, action]), 4)
    # Motions from nothing.
    assert emdm_model.action_vectors(jnp.arange(3), 0).shape == (3, 0)


@pytest.mark.parametrize(
    ("width", "lengths", "message"),
    [
        (3, None, r"3 channels, the model expects 4 \(action\)"),
        (4, (6, 0), "0 frames, the model makes 1 to 6"),
        (4, (7, 6), "7 frames, the model makes 1 to 6"),
        (4, (6, -1), "-1 frames, the model makes 1 to 6"),
        (4, (6,), "1 lengths for 2 conditions"),
        (4, (6, 6, 6), "3 lengths for 2 conditions"),
    ],
)
def test_conditions_that_do_not_fit_are_refused(width, lengths, message):
    with pytest.raises(ValueError, match=message):
        emdm_model.make_condition(jnp.zeros((2, width)), lengths, config=CONFIG)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(condition="none"), "condition_size is 4, expected 0 for.*'none'"),
        (dict(condition_size=0), "condition_size is 0.*at least 1 for.*'action'"),
        (dict(condition="text", condition_size=0), "at least 1 for.*'text'"),
        (dict(frames_per_token=4), r"frames is 6.*multiple of.*\(4\)"),
        (dict(discriminator_network="temporal"), "frames is 6.*expects 8 or more"),
        (dict(discriminator_width=32), "discriminator_width is 32.*multiple of 64"),
        (dict(discriminator_from=5), r"discriminator_from is 5.*num_steps \(4\)"),
        (dict(alpha_bar=(0.9, 0.5, 0.1)), r"alpha_bar is .*expected 4 falling"),
        (dict(alpha_bar=(0.9, 0.5, 0.5, 0.1)), "expected 4 falling"),
        (dict(alpha_bar=(1.0, 0.5, 0.4, 0.1)), "expected 4 falling"),
    ],
)
def test_configurations_that_cannot_be_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(CONFIG, **changes)
