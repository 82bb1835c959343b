"""EMDM's losses against oracles, and what the two networks are given."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxmotion.diffusion import gan
from jaxmotion.learning import adversarial, training
from jaxmotion.systems.emdm import loss as emdm_loss
from jaxmotion.systems.emdm import model as emdm_model
from tests import mostly_slow, tiny
from tests.reference import diffusion
from tests.reference import emdm as reference
from tests.systems.emdm import test_discriminator
from tests.tiny import float32

# Four joints, and a translation that the velocity loss leaves out.
CONFIG = emdm_model.Config(
    features=15,
    frames=6,
    condition_size=4,
    num_steps=4,
    latent=5,
    width=16,
    depth=1,
    heads=2,
    hidden=16,
    discriminator_width=128,
    weight_r1=0.5,
    weight_recon=2.0,
    weight_position=3.0,
    weight_velocity=5.0,
    weight_position_velocity=11.0,
    weight_acceleration=13.0,
    weight_foot=7.0,
)
DDPM = dataclasses.replace(CONFIG, latent=0, schedule="cosine")
WEIGHTS = dict(reconstruction=2.0, position=3.0, velocity=5.0, foot=7.0)
WEIGHTS |= dict(position_velocity=11.0, acceleration=13.0)
# The oracle's names of the terms.
NAMES = {
    "recon": "reconstruction",
    "position": "position",
    "velocity": "velocity",
    "position_velocity": "position_velocity",
    "acceleration": "acceleration",
    "foot": "foot",
}


def joints(x):
    return x[..., :12].reshape(*x.shape[:-1], 4, 3)


GEOMETRY = emdm_loss.Geometry(
    positions=joints, feet=(1, 3), channels=slice(0, 12), fps=20.0
)


def batch(*lengths, seed=0, config=CONFIG):
    """Motions whose feet move by up to 2 cm a frame: about half of them stand."""
    rng = np.random.default_rng(seed)
    steps = rng.uniform(-0.01, 0.01, (len(lengths), 6, 15))
    mask = np.arange(6)[None] < np.array(lengths)[:, None]
    x_0 = (rng.normal(size=(len(lengths), 1, 15)) + steps.cumsum(1)) * mask[..., None]
    actions = rng.integers(0, 4, len(lengths))
    return emdm_loss.Batch(
        x_0=float32(x_0), vector=float32(np.eye(4)[actions]), mask=jnp.asarray(mask)
    )


@functools.cache
def parameters(config=CONFIG):
    return tiny.random_params(emdm_model.init, config)


class Recorder:
    """A network that keeps what it is given and what it returns."""

    def __init__(self, net, seen):
        self.net, self.seen = net, seen

    def apply(self, *given, **options):
        out = self.net.apply(*given, **options)
        self.seen.append((given[1:], options, out))
        return out


class Plain:
    """A network in one line: of its parameters and its first input."""

    def __init__(self, function):
        self.function = function

    def apply(self, params, x, *given, **options):
        return self.function(params["params"], x)


def constant(value):
    """A generator that predicts the same whatever it sees."""
    return Plain(lambda params, x: jnp.full_like(x, value))


# A discriminator with a gradient of ones.
SUM = Plain(lambda params, x: jnp.sum(x, axis=(-1, -2)))


@pytest.fixture
def watch(monkeypatch):
    """Replaces a network by a recorder of it, or of another one."""

    def start(name, other=None):
        seen, make = [], getattr(emdm_model, name)
        recorder = lambda config: Recorder(other or make(config), seen)  # noqa: E731
        monkeypatch.setattr(emdm_model, name, recorder)
        return seen

    return start


def logits(params, calls):
    """The oracle's logits of recorded calls of a discriminator."""
    return [
        [
            reference.discriminator(
                params, *map(np.float64, pair), int(t) - 1, vector, groups=(4, 2)
            )
            for *pair, t, vector in zip(*args, strict=True)
        ]
        for args, _ in calls
    ]


# --- two players -------------------------------------------------------------------


