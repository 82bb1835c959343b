"""Shapes, variants and the cut of the denoisers in two; parity has its own file."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.networks import blocks, transformer
from jaxmotion.systems.camdm import network as camdm_network
from tests import mostly_slow, tiny

SIZES = dict(
    features=12,
    past=4,
    future=6,
    num_labels=3,
    num_steps=4,
    width=16,
    depth=2,
    heads=2,
    hidden=24,
    dropout=0.3,
)
KINDS = {
    "transformer": transformer.CamdmTransformer(**SIZES),
    "one layer": transformer.CamdmTransformer(**(SIZES | {"depth": 1})),
    "two frames a token": transformer.CamdmTransformer(**SIZES, frames_per_token=2),
    "overlapping tokens": transformer.CamdmTransformer(
        **SIZES, frames_per_token=2, token_margin=1
    ),
    "one label": transformer.CamdmTransformer(**SIZES | {"num_labels": 1}),
    "pre-norm": transformer.CamdmTransformer(**SIZES, norm="pre"),
    "prefix": transformer.CamdmTransformer(**SIZES, attention="prefix"),
    "prefix, convolution": transformer.CamdmTransformer(
        **(SIZES | {"depth": 1}), attention="prefix", norm="pre", frame_kernel=3
    ),
    "going on from the past": transformer.CamdmTransformer(
        **SIZES, attention="prefix", seam_half_life=2.0
    ),
    "mlp": camdm_network.CamdmMlp(**SIZES),
    "single token": camdm_network.SingleTokenTransformer(**SIZES),
    "single token, pre-norm, overlapping": camdm_network.SingleTokenTransformer(
        **SIZES, frames_per_token=2, token_margin=1, norm="pre"
    ),
}
TRANSFORMERS = [name for name in KINDS if not name.startswith(("mlp", "single"))]


def arguments(*batch):
    """x_t, t, past, path, facing, label, keep_past."""
    generator = np.random.default_rng(0)
    normal = lambda *shape: jnp.asarray(  # noqa: E731
        generator.normal(size=(*batch, *shape)), jnp.float32
    )
    whole = lambda high: jnp.asarray(  # noqa: E731
        generator.integers(0, high, batch), jnp.int32
    )
    return (
        normal(6, 12),
        1 + whole(4),
        normal(4, 12),
        normal(6, 2),
        normal(6, 6),
        whole(3),
        whole(2) == 1,
    )


def known_arguments(name):
    """Those of one sample, with a label that the network has."""
    *args, label, keep = arguments()
    return *args, label % KINDS[name].num_labels, keep


@functools.cache
def parameters(name):
    return tiny.random_params(KINDS[name].init, *known_arguments(name))


@functools.cache
def forward(name):
    return functools.partial(jax.jit(KINDS[name].apply), parameters(name))


def overlapped(out, net):
    """Cross-fade written frame by frame: sin^2 of the place in each token's window."""
    size = net.frames_per_token + 2 * net.token_margin
    out = out.reshape(net.num_outputs, size, net.features)
    frames = []
    for frame in range(net.future):
        total, weights = 0.0, 0.0
        for token in range(net.num_outputs):
            i = frame - (token * net.frames_per_token - net.token_margin)
            if 0 <= i < size:
                weight = np.sin(np.pi * (i + 0.5) / size) ** 2
                total, weights = total + weight * out[token, i], weights + weight
        frames.append(total / weights)
    return jnp.stack(frames)


def test_the_papers_network_has_147_tokens_and_3439260_parameters():
    net = transformer.CamdmTransformer(features=156)
    zeros = lambda *shape: jnp.zeros(shape)  # noqa: E731
    shapes = jax.eval_shape(
        net.init,
        jax.random.key(0),
        zeros(45, 156),
        jnp.ones((), jnp.int32),
        zeros(10, 156),
        zeros(45, 2),
        zeros(45, 6),
        jnp.zeros((), jnp.int32),
        jnp.ones((), bool),
    )
    assert net.num_tokens == 147
    assert sum(x.size for x in jax.tree.leaves(shapes)) == 3_439_260
    five = transformer.CamdmTransformer(features=156, frames_per_token=5)
    assert five.num_tokens == 31


@pytest.mark.parametrize(
    "name", mostly_slow(KINDS, ("transformer", "prefix", "mlp", "single token"))
)
def test_a_batch_is_its_samples(name):
    batched = arguments(3)
    out = forward(name)(*batched)
    assert out.shape == (3, 6, 12)
    single = jax.tree.map(lambda x: x[1], batched)
    np.testing.assert_allclose(forward(name)(*single), out[1], atol=5e-6)


@pytest.mark.parametrize("name", ["transformer", "mlp", "single token"])
def test_one_step_for_a_whole_batch(name):
    x_t, _, *condition = arguments(3)
    for_all = forward(name)(x_t, jnp.int32(2), *condition)
    for_each = forward(name)(x_t, jnp.full(3, 2, jnp.int32), *condition)
    np.testing.assert_array_equal(for_all, for_each)


