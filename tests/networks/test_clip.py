"""CLIP's text tower against a float64 oracle, and what its mask promises."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.networks.clip import ClipText, quick_gelu
from tests.reference import clip as reference

SIZES = dict(vocabulary=30, context=9, width=12, depth=2, hidden=20, dimensions=7)
HEADS, END = 3, 29
IDS = [[1, 4, 7, 7, END, 0, 0], [2, END, 5, END, 8, 1, 1], [3, 3, 2, 9, 1, 28, END]]


@pytest.fixture(scope="module")
def weights():
    return reference.random_weights(np.random.default_rng(3), **SIZES)


@pytest.fixture(scope="module")
def net():
    return ClipText(**SIZES, heads=HEADS, end_of_text=END)


def as_params(weights, depth=SIZES["depth"]):
    """The names of the hub to those of the module."""

    def pair(stem, norm=False):
        weight, bias = (jnp.asarray(weights[f"{stem}.{x}"]) for x in ("weight", "bias"))
        return {"scale" if norm else "kernel": weight.T, "bias": bias}

    def layer(stem):
        return {
            "query": pair(f"{stem}.self_attn.q_proj"),
            "key": pair(f"{stem}.self_attn.k_proj"),
            "value": pair(f"{stem}.self_attn.v_proj"),
            "out": pair(f"{stem}.self_attn.out_proj"),
            "expand": pair(f"{stem}.mlp.fc1"),
            "contract": pair(f"{stem}.mlp.fc2"),
            "norm_1": pair(f"{stem}.layer_norm1", norm=True),
            "norm_2": pair(f"{stem}.layer_norm2", norm=True),
        }

    def table(name):
        stem = f"text_model.embeddings.{name}_embedding"
        return {"embedding": jnp.asarray(weights[f"{stem}.weight"])}

    layers = {
        f"layers_{i}": layer(f"text_model.encoder.layers.{i}") for i in range(depth)
    }
    return layers | {
        "token_embedding": table("token"),
        "position_embedding": table("position"),
        "norm_out": pair("text_model.final_layer_norm", norm=True),
        "projection": {"kernel": jnp.asarray(weights["text_projection.weight"]).T},
    }


def test_against_the_oracle(weights, net):
    found = jax.jit(net.apply)({"params": as_params(weights)}, jnp.array(IDS))
    expected = [reference.encode(weights, ids, END, HEADS) for ids in IDS]
    assert np.std(expected) > 0.1
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_what_follows_the_first_end_does_not_matter(weights, net):
    rows = [[1, 4, END, END, END], [1, 4, END, 7, 2], [1, 5, END, END, END]]
    params, apply = {"params": as_params(weights)}, jax.jit(net.apply)
    one, other, before = apply(params, jnp.array(rows))
    np.testing.assert_allclose(one, other, atol=1e-6)
    assert np.abs(one - before).max() > 0.01
    short = apply(params, jnp.array(rows)[:, :3])
    np.testing.assert_allclose(one, short[0], atol=1e-5)


def test_order_matters(weights, net):
    ids = jnp.array([[1, 4, 5, END], [1, 5, 4, END]])
    found = jax.jit(net.apply)({"params": as_params(weights)}, ids)
    assert np.abs(found[0] - found[1]).max() > 0.01


def test_default_sizes_are_those_of_the_released_text_tower():
    """63 428 096 by hand: embeddings, 12 layers, last norm, projection."""
    ids = jax.ShapeDtypeStruct((1, 77), "int32")
    shapes = jax.eval_shape(lambda i: ClipText().init(jax.random.key(0), i), ids)
    width, hidden = 512, 2048
    layer = 4 * (width**2 + width) + 2 * width * hidden + hidden + width + 4 * width
    expected = (49408 + 77) * width + 12 * layer + 2 * width + width**2
    assert sum(x.size for x in jax.tree.leaves(shapes)) == expected == 63_428_096
    names = {f"layers_{i}" for i in range(12)}
    names |= {"token_embedding", "position_embedding", "norm_out", "projection"}
    assert set(shapes["params"]) == names


@pytest.mark.slow
def test_initialized_output_is_finite(net):
    found, _ = jax.jit(net.init_with_output)(jax.random.key(1), jnp.array(IDS))
    assert found.shape == (3, 7)
    assert np.isfinite(found).all()


def test_too_many_tokens(net):
    with pytest.raises(ValueError, match="10 tokens do not fit the context 9"):
        jax.eval_shape(
            lambda ids: net.init(jax.random.key(0), ids), jnp.zeros((1, 10), jnp.int32)
        )


def test_quick_gelu():
    x = np.linspace(-9.0, 9.0, 101)
    found = quick_gelu(jnp.asarray(x, jnp.float32))
    np.testing.assert_allclose(found, x / (1 + np.exp(-1.702 * x)), atol=1e-6)