def test_discriminator_loss_is_the_formula(watch):
    params, data, seen = parameters(), batch(6, 4, 6), watch("discriminator")

    @jax.jit
    def run(penalized):
        seen.clear()
        given = params["discriminator"], params["generator"], jax.random.key(0), data
        found = emdm_loss.discriminator_loss(*given, config=CONFIG, penalized=penalized)
        # Later calls are those of the penalty.
        return *found, [(call[0], call[2]) for call in seen[:2]]

    loss, info, calls = run(jnp.bool_(True))
    own = test_discriminator.oracle(params["discriminator"])
    real, fake = logits(own, calls)
    for call, expected in zip(calls, (real, fake), strict=True):
        np.testing.assert_allclose(call[1], expected, rtol=1e-3, atol=1e-4)
    assert np.abs(np.subtract(real, fake)).max() > 1e-3
    expected = reference.discriminator_loss(real, fake)
    x_prev, x_t, t, vector = (np.float64(x) for x in calls[0][0])

    def discriminate(x, i):
        return reference.discriminator(
            own, x, x_t[i], int(t[i]) - 1, vector[i], groups=(4, 2)
        )

    penalty = reference.r1(discriminate, x_prev, gamma=CONFIG.weight_r1)
    np.testing.assert_allclose(info["adversarial"], expected, rtol=1e-4)
    np.testing.assert_allclose(0.25 * info["r1"], penalty, rtol=2e-3)
    np.testing.assert_allclose(loss, expected + penalty, rtol=1e-4)
    assert penalty > 1e-4
    # The same pairs without it.
    without, info, _ = run(jnp.bool_(False))
    assert info["r1"] == 0.0 and without == info["adversarial"]
    np.testing.assert_allclose(without, expected, rtol=1e-4)


@pytest.mark.parametrize("weight", [0.5, 0.0])
def test_a_penalty_is_half_its_weight_of_the_squared_gradient(watch, weight):
    watch("generator", constant(0.2))
    watch("discriminator", SUM)
    config = dataclasses.replace(CONFIG, weight_r1=weight)
    given = {}, {}, jax.random.key(0), batch(6, 6)
    loss, info = emdm_loss.discriminator_loss(
        *given, config=config, penalized=jnp.bool_(True)
    )
    squared = 6 * 15 * (weight > 0)
    np.testing.assert_allclose(info["r1"], squared, rtol=1e-5)
    expected = info["adversarial"] + weight / 2 * squared
    np.testing.assert_allclose(loss, expected, rtol=1e-5)


def test_relativistic_losses_are_of_pairs_of_one_place(watch):
    """Both players judge the same differences; the penalty is at both pairs."""
    watch("generator", constant(0.2))
    config = dataclasses.replace(CONFIG, discriminator_loss="relativistic")
    seen = watch("discriminator", SUM)
    key, data = jax.random.key, batch(6, 6)
    loss, info = emdm_loss.discriminator_loss(
        {}, {}, key(0), data, config=config, penalized=jnp.bool_(True)
    )
    real, fake = (np.float64(call[2]) for call in seen[:2])
    expected = np.log1p(np.exp(fake - real)).mean()
    assert np.ptp(real - fake) > 0.1
    np.testing.assert_allclose(info["adversarial"], expected, rtol=1e-4)
    np.testing.assert_allclose(info["r1"], 2 * 6 * 15, rtol=1e-5)
    total = expected + config.weight_r1 / 2 * 2 * 6 * 15
    np.testing.assert_allclose(loss, total, rtol=1e-5)
    seen.clear()
    _, info = emdm_loss.generator_loss(
        {}, {}, key(0), data, config=config, geometry=None
    )
    fake, real = (np.float64(call[2]) for call in seen)
    expected = np.log1p(np.exp(real - fake)).mean()
    np.testing.assert_allclose(info["adversarial"], expected, rtol=1e-4)


def test_a_discriminator_may_judge_noisy_steps_alone(watch):
    """Below, it is shown nothing, and the generator has no verdict."""
    watch("generator", constant(0.2))
    data, key = batch(*[6] * 40), jax.random.key
    config = dataclasses.replace(CONFIG, discriminator_from=3)
    seen = watch("discriminator", SUM)
    options = dict(config=config, penalized=jnp.bool_(False))
    emdm_loss.discriminator_loss({}, {}, key(0), data, **options)
    steps = np.asarray(seen[0][0][2])
    assert set(steps) == {3, 4}
    seen.clear()
    _, info = emdm_loss.generator_loss(
        {}, {}, key(0), data, config=config, geometry=None
    )
    steps, logits = np.asarray(seen[0][0][2]), np.float64(seen[0][2])
    assert set(steps) == {1, 2, 3, 4}
    expected = np.log1p(np.exp(-logits[steps >= 3])).mean()
    np.testing.assert_allclose(info["adversarial"], expected, rtol=1e-4)


