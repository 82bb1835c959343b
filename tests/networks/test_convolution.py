"""Convolution as a product of matrices, against XLA's."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.networks import convolution


@pytest.mark.parametrize("frames", [4, 7, 8])
@pytest.mark.parametrize(
    ("width", "stride", "padding"),
    [
        (1, 1, "SAME"),
        (3, 1, "SAME"),
        (4, 2, ((1, 1),)),
        (3, 2, "VALID"),
        (2, 3, "SAME"),
    ],
)
def test_values_and_gradients_are_those_of_xla(frames, width, stride, padding):
    generator = np.random.default_rng(0)
    x = jnp.asarray(generator.normal(size=(2, frames, 5)), jnp.float32)
    kernel = jnp.asarray(generator.normal(size=(width, 5, 6)), jnp.float32)

    def ours(x, kernel):
        return convolution.convolve(x, kernel, (stride,), padding)

    def theirs(x, kernel):
        return jax.lax.conv_general_dilated(
            x, kernel, (stride,), padding, dimension_numbers=("NWC", "WIO", "NWC")
        )

    results = []
    for function in (ours, theirs):

        @jax.jit
        def whole(x, kernel, function=function):
            value, pull = jax.vjp(function, x, kernel)
            return value, *pull(jnp.cos(value))

        results.append(whole(x, kernel))
    for found, expected in zip(*results, strict=True):
        assert found.shape == expected.shape
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_layer_has_the_same_parameters():
    x = jax.random.normal(jax.random.key(0), (3, 9, 5))
    plain = nn.Conv(7, (3,))
    layer = nn.Conv(7, (3,), conv_general_dilated=convolution.convolve)
    params = plain.init(jax.random.key(1), x)
    assert jax.tree.all(
        jax.tree.map(jnp.array_equal, params, layer.init(jax.random.key(1), x))
    )
    np.testing.assert_allclose(
        layer.apply(params, x), plain.apply(params, x), atol=1e-5
    )


@pytest.mark.parametrize("what", ["kernel_dilation", "feature_group_count"])
def test_what_it_does_not_do_is_refused(what):
    layer = nn.Conv(6, (3,), conv_general_dilated=convolution.convolve, **{what: 2})
    with pytest.raises(ValueError, match="expected 1"):
        layer.init(jax.random.key(0), jnp.zeros((1, 8, 4)))
