import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.diffusion import chain, schedule
from tests import mostly_slow, tiny
from tests.reference import diffusion as reference

MEAN, VARIANCE = 1.5, 0.30
T = 8


def random(seed, shape=(5, 3)):
    return tiny.float32(np.random.default_rng(seed).normal(size=shape))


def tanh_denoiser(key, x_t, t):
    """Nonlinear, deterministic, and different at every step."""
    del key
    return jnp.tanh(1.3 * x_t + 0.1 * t.astype(x_t.dtype))


def noisy_denoiser(key, x_t, t):
    latent = jax.random.normal(key, x_t.shape)
    return tanh_denoiser(None, x_t, t) + 0.2 * latent


def exact_denoiser(betas, stochastic=False):
    """Posterior mean (or a posterior sample) of x_0 ~ N(MEAN, VARIANCE)."""
    pairs = [
        [
            *(
                reference.exact_denoiser(betas, i, x, MEAN, VARIANCE)[0]
                for x in (0.0, 1.0)
            ),
            reference.exact_denoiser(betas, i, 0.0, MEAN, VARIANCE)[1],
        ]
        for i in range(len(betas))
    ]
    at_zero, at_one, spread = jnp.asarray(np.transpose(pairs), jnp.float32)
    slope = at_one - at_zero

    def denoise(key, x_t, t):
        x_0 = at_zero[t - 1] + slope[t - 1] * x_t
        if not stochastic:
            return x_0
        return x_0 + jnp.sqrt(spread[t - 1]) * jax.random.normal(key, x_t.shape)

    return denoise


@pytest.mark.parametrize(
    ("num_steps", "stochastic"),
    mostly_slow(
        [(4, False), (8, False), (50, False), (2, True), (4, True), (8, True)],
        [(8, False), (4, True)],
    ),
)
def test_output_moments_of_an_exact_denoiser(num_steps, stochastic):
    betas = reference.cosine_betas(num_steps)
    mean, variance = reference.ancestral_moments(betas, MEAN, VARIANCE, stochastic)
    denoise = exact_denoiser(betas, stochastic)
    step = chain.ancestral_step(schedule.cosine_schedule(num_steps), denoise)
    n = 200_000
    x = chain.sample(step, jax.random.key(3), (n,), num_steps=num_steps)
    # z-scores: 4 standard errors of a normal sample's mean and variance.
    assert abs(float(x.mean()) - mean) / np.sqrt(variance / n) < 4
    assert abs(float(x.var()) / variance - 1) / np.sqrt(2 / n) < 4


def test_only_a_stochastic_denoiser_keeps_the_data_variance():
    betas = reference.cosine_betas(T)
    shares = [
        reference.ancestral_moments(betas, MEAN, VARIANCE, stochastic)[1] / VARIANCE
        for stochastic in (False, True)
    ]
    np.testing.assert_allclose(shares, [0.5647, 1.0], atol=1e-4)


def test_ancestral_step_is_the_published_update():
    table = reference.coefficients(reference.cosine_betas(T))
    x_t, key = random(0), jax.random.key(5)
    step = chain.ancestral_step(schedule.cosine_schedule(T), tanh_denoiser)
    for t in range(1, T + 1):
        found = step(jax.random.clone(key), x_t, jnp.array(t))
        noise = jax.random.normal(jax.random.split(jax.random.clone(key))[1], x_t.shape)
        i = t - 1
        x_0 = np.tanh(1.3 * np.float64(x_t) + 0.1 * t)
        expected = table["c1"][i] * x_0 + table["c2"][i] * np.float64(x_t)
        expected += np.sqrt(table["v"][i]) * np.float64(noise)
        np.testing.assert_allclose(found, expected, atol=2e-6)


def test_ancestral_step_takes_the_noise_that_it_is_given():
    table = schedule.cosine_schedule(T)
    x_t, noise = random(0), random(1, (T, 5, 3))
    step = chain.ancestral_step(table, tanh_denoiser, noise=noise)
    for t in (1, 3, T):
        found = step(jax.random.key(t), x_t, jnp.array(t))
        x_0 = tanh_denoiser(None, x_t, jnp.array(t))
        mean, variance = schedule.posterior(table, x_0, x_t, jnp.array(t))
        expected = mean + jnp.sqrt(variance) * noise[t - 1]
        np.testing.assert_allclose(found, expected, atol=2e-6)


