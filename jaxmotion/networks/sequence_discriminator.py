"""EMDM's discriminator: an MLP that sees two neighbouring noise levels of a motion.

    [x_{t-1}, x_t, step embedding, condition]
    -> 1024 selu -> 1024 norm selu -> 512 selu -> 512 norm selu -> 256 selu -> 64 selu
    -> 1

Source: released code of EMDM (Zhou et al. 2024); the paper says seven layers, each
followed by SELU, where the last one is not.
"""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


def step_codes(num_steps: int, width: int) -> Float[Array, "steps {width}"]:
    """Sinusoids of all steps, to be indexed by t: sines first, then cosines.

    Step t reads the code of t - 1, as the released code counts from 0; row 0 repeats
    row 1.

    Args:
      num_steps: T.
      width: Channels; even.

    Returns:
      One row a step 0..T.
    """
    half = width // 2
    rate = np.exp(-np.log(10000.0) * np.arange(half) / (half - 1))
    angle = np.maximum(np.arange(num_steps + 1) - 1, 0)[:, None] * rate
    return jnp.asarray(np.concatenate([np.sin(angle), np.cos(angle)], -1), jnp.float32)


class SequenceDiscriminator(nn.Module):
    """Logit that (x_{t-1}, x_t) is a pair of the data, given a condition.

    Attributes:
      num_steps: T.
      width: Channels of the first two layers; the others have its half, half, quarter
        and sixteenth. A multiple of 64: norms have groups of 32 channels, as
        published. (Few channels a group would leave little to tell motions by.)
      time_width: Channels of the step's embedding.
    """

    num_steps: int = 10
    width: int = 1024
    time_width: int = 128

    def setup(self):
        """Makes the layers."""
        full = self.width
        self.time_hidden = nn.Dense(self.time_width)
        self.time_out = nn.Dense(self.time_width)
        self.layers = [
            nn.Dense(n)
            for n in (full, full, full // 2, full // 2, full // 4, full // 16)
        ]
        # Over the channels of one sample only, whatever the batch axes.
        over_channels = dict(group_size=32, epsilon=1e-5, reduction_axes=(-1,))
        self.norm_1 = nn.GroupNorm(num_groups=None, **over_channels)
        self.norm_2 = nn.GroupNorm(num_groups=None, **over_channels)
        self.out = nn.Dense(1)

    def __call__(
        self,
        x_prev: Float[Array, "*batch frames features"],
        x_t: Float[Array, "*batch frames features"],
        t: Int[Array, "*batch"],
        condition: Float[Array, "*batch condition"],
    ) -> Float[Array, "*batch"]:
        """The network.

        Args:
          x_prev: Sample at step t - 1.
          x_t: Sample at step t.
          t: Step in 1..T.
          condition: One-hot action or text vector; of width 0 for none.

        Returns:
          The logit.
        """
        flat = lambda x: x.reshape(*x.shape[:-2], -1)  # noqa: E731
        codes = step_codes(self.num_steps, self.time_width)[t]
        step = self.time_out(nn.leaky_relu(self.time_hidden(codes), 0.2))
        h = jnp.concatenate([flat(x_prev), flat(x_t), step, condition], axis=-1)
        norms = {1: self.norm_1, 3: self.norm_2}
        for i, layer in enumerate(self.layers):
            h = layer(h)
            h = nn.selu(norms[i](h) if i in norms else h)
        return self.out(h)[..., 0]
