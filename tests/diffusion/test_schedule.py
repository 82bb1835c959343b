import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError

from jaxmotion.diffusion import schedule
from tests import mostly_slow, tiny
from tests.reference import diffusion as reference

# Published or independently computed tables, steps 1..T. Cosine T = 4 is the JSON that
# ships with CAMDM's ONNX models.
COSINE = {
    2: {
        "beta": [0.506156, 0.999],
        "alpha_bar": [0.493844, 4.93844e-4],
        "c1": [1, 0.702384],
        "c2": [0, 0.016014],
        "v": [0, 0.505900],
    },
    4: {
        "beta": [0.152988, 0.416958, 0.707859, 0.999],
        "alpha_bar": [0.847012, 0.493844, 0.144272, 1.44272e-4],
        "c1": [1, 0.7581454, 0.5813071, 0.3795066],
        "c2": [0, 0.2307927, 0.3197021, 0.0270644],
        "v": [0, 0.126027, 0.418693, 0.854996],
    },
    5: {
        "alpha_bar": [0.898706, 0.647478, 0.340810, 0.0940456, 9.40456e-5],
        "c1": [1, 0.751749, 0.578157, 0.466573, 0.306391],
        "c2": [0, 0.243894, 0.387988, 0.382224, 0.028651],
        "v": [0, 0.080325, 0.253291, 0.526835, 0.905134],
    },
    8: {
        "beta": [
            *(0.042195, 0.115673, 0.192188, 0.278246),
            *(0.383621, 0.526036, 0.740269, 0.999),
        ],
        "alpha_bar": [
            *(0.957805, 0.847012, 0.684227, 0.493844),
            *(0.304395, 0.144272, 0.0374720, 3.74720e-5),
        ],
        "c1": [
            *(1, 0.739971, 0.560139, 0.454719),
            *(0.387556, 0.339155, 0.292124, 0.193390),
        ],
        "c2": [
            *(0, 0.259367, 0.435448, 0.530012),
            *(0.571276, 0.559628, 0.453090, 0.030439),
        ],
        "v": [
            *(0, 0.031904, 0.093112, 0.173588),
            *(0.279141, 0.427605, 0.658130, 0.961602),
        ],
    },
}
VP = {
    1: {"beta": [0.999957]},
    2: {"beta": [0.921324, 0.999451]},
    3: {
        "beta": [0.681226, 0.964914, 0.996138],
        "alpha_bar": [0.318774, 0.0111844, 4.31905e-5],
    },
    4: {"beta": [0.478255, 0.849206, 0.956418, 0.987404]},
    5: {
        "beta": [0.343715, 0.703459, 0.866008, 0.939456, 0.972643],
        "alpha_bar": [0.656285, 0.194615, 0.0260768, 0.00157879, 4.31905e-5],
        "c1": [1, 0.707590, 0.392271, 0.151946, 0.038649],
        "c2": [0, 0.232401, 0.302703, 0.240019, 0.165144],
        "v": [0, 0.300216, 0.716145, 0.916405, 0.971150],
    },
    10: {
        "beta": [
            *(0.105311, 0.266466, 0.398593, 0.506921, 0.595736),
            *(0.668554, 0.728255, 0.777203, 0.817334, 0.850237),
        ],
        "alpha_bar": [
            *(0.894689, 0.656285, 0.394694, 0.194615, 0.0786760),
            *(0.0260768, 0.00708624, 0.00157879, 2.88392e-4, 4.31905e-5),
        ],
        "c1": [
            *(1, 0.733296, 0.533459, 0.395428, 0.285253),
            *(0.192545, 0.118440, 0.065528, 0.032485, 0.014439),
        ],
        "c2": [
            *(0, 0.262413, 0.440360, 0.527752, 0.555806),
            *(0.544621, 0.511321, 0.469410, 0.426843, 0.386898),
        ],
        "v": [
            *(0, 0.081643, 0.226336, 0.380988, 0.520769),
            *(0.632447, 0.714327, 0.772916, 0.816279, 0.850028),
        ],
    },
}
TABLES = [("cosine", T, t) for T, t in COSINE.items()] + [
    ("vp", T, t) for T, t in VP.items()
]
SCHEDULES = {
    "cosine": (schedule.cosine_schedule, reference.cosine_betas),
    "vp": (schedule.vp_schedule, reference.vp_betas),
    "linear": (schedule.linear_schedule, reference.linear_betas),
}


