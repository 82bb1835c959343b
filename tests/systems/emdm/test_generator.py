"""EMDM's generator against plain NumPy, and what it depends on."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.networks import blocks
from jaxmotion.systems.emdm import network as emdm_network
from tests import mostly_slow, tiny
from tests.reference import emdm as reference

NET = emdm_network.SequenceGenerator(
    features=3,
    frames=6,
    num_steps=4,
    latent=5,
    width=16,
    depth=2,
    heads=4,
    hidden=24,
    dropout=0.5,
)
# Each change of the paper's network at least once, and all tokens with and without.
KINDS = {
    "action": {},
    "text": dict(condition="text"),
    "none": dict(condition="none"),
    "denoiser": dict(latent=0),
    "nothing but time": dict(condition="none", latent=0),
    "folded": dict(frames_per_token=2),
    "pre": dict(norm="pre", condition="text"),
}
SIZE = 4
MASK = np.arange(6)[None] < np.array([[4], [6]])


def network(name):
    return dataclasses.replace(NET, **KINDS[name])


def normal(*shape, seed=0):
    values = np.random.default_rng(seed).normal(size=shape)
    return tiny.float32(values)


def given(net, mask=MASK):
    """x_t, t, condition, keep, mask and latent of two samples."""
    size = 0 if net.condition == "none" else SIZE
    return (
        normal(2, 6, 3),
        jnp.array([2, 4]),
        normal(2, size, seed=1),
        jnp.array([True, True]),
        jnp.asarray(mask),
        normal(2, net.latent, seed=2) if net.latent else None,
    )


@functools.cache
def parameters(name):
    """Random ones, norms as well."""
    params = tiny.random_params(network(name).init, *given(network(name)))
    rng = np.random.default_rng(3)
    shake = lambda x: x + jnp.asarray(0.1 * rng.normal(size=x.shape), x.dtype)  # noqa: E731
    return jax.tree.map(shake, params)


def layer(params):
    """A linear layer as the oracles want it."""
    bias = params.get("bias", np.zeros(params["kernel"].shape[-1]))
    return {"weight": params["kernel"], "bias": np.asarray(bias)}


def dense(params, x):
    return reference.linear(x, layer(params))


def layer_norm(params, x):
    mean, var = x.mean(-1, keepdims=True), x.var(-1, keepdims=True)
    unit = (x - mean) / np.sqrt(var + 1e-5)
    return unit * np.float64(params["scale"]) + np.float64(params["bias"])


def attention(params, x, seen, heads):
    """From the tokens x [tokens, width] to those that are seen, head by head."""
    q, (k, v) = dense(params["query"], x), np.split(dense(params["key_value"], x), 2, 1)
    size, out = x.shape[1] // heads, []
    for h in range(heads):
        part = slice(h * size, (h + 1) * size)
        logits = q[:, part] @ k[seen, part].T / np.sqrt(size)
        weights = np.exp(logits - logits.max(1, keepdims=True))
        out.append(weights / weights.sum(1, keepdims=True) @ v[seen, part])
    return dense(params["out"], np.concatenate(out, 1))


def encoder_layer(params, x, seen, heads, norm):
    norm_1, norm_2 = params["norm_1"], params["norm_2"]
    feed = lambda y: dense(  # noqa: E731
        params["contract"], reference.selu(dense(params["expand"], y))
    )
    if norm == "pre":
        x = x + attention(params, layer_norm(norm_1, x), seen, heads)
        return x + feed(layer_norm(norm_2, x))
    x = layer_norm(norm_1, x + attention(params, x, seen, heads))
    return layer_norm(norm_2, x + feed(x))


def plain(net, params, x_t, t, condition, keep, mask, latent):
    """One sample, in float64."""
    width, fold = net.width, net.frames_per_token
    hidden = dense(params["embed_time"]["hidden"], codes(net.num_steps, width)[t - 1])
    own = [dense(params["embed_time"]["out"], hidden / (1 + np.exp(-hidden)))]
    if net.condition != "none":
        vector = np.float64(condition) if keep else np.zeros(len(condition))
        own.append(dense(params["embed_condition"], vector))
    if net.latent:
        layers = [layer(params["embed_latent"][f"layers_{i}"]) for i in range(5)]
        own.append(reference.latent_mlp(layers, np.float64(latent)))
    rows = np.float64(x_t).reshape(net.frames // fold, -1)
    x = np.concatenate([np.stack(own), dense(params["embed_noisy"], rows)])
    x = x + codes(len(x), width)
    kept = np.asarray(mask).reshape(net.frames // fold, fold).any(1)
    seen = np.concatenate([np.ones(len(own), bool), kept])
    for i in range(net.depth):
        x = encoder_layer(params[f"layers_{i}"], x, seen, net.heads, net.norm)
    if net.norm == "pre":
        x = layer_norm(params["norm_out"], x)
    return dense(params["out"], x[len(own) :]).reshape(net.frames, net.features)


def codes(num, width):
    """Sines on even channels, cosines on odd ones."""
    out = np.empty((num, width))
    for place, i in np.ndindex(num, width // 2):
        angle = place / 1e4 ** (2 * i / width)
        out[place, 2 * i : 2 * i + 2] = np.sin(angle), np.cos(angle)
    return out


@pytest.mark.parametrize("name", mostly_slow(KINDS, ["action", "folded", "pre"]))
def test_network_is_the_formula(name):
    """Also for a sample whose condition is dropped."""
    net, params = network(name), parameters(name)["params"]
    x_t, t, condition, _, mask, latent = given(net)
    arguments = x_t, t, condition, jnp.array([True, False]), mask, latent
    found = jax.jit(net.apply)({"params": params}, *arguments)
    for i in range(2):
        own = [None if x is None else np.asarray(x)[i] for x in arguments]
        expected = plain(net, params, *own)
        np.testing.assert_allclose(found[i], expected, rtol=2e-4, atol=2e-5)


def test_latent_mlp_is_the_formula():
    net, latent = emdm_network.LatentMlp(7), normal(5)
    params = tiny.random_params(net.init, latent)
    layers = [layer(params["params"][f"layers_{i}"]) for i in range(5)]
    assert len(params["params"]) == 5
    expected = reference.latent_mlp(layers, np.float64(latent))
    found = net.apply(params, latent)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["action", "text"])
def test_a_dropped_condition_is_a_zero_vector(name):
    """Nothing is left of an action, and of a text the bias of its layer."""
    net, params = network(name), parameters(name)
    _, _, condition, keep, mask, _ = given(net)

    def token(condition, keep):
        return net.apply(params, condition, keep, mask, method="encode").condition

    dropped = token(condition, ~keep)
    np.testing.assert_array_equal(dropped, token(jnp.zeros_like(condition), keep))
    weights = params["params"]["embed_condition"]
    left = weights["bias"] if name == "text" else np.zeros(16)
    assert ("bias" in weights) == (name == "text")
    np.testing.assert_allclose(dropped, np.stack([left, left]), atol=1e-6)
    assert np.abs(token(condition, keep) - dropped).max() > 0.1


@pytest.mark.slow
def test_actions_start_as_a_table_of_unit_normal_draws():
    net = dataclasses.replace(NET, width=512, depth=1)
    actions = jnp.eye(SIZE)[:2]
    x_t, t, _, keep, mask, latent = given(net)
    arguments = x_t, t, actions, keep, mask, latent
    made = jax.jit(net.init)(jax.random.key(0), *arguments)
    table = np.asarray(made["params"]["embed_condition"]["kernel"])
    assert table.shape == (SIZE, 512)
    np.testing.assert_allclose(table.std(1), 1.0, atol=5 / np.sqrt(2 * 512))
    found = net.apply(made, actions, keep, mask, method="encode").condition
    np.testing.assert_allclose(found, table[:2], rtol=1e-6)


@pytest.mark.parametrize("name", mostly_slow(["action", "folded"], ["folded"]))
@pytest.mark.parametrize("masked", [True, False])
def test_frames_behind_the_end_are_seen_only_without_a_mask(name, masked):
    net, params = network(name), parameters(name)
    ends = MASK if masked else np.ones_like(MASK)
    x_t, t, condition, keep, mask, latent = given(net, ends)

    @jax.jit
    def run(x):
        return net.apply(params, x, t, condition, keep, mask, latent)

    behind = jnp.where(MASK[..., None], x_t, x_t + 5.0)
    gap = np.abs(run(behind) - run(x_t))
    if masked:
        assert gap[0, :4].max() < 1e-5 < gap[0, 4:].max()
    else:
        assert gap[0, :4].min() > 1e-5
    assert gap[1].max() == 0.0


def test_a_folded_token_counts_if_one_of_its_frames_does():
    net, params = network("folded"), parameters("folded")
    x_t, t, condition, keep, _, latent = given(net)

    @jax.jit
    def masked(x, ends):
        mask = jnp.arange(6)[None] < ends[:, None]
        return net.apply(params, x, t, condition, keep, mask, latent)

    run = lambda x, ends: masked(x, jnp.array(ends))  # noqa: E731
    np.testing.assert_array_equal(run(x_t, [3, 5]), run(x_t, [4, 6]))
    changed = x_t.at[:, 3].add(1.0)
    assert np.abs(run(changed, [3, 3]) - run(x_t, [3, 3]))[:, :2].max() > 1e-4


@pytest.mark.slow
def test_a_batch_is_its_samples_and_one_step_serves_all():
    params = parameters("action")
    x_t, t, condition, keep, mask, latent = given(NET)
    run = functools.partial(NET.apply, params)
    together = jax.jit(run)(x_t, t, condition, keep, mask, latent)
    alone = jax.jit(jax.vmap(run))(x_t, t, condition, keep, mask, latent)
    np.testing.assert_allclose(together, alone, rtol=1e-4, atol=1e-5)
    one = jax.jit(run)(x_t, jnp.array(2), condition, keep, mask, latent)
    np.testing.assert_allclose(one[0], together[0], rtol=1e-4, atol=1e-5)
    assert np.abs(one[1] - together[1]).max() > 1e-3
    # Any leading axes.
    wide = [x[None] for x in (x_t, t, condition, keep, mask, latent)]
    np.testing.assert_allclose(jax.jit(run)(*wide)[0], together, atol=1e-5)


def test_dropout_only_in_training_and_by_its_key():
    arguments, params = given(NET), parameters("action")

    @jax.jit
    def run(key):
        return NET.apply(params, *arguments, train=True, rngs={"dropout": key})

    first, same, other = (run(jax.random.key(n)) for n in (0, 0, 1))
    np.testing.assert_array_equal(first, same)
    assert np.abs(first - other).max() > 1e-3
    calm = jax.jit(functools.partial(NET.apply, params))(*arguments)
    assert np.abs(calm - first).max() > 1e-3


# --- sizes as published ------------------------------------------------------------


def counts(net, size):
    """Parameters of each part, without making them."""
    arguments = (
        jnp.zeros((1, net.frames, net.features)),
        jnp.ones(1, jnp.int32),
        jnp.zeros((1, size)),
        jnp.ones(1, bool),
        jnp.ones((1, net.frames), bool),
        jnp.zeros((1, net.latent)) if net.latent else None,
    )
    shapes = jax.eval_shape(lambda k: net.init(k, *arguments), jax.random.key(0))
    return {
        name: sum(np.prod(x.shape) for x in jax.tree.leaves(part))
        for name, part in shapes["params"].items()
    }


@pytest.mark.parametrize("name", ["action", "text"])
def test_published_sizes(name):
    features, frames, size = {"action": (150, 60, 12), "text": (263, 196, 512)}[name]
    net = emdm_network.SequenceGenerator(
        features=features, frames=frames, condition=name, latent=64
    )
    found = counts(net, size)
    layers = [found.pop(f"layers_{i}") for i in range(12)]
    assert sum(layers) == 12 * (6 * 1024**2 + 10 * 1024) == 75_620_352
    linear = lambda n, m: n * m + m  # noqa: E731
    assert found == {
        "embed_time": 2 * linear(1024, 1024),
        "embed_condition": linear(512, 1024) if name == "text" else 12 * 1024,
        "embed_latent": linear(64, 1024) + 4 * linear(1024, 1024),
        "embed_noisy": linear(features, 1024),
        "out": linear(1024, features),
    }


# --- what the encoder layer of all denoisers has got for it ------------------------


@pytest.mark.parametrize("norm", ["post", "pre"])
@pytest.mark.parametrize("activation", mostly_slow(["gelu", "selu"], ["gelu"]))
def test_a_masked_layer_is_one_of_fewer_tokens(norm, activation):
    net = blocks.EncoderLayer(8, 2, 12, 0.0, norm, activation)
    x, mask = normal(2, 5, 8), jnp.array([[1, 0, 1, 1, 0], [0, 1, 1, 0, 0]], bool)
    params = tiny.random_params(lambda k, y: net.init(k, y, train=False), x)
    run = jax.jit(
        functools.partial(net.apply, params, train=False), static_argnames="last"
    )
    found = run(x, mask=mask)
    for i in range(2):
        kept = np.flatnonzero(mask[i])
        alone = run(x[i][kept])
        np.testing.assert_allclose(found[i][kept], alone, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(run(x, mask=jnp.ones_like(mask)), run(x), atol=1e-6)
    last = run(x, mask=mask, last=2)
    np.testing.assert_allclose(last, found[:, -2:], rtol=1e-5, atol=1e-5)


def test_activations_are_told_apart():
    x, found = normal(3, 8), []
    for name, bend in (("gelu", blocks.gelu), ("selu", reference.selu)):
        net = blocks.EncoderLayer(8, 2, 12, 0.0, "pre", name)
        params = tiny.random_params(lambda k, y, n=net: n.init(k, y, train=False), x)
        weights = params["params"]
        h = np.float64(x)
        h = h + attention(weights, layer_norm(weights["norm_1"], h), np.arange(3), 2)
        inner = dense(weights["expand"], layer_norm(weights["norm_2"], h))
        bent = np.float64(bend(jnp.asarray(inner)))
        expected = h + dense(weights["contract"], bent)
        found.append(jax.jit(functools.partial(net.apply, train=False))(params, x))
        np.testing.assert_allclose(found[-1], expected, rtol=1e-4, atol=1e-5)
    assert np.abs(found[0] - found[1]).max() > 1e-2
