"""experiments/few_steps.py: what a classifier tells apart, what chains keep."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def script(load):
    return load("few_steps")


@pytest.fixture(scope="module")
def args(script):
    return script.Config(run=Path("none"), seconds=3.0, width=32)


def toy(key, number=3000):
    """A state, and what is one away from its half, above or below."""
    keys = jax.random.split(key, 2)
    state = jax.random.normal(keys[0], (number, 1))
    return state, 0.5 * state + jax.random.rademacher(keys[1], (number, 1), jnp.float32)


@pytest.mark.slow
def test_a_classifier_tells_only_what_differs(script, args):
    keys = jax.random.split(KEY, 3)
    real = toy(keys[0])
    same = script.told_apart(keys[2], real, toy(keys[1]), args)
    # Each by itself as the data have it, but not together.
    state, x_0 = toy(keys[1])
    shuffled = state, x_0[::-1]
    assert abs(same - 0.5) < 0.06
    assert script.told_apart(keys[2], real, shuffled, args) > 0.65


@pytest.mark.slow
def test_one_step_is_a_mean_and_an_adversary_draws(script, args):
    pairs = toy(KEY)
    zeros = jnp.zeros((2000, 1))

    def drawn(make, budget):
        made = make(jax.random.key(1), pairs, 1, budget)
        return script.sampler(made, 1, 1)(jax.random.key(2), zeros)

    assert script.rms(drawn(script.diffusion_model, args)) < 0.25
    found = drawn(script.gan_model, dataclasses.replace(args, seconds=8.0))
    assert 0.5 < script.rms(found) < 1.2
    assert 0.3 < jnp.mean(found > 0) < 0.7