@pytest.mark.parametrize("eta", [0.0, 0.4, 1.0])
def test_ddim_step_is_the_published_update(eta):
    betas = reference.vp_betas(T)
    x_t, key = random(0), jax.random.key(5)
    step = chain.ddim_step(schedule.vp_schedule(T), tanh_denoiser, eta=eta)
    for t in range(1, T + 1):
        found = step(jax.random.clone(key), x_t, jnp.array(t))
        noise = jax.random.normal(jax.random.split(jax.random.clone(key))[1], x_t.shape)
        x_0 = np.tanh(1.3 * np.float64(x_t) + 0.1 * t)
        expected = reference.ddim(
            betas, t - 1, x_0, np.float64(x_t), np.float64(noise), eta
        )
        np.testing.assert_allclose(found, expected, atol=3e-6)


@pytest.mark.slow
@pytest.mark.parametrize("make", [schedule.cosine_schedule, schedule.vp_schedule])
def test_ddim_with_full_noise_is_ancestral(make):
    table = make(T)
    key, x = jax.random.key(0), random(1)
    for denoise in (tanh_denoiser, noisy_denoiser):
        one, other = (
            chain.reverse_chain(step, jax.random.clone(key), x, start=T)
            for step in (
                chain.ancestral_step(table, denoise),
                chain.ddim_step(table, denoise, eta=1.0),
            )
        )
        np.testing.assert_allclose(one, other, atol=2e-6)


def test_ddim_of_a_traced_eta():
    table, x = schedule.cosine_schedule(T), random(1)

    @jax.jit
    def run(eta):
        step = chain.ddim_step(table, tanh_denoiser, eta=eta)
        return chain.reverse_chain(step, jax.random.key(0), x, start=T)

    step = chain.ddim_step(table, tanh_denoiser, eta=0.5)
    expected = chain.reverse_chain(step, jax.random.key(0), x, start=T)
    np.testing.assert_allclose(run(jnp.array(0.5)), expected, atol=1e-6)


def test_deterministic_ddim_ignores_the_key():
    step = chain.ddim_step(schedule.cosine_schedule(T), tanh_denoiser)
    one, other = (
        chain.reverse_chain(step, jax.random.key(k), random(1), start=T) for k in (0, 1)
    )
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    "factory",
    [
        chain.ancestral_step,
        chain.ddim_step,
        lambda s, d: chain.ddim_step(s, d, eta=1.0),
    ],
)
@pytest.mark.parametrize("make", [schedule.cosine_schedule, schedule.vp_schedule])
def test_the_last_step_returns_the_prediction_exactly(factory, make):
    x_t = random(2)
    step = factory(make(T), tanh_denoiser)
    expected = tanh_denoiser(None, x_t, jnp.array(1))
    # Two keys: no noise is added, to the last bit.
    for seed in (0, 1):
        found = step(jax.random.key(seed), x_t, jnp.array(1))
        np.testing.assert_array_equal(found, expected)
    other = [step(jax.random.key(seed), x_t, jnp.array(2)) for seed in (0, 1)]
    moved = float(jnp.max(jnp.abs(other[0] - other[1])))
    assert (moved > 0.1) == (factory is not chain.ddim_step)


@pytest.mark.parametrize("cut", mostly_slow(range(T + 1), [0, 1, T]))
def test_a_cut_chain_is_the_whole_chain(cut):
    step = chain.ancestral_step(schedule.cosine_schedule(T), noisy_denoiser)
    key, x = jax.random.key(11), random(3)
    whole = chain.reverse_chain(step, jax.random.clone(key), x, start=T)
    top = chain.reverse_chain(step, jax.random.clone(key), x, start=T, stop=cut)
    both = chain.reverse_chain(step, jax.random.clone(key), top, start=cut)
    np.testing.assert_allclose(both, whole, atol=1e-6)