def test_generator_loss_is_the_formula(watch):
    params, data = parameters(), batch(6, 6, 6)
    made, discriminated = watch("generator"), watch("discriminator")

    @jax.jit
    def run(*given):
        value, info = emdm_loss.generator_loss(*given, config=CONFIG, geometry=GEOMETRY)
        return value, info, made[-1][2], [(discriminated[-1][0], None)]

    given = params["generator"], params["discriminator"], jax.random.key(0), data
    value, info, prediction, calls = run(*given)
    (fake,) = logits(test_discriminator.oracle(params["discriminator"]), calls)
    expected = reference.generator_loss(fake)
    np.testing.assert_allclose(info["adversarial"], expected, rtol=1e-4)
    terms = oracle_terms(prediction, data)
    for name, own in NAMES.items():
        np.testing.assert_allclose(info[name], terms[own], rtol=1e-4)
    total = expected + reference.geometric_loss(terms, **WEIGHTS)
    np.testing.assert_allclose(value, total, rtol=1e-4)


def test_the_discriminators_gradient_stops_at_the_generator(watch):
    watch("generator", Plain(lambda params, x: params * x))
    watch("discriminator", SUM)
    data, key = batch(6, 4), jax.random.key
    config = dataclasses.replace(CONFIG, weight_r1=0.0)

    def discriminate(scale, params, key, data):
        options = dict(config=config, penalized=jnp.bool_(False))
        return emdm_loss.discriminator_loss(params, scale, key, data, **options)

    make = functools.partial(emdm_loss.generator_loss, config=config, geometry=GEOMETRY)
    slopes = [
        jax.jit(jax.grad(loss, has_aux=True))(jnp.float32(0.5), {}, key(0), data)[0]
        for loss in (discriminate, make)
    ]
    assert slopes[0] == 0.0 != slopes[1]


# --- what they are given -----------------------------------------------------------

ONE = dataclasses.replace(CONFIG, features=1, frames=2)
MANY = 6000


def many(value=0.7):
    return emdm_loss.Batch(
        x_0=jnp.full((MANY, 2, 1), value),
        vector=float32(np.eye(4)[np.arange(MANY) % 4]),
        mask=jnp.ones((MANY, 2), bool),
    )


def test_pairs_are_those_of_the_diffusion(watch):
    """Real ones by the noising of 0.7, made ones by the posterior of 0.2."""
    watch("generator", constant(0.2))
    seen = watch("discriminator", SUM)
    emdm_loss.discriminator_loss(
        {}, {}, jax.random.key(7), many(), config=ONE, penalized=jnp.bool_(False)
    )
    (x_prev, x_t, t, vector), (fake, same, *_) = (call[0] for call in seen[:2])
    x_prev, x_t, fake, same = (
        np.float64(x).reshape(MANY, 2) for x in (x_prev, x_t, fake, same)
    )
    t = np.asarray(t, int)
    np.testing.assert_array_equal(same, x_t)
    np.testing.assert_array_equal(vector, many().vector)
    counts = np.bincount(t, minlength=5)
    assert counts[0] == 0 and len(counts) == 5
    assert np.abs(counts[1:] / MANY - 0.25).max() < 4 * np.sqrt(0.25 * 0.75 / MANY)
    betas = reference.vp_variances(4)
    for step in range(1, 5):
        own, n = t == step, 2 * counts[step]
        wanted = reference.pair_moments(betas, step - 1, 0.7)
        a, b = x_prev[own], x_t[own]
        for x, end in ((a, ""), (b, "_next")):
            spread = wanted[f"variance{end}"]
            error = np.abs(x.mean() - wanted[f"mean{end}"])
            assert error <= 4.5 * np.sqrt(spread / n) + 1e-6
            assert np.abs(x.var() - spread) <= 4.5 * spread * np.sqrt(2 / n) + 1e-9
        together = np.mean((a - a.mean()) * (b - b.mean())) - wanted["covariance"]
        size = np.sqrt(wanted["variance"] * wanted["variance_next"] * 2 / n)
        assert np.abs(together) <= 4.5 * size + 1e-9
        mean, variance = reference.posterior(betas, step - 1, 0.2, b)
        if step == 1:
            np.testing.assert_allclose(a, 0.7, rtol=1e-6)
            np.testing.assert_allclose(fake[own], 0.2, rtol=1e-6)
            continue
        noise = (fake[own] - mean) / np.sqrt(variance)
        assert np.abs(noise.mean()) < 4.5 / np.sqrt(n)
        assert np.abs(noise.var() - 1.0) < 4.5 * np.sqrt(2 / n)
        assert np.abs(np.mean(noise * (a - a.mean()) / a.std())) < 4.5 / np.sqrt(n)