def posterior_coefficients(table):
    """c1, c2 and v of all steps, read off the posterior by unit inputs."""
    t = jnp.arange(1, table.num_steps + 1)
    one, zero = jnp.ones(table.num_steps), jnp.zeros(table.num_steps)
    c1, v = schedule.posterior(table, one, zero, t)
    c2, _ = schedule.posterior(table, zero, one, t)
    return {"c1": c1, "c2": c2, "v": v}


def random(seed, shape=(6, 3)):
    return tiny.float32(np.random.default_rng(seed).normal(size=shape))


@pytest.mark.parametrize(("name", "num_steps", "expected"), TABLES)
def test_published_tables(name, num_steps, expected):
    table = SCHEDULES[name][0](num_steps)
    found = posterior_coefficients(table) | {
        "beta": table.beta[1:],
        "alpha_bar": table.alpha_bar[1:],
    }
    for field, values in expected.items():
        np.testing.assert_allclose(found[field], values, atol=1e-6, rtol=0)


def test_published_log_variances():
    expected = [-2.071257, -0.870617, -0.156659]
    v = posterior_coefficients(schedule.cosine_schedule(4))["v"][1:]
    np.testing.assert_allclose(jnp.log(v), expected, atol=1e-6)
    expected = [-3.445032, -2.373948, -1.751072, -1.276037, -0.849555, -0.418353]
    v = posterior_coefficients(schedule.cosine_schedule(8))["v"][1:]
    np.testing.assert_allclose(jnp.log(v), [*expected, -0.039155], atol=1e-6)


@pytest.mark.parametrize("name", SCHEDULES)
@pytest.mark.parametrize("num_steps", mostly_slow([1, 3, 20, 1000], [20]))
def test_float32_tables_agree_with_float64(name, num_steps):
    make, oracle = SCHEDULES[name]
    table = make(num_steps)
    expected = reference.coefficients(oracle(num_steps))
    assert table.beta.dtype == jnp.float32
    assert table.num_steps == num_steps
    relative = 2e-6
    for found, name in [
        (table.beta[1:], expected["beta"]),
        (table.alpha_bar[1:], expected["alpha_bar"]),
        (table.one_minus_alpha_bar[1:], 1 - expected["alpha_bar"]),
    ]:
        np.testing.assert_allclose(found, name, rtol=relative)
    snr = expected["alpha_bar"] / (1 - expected["alpha_bar"])
    np.testing.assert_allclose(table.log_snr[1:], np.log(snr), rtol=2e-6, atol=2e-6)
    for field, found in posterior_coefficients(table).items():
        np.testing.assert_allclose(found, expected[field], rtol=3e-6, atol=1e-9)


@pytest.mark.parametrize("name", SCHEDULES)
def test_index_zero_is_clean(name):
    table = SCHEDULES[name][0](7)
    assert table.beta[0] == 0.0
    assert table.alpha_bar[0] == 1.0
    assert table.one_minus_alpha_bar[0] == 0.0
    assert table.log_snr[0] == jnp.inf
    assert bool(jnp.all(jnp.diff(table.log_snr[1:]) < 0))


def test_vp_ends_at_the_same_alpha_bar_for_every_length():
    ends = [float(schedule.vp_schedule(n).alpha_bar[-1]) for n in (1, 4, 10, 200)]
    np.testing.assert_allclose(ends, 4.31905e-5, rtol=2e-6)


