"""A convolutional recogniser of style, and the features for Fréchet distances.

Two residual convolutions over time, then three linear layers; the 512 activations
before the last are the features. Differs from the released one: layer and group norms
stand in for batch norms, so that a prediction does not depend on its batch and the
network has no state beside its parameters. `StyleClassifier` is the released one after
its training, for published weights.

Source: released feature extractor of CAMDM (Chen et al. 2024).
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.networks.convolution import convolve


class InferenceBatchNorm(nn.Module):
    """Batch norm whose statistics are parameters, as training left them.

    Attributes:
      channels: Channels, the last axis.
    """

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

    Attributes:
      channels: Output channels.
      frozen: Batch norm in inference mode in place of group norm.
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
        """Applies it along time.

        Args:
          x: Frames.

        Returns:
          As many frames.
        """
        return nn.leaky_relu(self.norm(self.main(x))) + self.side(x)


class Recognizer(nn.Module):
    """Windows of poses to features and class logits.

    Attributes:
      num_classes: Classes.
      num_features: Width of the feature layer.
      dropout: Rate after the convolutions.
      frozen: Batch norms in inference mode in place of layer and group norms.
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
        """Recognises windows.

        Args:
          x: Joint positions, root-relative and facing +z in each frame, metres;
            all windows of the length that it was initialised with.
          train: Whether to drop; needs rngs={"dropout": key}.

        Returns:
          Features, and logits.
        """
        x = self.convolution_2(self.convolution_1(x))
        x = self.drop(x, deterministic=not train).reshape(x.shape[0], -1)
        x = nn.leaky_relu(self.hidden_norm(self.hidden(x)))
        features = nn.leaky_relu(self.feature_norm(self.feature(x)))
        return features, self.out(features)


class StyleClassifier(Recognizer):
    """The released recognizer; its input is `learning.recognition.released_input`."""

    frozen: bool = True