def test_the_chain_is_a_python_loop():
    table = schedule.cosine_schedule(T)
    step = chain.ancestral_step(table, noisy_denoiser)
    key, x = jax.random.key(11), random(3)
    expected, states = x, []
    for t in range(T, 0, -1):
        key_t = jax.random.fold_in(jax.random.clone(key), t)
        expected = step(key_t, expected, jnp.array(t))
        states.append(expected)
    found, trace = chain.reverse_chain_trace(step, jax.random.clone(key), x, start=T)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    np.testing.assert_allclose(trace, np.stack(states), atol=1e-6)
    np.testing.assert_array_equal(trace[-1], found)
    np.testing.assert_array_equal(
        found, chain.reverse_chain(step, jax.random.clone(key), x, start=T)
    )


def test_trace_of_a_part_and_of_nothing():
    step = chain.ancestral_step(schedule.cosine_schedule(T), tanh_denoiser)
    x = random(3)
    run = chain.reverse_chain_trace
    assert run(step, jax.random.key(0), x, start=5, stop=2)[1].shape == (3, 5, 3)
    same, none = run(step, jax.random.key(0), x, start=4, stop=4)
    np.testing.assert_array_equal(same, x)
    assert none.shape == (0, 5, 3)


def test_vmap_over_characters_is_a_loop():
    step = chain.ancestral_step(schedule.cosine_schedule(T), noisy_denoiser)

    def run(key, x):
        return chain.reverse_chain(step, key, x, start=T)

    keys, x = jax.random.split(jax.random.key(0), 4), random(4, (4, 5, 3))
    found = jax.vmap(run)(jax.random.clone(keys), x)
    for i in range(4):
        one = run(jax.random.clone(keys[i]), x[i])
        np.testing.assert_allclose(found[i], one, atol=1e-6)


def test_sample_starts_from_normal_noise_and_jits():
    step = chain.ancestral_step(schedule.cosine_schedule(T), tanh_denoiser)
    key = jax.random.key(7)

    def run(key):
        return chain.sample(step, key, (5, 3), num_steps=T)

    eager = run(jax.random.clone(key))
    np.testing.assert_allclose(jax.jit(run)(jax.random.clone(key)), eager, atol=1e-6)
    key_start, key_chain = jax.random.split(jax.random.clone(key))
    start = jax.random.normal(key_start, (5, 3))
    expected = chain.reverse_chain(step, key_chain, start, start=T)
    np.testing.assert_array_equal(eager, expected)
    x = chain.sample(step, key, (100_000,), num_steps=0)
    assert abs(float(x.mean())) < 4 / np.sqrt(1e5)
    assert abs(float(x.var()) - 1) < 4 * np.sqrt(2 / 1e5)


def test_one_compile_and_one_trace_of_the_network():
    @chex.assert_max_traces(n=1)
    def network(key, x_t, t):
        return tanh_denoiser(key, x_t, t)

    @jax.jit
    @chex.assert_max_traces(n=1)
    def run(key, x):
        step = chain.ancestral_step(schedule.cosine_schedule(T), network)
        return chain.reverse_chain(step, key, x, start=T)

    one, other = (run(jax.random.key(k), random(0)) for k in (0, 1))
    assert float(jnp.max(jnp.abs(one - other))) > 1e-3


def test_gradients_flow_through_the_chain():
    table = schedule.cosine_schedule(4)

    def end(shift):
        def denoise(key, x_t, t):
            return tanh_denoiser(key, x_t, t) + shift

        step = chain.ancestral_step(table, denoise)
        x = chain.reverse_chain(step, jax.random.key(0), random(0), start=4)
        return jnp.sum(x**2)

    gradient = jax.grad(end)(0.3)
    expected = (end(0.31) - end(0.29)) / 0.02
    np.testing.assert_allclose(gradient, expected, rtol=1e-2)