def test_hyperparameters_reach_the_tables():
    for found, betas in [
        (
            schedule.cosine_schedule(6, offset=0.05, max_beta=0.9),
            reference.cosine_betas(6, 0.05, 0.9),
        ),
        (
            schedule.vp_schedule(6, beta_min=0.2, beta_max=9.0, t_min=0.01),
            reference.vp_betas(6, 0.2, 9.0, 0.01),
        ),
        (
            schedule.linear_schedule(6, beta_min=0.1, beta_max=0.5),
            reference.linear_betas(6, 0.1, 0.5),
        ),
        (
            schedule.linear_schedule(40, scaled=True),
            reference.linear_betas(40, scale=25.0),
        ),
    ]:
        expected = reference.coefficients(betas)
        np.testing.assert_allclose(found.beta[1:], betas, rtol=2e-6)
        np.testing.assert_allclose(
            found.alpha_bar[1:], expected["alpha_bar"], rtol=5e-6
        )


def test_scaled_linear_schedule_may_end_in_pure_noise():
    table = schedule.linear_schedule(20, scaled=True)
    x_0, x_t = random(0, (2,)), random(1, (2,))
    assert table.beta[-1] == 1.0 and table.alpha_bar[-1] == 0.0
    mean, variance = schedule.posterior(table, x_0, x_t, jnp.array(20))
    np.testing.assert_allclose(mean, jnp.sqrt(table.alpha_bar[19]) * x_0, rtol=1e-6)
    np.testing.assert_allclose(variance, table.one_minus_alpha_bar[19], rtol=1e-6)


def test_posterior_is_bayes_product():
    betas = reference.cosine_betas(8)
    table = schedule.cosine_schedule(8)
    x_0, x_t = random(0), random(1)
    for t in range(2, 9):
        mean, variance = schedule.posterior(table, x_0, x_t, jnp.array(t))
        expected = reference.bayes_posterior(
            betas, t - 1, np.float64(x_0), np.float64(x_t)
        )
        np.testing.assert_allclose(mean, expected[0], atol=2e-6)
        np.testing.assert_allclose(variance, expected[1], rtol=2e-6)


@pytest.mark.parametrize("name", SCHEDULES)
@pytest.mark.parametrize("num_steps", mostly_slow([1, 2, 5, 8, 1000], [8]))
def test_posterior_at_the_last_step_returns_x_0_exactly(name, num_steps):
    table = SCHEDULES[name][0](num_steps)
    x_0, x_t = random(2), random(3)
    mean, variance = schedule.posterior(table, x_0, x_t, jnp.array(1))
    np.testing.assert_array_equal(mean, x_0)
    assert float(jnp.max(jnp.abs(variance))) == 0.0


def test_q_sample_is_repeated_q_step():
    table = schedule.cosine_schedule(5)
    rng = np.random.default_rng(0)
    x_0 = jnp.full((200_000,), 0.7, jnp.float32)
    x = x_0
    for t in range(1, 4):
        noise = jnp.asarray(rng.normal(size=x.shape), jnp.float32)
        x = schedule.q_step(table, x, jnp.array(t), noise)
    # Moments of the closed form; z-scores of mean and variance.
    signal = schedule.q_sample(table, x_0, jnp.array(3), jnp.zeros_like(x_0))[0]
    spread = schedule.q_sample(table, jnp.zeros(()), jnp.array(3), jnp.ones(()))
    n, variance = x.size, float(spread) ** 2
    assert abs(float(x.mean() - signal)) / np.sqrt(variance / n) < 4
    assert abs(float(x.var()) / variance - 1) / np.sqrt(2 / n) < 4


