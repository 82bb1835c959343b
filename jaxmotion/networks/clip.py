"""The text tower of CLIP: a sentence to one vector.

Token embeddings plus learned positions, pre-norm transformer layers in which a token
sees itself and what stands before it, and a linear projection of one row, that of the
end-of-text token, the only one that has seen the whole sentence:

    h = x + out(softmax(q k^T / sqrt(d) + mask) v)         q, k, v of norm_1(x)
    y = h + W_2 f(W_1 norm_2(h)),   f(u) = u sigmoid(1.702 u)
    vector = W norm_out(y)[end]

What follows the end-of-text token cannot reach its row, so any padding will do.

Source: Radford et al. 2021, "Learning Transferable Visual Models From Natural Language
Supervision", section 2.4; sizes and the quick GELU of the released ViT-B/32.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.networks import blocks

EPSILON = 1e-5


def quick_gelu(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """CLIP's stand-in for GELU: x sigmoid(1.702 x), of Hendrycks & Gimpel 2016."""
    return x * jax.nn.sigmoid(1.702 * x)


class ClipLayer(nn.Module):
    """Pre-norm transformer layer with a causal mask."""

    width: int
    heads: int
    hidden: int

    def setup(self):
        """Makes projections, feed-forward layers and norms."""
        self.query = nn.Dense(self.width)
        self.key = nn.Dense(self.width)
        self.value = nn.Dense(self.width)
        self.out = nn.Dense(self.width)
        self.expand = nn.Dense(self.hidden)
        self.contract = nn.Dense(self.width)
        self.norm_1 = nn.LayerNorm(epsilon=EPSILON)
        self.norm_2 = nn.LayerNorm(epsilon=EPSILON)

    def __call__(
        self, x: Float[Array, "batch tokens width"]
    ) -> Float[Array, "batch tokens width"]:
        """Applies it."""
        normed = self.norm_1(x)
        heads = (*x.shape[:-1], self.heads, self.width // self.heads)
        mixed = jax.nn.dot_product_attention(
            self.query(normed).reshape(heads),
            self.key(normed).reshape(heads),
            self.value(normed).reshape(heads),
            is_causal=True,
        )
        x = x + self.out(mixed.reshape(x.shape))
        return x + self.contract(quick_gelu(self.expand(self.norm_2(x))))


class ClipText(nn.Module):
    """Token ids to one vector a text. The defaults are ViT-B/32's.

    The row of the token `end_of_text` is read; `context` are the most tokens of a text,
    with those of start and end.
    """

    vocabulary: int = 49408
    context: int = 77
    width: int = 512
    depth: int = 12
    heads: int = 8
    hidden: int = 2048
    dimensions: int = 512
    end_of_text: int = 49407

    def setup(self):
        """Makes embeddings, layers, norm and projection."""
        self.token_embedding = nn.Embed(
            self.vocabulary, self.width, embedding_init=nn.initializers.normal(0.02)
        )
        self.position_embedding = nn.Embed(
            self.context, self.width, embedding_init=nn.initializers.normal(0.01)
        )
        self.layers = [
            ClipLayer(self.width, self.heads, self.hidden) for _ in range(self.depth)
        ]
        self.norm_out = nn.LayerNorm(epsilon=EPSILON)
        self.projection = nn.Dense(self.dimensions, use_bias=False)

    def __call__(
        self, ids: Int[Array, "batch tokens"]
    ) -> Float[Array, "batch dimensions"]:
        """Encodes texts, not normalized.

        Ids are in 0..vocabulary-1, at most `context` of them; every row holds the
        end-of-text token, and its first one ends the text. (The released code takes the
        largest id of a row: with its vocabulary the same place.)
        """
        tokens = ids.shape[-1]
        if tokens > self.context:
            raise ValueError(f"{tokens} tokens do not fit the context {self.context}")
        positions = self.position_embedding(jnp.arange(tokens))
        x = blocks.add_rows(self.token_embedding(ids), positions)
        for layer in self.layers:
            x = layer(x)
        end = jnp.argmax(ids == self.end_of_text, axis=-1)
        row = jnp.take_along_axis(x, end[:, None, None], axis=-2)[:, 0]
        return self.projection(self.norm_out(row))