@pytest.mark.parametrize(
    ("make", "num_steps"),
    mostly_slow(
        [(make, steps) for make in ("ancestral", "ddim", "dpm") for steps in (1, 4)],
        [("ddim", 4)],
    ),
)
def test_gradients_flow_through_the_schedule_and_eta(make, num_steps):
    def end(scale, eta):
        table = schedule.schedule_from_betas(scale * beta)
        step = {
            "ancestral": lambda: chain.ancestral_step(table, tanh_denoiser),
            "ddim": lambda: chain.ddim_step(table, tanh_denoiser, eta=eta),
            "dpm": lambda: chain.dpm_solver_step(table, tanh_denoiser),
        }[make]()
        x = chain.sample_from(step, jax.random.key(0), start, start=num_steps)
        return jnp.sum(x**2)

    with jax.enable_x64(True):
        beta = schedule.cosine_schedule(num_steps).beta[1:]
        start = jnp.asarray(random(0), beta.dtype)
        run = jax.jit(end)
        for eta in (0.0, 0.5, 1.0):
            at = jnp.array([0.9, eta])
            found = jax.jit(jax.grad(lambda at: end(*at)))(at)
            shifts = 1e-5 * np.eye(2)
            wanted = [(run(*(at + x)) - run(*(at - x))) / 2e-5 for x in shifts]
            np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-8)
        if num_steps > 1:
            assert np.abs(found[0]) > 1e-3


def test_half_precision_network_in_a_float32_chain():
    def half(key, x_t, t):
        return tanh_denoiser(key, x_t.astype(jnp.bfloat16), t)

    step = chain.ancestral_step(schedule.cosine_schedule(T), half)
    x = chain.reverse_chain(step, jax.random.key(0), random(0), start=T)
    assert x.dtype == jnp.float32


@pytest.mark.parametrize("run", [chain.reverse_chain, chain.reverse_chain_trace])
@pytest.mark.parametrize(("start", "stop"), [(2, 3), (3, -1), (-1, -2), (-1, 0)])
def test_bad_range_of_steps(run, start, stop):
    step = chain.ancestral_step(schedule.cosine_schedule(T), tanh_denoiser)
    with pytest.raises(ValueError, match=f"start={start}, stop={stop}"):
        run(step, jax.random.key(0), random(0), start=start, stop=stop)


def test_a_multistep_walks_no_sample():
    step = chain.dpm_solver_step(schedule.cosine_schedule(T), tanh_denoiser)
    with pytest.raises(ValueError, match=r"x is a sample, expected step.init\(x\)"):
        chain.reverse_chain(step, jax.random.key(0), random(0), start=T)


@pytest.mark.parametrize("eta", [-0.1, 1.5])
def test_bad_eta(eta):
    with pytest.raises(ValueError, match="eta is"):
        chain.ddim_step(schedule.cosine_schedule(T), tanh_denoiser, eta=eta)


def even_schedule(num_steps, highest=1.9, lowest=-1.9):
    """Steps of equal size in log(signal / noise), from `lowest` up to `highest`."""
    ratio = np.linspace(highest, lowest, num_steps)
    log_alpha_bar = np.append(0.0, -np.log1p(np.exp(-2 * ratio)))
    beta = np.append(0.0, -np.expm1(np.diff(log_alpha_bar)))
    return schedule.Schedule(
        beta=jnp.asarray(beta, jnp.float32),
        log_alpha_bar=jnp.asarray(log_alpha_bar, jnp.float32),
    )


def gaussian_denoiser(table):
    """Posterior mean of x_0 ~ N(MEAN, VARIANCE)."""

    def denoise(key, x_t, t):
        del key
        alpha_bar, noise = table.alpha_bar[t], table.one_minus_alpha_bar[t]
        gain = jnp.sqrt(alpha_bar) * VARIANCE / (alpha_bar * VARIANCE + noise)
        return MEAN + gain * (x_t - jnp.sqrt(alpha_bar) * MEAN)

    return denoise


def flow(table, x, start, stop):
    """The flow's solution: the normalized deviation from the mean does not change."""
    alpha_bar = np.exp(np.float64(table.log_alpha_bar))
    deviation = lambda t: np.sqrt(alpha_bar[t] * VARIANCE + 1 - alpha_bar[t])  # noqa: E731
    mean = lambda t: np.sqrt(alpha_bar[t]) * MEAN  # noqa: E731
    return mean(stop) + deviation(stop) / deviation(start) * (x - mean(start))