def test_q_sample_agrees_with_float64():
    alpha_bar = reference.coefficients(reference.vp_betas(10))["alpha_bar"]
    table = schedule.vp_schedule(10)
    x_0, noise = random(4), random(5)
    np.testing.assert_array_equal(
        schedule.q_sample(table, x_0, jnp.array(0), noise), x_0
    )
    for t in (1, 4, 10):
        expected = np.sqrt(alpha_bar[t - 1]) * np.float64(x_0)
        expected += np.sqrt(1 - alpha_bar[t - 1]) * np.float64(noise)
        found = schedule.q_sample(table, x_0, jnp.array(t), noise)
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_q_step_agrees_with_float64():
    betas = reference.cosine_betas(8)
    x, noise = random(4), random(5)
    for t in (1, 5, 8):
        expected = np.sqrt(1 - betas[t - 1]) * np.float64(x)
        expected += np.sqrt(betas[t - 1]) * np.float64(noise)
        found = schedule.q_step(schedule.cosine_schedule(8), x, jnp.array(t), noise)
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_conversions_round_trip():
    table = schedule.cosine_schedule(8)
    x_0, noise = random(6), random(7)
    for t in range(1, 9):
        t = jnp.array(t)
        x_t = schedule.q_sample(table, x_0, t, noise)
        gain = float(jnp.sqrt(1 / table.alpha_bar[t]))
        found = schedule.x0_from_noise(table, noise, x_t, t)
        np.testing.assert_allclose(found, x_0, atol=1e-6 * gain)
        gain = float(jnp.sqrt(1 / table.one_minus_alpha_bar[t]))
        found = schedule.noise_from_x0(table, x_0, x_t, t)
        np.testing.assert_allclose(found, noise, atol=1e-6 * gain)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(6,), (6, 1), (1,), (6, 3)])
def test_t_with_leading_axes_is_a_loop(shape):
    table = schedule.cosine_schedule(8)
    x, y = random(8, (6, 3, 2)), random(9, (6, 3, 2))
    t = jnp.asarray(np.random.default_rng(1).integers(1, 9, shape))
    full = np.broadcast_to(np.reshape(t, shape + (1,) * (2 - len(shape))), (6, 3))
    for function in (
        schedule.q_sample,
        schedule.q_step,
        schedule.noise_from_x0,
        schedule.x0_from_noise,
    ):
        arguments = (
            (table, x, t, y)
            if function in (schedule.q_sample, schedule.q_step)
            else None
        )
        arguments = arguments or (table, x, y, t)
        found = function(*arguments)
        for i in range(6):
            for j in range(3):
                one = jnp.array(full[i, j])
                swap = tuple(
                    one if a is t else a[i, j] if a is not table else table
                    for a in arguments
                )
                np.testing.assert_allclose(found[i, j], function(*swap), rtol=1e-6)
    mean, variance = schedule.posterior(table, x, y, t)
    for i in range(6):
        one = schedule.posterior(table, x[i, 1], y[i, 1], jnp.array(full[i, 1]))
        np.testing.assert_allclose(mean[i, 1], one.mean, rtol=1e-6)
        variances = jnp.broadcast_to(variance, mean.shape)[i, 1]
        np.testing.assert_allclose(
            variances, jnp.broadcast_to(one.variance, (2,)), rtol=1e-6
        )


def test_steps_out_of_range_clamp():
    table = schedule.cosine_schedule(4)
    x, y = random(0), random(1)
    for function in (schedule.posterior, schedule.noise_from_x0):
        for outside, inside in [(0, 1), (-3, 1), (9, 4)]:
            chex.assert_trees_all_equal(
                function(table, x, y, jnp.array(outside)),
                function(table, x, y, jnp.array(inside)),
            )
    low, high = (schedule.q_sample(table, x, jnp.array(t), y) for t in (-2, 7))
    np.testing.assert_array_equal(low, x)
    np.testing.assert_array_equal(high, schedule.q_sample(table, x, jnp.array(4), y))


def test_half_precision_stays_half_precision():
    table = schedule.cosine_schedule(4)
    x, y = random(0).astype(jnp.bfloat16), random(1).astype(jnp.bfloat16)
    assert schedule.q_sample(table, x, jnp.array(2), y).dtype == jnp.bfloat16
    assert schedule.posterior(table, x, y, jnp.array(2)).mean.dtype == jnp.bfloat16


