"""MLPs of a pose autoencoder.

Source: Holden et al. 2020 (Learned Motion Matching), released code: the encoder has
four linear layers with ELU, the decoder two with ReLU, 512 channels. Li et al. 2024
(AAMDM) give no sizes.
"""

import flax.linen as nn
from jaxtyping import Array, Float


class PoseEncoder(nn.Module):
    """Maps a normalized pose vector to a latent vector."""

    latent: int
    width: int = 512
    depth: int = 4

    @nn.compact
    def __call__(self, pose: Float[Array, "*batch n"]) -> Float[Array, "*batch latent"]:
        for _ in range(self.depth - 1):
            pose = nn.elu(nn.Dense(self.width)(pose))
        return nn.Dense(self.latent)(pose)


class PoseDecoder(nn.Module):
    """Maps an embedded vector to a normalized pose vector."""

    features: int
    width: int = 512
    depth: int = 2

    @nn.compact
    def __call__(self, embedded: Float[Array, "*batch n"]) -> Float[Array, "*batch m"]:
        """The network."""
        for _ in range(self.depth - 1):
            embedded = nn.relu(nn.Dense(self.width)(embedded))
        return nn.Dense(self.features)(embedded)
