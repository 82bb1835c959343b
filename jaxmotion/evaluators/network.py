"""A convolutional evaluator of style, and the features for Fréchet distances.

Two residual convolutions over time, then three linear layers; the 512 activations
before the last are the features. Differs from the released one: layer and group norms
stand in for batch norms, so that a prediction does not depend on its batch and the
network has no state beside its parameters. `StyleClassifier` is the released one after
its training, for published weights.

Source: released feature extractor of CAMDM (Chen et al. 2024).
"""

from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.networks.convolution import convolve


class InferenceBatchNorm(nn.Module):
    """Batch norm whose statistics are parameters, as training left them."""

    channels: int

    def setup(self):
        """Makes the four vectors."""
        zeros, ones = nn.initializers.zeros, nn.initializers.ones
        shape = (self.channels,)
        self.mean = self.param("mean", zeros, shape)
        self.variance = self.param("variance", ones, shape)
        self.scale = self.param("scale", ones, shape)
        self.bias = self.param("bias", zeros, shape)

    def __call__(self, x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Standardizes each channel, then scales and shifts it."""
        factor = self.scale * jax.lax.rsqrt(self.variance + 1e-5)
        shift = self.bias - self.mean * factor
        factor, shift = (jnp.broadcast_to(v, x.shape) for v in (factor, shift))
        return x * factor + shift


class ResidualConvolution(nn.Module):
    """Convolution of width 3, norm and leaky ReLU, added to a 1 x 1 convolution.

    Where `frozen`, batch norm in inference mode takes the place of group norm.
    """

    channels: int
    frozen: bool = False

    def setup(self):
        """Makes the two convolutions and the norm."""
        self.main = nn.Conv(self.channels, (3,), conv_general_dilated=convolve)
        self.norm = (
            InferenceBatchNorm(self.channels) if self.frozen else nn.GroupNorm(8)
        )
        self.side = nn.Conv(self.channels, (1,), conv_general_dilated=convolve)

    def __call__(
        self, x: Float[Array, "batch frames channels_in"]
    ) -> Float[Array, "batch frames channels"]:
        """Applies it along time, to as many frames."""
        return nn.leaky_relu(self.norm(self.main(x))) + self.side(x)


class WindowClassifier(nn.Module):
    """Windows of poses to features and class logits.

    Where `frozen`, batch norms in inference mode replace layer and group norms.
    """

    num_classes: int
    num_features: int = 512
    dropout: float = 0.5
    frozen: bool = False

    def setup(self):
        """Makes the layers."""
        self.convolution_1 = ResidualConvolution(64, self.frozen)
        self.convolution_2 = ResidualConvolution(128, self.frozen)
        self.hidden = nn.Dense(1024)
        self.hidden_norm = self._norm(1024)
        self.feature = nn.Dense(self.num_features)
        self.feature_norm = self._norm(self.num_features)
        self.out = nn.Dense(self.num_classes)
        self.drop = nn.Dropout(self.dropout)

    def _norm(self, channels: int) -> nn.Module:
        if self.frozen:
            return InferenceBatchNorm(channels)
        return nn.LayerNorm(epsilon=1e-5)

    def __call__(
        self, x: Float[Array, "batch frames channels"], *, train: bool = False
    ) -> tuple[Float[Array, "batch features"], Float[Array, "batch classes"]]:
        """Features and logits of windows, all of the length it was initialized with.

        Joint positions are root-relative and facing +z in each frame, meters. Training
        needs rngs={"dropout": key}.
        """
        x = self.convolution_2(self.convolution_1(x))
        x = self.drop(x, deterministic=not train).reshape(x.shape[0], -1)
        x = nn.leaky_relu(self.hidden_norm(self.hidden(x)))
        features = nn.leaky_relu(self.feature_norm(self.feature(x)))
        return features, self.out(features)


class StyleClassifier(WindowClassifier):
    """The released evaluator; its input is `style.released_input`."""

    frozen: bool = True


class ActionClassifier(nn.Module):
    """Motions to features and class logits."""

    num_classes: int
    num_features: int = 30
    hidden: int = 128

    def setup(self):
        """Makes the layers."""
        self.lower = nn.RNN(nn.GRUCell(self.hidden))
        self.upper = nn.RNN(nn.GRUCell(self.hidden))
        self.feature = nn.Dense(self.num_features)
        self.out = nn.Dense(self.num_classes)

    def __call__(
        self,
        x: Float[Array, "batch frames channels"],
        state: Float[Array, "batch 2 hidden"],
    ) -> tuple[Float[Array, "batch features"], Float[Array, "batch classes"]]:
        """Features in (-1, 1), and logits, of motions of any length.

        Joint positions are in the frame of the first pose, meters; the states are the
        lower and the upper layer's before the first frame.
        """
        lower = jnp.asarray(self.lower(x, initial_carry=state[:, 0]))
        upper = jnp.asarray(self.upper(lower, initial_carry=state[:, 1]))
        features = jnp.tanh(self.feature(upper[:, -1]))
        return features, self.out(features)


Padding = Literal["zeros", "kept"]
UNIT = 4  # frames of a movement: two convolutions of stride 2

_XAVIER = nn.initializers.xavier_normal()
_SLOPE = 0.2


class MovementEncoder(nn.Module):
    """Two convolutions of width 4 and stride 2, and a linear layer."""

    width: int = 512
    dropout: float = 0.2

    def setup(self):
        """Makes the layers."""
        halve: dict[str, Any] = dict(
            strides=(2,),
            padding=((1, 1),),
            kernel_init=_XAVIER,
            conv_general_dilated=convolve,
        )
        self.convolution_1 = nn.Conv(self.width, (4,), **halve)
        self.convolution_2 = nn.Conv(self.width, (4,), **halve)
        self.out = nn.Dense(self.width, kernel_init=_XAVIER)
        self.drop = nn.Dropout(self.dropout)

    def __call__(
        self, x: Float[Array, "batch frames channels"], *, train: bool = False
    ) -> Float[Array, "batch units width"]:
        """Encodes movements: one row per `UNIT` frames.

        A row sees 3 frames on each side of its own; frames beyond the last whole
        movement are dropped. Training needs rngs={"dropout": key}.
        """
        for convolution in (self.convolution_1, self.convolution_2):
            x = self.drop(convolution(x), deterministic=not train)
            x = nn.leaky_relu(x, _SLOPE)
        return self.out(x)


class SequenceEncoder(nn.Module):
    """Linear layer, bidirectional GRU with learned first states, and two layers more.

    The width is that of one direction of the GRU.
    """

    width: int
    embedding: int

    def setup(self):
        """Makes the layers."""
        self.input = nn.Dense(self.width, kernel_init=_XAVIER)
        self.start = self.param("start", nn.initializers.normal(1.0), (2, self.width))
        self.forward = nn.RNN(nn.GRUCell(self.width), return_carry=True)
        self.backward = nn.RNN(nn.GRUCell(self.width), return_carry=True, reverse=True)
        self.hidden = nn.Dense(self.width, kernel_init=_XAVIER)
        self.norm = nn.LayerNorm(epsilon=1e-5)
        self.out = nn.Dense(self.embedding, kernel_init=_XAVIER)

    def __call__(
        self, x: Float[Array, "batch rows channels"], length: Int[Array, " batch"]
    ) -> Float[Array, "batch embedding"]:
        """Embeds sequences of a length in 1..rows each; later rows are not read."""
        x = self.input(x)
        states = []
        for start, pass_over in zip(
            self.start, (self.forward, self.backward), strict=True
        ):
            carry = jnp.broadcast_to(start[None], (x.shape[0], self.width))
            state, _ = pass_over(x, initial_carry=carry, seq_lengths=length)
            states.append(state)
        x = self.norm(self.hidden(jnp.concatenate(states, axis=-1)))
        return self.out(nn.leaky_relu(x, _SLOPE))


class TextEncoder(nn.Module):
    """Word vectors, plus a linear layer of their tags, through a sequence encoder.

    The width is that of one direction of the GRU.
    """

    width: int = 512
    embedding: int = 512

    @nn.compact
    def __call__(
        self,
        vectors: Float[Array, "batch slots word"],
        tags: Float[Array, "batch slots classes"],
        words: Int[Array, " batch"],
    ) -> Float[Array, "batch embedding"]:
        """Embeds sentences of different lengths.

        Tags are one-hot parts of speech; words count each sentence's, with its marks of
        start and end, in 1..slots.
        """
        tagged = nn.Dense(vectors.shape[-1], kernel_init=_XAVIER, name="tags")(tags)
        encoder = SequenceEncoder(self.width, self.embedding, name="sequence")
        return encoder(vectors + tagged, words)


class Matcher(nn.Module):
    """Both towers: motions and sentences to embeddings that can be compared.

    Widths are those of one direction of the GRUs.
    """

    movement_width: int = 512
    motion_width: int = 1024
    text_width: int = 512
    embedding: int = 512
    dropout: float = 0.2

    def setup(self):
        """Makes the three encoders."""
        self.movement = MovementEncoder(self.movement_width, self.dropout)
        self.motion = SequenceEncoder(self.motion_width, self.embedding)
        self.text = TextEncoder(self.text_width, self.embedding)

    def embed_motion(
        self,
        features: Float[Array, "batch frames channels"],
        frames: Int[Array, " batch"],
        *,
        train: bool = False,
        padding: Padding = "zeros",
    ) -> Float[Array, "batch embedding"]:
        """Embeds motions of different lengths, at least `UNIT` frames.

        Only whole movements count, but as in the source the last one's convolutions
        reach 3 frames beyond it, so motions that are to be compared are padded to one
        length (there 196 frames). Training needs rngs={"dropout": key}.

        Features have mean 0 and deviation 1, no contact labels; `padding` "kept" sees
        what is there beyond the whole movements.
        """
        units = frames // UNIT
        if padding == "zeros":
            inside = jnp.arange(features.shape[1])[None] < UNIT * units[:, None]
            features = jnp.where(inside[..., None], features, 0.0)
        return self.motion(self.movement(features, train=train), units)

    def embed_text(
        self,
        vectors: Float[Array, "batch slots word"],
        tags: Float[Array, "batch slots classes"],
        words: Int[Array, " batch"],
    ) -> Float[Array, "batch embedding"]:
        """Embeds sentences of different lengths; arguments as `TextEncoder`'s."""
        return self.text(vectors, tags, words)

    def __call__(
        self,
        features: Float[Array, "batch frames channels"],
        frames: Int[Array, " batch"],
        vectors: Float[Array, "batch slots word"],
        tags: Float[Array, "batch slots classes"],
        words: Int[Array, " batch"],
        *,
        train: bool = False,
    ) -> tuple[Float[Array, "batch embedding"], Float[Array, "batch embedding"]]:
        """Embeddings of sentences and motions; training needs rngs={"dropout": key}."""
        motion = self.embed_motion(features, frames, train=train)
        return self.embed_text(vectors, tags, words), motion