def test_respace_keeps_the_steps():
    table = schedule.vp_schedule(10)
    steps = (1, 4, 10)
    short = schedule.respace(table, steps)
    kept = table.log_alpha_bar[jnp.array(steps)]
    np.testing.assert_array_equal(short.log_alpha_bar[1:], kept)
    alpha_bar = reference.coefficients(reference.vp_betas(10))["alpha_bar"][[0, 3, 9]]
    expected = 1 - alpha_bar / np.append(1.0, alpha_bar[:-1])
    np.testing.assert_allclose(short.beta[1:], expected, rtol=2e-6)


def test_respace_to_all_steps_is_the_same_schedule():
    table = schedule.cosine_schedule(50)
    chex.assert_trees_all_close(
        schedule.respace(table, tuple(range(1, 51))), table, atol=1e-6
    )


def test_schedule_from_betas_rebuilds_a_schedule_and_jits():
    betas = reference.cosine_betas(8)
    eager = schedule.schedule_from_betas(jnp.asarray(betas, jnp.float32))
    traced = jax.jit(schedule.schedule_from_betas)(jnp.asarray(betas, jnp.float32))
    chex.assert_trees_all_close(eager, traced, rtol=1e-6)
    chex.assert_trees_all_close(eager, schedule.cosine_schedule(8), rtol=5e-5)


def test_the_last_beta_may_leave_nothing_of_the_sample():
    table = schedule.schedule_from_betas(jnp.array([0.5, 0.2, 1.0]))
    np.testing.assert_allclose(table.alpha_bar, [1.0, 0.5, 0.4, 0.0], rtol=1e-6)


def test_schedule_is_a_pytree_that_maps_and_jits():
    table = schedule.cosine_schedule(8)
    leaves, treedef = jax.tree.flatten(table)
    assert len(leaves) == 2
    assert jax.tree.unflatten(treedef, leaves).num_steps == 8
    inside = jax.jit(lambda: schedule.cosine_schedule(8))()
    chex.assert_trees_all_close(inside, table, rtol=1e-6)
    x, y = random(0), random(1)
    with jax.disable_jit():
        eager = schedule.posterior(table, x, y, jnp.array(3))
    chex.assert_trees_all_close(
        eager, schedule.posterior(table, x, y, jnp.array(3)), rtol=1e-6
    )
    # A stack of schedules of one length maps like any array.
    stack = jax.tree.map(lambda a, b: jnp.stack([a, b]), table, schedule.vp_schedule(8))
    both = jax.vmap(lambda s: schedule.q_sample(s, x, jnp.array(2), y))(stack)
    np.testing.assert_allclose(
        both[1],
        schedule.q_sample(schedule.vp_schedule(8), x, jnp.array(2), y),
        rtol=1e-6,
    )


