"""The encoders against loops, and what they must not see."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.evaluators import network as evaluator_network
from tests import tiny
from tests.reference import matching as oracle

NET = evaluator_network.Matcher(
    movement_width=8, motion_width=10, text_width=6, embedding=5, dropout=0.3
)
FRAMES = np.array([20, 4, 13, 18])
WORDS = np.array([3, 6, 1, 5])


@functools.cache
def inputs():
    generator = np.random.default_rng(0)
    tags = np.eye(4)[generator.integers(0, 4, (4, 6))]
    return (
        jnp.asarray(generator.normal(size=(4, 20, 7)), jnp.float32),
        jnp.asarray(FRAMES, jnp.int32),
        jnp.asarray(generator.normal(size=(4, 6, 9)), jnp.float32),
        jnp.asarray(tags, jnp.float32),
        jnp.asarray(WORDS, jnp.int32),
    )


@functools.cache
def params():
    return tiny.random_params(NET.init, *inputs())["params"]


@functools.cache
def embed():
    return functools.partial(jax.jit(NET.apply), {"params": params()})


def test_embeddings_are_the_loops():
    """Each row alone, without padding: motions of 20, 4, 13 (so 12) and 18 frames."""
    features, frames, vectors, tags, words = inputs()
    text, motion = embed()(*inputs())
    assert text.shape == motion.shape == (4, 5)
    for i in range(4):
        want = oracle.motion(params(), features[i], FRAMES[i])
        np.testing.assert_allclose(motion[i], want, atol=2e-5)
        want = oracle.text(params(), vectors[i], tags[i], WORDS[i])
        np.testing.assert_allclose(text[i], want, atol=2e-5)


def test_padding_is_not_seen():
    features, frames, vectors, tags, words = inputs()
    beyond = np.arange(20)[None] >= (FRAMES // 4 * 4)[:, None]
    features = jnp.where(beyond[..., None], jnp.nan, features)
    after = np.arange(6)[None] >= WORDS[:, None]
    vectors = jnp.where(after[..., None], 100.0, vectors)
    text, motion = embed()(features, frames, vectors, tags, words)
    np.testing.assert_array_equal(text, embed()(*inputs())[0])
    np.testing.assert_array_equal(motion, embed()(*inputs())[1])


def test_last_frame_and_last_word_are_seen():
    features, frames, vectors, tags, words = inputs()
    row = np.arange(4)
    features = features.at[row, FRAMES // 4 * 4 - 1].add(1.0)
    tags = tags.at[row, WORDS - 1].add(1.0)
    text, motion = embed()(features, frames, vectors, tags, words)
    assert np.abs(text - embed()(*inputs())[0]).max(axis=-1).min() > 1e-3
    assert np.abs(motion - embed()(*inputs())[1]).max(axis=-1).min() > 1e-3


def test_movements_of_four_frames():
    net = evaluator_network.MovementEncoder(width=8)
    x = jax.random.normal(jax.random.key(0), (2, 23, 7))
    variables = tiny.random_params(net.init, x)
    got = net.apply(variables, x)
    assert got.shape == (2, 5, 8)
    want = oracle.movements(variables["params"], np.asarray(x[1], np.float64))
    np.testing.assert_allclose(got[1], want, atol=1e-5)


def test_dropout_is_of_movements_and_needs_training():
    apply = jax.jit(
        lambda params, key: NET.apply(
            {"params": params}, *inputs(), train=True, rngs={"dropout": key}
        )
    )
    draw = lambda seed: apply(params(), jax.random.key(seed))  # noqa: E731
    np.testing.assert_array_equal(draw(0)[1], draw(0)[1])
    assert np.abs(draw(0)[1] - draw(1)[1]).max() > 1e-3
    np.testing.assert_array_equal(draw(0)[0], draw(1)[0])


def test_gradients_reach_every_array():
    def loss(params):
        text, motion = NET.apply({"params": params}, *inputs())
        return jnp.sum(text**3) + jnp.sum(motion**3)

    grads = jax.tree_util.tree_leaves_with_path(jax.jit(jax.grad(loss))(params()))
    flat = {jax.tree_util.keystr(path): np.abs(x).max() for path, x in grads}
    assert all(np.isfinite(x) and x > 0 for x in flat.values()), flat


def test_published_size():
    def sequence(channels, width):
        gru = 6 * width**2 + 4 * width  # r and z have one bias, n has two
        layers = (channels + 1) * width + (2 * width + 1) * width + (width + 1) * 512
        return 2 * (width + gru) + layers + 2 * width

    movement = (4 * 259 + 1) * 512 + (4 * 512 + 1) * 512 + (512 + 1) * 512
    size = movement + sequence(512, 1024) + sequence(300, 512) + 16 * 300
    one = jax.ShapeDtypeStruct((1,), jnp.int32)
    shapes = jax.eval_shape(
        evaluator_network.Matcher().init,
        jax.eval_shape(lambda: jax.random.key(0)),
        jax.ShapeDtypeStruct((1, 8, 259), jnp.float32),
        one,
        jax.ShapeDtypeStruct((1, 3, 300), jnp.float32),
        jax.ShapeDtypeStruct((1, 3, 15), jnp.float32),
        one,
    )
    assert sum(x.size for x in jax.tree.leaves(shapes)) == size
