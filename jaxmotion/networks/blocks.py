"""Parts that the denoisers share: positions, time embedding, encoder layers.

The encoder layer is PyTorch's `TransformerEncoderLayer` with its defaults (post-norm,
epsilon 1e-5) and exact GELU:

    h = norm_1(x + out(softmax(q k^T / sqrt(d)) v))        q, k, v = projections of x
    y = norm_2(h + W_2 gelu(W_1 h))

EMDM's has SELU in its place. Weights begin as Flax's do, not as PyTorch's: those of
linear layers 1.7 times as large, of queries 1.4 and of keys and values 1.2 times, and
biases at zero; so do all networks here (`runs.Budget(initial_scale=)` makes them
smaller). With norm="pre" the branches read normalized tokens and add to plain ones,
which trains several times faster from scratch (Xiong et al. 2020, "On Layer
Normalization in the Transformer Architecture"):

    h = x + out(softmax(q k^T / sqrt(d)) v)                q, k, v of norm_1(x)
    y = h + W_2 gelu(W_1 norm_2(h))

It is cut in two, `project` and `attend`, so that a sampler can keep the projections of
tokens that do not change between steps, and can skip the rows that nobody reads.
"""

import dataclasses
import functools
from typing import Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from jaxmotion.typing import Params


def apply(params: Params, module: Any, *args: Any, **options: Any) -> Any:
    """What a module makes of its parameters and arguments.

    It has no collections but these; options are its method's, and Flax's own `method`
    and `rngs`.
    """
    return module.apply({"params": params}, *args, **options)


def sized(kind: type, config: Any, **more: Any) -> Any:
    """A module whose fields have the values that a configuration gives them."""
    names = {field.name for field in dataclasses.fields(kind)} - {"parent", "name"}
    sizes = {k: v for k, v in dataclasses.asdict(config).items() if k in names}
    return kind(**sizes, **more)


def known_labels(
    labels: Int[Array, "*batch"], number: int, *, what: str = "labels"
) -> Int[Array, "*batch"]:
    """Labels; a concrete one out of 0..number - 1 is refused, a traced one clipped.

    (JAX's own gather would make NaN of it.) The `ValueError` names the range, `what`,
    and the labels found.
    """
    if not isinstance(labels, Tracer):
        found = np.asarray(labels)
        low, high = found.min(), found.max()
        if low < 0 or high >= number:
            raise ValueError(f"{what} are in {low}..{high}, expected 0..{number - 1}")
    return jnp.clip(labels, 0, number - 1)


def sinusoidal_positions(num: int, width: int) -> Float[Array, "{num} {width}"]:
    """Table of sinusoidal position codes: sine on even channels, cosine on odd.

    It is made in float64, so high positions stay exact.

    Source: Vaswani et al. 2017, section 3.5, with base 10000.
    """
    if width % 2:
        raise ValueError(f"width is {width}, expected an even number")
    rate = np.exp(-np.log(10000.0) * np.arange(0, width, 2) / width)
    angle = np.arange(num)[:, None] * rate
    table = np.stack([np.sin(angle), np.cos(angle)], axis=-1).reshape(num, width)
    return jnp.asarray(table, jnp.float32)


def add_rows(
    x: Float[Array, "*batch tokens width"], rows: Float[Array, "*rows width"]
) -> Float[Array, "*batch tokens width"]:
    """Adds rows (positions), one per token or one for all, to all samples' tokens."""
    return x + jnp.broadcast_to(rows, x.shape)