@pytest.mark.slow
@pytest.mark.parametrize("mask_frames", [True, False])
@pytest.mark.parametrize("conditional", mostly_slow([True, False], [True]))
def test_the_discriminator_sees_motions_to_their_end(watch, mask_frames, conditional):
    config = dataclasses.replace(
        CONFIG, mask_frames=mask_frames, discriminator_condition=conditional
    )
    watch("generator", constant(0.2))
    data, seen = batch(2, 6, 4), watch("discriminator", SUM)
    given = {}, {}, jax.random.key(0), data
    emdm_loss.discriminator_loss(*given, config=config, penalized=jnp.bool_(False))
    given = {}, {}, jax.random.key(1), data
    emdm_loss.generator_loss(*given, config=config, geometry=GEOMETRY)
    calls = [seen[0], seen[1], seen[-1]]
    behind = ~np.asarray(data.mask)
    for (x_prev, x_t, _, vector), *_ in calls:
        for x in (x_prev, x_t):
            assert np.abs(x[~behind]).min() > 0.0
            assert (np.abs(x[behind]).max() == 0.0) == mask_frames
        assert vector.shape == (3, 4 if conditional else 0)
        if conditional:
            np.testing.assert_array_equal(vector, data.vector)


@pytest.mark.parametrize("rate", mostly_slow([0.0, 0.3, 1.0], [0.3]))
def test_the_generator_loses_its_condition_at_a_rate(watch, rate):
    """In both ways to train one; the discriminator keeps it."""
    config = dataclasses.replace(ONE, drop_condition=rate)
    seen, discriminated = watch("generator", constant(0.0)), watch("discriminator", SUM)
    data, options = many(), dict(config=config, geometry=None)
    emdm_loss.generator_loss({}, {}, jax.random.key(0), data, **options)
    plain = dataclasses.replace(config, latent=0)
    emdm_loss.diffusion_loss({}, jax.random.key(1), data, config=plain, geometry=None)
    emdm_loss.diffusion_loss({}, jax.random.key(2), data, **options)
    np.testing.assert_array_equal(discriminated[0][0][3], data.vector)
    assert seen[1][0][-1] is None
    for call in (seen[0], seen[2]):
        latent = np.asarray(call[0][-1])
        assert latent.shape == (MANY, 5) and np.abs(latent.std() - 1.0) < 0.02
    for (_, t, vector, keep, mask, _), options, _ in seen:
        np.testing.assert_array_equal(vector, data.vector)
        assert np.asarray(mask).all() and set(np.unique(t)) == {1, 2, 3, 4}
        assert options["train"] and "dropout" in options["rngs"]
        spread = np.sqrt(rate * (1 - rate) / MANY)
        assert np.abs(1.0 - np.mean(keep) - rate) <= 4.5 * spread


@pytest.mark.parametrize("mask_frames", [True, False])
def test_the_generator_is_told_where_motions_end(watch, mask_frames):
    seen, data = watch("generator", constant(0.0)), batch(2, 6, 4)
    watch("discriminator", SUM)
    options = dict(
        config=dataclasses.replace(CONFIG, mask_frames=mask_frames), geometry=GEOMETRY
    )
    emdm_loss.generator_loss({}, {}, jax.random.key(0), data, **options)
    emdm_loss.diffusion_loss({}, jax.random.key(1), data, **options)
    assert len(seen) == 2
    for (*_, mask, _), _, _ in seen:
        np.testing.assert_array_equal(mask, np.asarray(data.mask) | (not mask_frames))


