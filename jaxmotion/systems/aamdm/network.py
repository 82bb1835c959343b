"""MLPs of a pose autoencoder.

Source: Holden et al. 2020 (Learned Motion Matching), released code: the encoder has
four linear layers with ELU, the decoder two with ReLU, 512 channels. Li et al. 2024
(AAMDM) give no sizes.
"""

import flax.linen as nn
from jaxtyping import Array, Float


class PoseEncoder(nn.Module):
    """Maps a normalized pose vector to a latent vector.

    Attributes:
      latent: Channels of the result.
      width: Channels of a hidden layer.
      depth: Linear layers.
    """

    latent: int
    width: int = 512
    depth: int = 4

    @nn.compact
    def __call__(self, pose: Float[Array, "*batch n"]) -> Float[Array, "*batch latent"]:
        """The network.

        Args:
          pose: Normalized pose vectors.

        Returns:
          Latent vectors.
        """
        for _ in range(self.depth - 1):
            pose = nn.elu(nn.Dense(self.width)(pose))
        return nn.Dense(self.latent)(pose)


class PoseDecoder(nn.Module):
    """Maps an embedded vector to a normalized pose vector.

    Attributes:
      features: Channels of the result.
      width: Channels of a hidden layer.
      depth: Linear layers.
    """

    features: int
    width: int = 512
    depth: int = 2

    @nn.compact
    def __call__(self, embedded: Float[Array, "*batch n"]) -> Float[Array, "*batch m"]:
        """The network.

        Args:
          embedded: Embedded vectors.

        Returns:
          Normalized pose vectors.
        """
        for _ in range(self.depth - 1):
            embedded = nn.relu(nn.Dense(self.width)(embedded))
        return nn.Dense(self.features)(embedded)
