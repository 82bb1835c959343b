"""Work that is counted, against the compiler's count and by hand."""

import jax
import jax.numpy as jnp
import pytest
from flax import linen as nn
from jax import lax

from jaxmotion.diffusion import guidance
from jaxmotion.networks import work


def test_flops_are_those_of_the_compiler_where_there_is_no_loop():
    x, kernel = jnp.ones((2, 7, 5)), jnp.ones((3, 5, 4))
    products = {
        "matrices": (lambda a, b: a @ b, (jnp.ones((7, 5)), jnp.ones((5, 3)))),
        "batch": (lambda a, b: jnp.einsum("bij,bkj->bik", a, b), (x, x)),
        "convolution": (
            lambda a, b: lax.conv_general_dilated(
                a, b, (1,), "VALID", dimension_numbers=("NWC", "WIO", "NWC")
            ),
            (x, kernel),
        ),
    }
    for name, (function, given) in products.items():
        compiled = jax.jit(function).lower(*given).compile()
        expected = compiled.cost_analysis()["flops"]
        assert work.count(function, *given).flops == expected, name


def test_a_loop_counts_as_often_as_it_runs():
    x, w = jnp.ones((1, 4)), jnp.ones((4, 4))

    def loop(x, w):
        return lax.scan(lambda c, _: (c @ w, None), x, length=8)[0]

    def branch(x, w):
        return lax.cond(x[0, 0] > 0, lambda: loop(x, w), lambda: x)

    assert work.count(loop, x, w).flops == 8 * 2 * 4 * 4
    assert work.count(jax.jit(branch), x, w).flops == 8 * 2 * 4 * 4
    endless = lambda x, w: lax.while_loop(  # noqa: E731
        lambda c: c[0, 0] < 9, lambda c: c @ w, x
    )
    with pytest.raises(ValueError, match="while"):
        work.count(endless, x, w)


def test_guidance_and_batches_multiply_network_calls():
    net = nn.Sequential([nn.Dense(4), nn.Dense(4)])
    params = net.init(jax.random.key(0), jnp.ones(4))

    def denoise(key, x_t, t, cond):
        return net.apply(params, x_t + cond)

    def chain(denoise, x):
        step = lambda x, t: (denoise(jax.random.key(0), x, t), None)  # noqa: E731
        return lax.scan(step, x, jnp.arange(3))[0]

    ones = jnp.ones(4)
    plain = lambda x: chain(lambda k, x, t: denoise(k, x, t, ones), x)  # noqa: E731
    guided = guidance.classifier_free(denoise, ones, 0 * ones, 2.0)
    assert work.count(plain, ones).network_calls == 3
    assert work.count(lambda x: chain(guided, x), ones).network_calls == 6
    many = jnp.ones((5, 4))
    assert work.count(jax.vmap(plain), many).network_calls == 15
    assert work.count(lambda x: lax.map(plain, x), many).network_calls == 15
    slope = jax.grad(lambda x: denoise(None, x, 1, ones).sum())
    assert work.count(slope, ones).network_calls == 1
