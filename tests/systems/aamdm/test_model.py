"""AAMDM's transition and losses."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.diffusion import chain, guidance, schedule
from jaxmotion.systems.aamdm import loss as aamdm_loss
from jaxmotion.systems.aamdm import model as aamdm_model
from tests import mostly_slow, tiny

CONFIG = aamdm_model.Config(features=3, latent=2, width=16, depth=2, window=4)
CHANGING = dataclasses.replace(CONFIG, predict="change")
CHANGE = jnp.array([0.5, 0.1, 2.0])


@functools.cache
def parameters():
    return tiny.random_params(aamdm_model.init, CONFIG)


def normal(*shape, seed=0):
    values = np.random.default_rng(seed).normal(size=shape)
    return tiny.float32(values)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("drafts", "polishes"), mostly_slow([(3, 2), (5, 0), (0, 5), (1, 1)], [(3, 2)])
)
def test_drafts_come_before_polishes(drafts, polishes):
    """Each step, one by one, with the network that its number belongs to."""
    config = dataclasses.replace(CONFIG, drafts=drafts, polishes=polishes)
    params = tiny.random_params(aamdm_model.init, config)
    key, previous = jax.random.key(1), normal(3)
    found = jax.jit(aamdm_model.sampler(params, config=config))(key, previous)

    key_start, key_chain = jax.random.split(jax.random.clone(key))
    x = jax.random.normal(key_start, (3,))
    for t in range(config.num_steps, 0, -1):
        name, make = ("generator", aamdm_model.draft), ("polisher", aamdm_model.polish)
        part = name if t > polishes else make
        denoise = part[1](params[part[0]], previous, config=config)
        step = chain.ancestral_step(config.table(), denoise)
        x = step(jax.random.fold_in(key_chain, t), x, jnp.array(t))
    np.testing.assert_allclose(found, x, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("predict", ["frame", "change"])
def test_a_held_frame_stands_for_the_drafts(predict):
    """The frame before, noised to the step where polishing begins; no generator."""
    config = dataclasses.replace(CONFIG, predict=predict)
    change = CHANGE if predict == "change" else None
    polisher = parameters()["polisher"]
    sample = aamdm_model.sampler(
        {"polisher": polisher}, config=config, change=change, held=True
    )
    key, previous = jax.random.key(1), normal(3)
    found = jax.jit(sample)(key, previous)

    key_start, key_chain = jax.random.split(jax.random.clone(key))
    kept = config.table().alpha_bar[2]
    noise = jax.random.normal(key_start, (3,))
    x = jnp.sqrt(kept) * previous + jnp.sqrt(1 - kept) * noise
    denoise = aamdm_model.polish(polisher, previous, config=config, change=change)
    for t in (2, 1):
        step = chain.ancestral_step(config.table(), denoise)
        x = step(jax.random.fold_in(key_chain, t), x, jnp.array(t))
    np.testing.assert_allclose(found, x, rtol=1e-5, atol=1e-6)
    drafts = dataclasses.replace(config, drafts=5, polishes=0)
    with pytest.raises(ValueError, match="held: a chain of drafts alone"):
        aamdm_model.sampler({}, config=drafts, change=change, held=True)


@pytest.mark.slow
def test_characters_batch_by_vmap_and_compile_once():
    step = aamdm_model.sampler(parameters(), config=CONFIG)
    traced = chex.assert_max_traces(lambda *a: jax.vmap(step)(*a), n=1)
    run = jax.jit(traced)
    keys, previous = jax.random.split(jax.random.key(0), 4), normal(4, 3)
    together = run(keys, previous)
    run(jax.random.split(jax.random.key(9), 4), previous + 1)
    alone = jnp.stack([step(k, x) for k, x in zip(keys, previous, strict=True)])
    np.testing.assert_allclose(together, alone, rtol=1e-4, atol=1e-5)


def test_guidance_lowers_its_objective():
    step = aamdm_model.sampler(parameters(), config=CONFIG)
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


@pytest.mark.slow
@pytest.mark.parametrize("guided_steps", mostly_slow([None, 1, 3, 4], [1]))
def test_only_the_last_steps_are_guided(guided_steps):
    """Each step, one by one, with the gradient of the objective or without."""
    sample = aamdm_model.sampler(parameters(), config=CONFIG)
    key, previous = jax.random.key(1), normal(3)
    objective = lambda x: 0.5 * jnp.sum(jnp.square(x - 0.5))  # noqa: E731
    guide = dict(objective=objective, scale=0.3)
    found = jax.jit(functools.partial(sample, **guide, guided_steps=guided_steps))
    found = found(key, previous)

    key_start, key_chain = jax.random.split(jax.random.clone(key))
    x = jax.random.normal(key_start, (3,))
    for t in range(5, 0, -1):
        name, make = ("polisher", aamdm_model.polish)
        if t > 2:
            name, make = ("generator", aamdm_model.draft)
        denoise = make(parameters()[name], previous, config=CONFIG)
        if t <= (guided_steps or 5):
            denoise = guidance.gradient_guidance(
                CONFIG.table(), denoise, objective, scale=0.3
            )
        step = chain.ancestral_step(CONFIG.table(), denoise)
        x = step(jax.random.fold_in(key_chain, t), x, jnp.array(t))
    np.testing.assert_allclose(found, x, rtol=1e-5, atol=1e-6)


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
        now = aamdm_model.network(CONFIG).apply({"params": params}, x_t, t[i], own)
        errors.append(np.abs(now - windows[:, i]))
        changes.append(np.abs(now - own - windows[:, i] + windows[:, i - 1]))
        own = now
    np.testing.assert_allclose(terms["value"], np.mean(errors), rtol=1e-4)
    np.testing.assert_allclose(terms["velocity"], np.mean(changes), rtol=1e-4)
    np.testing.assert_allclose(
        loss, np.mean(errors) + 0.1 * np.mean(changes), rtol=1e-4
    )


@pytest.mark.slow
def test_each_player_moves_only_itself():
    params, windows = parameters(), normal(8, 3, 3)
    discriminate = functools.partial(aamdm_loss.discriminator_loss, config=CONFIG)
    make = functools.partial(aamdm_loss.generator_loss, config=CONFIG)
    given = params["discriminator"], params["generator"], jax.random.key(0), windows
    (loss, info), grad = jax.value_and_grad(discriminate, has_aux=True)(*given)
    expected = info["adversarial"] + 0.5 * CONFIG.weight_r1 * info["r1"]
    np.testing.assert_allclose(loss, expected, rtol=1e-6)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(grad))
    given = params["generator"], params["discriminator"], jax.random.key(0), windows
    _, grad = jax.value_and_grad(make, has_aux=True)(*given)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(grad))
    assert any(np.abs(x).max() > 0 for x in jax.tree.leaves(grad))


# --- networks that predict changes --------------------------------------------------


@pytest.mark.parametrize("shape", [(), (5,), (2, 5)])
def test_a_predicted_change_is_in_deviations(shape):
    found, previous = normal(*shape, 3), normal(*shape, 3, seed=1)
    frame = aamdm_model.to_frame(found, previous, CHANGE)
    expected = np.float64(previous) + np.float64(found) * [0.5, 0.1, 2.0]
    np.testing.assert_allclose(frame, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(aamdm_model.to_frame(found, previous, None), found)


@pytest.mark.parametrize(
    ("config", "change", "message"),
    [
        (CHANGING, None, "'change'.*is none"),
        (CONFIG, CHANGE, r"'frame'.*shape \(3,\)"),
    ],
)
def test_the_scale_of_changes_must_fit_what_is_predicted(config, change, message):
    params, windows, key = parameters(), normal(8, 5, 3), jax.random.key(0)
    given = dict(config=config, change=change)
    players = params["generator"], params["discriminator"]
    for make in (
        lambda: aamdm_model.check_change(config, change),
        lambda: aamdm_model.sampler(params, **given),
        lambda: aamdm_loss.polisher_loss(params["polisher"], key, windows, **given),
        lambda: aamdm_loss.generator_loss(*players, key, windows, **given),
        lambda: aamdm_loss.discriminator_loss(*players[::-1], key, windows, **given),
    ):
        with pytest.raises(ValueError, match=message):
            make()
    aamdm_model.check_change(CHANGING, CHANGE)
    aamdm_model.check_change(CONFIG, None)


def test_the_chain_denoises_frames_whatever_is_predicted():
    """Networks of frames that say what those of changes mean make the same frames."""
    params, key, previous = parameters(), jax.random.key(1), normal(3)
    step = aamdm_model.sampler(params, config=CHANGING, change=CHANGE)
    found = jax.jit(step)(key, previous)

    key_start, key_chain = jax.random.split(jax.random.clone(key))
    x = jax.random.normal(key_start, (3,))
    for t in range(5, 0, -1):
        name, make = ("generator", aamdm_model.draft), ("polisher", aamdm_model.polish)
        part = name if t > 2 else make
        change = part[1](params[part[0]], previous, config=CONFIG)
        frame = lambda *a, change=change: previous + CHANGE * change(*a)  # noqa: E731
        reverse = chain.ancestral_step(CHANGING.table(), frame)
        x = reverse(jax.random.fold_in(key_chain, t), x, jnp.array(t))
    np.testing.assert_allclose(found, x, rtol=1e-5, atol=1e-6)


class Constant:
    """A network that predicts the same whatever it sees."""

    def __init__(self, value):
        self.value = value

    def apply(self, params, x_t, t, previous, latent=None):
        return jnp.broadcast_to(self.value, x_t.shape)


def test_windows_of_an_even_change_cost_who_predicts_it_nothing(monkeypatch):
    pace = jnp.array([1.0, -2.0, 0.5])
    start = normal(6, 1, 3)
    frames = jnp.arange(5.0).reshape(1, 5, 1) * (pace * CHANGE).reshape(1, 1, 3)
    windows = start + frames
    given = dict(config=CHANGING, change=CHANGE)

    def loss(wrong):
        made = Constant((pace + wrong).reshape(1, 3))
        monkeypatch.setattr(aamdm_model, "network", lambda config: made)
        return aamdm_loss.polisher_loss({}, jax.random.key(0), windows, **given)

    value, terms = loss(0.0)
    np.testing.assert_allclose(value, 0.0, atol=1e-5)
    # An error of 0.3 deviations a frame adds up over the four frames of the window.
    value, terms = loss(0.3)
    np.testing.assert_allclose(terms["value"], 0.3 * (1 + 2 + 3 + 4) / 4, rtol=1e-4)
    np.testing.assert_allclose(terms["velocity"], 0.3, rtol=1e-4)
    np.testing.assert_allclose(value, 0.75 + 0.1 * 0.3, rtol=1e-4)


def test_errors_of_poses_are_those_of_whole_windows():
    config = dataclasses.replace(CONFIG, weight_pose=0.5)
    windows, key = normal(6, 5, 3), jax.random.key(2)
    seen = []

    def error(found, frames):
        seen.append((found, frames))
        return jnp.mean(jnp.square(found - frames))

    params = parameters()["polisher"]
    loss, terms = aamdm_loss.polisher_loss(
        params, key, windows, config=config, pose_error=error
    )
    (found, frames) = seen[0]
    np.testing.assert_array_equal(frames, windows)
    np.testing.assert_array_equal(found[:, 0], windows[:, 0])
    value = np.abs(np.float64(found) - np.float64(windows))[:, 1:].mean()
    np.testing.assert_allclose(terms["value"], value, rtol=1e-5)
    expected = terms["value"] + 0.1 * terms["velocity"] + 0.5 * terms["pose"]
    np.testing.assert_allclose(loss, expected, rtol=1e-5)
    for own, given in ((CONFIG, error), (config, None)):
        with pytest.raises(ValueError, match="weight_pose is"):
            aamdm_loss.polisher_loss(params, key, windows, config=own, pose_error=given)


# --- noise on given frames ---------------------------------------------------------


def test_each_row_has_noise_of_a_size_of_its_own():
    found = aamdm_loss.random_noise(jax.random.key(0), (2000, 200), largest=0.3)
    size = np.std(found, axis=1)
    expected = 0.3 * np.array([0.1, 0.5, 0.9])
    np.testing.assert_allclose(np.quantile(size, [0.1, 0.5, 0.9]), expected, rtol=0.1)
    assert size.max() < 0.3 * 1.3
    none = aamdm_loss.random_noise(jax.random.key(0), (20, 3), largest=0.0)
    np.testing.assert_array_equal(none, 0.0)


@pytest.mark.parametrize("largest", [0.0, 0.2])
def test_given_frames_are_shaken_in_deviations_of_frames(monkeypatch, largest):
    """Who adds the right change keeps the error of the first frame to the end."""
    pace = jnp.array([1.0, -2.0, 0.5])
    frames = jnp.arange(5.0).reshape(1, 5, 1) * (pace * CHANGE).reshape(1, 1, 3)
    windows = jnp.broadcast_to(frames, (3000, 5, 3))
    made = Constant(pace.reshape(1, 3))
    monkeypatch.setattr(aamdm_model, "network", lambda config: made)
    config = dataclasses.replace(CHANGING, previous_noise=largest)
    given = dict(config=config, change=CHANGE)
    _, terms = aamdm_loss.polisher_loss({}, jax.random.key(0), windows, **given)
    # Errors are measured in deviations of changes.
    error = largest / 2 * np.sqrt(2 / np.pi) * np.mean(1 / np.float64(CHANGE))
    np.testing.assert_allclose(terms["value"], error, rtol=0.05, atol=1e-5)
    np.testing.assert_allclose(terms["velocity"], error / 4, rtol=0.05, atol=1e-5)


@pytest.mark.parametrize(("config", "change"), [(CONFIG, None), (CHANGING, CHANGE)])
def test_players_are_given_shaken_frames(monkeypatch, config, change):
    seen = []

    class Discriminator:
        def apply(self, params, x, x_t, t, previous):
            seen.append(previous)
            return jnp.zeros(len(x))

    monkeypatch.setattr(aamdm_model, "discriminator", lambda config: Discriminator())
    monkeypatch.setattr(
        aamdm_model, "network", lambda config: Constant(jnp.zeros((1, 3)))
    )
    windows = jnp.broadcast_to(normal(1, 3, 3), (3000, 3, 3))
    for largest in (0.0, 0.2):
        own = dataclasses.replace(config, previous_noise=largest, own_previous=0.0)
        given = dict(config=own, change=change)
        aamdm_loss.generator_loss({}, {}, jax.random.key(0), windows, **given)
        noise = np.abs(np.float64(seen.pop()) - np.float64(windows[:, -2])).mean(0)
        expected = largest / 2 * np.sqrt(2 / np.pi) * np.ones(3)
        np.testing.assert_allclose(noise, expected, rtol=0.1, atol=1e-6)


@pytest.mark.parametrize("own_previous", [0.0, 1.0])
def test_players_are_given_the_generators_frames_through_a_window(
    monkeypatch, own_previous
):
    seen, pace = [], np.array([1.0, -2.0, 0.5])

    class Discriminator:
        def apply(self, params, x, x_t, t, previous):
            seen.append(previous)
            return jnp.zeros(len(x))

    monkeypatch.setattr(aamdm_model, "discriminator", lambda config: Discriminator())
    made = Constant(jnp.asarray(pace[None], jnp.float32))
    monkeypatch.setattr(aamdm_model, "network", lambda config: made)
    config = dataclasses.replace(CHANGING, own_previous=own_previous, gan_window=5)
    windows = normal(4, 5, 3)
    given = dict(config=config, change=CHANGE)
    aamdm_loss.generator_loss({}, {}, jax.random.key(0), windows, **given)
    # A generator that always adds the same change to the first frame.
    data = np.asarray(windows)
    expected = data[:, 1:4]
    if own_previous:
        changes = np.arange(1, 4)[:, None] * pace * np.asarray(CHANGE)
        expected = data[:, :1] + changes
    expected = np.swapaxes(expected, 0, 1).reshape(-1, 3)
    np.testing.assert_allclose(seen[0], expected, atol=1e-5)


def test_the_generators_own_frames_are_constants_of_its_gradient(monkeypatch):
    """A discriminator that sees only what stands before a frame teaches it nothing."""

    class Generator:
        def apply(self, variables, x_t, t, previous, latent=None):
            return jnp.broadcast_to(variables["params"], x_t.shape)

    class Discriminator:
        def apply(self, variables, x, x_t, t, previous):
            return jnp.sum(previous, axis=-1)

    monkeypatch.setattr(aamdm_model, "discriminator", lambda config: Discriminator())
    monkeypatch.setattr(aamdm_model, "network", lambda config: Generator())
    config = dataclasses.replace(CHANGING, own_previous=1.0, gan_window=5)

    def loss(pace):
        given = pace, {}, jax.random.key(0), normal(4, 5, 3)
        return aamdm_loss.generator_loss(*given, config=config, change=CHANGE)[0]

    pace = jnp.array([[1.0, -2.0, 0.5]])
    assert float(jnp.abs(loss(pace) - loss(2.0 * pace))) > 0.1
    np.testing.assert_array_equal(jax.grad(loss)(pace), 0.0)


# --- levels of noise ----------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("levels", ["all", "own"])
def test_networks_learn_the_steps_that_the_chain_asks_them_for(monkeypatch, levels):
    seen = []

    class Watched:
        def apply(self, params, x_t, t, previous, latent=None):
            jax.debug.callback(lambda t: seen.extend(np.ravel(t).tolist()), t)
            return jnp.zeros_like(x_t)

    monkeypatch.setattr(aamdm_model, "network", lambda config: Watched())
    monkeypatch.setattr(
        aamdm_model, "discriminator", lambda config: Constant(jnp.zeros((1,)))
    )
    config = dataclasses.replace(CONFIG, levels=levels)
    windows = normal(400, 6, 3)
    for loss, own in (
        (aamdm_loss.polisher_loss, range(1, config.polishes + 1)),
        (
            functools.partial(aamdm_loss.discriminator_loss, {}),
            range(config.polishes + 1, config.num_steps + 1),
        ),
    ):
        seen.clear()
        jax.block_until_ready(loss({}, jax.random.key(0), windows, config=config))
        jax.effects_barrier()
        every = range(1, config.num_steps + 1)
        assert set(seen) == set(own if levels == "own" else every)