# --- geometry ----------------------------------------------------------------------


def oracle_terms(prediction, data):
    prediction, x_0 = np.float64(prediction), np.float64(data.x_0)
    return reference.geometric_terms(
        prediction,
        x_0,
        joints(prediction),
        joints(x_0),
        np.asarray(data.mask, float),
        GEOMETRY.feet,
        translation=slice(12, 15),
    )


def guess(data, seed=1):
    noise = np.random.default_rng(seed).normal(size=data.x_0.shape)
    return data.x_0 + float32(0.3 * noise)


def terms_of(prediction, data, config=CONFIG, t=1):
    run = functools.partial(emdm_loss.geometric_loss, config=config, geometry=GEOMETRY)
    return jax.jit(run)(prediction, data, jnp.full(data.x_0.shape[0], t))


def test_geometric_terms_are_the_formulas():
    data = batch(6, 6, 6, 6)
    prediction = guess(data)
    total, found = terms_of(prediction, data)
    expected = oracle_terms(prediction, data)
    feet = joints(np.float64(data.x_0))[..., GEOMETRY.feet, :]
    speed = np.linalg.norm(np.diff(feet, axis=1), axis=-1)
    assert 0.2 < np.mean(speed < 0.01) < 0.8 and expected["foot"] > 0.0
    for name, own in NAMES.items():
        np.testing.assert_allclose(found[name], expected[own], rtol=1e-4)
    weighted = reference.geometric_loss(expected, **WEIGHTS)
    np.testing.assert_allclose(total, weighted, rtol=1e-4)


@pytest.mark.parametrize("length", mostly_slow([1, 3, 6], [3]))
def test_geometric_terms_of_a_motion_are_of_its_frames(length):
    data = batch(length)
    prediction = guess(data)
    _, found = terms_of(prediction, data)
    expected = oracle_terms(prediction, data) if length > 1 else None
    if length == 1:
        error = np.float64(prediction - data.x_0)[0, 0]
        expected = {
            "reconstruction": np.mean(error**2),
            "position": np.mean(error[:12] ** 2),
            "velocity": 0.0,
        }
    for name in ("recon", "position", "velocity"):
        np.testing.assert_allclose(found[name], expected[NAMES[name]], rtol=1e-4)
    # Whatever lies after the end has no part in any of them.
    beyond = jnp.where(data.mask[..., None], prediction, 50.0)
    for name, value in terms_of(beyond, data)[1].items():
        np.testing.assert_allclose(value, found[name], rtol=1e-5)


def test_losses_of_unequal_lengths_are_the_released_ones():
    config = dataclasses.replace(CONFIG, mask_frames=False)
    data = batch(2, 3, 6)
    prediction = guess(data)
    total, found = terms_of(prediction, data, config)
    expected = oracle_terms(prediction, data)
    for name, own in NAMES.items():
        np.testing.assert_allclose(found[name], expected[own], rtol=1e-5)
    weighted = reference.geometric_loss(expected, **WEIGHTS)
    np.testing.assert_allclose(total, weighted, rtol=1e-5)


def test_every_frame_of_unequal_lengths_counts_the_same():
    """The means of single motions, weighted by the frames or steps that they have."""
    lengths = (2, 3, 6)
    data = batch(*lengths)
    prediction = guess(data)
    _, found = terms_of(prediction, data)
    cut = lambda x, i: jax.tree.map(lambda a: a[i : i + 1], x)  # noqa: E731
    alone = [oracle_terms(prediction[i : i + 1], cut(data, i)) for i in range(3)]
    for name, own in NAMES.items():
        order = {"recon": 0, "position": 0, "acceleration": 2}.get(name, 1)
        counts = np.array(lengths) - order
        expected = np.average([terms[own] for terms in alone], weights=counts)
        np.testing.assert_allclose(found[name], expected, rtol=1e-5)