@pytest.mark.parametrize(
    ("factory", "order"), [(chain.ddim_step, 1), (chain.dpm_solver_step, 2)]
)
def test_order_of_convergence_against_the_closed_form(factory, order):
    x, errors = np.array([-1.7, -0.4, 0.9, 2.2]), []
    for num_steps in (33, 65, 129):
        table = even_schedule(num_steps)
        step = factory(table, gaussian_denoiser(table))
        found = chain.sample_from(
            step, jax.random.key(0), jnp.float32(x), start=num_steps, stop=1
        )
        errors.append(np.abs(found - flow(table, x, num_steps, 1)).max())
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(rates, order, atol=0.15)
    if order == 2:
        assert errors[-1] < 1e-4


def test_dpm_solver_begins_as_ddim_and_ends_with_the_prediction():
    table = schedule.cosine_schedule(T)
    solver = chain.dpm_solver_step(table, tanh_denoiser)
    ddim = chain.ddim_step(table, tanh_denoiser)
    one = dict(start=T, stop=T - 1)
    np.testing.assert_allclose(
        chain.sample_from(solver, jax.random.key(0), random(0), **one),
        chain.sample_from(ddim, jax.random.key(0), random(0), **one),
        atol=1e-6,
    )
    state = chain.reverse_chain(
        solver, jax.random.key(0), solver.init(random(0)), start=T, stop=1
    )
    last = solver(jax.random.key(1), state, jnp.array(1))
    np.testing.assert_allclose(
        solver.finish(last), tanh_denoiser(None, state.x, jnp.array(1)), atol=1e-6
    )


def test_a_respaced_chain_tells_the_denoiser_the_schedules_own_steps():
    table = schedule.cosine_schedule(T)
    x, told = random(2), (8, 5, 2)
    found = chain.sample_from(
        chain.respaced(chain.ddim_step, told[::-1])(table, tanh_denoiser),
        jax.random.key(0),
        x,
        start=3,
    )
    alpha_bar = np.asarray(table.alpha_bar, np.float64)
    x = np.asarray(x, np.float64)
    for t, below in zip(told, (5, 2, 0), strict=True):
        x_0 = np.tanh(1.3 * x + 0.1 * t)
        noise = (x - np.sqrt(alpha_bar[t]) * x_0) / np.sqrt(1.0 - alpha_bar[t])
        x = np.sqrt(alpha_bar[below]) * x_0 + np.sqrt(1.0 - alpha_bar[below]) * noise
    np.testing.assert_allclose(found, x, atol=2e-6)


def test_a_respaced_chain_of_all_steps_is_the_chain():
    make = chain.ancestral_step
    assert chain.respaced(make, None) is make


def test_a_cut_chain_keeps_the_history_that_it_walks():
    table = schedule.cosine_schedule(T)
    solver = chain.dpm_solver_step(table, tanh_denoiser)
    run = lambda x, **cut: chain.reverse_chain(solver, jax.random.key(0), x, **cut)  # noqa: E731
    start = solver.init(random(0))
    whole = run(start, start=T)
    parts = run(run(start, start=T, stop=3), start=3)
    np.testing.assert_allclose(parts.x, whole.x, atol=1e-6)
    # Without its history the second part begins with a step of first order.
    forgotten = solver.init(run(start, start=T, stop=3).x)
    assert np.abs(run(forgotten, start=3).x - whole.x).max() > 1e-4


def test_a_multistep_samples_like_any_step():
    table = schedule.cosine_schedule(T)
    solver = chain.dpm_solver_step(table, noisy_denoiser)
    draw = lambda k: chain.sample(solver, k, (3,), num_steps=T)  # noqa: E731
    alone = draw(jax.random.split(jax.random.key(0), 4)[2])
    together = jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(0), 4))
    assert together.shape == (4, 3) and np.isfinite(together).all()
    np.testing.assert_allclose(together[2], alone, atol=1e-5)
