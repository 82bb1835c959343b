import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.motion import spring
from tests.reference import trajectory as oracle


def directions(angles):
    angles = np.asarray(angles)
    return np.stack([np.sin(angles), np.cos(angles)], -1).astype(np.float32)


@pytest.mark.parametrize("half_life", [0.05, 0.27, 1.155])
@pytest.mark.parametrize("t", [1 / 60, 0.5, 3.0])
def test_springs_solve_their_differential_equations(half_life, t):
    x, v, a, goal = 0.3, -1.2, 2.5, 1.7
    want = oracle.integrate_spring(x, v, goal, half_life, t)
    x_, v_, a_, goal_ = (jnp.float32(n) for n in (x, v, a, goal))
    got = spring.spring(x_, v_, goal_, half_life=half_life, dt=t)
    np.testing.assert_allclose(got, want, atol=2e-5)
    want = oracle.integrate_velocity_spring(x, v, a, goal, half_life, t)
    got = spring.velocity_spring(x_, v_, a_, goal_, half_life=half_life, dt=t)
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=5e-5)


def test_a_slow_spring_keeps_its_digits_over_a_short_time():
    for half_life in (30.0, 100.0, 300.0, 1000.0):
        want = oracle.integrate_velocity_spring(0.0, 1.0, 0.0, 0.0, half_life, 1 / 60)
        x, v, a = (jnp.float32(n) for n in (0.0, 1.0, 0.0))
        got = spring.velocity_spring(x, v, a, x, half_life=half_life, dt=1 / 60)
        np.testing.assert_allclose(got[0], want[0], rtol=1e-5)


def test_springs_are_semigroups():
    x, v, a, goal = (jnp.float32(n) for n in (0.3, -1.2, 2.5, 1.7))
    for dt1, dt2 in [(0.1, 0.25), (0.01, 1.0)]:
        for state, call in [
            ((x, v), lambda s, dt: spring.spring(*s, goal, half_life=0.3, dt=dt)),
            (
                (x, v, a),
                lambda s, dt: spring.velocity_spring(*s, goal, half_life=0.3, dt=dt),
            ),
        ]:
            once, twice = call(state, dt1 + dt2), call(call(state, dt1), dt2)
            np.testing.assert_allclose(once, twice, rtol=1e-4, atol=1e-5)


def test_velocity_spring_at_its_goal_velocity_moves_by_velocity_times_time():
    v = jnp.array([1.5, -0.5])
    x, v_new, a = spring.velocity_spring(
        jnp.zeros(2), v, jnp.zeros(2), v, half_life=0.27, dt=0.4
    )
    np.testing.assert_array_equal(x, v * jnp.float32(0.4))
    np.testing.assert_array_equal(v_new, v)
    np.testing.assert_array_equal(a, jnp.zeros(2))


def test_half_life_is_nominal():
    zero, one = jnp.float32(0), jnp.float32(1)
    _, v, _ = spring.velocity_spring(zero, zero, zero, one, half_life=0.27, dt=0.27)
    np.testing.assert_allclose(1 - v, (1 + 2 * np.log(2)) / 4, rtol=1e-5)


def test_springs_of_no_half_life_arrive_at_once_and_finitely():
    zero, one = jnp.float32(0), jnp.float32(1)
    x, v = spring.spring(zero, zero, one, half_life=0.0, dt=0.1)
    np.testing.assert_array_equal([x, v], [1.0, 0.0])
    x, v, a = spring.velocity_spring(zero, zero, zero, one, half_life=0.0, dt=0.1)
    np.testing.assert_allclose([x, v, a], [0.1, 1.0, 0.0], atol=1e-4)


def test_facing_spring_takes_the_shorter_arc_across_pi():
    start, goal = jnp.asarray(directions(3.0)), jnp.asarray(directions(-3.0))
    angles = []
    for dt in (0.0, 0.1, 0.3, 5.0):
        facing, _ = spring.facing_spring(
            start, jnp.float32(0.5), goal, half_life=0.27, dt=dt
        )
        np.testing.assert_allclose(np.linalg.norm(facing), 1.0, atol=1e-6)
        # The oracle integrates the angle itself, unwrapped to the near side.
        want, _ = oracle.integrate_spring(3.0, 0.5, 2 * np.pi - 3.0, 0.27, dt or 1e-9)
        angles.append(oracle.wrap(oracle.yaw(np.asarray(facing)) - want))
    np.testing.assert_allclose(angles, 0.0, atol=1e-5)


def test_facing_spring_has_finite_gradients_at_zero_and_opposite_vectors():
    def total(facing, goal):
        turned, rate = spring.facing_spring(
            facing, jnp.float32(0), goal, half_life=0.27, dt=0.1
        )
        return jnp.sum(turned) + rate

    ahead = jnp.array([0.0, 1.0])
    for pair in [(jnp.zeros(2), jnp.zeros(2)), (ahead, -ahead), (ahead, ahead)]:
        value, grads = jax.value_and_grad(total, (0, 1))(*pair)
        assert np.isfinite(value) and all(np.isfinite(g).all() for g in grads)
