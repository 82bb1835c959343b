"""MLPs that read a noisy vector, a step and a condition at every layer.

    h = silu(W_0 [x_t, c, e_t, z])
    h = silu(norm(W_i [h, x_t, c, e_t, z]))        i = 1..depth - 1
    y = W_out [h, x_t, c, e_t, z]

c is the condition (a previous frame), e_t the step's embedding, z a latent.

Source: the network of AMDM (Shi et al. 2024), whose every layer reads its inputs again;
sizes by us, since Li et al. 2024 (AAMDM) do not give theirs.
"""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.networks import blocks


def _step_embedding(
    width: int, num_steps: int, t: Int[Array, "..."], batch: tuple[int, ...]
) -> Array:
    """Embedding of the step, one a sample; a submodule of the caller."""
    step = blocks.TimeEmbedding(width)(num_steps)[t]
    return jnp.broadcast_to(step, (*batch, width))


class ConditionedMlp(nn.Module):
    """Maps a noisy vector, its step and a condition to a vector.

    Attributes:
      width: Channels of a hidden layer; a multiple of 16.
      time_width: Channels of the step's embedding; even.
      groups: Groups of the norms.
    """

    features: int
    num_steps: int
    width: int = 512
    depth: int = 4
    time_width: int = 64
    groups: int = 16

    @nn.compact
    def __call__(
        self,
        x_t: Float[Array, "*batch features"],
        t: Int[Array, "*#batch"],
        condition: Float[Array, "*batch condition"],
        latent: Float[Array, "*batch latent"] | None = None,
    ) -> Float[Array, "*batch out"]:
        """A vector of `features` channels.

        Args:
          t: Step in 1..T, one for all or one a sample.
          condition: What the result depends on besides.
          latent: Noise of a generator; None for none.
        """
        step = _step_embedding(self.time_width, self.num_steps, t, x_t.shape[:-1])
        given = [x_t, condition, step] + ([] if latent is None else [latent])
        given = jnp.concatenate(given, axis=-1)
        h = nn.silu(nn.Dense(self.width)(given))
        for _ in range(self.depth - 1):
            h = nn.Dense(self.width)(jnp.concatenate([h, given], axis=-1))
            # Over the channels of one sample only, whatever the batch axes.
            h = nn.silu(nn.GroupNorm(self.groups, reduction_axes=(-1,))(h))
        return nn.Dense(self.features)(jnp.concatenate([h, given], axis=-1))


class PairDiscriminator(nn.Module):
    """Logit that (x_{t-1}, x_t) is a pair of the data, given a condition.

    Attributes:
      time_width: Channels of the step's embedding; even.
    """

    num_steps: int
    width: int = 512
    depth: int = 4
    time_width: int = 64

    @nn.compact
    def __call__(
        self,
        x_prev: Float[Array, "*batch features"],
        x_t: Float[Array, "*batch features"],
        t: Int[Array, "*#batch"],
        condition: Float[Array, "*batch condition"],
    ) -> Float[Array, "*batch"]:
        """The logit of a pair at step t in 1..T, which depends on the condition."""
        step = _step_embedding(self.time_width, self.num_steps, t, x_t.shape[:-1])
        h = jnp.concatenate([x_prev, x_t, condition, step], axis=-1)
        for _ in range(self.depth):
            h = nn.leaky_relu(nn.Dense(self.width)(h), 0.2)
        return nn.Dense(1)(h)[..., 0]