@pytest.mark.parametrize(
    "name",
    mostly_slow(
        [name for name in KINDS if name != "one label"],
        ("transformer", "prefix", "mlp", "single token"),
    ),
)
def test_every_argument_matters(name):
    args = list(arguments())
    args[-1] = jnp.ones((), bool)
    base = forward(name)(*args)
    changes = [lambda x: x + 1.0, lambda t: t % 4 + 1, *([lambda x: x + 1.0] * 3)]
    changes += [lambda label: (label + 1) % 3, jnp.logical_not]
    for i, change in enumerate(changes):
        other = [change(x) if i == j else x for j, x in enumerate(args)]
        assert np.abs(forward(name)(*other) - base).max() > 1e-4, i


@pytest.mark.parametrize("name", ["transformer", "mlp", "single token"])
def test_unknown_labels_are_refused_or_when_compiled_the_nearest(name):
    *args, _, keep = arguments(2)
    with_labels = lambda *labels: (*args, jnp.array(labels), keep)  # noqa: E731
    for labels in ((0, 3), (-1, 2)):
        found = forward(name)(*with_labels(*labels))
        nearest = forward(name)(*with_labels(*np.clip(labels, 0, 2)))
        np.testing.assert_array_equal(found, nearest)
        assert np.isfinite(found).all()
        message = f"labels are in {min(labels)}..{max(labels)}, expected 0..2"
        with pytest.raises(ValueError, match=message):
            KINDS[name].apply(parameters(name), *with_labels(*labels))


@pytest.mark.parametrize("name", ["transformer", "mlp", "single token"])
def test_a_dropped_past_is_a_past_of_zeros(name):
    *args, _ = arguments()
    dropped = forward(name)(*args, jnp.zeros((), bool))
    args[2] = jnp.zeros_like(args[2])
    kept = forward(name)(*args, jnp.ones((), bool))
    np.testing.assert_array_equal(dropped, kept)


@pytest.mark.parametrize(
    "name", mostly_slow(TRANSFORMERS, ("transformer", "overlapping tokens", "prefix"))
)
def test_encode_and_denoise_are_the_plain_network(name):
    """Oracle: all tokens in the documented order through all whole layers.

    With prefix attention the condition goes through each layer alone, and the others
    through the same layer with all of it in sight.
    """
    net, variables = KINDS[name], parameters(name)

    def plain(net, x_t, t, past, path, facing, label, keep_past):
        fold = lambda x: blocks.fold_frames(x, net.frames_per_token)  # noqa: E731
        tokens = jnp.concatenate(
            [
                net.embed_time(net.num_steps)[t][None],
                net.embed_label(label)[None],
                net.embed_path(fold(path)),
                net.embed_facing(fold(facing)),
                net.embed_past(fold(past * keep_past)),
                net.embed_noisy(fold(x_t)),
            ]
        )
        tokens = tokens + blocks.sinusoidal_positions(*tokens.shape)
        given = tokens[1 : -net.num_outputs]
        for layer in net.layers:
            if net.attention == "prefix":
                ends = jnp.delete(tokens, slice(1, -net.num_outputs), axis=0)
                ends = layer(jnp.concatenate([given, ends]), train=False)[len(given) :]
                given = layer(given, train=False)
                tokens = jnp.concatenate([ends[:1], given, ends[1:]])
            else:
                tokens = layer(tokens, train=False)
        if net.norm == "pre":
            tokens = net.norm_out(tokens)
        out = net.out(tokens[-net.num_outputs :])
        if net.token_margin:
            return overlapped(out, net)
        frames = out.reshape(net.future, net.features)
        if net.frame_kernel:
            kernel = net.smooth.variables["params"]["kernel"]
            around = jnp.pad(frames, [(1, 1), (0, 0)])
            frames += sum(around[i : i + net.future] @ kernel[i] for i in range(3))
        if net.seam_half_life:
            missed = keep_past * (past[-1] - (2 * frames[0] - frames[1]))
            ahead = jnp.arange(1, net.future + 1)
            frames += jnp.outer(2 ** (-ahead / net.seam_half_life), missed)
        return frames

    args = known_arguments(name)
    expected = net.apply(variables, *args, method=plain)
    np.testing.assert_allclose(forward(name)(*args), expected, atol=5e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["transformer", "mlp", "single token"])
