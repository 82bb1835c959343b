"""What a student is taught, where the teacher is exact: Gaussian data."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.diffusion import distillation, schedule

MEAN, VARIANCE = 1.5, 0.30
T = 8


def numbers(table):
    """a and s of x_t = a x_0 + s noise, in float64."""
    a_bar = np.exp(np.float64(table.log_alpha_bar))
    return np.sqrt(a_bar), np.sqrt(1.0 - a_bar)


def linear(table):
    """Posterior mean of x_0 ~ N(MEAN, VARIANCE) at each step: slope and offset."""
    a, s = numbers(table)
    total = a**2 * VARIANCE + s**2
    return VARIANCE * a / total, MEAN * s**2 / total


def chain_ends(table):
    """Slope and offset of where DDIM's chain ends from each step, in float64."""
    (a, s), (slope, offset) = numbers(table), linear(table)
    ends = [(1.0, 0.0)]
    for t in range(1, table.num_steps + 1):
        # One step is a' D(x) + s' / s (x - a D(x)); the rest of the chain follows.
        share, keep = a[t - 1] - s[t - 1] / s[t] * a[t], s[t - 1] / s[t]
        later, shift = ends[-1]
        ends.append(
            (later * (share * slope[t] + keep), later * share * offset[t] + shift)
        )
    return tuple(np.transpose(ends))


def denoiser(slope, offset):
    slope, offset = (jnp.asarray(x, jnp.float32) for x in (slope, offset))
    return lambda key, x_t, t: slope[t] * x_t + offset[t]


def data(seed=0, shape=(3, 2)):
    drawn = np.random.default_rng(seed).normal(MEAN, VARIANCE**0.5, shape)
    return jnp.asarray(drawn, jnp.float32)


def make_pairs(kind, table, student, teacher):
    if kind == "chain":
        run, more = distillation.chain_pairs, dict(steps=(1, 2, 5, table.num_steps))
    else:
        run, more = distillation.consistency_pairs, dict(number=table.num_steps)
    key = jax.random.key(0)
    return run(key, data(), table=table, student=student, teacher=teacher, **more)


@functools.cache
def program(kind):
    """Pairs of linear denoisers, jitted once for all of them."""
    return jax.jit(
        lambda table, student, teacher: make_pairs(
            kind, table, denoiser(*student), denoiser(*teacher)
        )
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["chain", "consistency"])
@pytest.mark.parametrize("make", [schedule.cosine_schedule, schedule.vp_schedule])
def test_the_exact_consistency_function_has_nothing_to_learn(kind, make):
    table = make(T)
    slope, offset = chain_ends(table)
    found, wanted = program(kind)(table, (slope, offset), linear(table))
    np.testing.assert_allclose(found, wanted, atol=2e-5)
    # One that is off at every step has: it is exactly so much off the chain's end.
    found, wanted = program(kind)(table, (slope, offset + 0.1), linear(table))
    off = np.abs(np.asarray(found - wanted)).max(axis=(1, 2))
    if kind == "chain":
        np.testing.assert_allclose(off, 0.1, atol=2e-5)
    else:  # all but the pair of t = 1 are as far off as their targets
        np.testing.assert_allclose(np.sort(off), [0.0] * (T - 1) + [0.1], atol=2e-5)


@pytest.mark.slow
def test_the_chain_ends_where_the_ode_does():
    """The ODE of Gaussian data maps deviations by the ratio of the deviations."""
    table = schedule.cosine_schedule(800)
    t = np.array([1, 200, 500, 700])
    a, s = (x[t] for x in numbers(table))
    slope = np.sqrt(VARIANCE / (a**2 * VARIANCE + s**2))
    identity = denoiser(np.ones(801), np.zeros(801))  # shows what it was given
    x_t, end = distillation.chain_pairs(
        jax.random.key(0),
        data(),
        table=table,
        student=identity,
        teacher=denoiser(*linear(table)),
        steps=tuple(t.tolist()),
    )
    ratio, mean = (x[:, None, None] for x in (slope, a * MEAN))
    np.testing.assert_allclose(end, MEAN + ratio * (x_t - mean), atol=4e-3)


def test_noise_is_of_the_steps_own_size():
    table, steps = schedule.cosine_schedule(T), (2, 6)
    identity = denoiser(np.ones(T + 1), np.zeros(T + 1))
    x_0 = jnp.full((200, 200), MEAN)
    x_t, _ = distillation.chain_pairs(
        jax.random.key(1),
        x_0,
        table=table,
        student=identity,
        teacher=identity,
        steps=steps,
    )
    a, s = (x[list(steps)] for x in numbers(table))
    np.testing.assert_allclose(np.mean(x_t, axis=(1, 2)), a * MEAN, atol=0.02)
    np.testing.assert_allclose(np.std(x_t, axis=(1, 2)), s, rtol=0.02)


@pytest.mark.slow
def test_consistency_visits_each_step_once_and_anew():
    table = schedule.cosine_schedule(T)
    steps = denoiser(np.zeros(T + 1), np.arange(T + 1))  # predicts t
    make = functools.partial(
        distillation.consistency_pairs, table=table, student=steps, teacher=steps
    )
    found, _ = make(jax.random.key(0), data(), number=T)
    assert sorted(np.asarray(found)[:, 0, 0].tolist()) == list(range(1, T + 1))
    half, _ = make(jax.random.key(0), data(), number=T // 2)
    np.testing.assert_array_equal(np.diff(np.sort(half[:, 0, 0])), 2.0)
    one = jax.jit(functools.partial(make, number=1))
    drawn = {float(one(jax.random.key(i), data())[0][0, 0, 0]) for i in range(40)}
    assert drawn == set(range(1, T + 1))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["chain", "consistency"])
def test_targets_are_constants_of_the_gradient(kind):
    """With a student c x_t, the gradient is that of its prediction alone.

    That holds for a teacher with the same c, too.
    """
    table = schedule.cosine_schedule(T)
    exact = denoiser(*linear(table))

    def off(c):
        student = lambda key, x_t, t: c * x_t  # noqa: E731
        teacher = lambda key, x_t, t: c * exact(key, x_t, t)  # noqa: E731
        found, wanted = make_pairs(kind, table, student, teacher)
        return jnp.sum((found - wanted) ** 2) / 2, (found, wanted)

    (_, (found, wanted)), slope = jax.value_and_grad(off, has_aux=True)(2.0)
    expected = np.sum(np.float64(found - wanted) * np.float64(found) / 2.0)
    np.testing.assert_allclose(slope, expected, rtol=1e-4)