def fold_frames(x: Float[Array, "*batch frames features"], n: int) -> Array:
    """Each n frames as one row of n times the features; no remainder (`ValueError`)."""
    frames, features = x.shape[-2:]
    if frames % n:
        raise ValueError(f"{frames} frames are no multiple of frames_per_token {n}")
    return x.reshape(*x.shape[:-2], frames // n, n * features)


Window = Literal["hann", "trapezoid"]


def unfold_weights(
    tokens: int, n: int, *, margin: int, window: Window
) -> Float[np.ndarray, "frames predictions"]:
    """How overlapping tokens share their frames: the matrix of `unfold_frames`.

    One row per frame, one column per prediction (token by token). Token i speaks for
    the frames [i n - margin, (i + 1) n + margin) that exist. Its window is sin^2 over
    all of them ("hann"), or rises over the margin, is flat over its own frames and
    falls ("trapezoid"). Windows are normalized over tokens: the weights of a frame sum
    to 1.
    """
    size = n + 2 * margin
    place = np.arange(size) + 0.5
    if window == "hann":
        shape = np.sin(np.pi * place / size) ** 2
    else:
        shape = np.minimum(1.0, np.minimum(place, size - place) / (margin + 0.5))
    matrix = np.zeros((tokens * n, tokens, size))
    for token in range(tokens):
        frame = token * n - margin + np.arange(size)
        inside = (frame >= 0) & (frame < tokens * n)
        matrix[frame[inside], token, np.flatnonzero(inside)] = shape[inside]
    matrix /= matrix.sum(axis=(1, 2), keepdims=True)
    return matrix.reshape(tokens * n, tokens * size)


def unfold_frames(
    x: Float[Array, "*batch tokens predictions"],
    n: int,
    *,
    margin: int = 0,
    window: Window = "hann",
) -> Float[Array, "*batch frames features"]:
    """Frames of tokens that each predict n frames and `margin` more on either side.

    Without a margin this is the inverse of `fold_frames`, and the motion may jump where
    one token ends and the next begins: nothing but the network's own effort joins them.
    With one, neighbors predict the same frames and are cross-faded. Each token has n +
    2 margin frames of features.
    """
    *batch, tokens, channels = x.shape
    features = channels // (n + 2 * margin)
    if margin == 0:
        return x.reshape(*batch, tokens * n, features)
    weights = unfold_weights(tokens, n, margin=margin, window=window)
    predictions = x.reshape(*batch, tokens * (n + 2 * margin), features)
    # Places among them, in meters: GPUs would round each to ten bits, another way in
    # every frame.
    mixed = functools.partial(jnp.einsum, "fp,...pd->...fd", precision="highest")
    return mixed(jnp.asarray(weights, x.dtype), predictions)


def set_up_layers(net: Any, *, activation: Literal["gelu", "selu"] = "gelu") -> None:
    """Gives a network its `layers`, and what `frames_of` asks for, in its `setup`."""
    net.layers = [
        EncoderLayer(
            net.width, net.heads, net.hidden, net.dropout, net.norm, activation
        )
        for _ in range(net.depth)
    ]
    if net.norm == "pre":
        net.norm_out = nn.LayerNorm(epsilon=1e-5)
    net.out = nn.Dense(net.features * (net.frames_per_token + 2 * net.token_margin))


def frames_of(
    net: Any, x: Float[Array, "*batch tokens width"]
) -> Float[Array, "*batch frames features"]:
    """Frames that a network's last tokens stand for: its `norm_out` and `out`.

    A network has the first where it norms before its branches, and as attributes what
    `unfold_frames` asks for.
    """
    if net.norm == "pre":
        x = net.norm_out(x)
    return unfold_frames(
        net.out(x),
        net.frames_per_token,
        margin=net.token_margin,
        window=net.token_window,
    )


def gelu(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Exact GELU: x times the normal distribution's probability of less than x.

    Written with erf. `jax.nn.gelu` takes erfc, which keeps relative accuracy where the
    result is nearly zero and takes three times as long on a CPU; the two differ by
    less than 1e-6.

    Source: Hendrycks & Gimpel 2016; PyTorch's formula.
    """
    return x * (0.5 + 0.5 * jax.lax.erf(x * np.float32(np.sqrt(0.5))))


_ACTIVATIONS = {"gelu": gelu, "selu": nn.selu}


class Projections(NamedTuple):
    """Queries, keys and values of some tokens, split into heads."""

    query: Float[Array, "*batch queries heads channels"]
    key: Float[Array, "*batch tokens heads channels"]
    value: Float[Array, "*batch tokens heads channels"]


class Prefix(NamedTuple):
    """Keys and values of tokens that do not see those that attend to them."""

    key: Float[Array, "*batch heads channels tokens"]
    value: Float[Array, "*batch heads tokens channels"]


def prefix_of(projections: Projections) -> Prefix:
    """The keys and values of tokens, for others that attend to them."""
    return Prefix(
        key=jnp.moveaxis(projections.key, -3, -1),
        value=jnp.swapaxes(projections.value, -2, -3),
    )


def row_of(
    steps: Float[Array, "*stack rows width"], t: Int[Array, "*batch"]
) -> Float[Array, "..."]:
    """Rows of a table of steps: `steps[t]`, which stays one plain gather under vmap."""
    return jnp.take(steps, t, axis=0, mode="clip")


class TimeEmbedding(nn.Module):
    """Sinusoid of the step, then Linear, SiLU, Linear."""

    width: int

    def setup(self):
        """Makes the two layers."""
        self.hidden = nn.Dense(self.width)
        self.out = nn.Dense(self.width)

    def __call__(self, num_steps: int) -> Float[Array, "steps width"]:
        """Embeddings of all steps 0..num_steps, to be indexed by t.

        Step t reads row t - 1 of the sinusoid, as the released weights of CAMDM do
        (their least noisy step is 0); row 0 (clean data) repeats row 1.
        """
        codes = sinusoidal_positions(num_steps, self.width)
        codes = jnp.concatenate([codes[:1], codes])
        return self.out(nn.silu(self.hidden(codes)))


class LabelEmbedding(nn.Module):
    """A learned row for each label; `nn.Embed` cannot look up one label of one.

    Labels out of range are as in `known_labels`.
    """

    num_labels: int
    width: int

    def setup(self):
        """Makes the table."""
        shape = (self.num_labels, self.width)
        self.embedding = self.param("embedding", nn.initializers.normal(1.0), shape)

    def __call__(self, label: Int[Array, "*batch"]) -> Float[Array, "*batch width"]:
        known = known_labels(label, self.num_labels)
        return jnp.take(self.embedding, known, axis=0, mode="clip")


class EncoderLayer(nn.Module):
    """Transformer encoder layer.

    Attributes:
      norm: "post", or "pre"; see the module's docstring.
      activation: Of the feed-forward layer.
    """

    width: int
    heads: int
    hidden: int
    dropout: float
    norm: Literal["post", "pre"] = "post"
    activation: Literal["gelu", "selu"] = "gelu"

    def setup(self):
        """Makes projections, feed-forward layers and norms."""
        xavier = nn.initializers.xavier_uniform()
        self.query = nn.Dense(self.width, kernel_init=xavier)
        self.key_value = nn.Dense(2 * self.width, kernel_init=xavier)
        self.out = nn.Dense(self.width)
        self.expand = nn.Dense(self.hidden)
        self.contract = nn.Dense(self.width)
        self.norm_1 = nn.LayerNorm(epsilon=1e-5)
        self.norm_2 = nn.LayerNorm(epsilon=1e-5)
        self.drop = nn.Dropout(self.dropout)

    def _heads(self, x: Float[Array, "*batch tokens width"]) -> Array:
        return x.reshape(*x.shape[:-1], self.heads, -1)

    def project(
        self, x: Float[Array, "*batch tokens width"], *, last: int | None = None
    ) -> Projections:
        """Queries (of only the `last` tokens, if given), keys and values of tokens."""
        if self.norm == "pre":
            x = self.norm_1(x)
        key, value = jnp.split(self.key_value(x), 2, axis=-1)
        asking = x if last is None else x[..., -last:, :]
        return Projections(
            self._heads(self.query(asking)), self._heads(key), self._heads(value)
        )

    def attend(
        self,
        x: Float[Array, "*batch queries width"],
        projections: Projections,
        *,
        train: bool,
        mask: Bool[Array, "*batch tokens"] | None = None,
        prefix: Prefix | None = None,
    ) -> Float[Array, "*batch queries width"]:
        """The rest of the layer for the tokens that the queries came from.

        The projections are queries of those tokens, keys and values of all; the mask
        says which may be attended to (None: all). A prefix is more tokens to attend to.
        They stay apart, so that `vmap` shares one prefix among many `x` without a copy.
        """
        query, key, value = projections
        drop = lambda y: self.drop(y, deterministic=not train)  # noqa: E731
        # [heads, tokens, channels] once, so that both products are plain matmuls.
        query, key, value = (jnp.swapaxes(y, -2, -3) for y in (query, key, value))
        logits = query @ jnp.swapaxes(key, -1, -2) / np.sqrt(query.shape[-1])
        if mask is not None:
            seen = jnp.broadcast_to(mask[..., None, None, :], logits.shape)
            logits = jnp.where(seen, logits, jnp.finfo(logits.dtype).min)
        if prefix is None:
            mixed = drop(jax.nn.softmax(logits, axis=-1)) @ value
        else:
            ahead = query @ prefix.key / np.sqrt(query.shape[-1])
            logits = jnp.concatenate([ahead, logits], axis=-1)
            weights = drop(jax.nn.softmax(logits, axis=-1))
            number = prefix.value.shape[-2]
            mixed = weights[..., :number] @ prefix.value + weights[..., number:] @ value
        mixed = jnp.swapaxes(mixed, -2, -3)
        x = x + drop(self.out(mixed.reshape(x.shape)))
        act = _ACTIVATIONS[self.activation]
        feed = lambda y: drop(self.contract(drop(act(self.expand(y)))))  # noqa: E731
        if self.norm == "pre":
            return x + feed(self.norm_2(x))
        x = self.norm_1(x)
        return self.norm_2(x + feed(x))

    def __call__(
        self,
        x: Float[Array, "*batch tokens width"],
        *,
        train: bool,
        last: int | None = None,
        mask: Bool[Array, "*batch tokens"] | None = None,
        prefix: Prefix | None = None,
    ) -> Float[Array, "*batch out width"]:
        """The whole layer; only the last so many tokens, where given. See `attend`."""
        projections = self.project(x, last=last)
        return self.attend(
            x if last is None else x[..., -last:, :],
            projections,
            train=train,
            mask=mask,
            prefix=prefix,
        )
