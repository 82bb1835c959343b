"""A recurrent recogniser of actions, and the features for Fréchet distances.

Two layers of gated recurrent units (GRU) read a motion frame by frame. The last state
of the upper one goes through a linear layer and tanh, which gives the features, and
through another to the logits. Differs from the released one: the
states before the first frame are an input, where that draws them inside each call.

Source: Guo et al. 2020 (Action2Motion), as released with EMDM (Zhou et al. 2024).
"""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float


class ActionRecognizer(nn.Module):
    """Motions to features and class logits.

    Attributes:
      num_classes: Classes.
      num_features: Width of the feature layer.
      hidden: Width of both states.
    """

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
        """Recognises motions.

        Args:
          x: Joint positions in the frame of the first pose, metres; any length.
          state: States of the lower and the upper layer before the first frame.

        Returns:
          Features in (-1, 1), and logits.
        """
        x = self.lower(x, initial_carry=state[:, 0])
        x = self.upper(x, initial_carry=state[:, 1])
        features = jnp.tanh(self.feature(x[:, -1]))
        return features, self.out(features)