def test_standing_feet_must_not_move_and_others_may():
    """One foot stands, one walks; both are predicted to walk a centimeter a frame."""
    x_0, walk = np.zeros((1, 6, 15)), 0.01 * np.arange(6)
    x_0[0, :, 3 * 3] = 0.03 * np.arange(6)
    for foot, expected in ((1, 0.01**2 / 6), (3, 0.0)):
        made = x_0.copy()
        made[0, :, 3 * foot] += walk
        data = emdm_loss.Batch(
            x_0=float32(x_0), vector=jnp.eye(4)[:1], mask=jnp.ones((1, 6), bool)
        )
        _, found = terms_of(float32(made), data)
        # A mean over three coordinates and two feet.
        np.testing.assert_allclose(found["foot"], expected, rtol=1e-4, atol=1e-9)


def test_without_a_geometry_only_features_count():
    data = batch(6, 6)
    prediction = guess(data)
    total, found = emdm_loss.geometric_loss(
        prediction, data, jnp.ones(2, int), config=CONFIG, geometry=None
    )
    assert set(found) == {"recon"}
    np.testing.assert_allclose(total, 2.0 * found["recon"], rtol=1e-6)


def test_losses_of_joints_fade_with_the_noise():
    data = batch(6, 6)
    prediction = guess(data)
    _, plain = terms_of(prediction, data)
    config = dataclasses.replace(CONFIG, fade_geometry=True)
    for t in (1, 3):
        total, found = terms_of(prediction, data, config, t)
        part = float(config.table().alpha_bar[t])
        np.testing.assert_allclose(found["recon"], plain["recon"], rtol=1e-6)
        expected = 2.0 * plain["recon"]
        for name, weight in list(WEIGHTS.items())[1:]:
            np.testing.assert_allclose(found[name], part * plain[name], rtol=1e-4)
            expected += weight * part * plain[name]
        np.testing.assert_allclose(total, expected, rtol=1e-4)


def test_errors_count_as_the_posterior_weighs_the_verdict():
    """The gradient of x_{t-1} in the prediction, by automatic differentiation."""
    data = batch(6, 6)
    prediction = guess(data)
    _, plain = terms_of(prediction, data)
    config = dataclasses.replace(CONFIG, weigh_levels="posterior")
    x_t = jnp.zeros_like(prediction)
    for t in (1, 2, 3):
        step = jnp.full(2, t)
        draw = functools.partial(
            gan.posterior_sample, config.table(), jax.random.key(0), x_t=x_t, t=step
        )
        weight = jax.grad(lambda x, draw=draw: draw(x_0=x).mean())(prediction)
        weight = float(weight.mean() * prediction.size)
        _, found = terms_of(prediction, data, config, t)
        for name in plain:
            np.testing.assert_allclose(found[name], weight * plain[name], rtol=1e-4)
    both = dataclasses.replace(config, fade_geometry=True)
    _, found = terms_of(prediction, data, both, 3)
    part = weight * float(config.table().alpha_bar[3])
    np.testing.assert_allclose(found["foot"], part * plain["foot"], rtol=1e-4)


# --- MDM ---------------------------------------------------------------------------


def test_diffusion_loss_is_the_formula(watch):
    params, data, seen = parameters(DDPM), batch(6, 6, 6), watch("generator")
    loss = functools.partial(emdm_loss.diffusion_loss, config=DDPM, geometry=GEOMETRY)

    @jax.jit
    def run(*given):
        seen.clear()
        return *loss(*given), seen[0][2]

    value, info, prediction = run(params["generator"], jax.random.key(0), data)
    terms = oracle_terms(prediction, data)
    for name, own in NAMES.items():
        np.testing.assert_allclose(info[name], terms[own], rtol=1e-4)
    weighted = reference.geometric_loss(terms, **WEIGHTS)
    np.testing.assert_allclose(value, weighted, rtol=1e-4)


def test_a_denoiser_is_shown_data_noised_by_its_schedule(watch):
    config = dataclasses.replace(ONE, latent=0, schedule="cosine")
    seen = watch("generator", constant(0.2))
    given = {}, jax.random.key(3), many()
    loss, _ = emdm_loss.diffusion_loss(*given, config=config, geometry=None)
    x_t, t, *_ = seen[0][0]
    np.testing.assert_allclose(loss, 2.0 * 0.5**2, rtol=1e-5)
    alpha_bar = np.cumprod(1 - diffusion.cosine_betas(4))
    for step in range(1, 5):
        own = np.float64(x_t)[np.asarray(t) == step].ravel()
        at, n = alpha_bar[step - 1], own.size
        assert np.abs(own.mean() - np.sqrt(at) * 0.7) < 4.5 * np.sqrt((1 - at) / n)
        assert np.abs(own.var() / (1 - at) - 1.0) < 4.5 * np.sqrt(2 / n)


