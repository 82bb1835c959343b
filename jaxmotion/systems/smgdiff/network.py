"""SMGDiff's trajectory generator: a small transformer from commands to a ground path.

Tokens: time (1), skill (1), target (1), past path, noisy future path; the last ones go
through a linear layer and are the predicted path. The paper concatenates its noise with
the conditions; here the noise is the noisy path of the last diffusion step, which is
the same thing at T = 1 and makes T >= 2 the same network.

Source: SMGDiff, section 3.1; its sizes are in the missing supplement.
"""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.networks import blocks

CHANNELS = 4


class TrajectoryGenerator(nn.Module):
    """The denoiser of paths: (x, z) and facing (x, z) of each frame."""

    past: int
    future: int
    num_labels: int
    num_steps: int
    width: int
    depth: int
    heads: int
    hidden: int
    frames_per_token: int
    token_margin: int = 0
    token_window: blocks.Window = "hann"
    # Not fields: what `blocks.set_up_layers` asks for.
    norm, dropout, features = "pre", 0.0, CHANNELS

    def setup(self):
        """Makes embeddings and layers."""
        self.embed_time = blocks.TimeEmbedding(self.width)
        self.embed_label = blocks.LabelEmbedding(self.num_labels, self.width)
        self.embed_target = nn.Dense(self.width)
        self.embed_past = nn.Dense(self.width)
        self.embed_noisy = nn.Dense(self.width)
        blocks.set_up_layers(self)

    def __call__(
        self,
        x_t: Float[Array, "*batch future 4"],
        t: Int[Array, "*#batch"],
        past: Float[Array, "*batch past 4"],
        target: Float[Array, "*batch targets"],
        label: Int[Array, "*batch"],
    ) -> Float[Array, "*batch future 4"]:
        """The clean path, predicted from step t in 1..T.

        `target` is where the user points to: wanted velocity times one second, meters;
        with a second target the mean velocity to that one, too.
        """
        n, batch = self.frames_per_token, x_t.shape[:-2]
        time = jnp.broadcast_to(
            self.embed_time(self.num_steps)[t], (*batch, self.width)
        )
        tokens = jnp.concatenate(
            [
                time[..., None, :],
                self.embed_label(label)[..., None, :],
                self.embed_target(target)[..., None, :],
                self.embed_past(blocks.fold_frames(past, n)),
                self.embed_noisy(blocks.fold_frames(x_t, n)),
            ],
            axis=-2,
        )
        positions = blocks.sinusoidal_positions(tokens.shape[-2], self.width)
        tokens = blocks.add_rows(tokens, positions)
        for i, layer in enumerate(self.layers, start=1):
            outputs = self.future // n if i == self.depth else None
            tokens = layer(tokens, train=False, last=outputs)
        return blocks.frames_of(self, tokens)
