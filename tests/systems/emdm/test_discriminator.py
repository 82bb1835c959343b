"""EMDM's discriminator against its oracle, its published sizes, and its inputs."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.systems.emdm import network as emdm_network
from tests import tiny
from tests.reference import emdm as reference

NET = emdm_network.SequenceDiscriminator(num_steps=4, width=128, time_width=16)


def normal(*shape, seed=0):
    values = np.random.default_rng(seed).normal(size=shape)
    return tiny.float32(values)


def pair(*batch, size=2, frames=5):
    """x_{t-1}, x_t, t and condition."""
    steps = np.random.default_rng(4).integers(1, 5, batch)
    return (
        normal(*batch, frames, 3),
        normal(*batch, frames, 3, seed=1),
        jnp.asarray(steps, jnp.int32),
        normal(*batch, size, seed=2),
    )


def make(net, *arguments):
    """Random parameters, norms as well."""
    params = tiny.random_params(net.init, *arguments)["params"]
    rng = np.random.default_rng(3)
    shake = lambda x: x + jnp.asarray(0.3 * rng.normal(size=x.shape), x.dtype)  # noqa: E731
    return {
        name: jax.tree.map(shake, part) if name.startswith("norm") else part
        for name, part in params.items()
    }


@functools.cache
def parameters():
    return make(NET, *pair())


def oracle(params):
    """The same parameters by the oracle's names."""
    linear = lambda part: {"weight": part["kernel"], "bias": part["bias"]}  # noqa: E731
    layers = [linear(params[f"layers_{i}"]) for i in range(6)]
    return {
        "time": [linear(params["time_hidden"]), linear(params["time_out"])],
        "layers": [*layers, linear(params["out"])],
        "norms": [params["norm_1"], params["norm_2"]],
    }


def test_network_is_the_formula_at_every_step():
    params = parameters()
    x_prev, x_t, _, condition = pair()
    run, found = jax.jit(NET.apply), []
    for t in range(1, 5):
        found.append(run({"params": params}, x_prev, x_t, jnp.array(t), condition))
        expected = reference.discriminator(
            oracle(params),
            *map(np.float64, (x_prev, x_t)),
            t - 1,
            np.float64(condition),
            width=16,
            groups=(4, 2),
        )
        np.testing.assert_allclose(found[-1], expected, rtol=1e-4, atol=1e-5)
    assert np.ptp(found) > 1e-3


def test_widths_and_groups_are_the_published_ones():
    net = emdm_network.SequenceDiscriminator()
    arguments = pair()
    params = make(net, *arguments)
    widths = [params[f"layers_{i}"]["kernel"].shape[1] for i in range(6)]
    assert widths == [1024, 1024, 512, 512, 256, 64]
    x_prev, x_t, t, condition = arguments
    expected = reference.discriminator(
        oracle(params), x_prev, x_t, int(t) - 1, condition
    )
    found = jax.jit(net.apply)({"params": params}, *arguments)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("features", "frames", "condition", "count"),
    [(150, 60, 12, 20_597_377), (263, 196, 512, 108_247_681), (251, 196, 512, None)],
)
def test_published_sizes(features, frames, condition, count):
    net = emdm_network.SequenceDiscriminator()
    x = jnp.zeros((1, frames, features))
    arguments = x, x, jnp.ones(1, jnp.int32), jnp.zeros((1, condition))
    shapes = jax.eval_shape(lambda k: net.init(k, *arguments), jax.random.key(0))
    found = sum(np.prod(x.shape) for x in jax.tree.leaves(shapes))
    inputs = 2 * features * frames + 128 + condition
    assert shapes["params"]["layers_0"]["kernel"].shape == (inputs, 1024)
    millions = {150: 20.597, 263: 108.248, 251: 103.431}[features]
    assert round(found / 1e6, 3) == millions
    assert count is None or found == count


@pytest.mark.parametrize("num_steps", [1, 7])
def test_codes_of_steps(num_steps):
    found = emdm_network.step_codes(num_steps, 12)
    expected = [reference.time_code(t, 12) for t in (0, *range(num_steps))]
    np.testing.assert_allclose(found, np.stack(expected), atol=1e-6)


def test_a_batch_is_its_samples():
    """The norms must not mix them, whatever the batch axes."""
    run = functools.partial(NET.apply, {"params": parameters()})
    arguments = pair(2, 3)
    together = jax.jit(run)(*arguments)
    assert together.shape == (2, 3)
    alone = jax.jit(jax.vmap(jax.vmap(run)))(*arguments)
    np.testing.assert_allclose(together, alone, rtol=1e-4, atol=1e-5)
    assert np.ptp(together) > 0.1


def test_without_a_condition_its_vector_has_no_channels():
    arguments = pair(3, size=0)
    params = make(NET, *arguments)
    assert params["layers_0"]["kernel"].shape == (2 * 15 + 16, 128)
    assert jax.jit(NET.apply)({"params": params}, *arguments).shape == (3,)


# --- the temporal one ---------------------------------------------------------------

TEMPORAL = emdm_network.TemporalDiscriminator(num_steps=4, width=8, time_width=16)


def leaky(x):
    return np.where(x > 0, x, 0.2 * x)


def dense(part, x):
    return x @ np.float64(part["kernel"]) + np.float64(part.get("bias", 0))


def convolved(part, x):
    """Correlation over time with zeros beyond the ends, a channel at a time."""
    kernel = np.float64(part["kernel"]).reshape(3, x.shape[1], -1)
    out = np.zeros((len(x), kernel.shape[2])) + np.float64(part["bias"])
    for i in range(x.shape[1]):
        for j in range(kernel.shape[2]):
            out[:, j] += np.correlate(np.pad(x[:, i], 1), kernel[:, i, j], "valid")
    return out


def temporal_oracle(params, x_prev, x_t, t, condition):
    code = reference.time_code(t - 1, 16)
    given = leaky(dense(params["given"], np.concatenate([code, condition])))
    h = dense(params["embed"], np.concatenate([x_prev, x_t], axis=1))
    for i in range(5):
        part = params[f"blocks_{i}"]
        inner = convolved(part["first"], leaky(h)) + dense(part["given"], given)
        h = h + convolved(part["second"], leaky(inner))
        if i in (1, 2, 3):
            h = np.stack([h[k : k + 2].mean(axis=0) for k in range(0, len(h) - 1, 2)])
    h = dense(params["hidden"], leaky(h).reshape(-1))
    projected = dense(params["project"], condition) @ h / np.sqrt(8)
    return dense(params["out"], leaky(h))[0] + projected


@pytest.mark.parametrize("frames", [8, 13])
def test_temporal_network_is_convolutions_of_three_frames(frames):
    arguments = pair(3, frames=frames)
    params = make(TEMPORAL, *arguments)
    found = jax.jit(TEMPORAL.apply)({"params": params}, *arguments)
    x_prev, x_t, t, condition = (np.float64(x) for x in arguments)
    expected = [
        temporal_oracle(params, x_prev[i], x_t[i], int(t[i]), condition[i])
        for i in range(3)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert np.ptp(found) > 1e-2


def test_a_temporal_network_needs_no_condition_and_any_batch():
    arguments = pair(2, 3, size=0, frames=8)
    params = make(TEMPORAL, *arguments)
    run = functools.partial(TEMPORAL.apply, {"params": params})
    together = jax.jit(run)(*arguments)
    alone = jax.jit(jax.vmap(jax.vmap(run)))(*arguments)
    assert together.shape == (2, 3)
    np.testing.assert_allclose(together, alone, rtol=1e-4, atol=1e-5)