def test_gradients_are_finite_and_reach_the_betas():
    def loss(beta):
        table = schedule.schedule_from_betas(beta)
        x_t = schedule.q_sample(table, random(0), jnp.array(2), random(1))
        return jnp.sum(
            schedule.posterior(table, random(0), x_t, jnp.array(2)).mean ** 2
        )

    beta = jnp.asarray(reference.cosine_betas(4), jnp.float32)
    gradient = jax.grad(loss)(beta)
    assert bool(jnp.all(jnp.isfinite(gradient)))
    assert float(jnp.abs(gradient[0])) > 1e-3
    for i, step in [(0, 1e-3), (1, 1e-3)]:
        change = loss(beta.at[i].add(step)) - loss(beta.at[i].add(-step))
        np.testing.assert_allclose(gradient[i], change / (2 * step), rtol=2e-2)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: schedule.cosine_schedule(0), "num_steps is 0"),
        (lambda: schedule.cosine_schedule(4, max_beta=1.0), "max_beta is 1.0"),
        (lambda: schedule.cosine_schedule(4, offset=-0.1), "offset is -0.1"),
        (lambda: schedule.vp_schedule(-1), "num_steps is -1"),
        (lambda: schedule.vp_schedule(4, t_min=1.0), "t_min is 1.0"),
        (lambda: schedule.vp_schedule(4, beta_min=0.0), "beta_min is 0.0"),
        (lambda: schedule.vp_schedule(4, beta_max=0.01), "beta_max is 0.01"),
        (lambda: schedule.linear_schedule(4, beta_max=1.5), "beta_max is 1.5"),
        (lambda: schedule.linear_schedule(4, beta_min=0.0), "beta_min is 0.0"),
        (lambda: schedule.linear_schedule(4, beta_min=1.0), "beta_min is 1.0"),
        (
            lambda: schedule.linear_schedule(8, beta_min=0.008, scaled=True),
            "at least 20 steps",
        ),
        (
            lambda: schedule.linear_schedule(40, beta_min=0.04, scaled=True),
            "at least 41 steps",
        ),
        (lambda: schedule.linear_schedule(19, scaled=True), "at least 20 steps"),
        (lambda: schedule.linear_schedule(8, scaled=True), "at least 20 steps"),
        (lambda: schedule.schedule_from_betas(jnp.array([])), "T >= 1"),
        (
            lambda: schedule.schedule_from_betas(jnp.array([0.1, 1.0, 0.2])),
            "step 2 is 1.0",
        ),
        (
            lambda: schedule.schedule_from_betas(jnp.array([0.1, jnp.nan])),
            "step 2 is nan",
        ),
        (lambda: schedule.schedule_from_betas(jnp.array([0.0, 0.5])), "step 1 is 0.0"),
        (lambda: schedule.respace(schedule.cosine_schedule(4), ()), "empty"),
        (
            lambda: schedule.respace(schedule.cosine_schedule(4), (2, 5)),
            "step 5 after 2",
        ),
        (
            lambda: schedule.respace(schedule.cosine_schedule(4), (2, 2)),
            "step 2 after 2",
        ),
        (
            lambda: schedule.respace(schedule.cosine_schedule(4), (0, 2)),
            "step 0 after 0",
        ),
    ],
)
def test_bad_arguments(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_shapes_that_do_not_fit():
    table, t = schedule.cosine_schedule(4), jnp.array(1)
    # Annotations catch the first two where they are checked, as they are in tests.
    for function in (
        schedule.posterior,
        schedule.noise_from_x0,
        schedule.x0_from_noise,
    ):
        with pytest.raises((ValueError, TypeCheckError)):
            function(table, random(0, (4, 3)), random(1, (4, 1)), t)
    with pytest.raises((ValueError, TypeCheckError)):
        schedule.q_sample(table, random(0, (4, 3)), t, random(1, (4, 1)))
    for shape in [(3,), (4, 3, 2)]:
        with pytest.raises(ValueError, match="t has shape"):
            schedule.posterior(
                table, random(0, (4, 3)), random(1, (4, 3)), jnp.ones(shape, int)
            )


def test_one_compile_for_all_steps():
    @jax.jit
    @chex.assert_max_traces(n=1)
    def program(table, x, y, t):
        return schedule.posterior(table, x, y, t)

    for t in (1, 2, 3):
        program(schedule.cosine_schedule(4), random(t), random(t + 1), jnp.array(t))


def test_spread_steps_end_at_the_last():
    assert schedule.spread_steps(8, 8) == tuple(range(1, 9))
    assert schedule.spread_steps(8, 1) == (8,)
    assert schedule.spread_steps(8, 3) == (3, 6, 8)
    for total in (1, 7, 50):
        for number in range(1, total + 1):
            steps = schedule.spread_steps(total, number)
            assert len(set(steps)) == number and steps[-1] == total
            assert sorted(steps) == list(steps) and steps[0] >= 1
    for number in (0, 9):
        with pytest.raises(ValueError, match=f"{number} steps of 8, expected 1 to 8"):
            schedule.spread_steps(8, number)