def test_dropout_only_in_training_and_by_its_key(name):
    net, args = KINDS[name], arguments()
    train = jax.jit(
        lambda variables, key: net.apply(
            variables, *args, train=True, rngs={"dropout": key}
        )
    )
    first, again, other = (
        train(parameters(name), jax.random.key(seed)) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3
    assert np.abs(first - forward(name)(*args)).max() > 1e-3


@pytest.mark.slow
def test_a_convolution_over_frames_starts_as_zero():
    name = "prefix, convolution"
    kernel = KINDS[name].init(jax.random.key(0), *arguments())["params"]["smooth"]
    assert not np.any(kernel["kernel"])


@pytest.mark.slow
def test_many_noisy_samples_share_one_prefix():
    """Under vmap its keys are read by all, and no operation copies them."""
    net, variables = KINDS["prefix"], parameters("prefix")
    x_t, t, *condition = arguments()
    context = net.apply(variables, *condition, method="encode")
    many = jnp.stack([x_t, x_t + 1.0, x_t - 1.0])
    denoise = lambda x: net.apply(variables, context, x, t, method="denoise")  # noqa: E731
    found = jax.vmap(denoise)(many)
    for x, out in zip(many, found, strict=True):
        np.testing.assert_allclose(denoise(x), out, atol=5e-6)
    program = str(jax.make_jaxpr(jax.vmap(denoise))(many))
    for own in (context.layers[0].key, context.layers[0].value):
        shape = ",".join(map(str, own.shape))
        assert f"[{shape}]" in program and f"[3,{shape}]" not in program


def test_frames_fold_in_order_and_must_divide():
    x = jnp.arange(12.0).reshape(6, 2)
    folded = blocks.fold_frames(x, 3)
    np.testing.assert_array_equal(folded, np.arange(12.0).reshape(2, 6))
    with pytest.raises(ValueError, match="6 frames are no multiple.*4"):
        blocks.fold_frames(x, 4)


@pytest.mark.parametrize("window", ["hann", "trapezoid"])
@pytest.mark.parametrize("margin", [0, 1, 2, 4, 7])
def test_overlapping_tokens_share_frames(window, margin):
    weights = blocks.unfold_weights(9, 5, margin=margin, window=window)
    assert weights.shape == (45, 9 * (5 + 2 * margin)) and weights.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-12)
    # Tokens that agree are believed, also at both ends.
    motion = np.random.default_rng(0).normal(size=(45, 2)).astype(np.float32)
    frame = np.clip(np.arange(-margin, 5 + margin) + 5 * np.arange(9)[:, None], 0, 44)
    tokens = jnp.asarray(motion[frame].reshape(9, -1))
    found = blocks.unfold_frames(tokens, 5, margin=margin, window=window)
    np.testing.assert_allclose(found, motion, atol=1e-6)


def test_the_trapezoid_is_flat_over_own_frames_and_no_margin_is_no_change():
    weights = blocks.unfold_weights(3, 4, margin=1, window="trapezoid")
    # A frame in the middle of a token is its own; at the border both speak.
    assert weights[5].tolist() == [0.0] * 6 + [0, 0, 1, 0, 0, 0] + [0.0] * 6
    assert (weights[4] > 0).sum() == 2
    x = jnp.arange(24.0).reshape(2, 12)
    np.testing.assert_array_equal(blocks.unfold_frames(x, 4), x.reshape(8, 3))


def test_positions_are_sines_and_cosines():
    table = blocks.sinusoidal_positions(5000, 8)
    for position in (0, 1, 4999):
        for channel in range(4):
            angle = position / 10000 ** (2 * channel / 8)
            expected = [np.sin(angle), np.cos(angle)]
            found = table[position, 2 * channel : 2 * channel + 2]
            np.testing.assert_allclose(found, expected, atol=1e-6)
    with pytest.raises(ValueError, match="width is 7"):
        blocks.sinusoidal_positions(3, 7)


def test_the_first_step_reads_the_first_position():
    embedding = blocks.TimeEmbedding(8)
    rows, variables = embedding.init_with_output(jax.random.key(0), 4)
    codes = np.asarray(blocks.sinusoidal_positions(4, 8), np.float64)
    layers = jax.tree.map(lambda x: np.asarray(x, np.float64), variables["params"])
    hidden = codes @ layers["hidden"]["kernel"] + layers["hidden"]["bias"]
    hidden = hidden / (1 + np.exp(-hidden))
    expected = hidden @ layers["out"]["kernel"] + layers["out"]["bias"]
    assert rows.shape == (5, 8)
    np.testing.assert_allclose(rows[1:], expected, atol=1e-6)
    np.testing.assert_array_equal(rows[0], rows[1])


@pytest.mark.slow
@pytest.mark.parametrize("attention", ["full", "prefix"])
@pytest.mark.parametrize("moved", mostly_slow([0, 7], [7]))
def test_plans_go_on_from_the_last_pose_where_the_past_is_kept(attention, moved):
    """The offset is written number by number, on the same network without it."""
    plain = transformer.CamdmTransformer(**SIZES, attention=attention)
    net = plain.clone(seam_half_life=2.0, seam_features=moved)
    *given, _ = arguments(2)
    params = tiny.random_params(plain.init, *given, jnp.ones(2, bool))
    for keep in (True, False):
        free, found = (
            np.asarray(jax.jit(x.apply)(params, *given, jnp.full(2, keep)), np.float64)
            for x in (plain, net)
        )
        past = np.asarray(given[2], np.float64)
        expected = free.copy()
        for sample in range(2):
            for channel in range(moved or 12):
                first, second = free[sample, :2, channel]
                missed = past[sample, -1, channel] - (2 * first - second)
                for frame in range(6):
                    offset = missed * 2 ** (-(frame + 1) / 2.0)
                    expected[sample, frame, channel] += keep * offset
        np.testing.assert_allclose(found, expected, atol=1e-5)
        assert keep != np.allclose(found, free, atol=1e-3)