# --- learning ----------------------------------------------------------------------

# One number a motion, N(1.5, 0.5^2), and no loss but the adversarial one.
TOY = emdm_model.Config(
    features=1,
    frames=1,
    condition="none",
    condition_size=0,
    num_steps=2,
    latent=4,
    width=16,
    depth=1,
    heads=2,
    hidden=16,
    dropout=0.0,
    discriminator_width=128,
    weight_recon=0.0,
    weight_r1=0.0,
)


@functools.cache
def toy_chunk():
    """A hundred updates of both players, `(state, key, rates) -> (state, info)`."""

    def draw(key):
        return emdm_loss.Batch(
            x_0=1.5 + 0.5 * jax.random.normal(key, (64, 1, 1)),
            vector=jnp.zeros((64, 0)),
            mask=jnp.ones((64, 1), bool),
        )

    def run(state, key, rates):
        discriminate = functools.partial(
            emdm_loss.discriminator_loss, config=TOY, penalized=jnp.bool_(False)
        )
        make = functools.partial(emdm_loss.generator_loss, config=TOY, geometry=None)
        optimizers = tuple(
            optax.chain(
                training.make_optimizer("adam", learning_rate=1.0), optax.scale(rate)
            )
            for rate in rates
        )
        update = adversarial.make_gan_update(
            discriminate, make, optimizers, ema_decay=0.9
        )

        def one(state, key):
            key_batch, key_loss = jax.random.split(key)
            return update(state, key_loss, draw(key_batch))

        return jax.lax.scan(one, state, jax.random.split(key, 100))

    return jax.jit(run)


def toy_state():
    params, optimizer = (
        parameters(TOY),
        optax.chain(
            training.make_optimizer("adam", learning_rate=1e-4), optax.scale(1)
        ),
    )
    return adversarial.GanState(
        **{name: training.init_train_state(params[name], optimizer) for name in params}
    )


@pytest.mark.slow
@pytest.mark.parametrize("mover", ["generator", "discriminator"])
def test_no_player_moves_the_other(mover):
    state = toy_state()
    rates = tuple(1e-3 * (mover == name) for name in ("generator", "discriminator"))
    after, info = toy_chunk()(state, jax.random.key(0), jnp.array(rates))
    for name in ("generator", "discriminator"):
        new, old = getattr(after, name).params, getattr(state, name).params
        gap = jax.tree.map(lambda a, b: np.abs(a - b).max(), new, old)
        assert max(jax.tree.leaves(gap)) > 1e-4 if name == mover else True
        assert max(jax.tree.leaves(gap)) == 0.0 if name != mover else True
    # Against a player that stands still, the other one gains.
    loss = info["loss" if mover == "generator" else "discriminator/loss"]
    assert np.mean(loss[-20:]) < np.mean(loss[:20]) - 0.05


@pytest.mark.slow
def test_two_players_learn_a_mean_and_a_spread():
    @jax.jit
    def moments(params, key):
        condition = emdm_model.Condition(
            vector=jnp.zeros(0), keep=jnp.array(True), mask=jnp.ones(1, bool)
        )
        sample = emdm_model.sampler(params, config=TOY)
        x = jax.vmap(lambda k: sample(k, condition))(jax.random.split(key, 512))
        return jnp.mean(x), jnp.std(x)

    state = toy_state()
    before, _ = moments(state.generator.params, jax.random.key(1))
    assert np.abs(before - 1.5) > 1.0
    for seed in range(3):
        state, info = toy_chunk()(state, jax.random.key(seed), jnp.array([1e-3, 1e-3]))
        assert np.isfinite(info["loss"]).all()
    mean, spread = moments(state.generator.ema_params, jax.random.key(1))
    assert np.abs(mean - 1.5) < 0.3
    assert 0.2 < spread < 1.0
