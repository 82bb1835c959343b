"""EMDM's generator: a transformer encoder over a whole motion.

Tokens in order (63 for 60 frames of the paper, 199 for 196):

    [time] [condition] [latent] [noisy frames]

The condition is one vector: a one-hot action (its linear layer is then the table of
learned actions) or a text's embedding. The latent z goes through a small MLP. Positions
are added to all tokens; the frames' tokens go through a linear layer and are the
prediction of x_0. Without latent it is the denoiser of a diffusion model of the same
size (MDM adds time and text into one token; here they are two).

Source: Zhou et al. 2024 (EMDM), sec. 3.1, and the released code (no skip connections).
"""

import functools
from typing import Any, Literal, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmotion.networks import blocks
from jaxmotion.networks.convolution import convolve


class GeneratorContext(NamedTuple):
    """What `SequenceGenerator.encode` made: token of the condition, steps, frames."""

    condition: Float[Array, "*batch width"] | None
    steps: Float[Array, "steps width"]
    mask: Bool[Array, "*batch outputs"]


class LatentMlp(nn.Module):
    """Linear layers, each with leaky ReLU, from a latent to a token."""

    width: int
    depth: int = 5

    def setup(self):
        """Makes the layers."""
        self.layers = [nn.Dense(self.width) for _ in range(self.depth)]

    def __call__(self, latent: Float[Array, "*batch latent"]) -> Float[Array, "..."]:
        """The token of a latent drawn from N(0, 1)."""
        for layer in self.layers:
            latent = nn.leaky_relu(layer(latent), 0.2)
        return latent


class SequenceGenerator(nn.Module):
    """Predicts a whole clean motion from a noisy one, its step, a condition, a latent.

    Attributes:
      condition: "action" (one-hot), "text" (a vector) or "none".
      latent: Channels of z; 0 for a deterministic denoiser.
      dropout: Rate, after the positions and in every layer.
      frames_per_token: Frames of one token; 1 in the paper. Divides `frames`.
      token_margin: Frames beyond its own, on either side, that a token predicts and
        shares with its neighbors (ours; 0 in the paper).
      token_window: How shared frames are cross-faded: "hann" (sin^2) or "trapezoid";
        see `blocks.unfold_weights`.
      norm: Layer norms after each sum ("post", the paper's) or before each branch
        ("pre", ours: learns faster in short runs), with one more norm before the
        output.
    """

    features: int
    frames: int = 60
    num_steps: int = 10
    condition: Literal["action", "text", "none"] = "action"
    latent: int = 64
    width: int = 1024
    depth: int = 12
    heads: int = 32
    hidden: int = 1024
    dropout: float = 0.1
    frames_per_token: int = 1
    token_margin: int = 0
    token_window: blocks.Window = "hann"
    norm: Literal["post", "pre"] = "post"

    def setup(self):
        """Makes embeddings and layers."""
        self.embed_time = blocks.TimeEmbedding(self.width)
        if self.condition == "action":
            table = nn.initializers.normal(1.0)
            self.embed_condition = nn.Dense(
                self.width, use_bias=False, kernel_init=table
            )
        elif self.condition == "text":
            self.embed_condition = nn.Dense(self.width)
        if self.latent:
            self.embed_latent = LatentMlp(self.width)
        self.embed_noisy = nn.Dense(self.width)
        blocks.set_up_layers(self, activation="selu")
        self.drop = nn.Dropout(self.dropout)

    @property
    def num_outputs(self) -> int:
        """Tokens of the frames."""
        return self.frames // self.frames_per_token

    def encode(
        self,
        condition: Float[Array, "*batch condition"],
        keep: Bool[Array, "*batch"],
        mask: Bool[Array, "*batch frames"],
    ) -> GeneratorContext:
        """What does not depend on the noisy sample.

        Args:
          condition: One-hot action or text vector; of width 0 for "none".
          keep: Where False the condition is zeroed before its linear layer, which is
            the null condition of classifier-free guidance.
          mask: Frames that count; tokens without any are not attended to.
        """
        token = None
        if self.condition != "none":
            token = self.embed_condition(jnp.where(keep[..., None], condition, 0.0))
        groups = mask.reshape(*mask.shape[:-1], self.num_outputs, -1)
        return GeneratorContext(
            condition=token,
            steps=self.embed_time(self.num_steps),
            mask=jnp.any(groups, axis=-1),
        )

    def denoise(
        self,
        context: GeneratorContext,
        x_t: Float[Array, "*batch frames features"],
        t: Int[Array, "*#batch"],
        latent: Float[Array, "*batch latent"] | None,
        *,
        train: bool = False,
    ) -> Float[Array, "*batch frames features"]:
        """The clean motion, predicted from step t in 1..T, one for all or per sample.

        The latent is drawn from N(0, 1), None for a deterministic denoiser. Training,
        with dropout, needs rngs={"dropout": key}.
        """
        batch = x_t.shape[:-2]
        own = [jnp.broadcast_to(blocks.row_of(context.steps, t), (*batch, self.width))]
        if context.condition is not None:
            own.append(context.condition)
        if latent is not None:
            own.append(self.embed_latent(latent))
        frames = blocks.fold_frames(x_t, self.frames_per_token)
        x = jnp.concatenate([jnp.stack(own, -2), self.embed_noisy(frames)], axis=-2)
        positions = blocks.sinusoidal_positions(x.shape[-2], self.width)
        x = self.drop(blocks.add_rows(x, positions), deterministic=not train)
        always = jnp.ones((*batch, len(own)), bool)
        mask = jnp.concatenate(
            [always, jnp.broadcast_to(context.mask, (*batch, self.num_outputs))], -1
        )
        for i, layer in enumerate(self.layers, start=1):
            last = self.num_outputs if i == self.depth else None
            x = layer(x, train=train, last=last, mask=mask)
        return blocks.frames_of(self, x)

    def __call__(
        self,
        x_t: Float[Array, "*batch frames features"],
        t: Int[Array, "*#batch"],
        condition: Float[Array, "*batch condition"],
        keep: Bool[Array, "*batch"],
        mask: Bool[Array, "*batch frames"],
        latent: Float[Array, "*batch latent"] | None,
        *,
        train: bool = False,
    ) -> Float[Array, "*batch frames features"]:
        """`encode`, then `denoise`; arguments as there."""
        context = self.encode(condition, keep, mask)
        return self.denoise(context, x_t, t, latent, train=train)


def step_codes(num_steps: int, width: int) -> Float[Array, "steps {width}"]:
    """Sinusoids of all steps 0..T, to be indexed by t: sines first, then cosines.

    Step t reads the code of t - 1, as the released code counts from 0; row 0 repeats
    row 1. The width is even.
    """
    half = width // 2
    rate = np.exp(-np.log(10000.0) * np.arange(half) / (half - 1))
    angle = np.maximum(np.arange(num_steps + 1) - 1, 0)[:, None] * rate
    return jnp.asarray(np.concatenate([np.sin(angle), np.cos(angle)], -1), jnp.float32)


class SequenceDiscriminator(nn.Module):
    """Logit that (x_{t-1}, x_t) is a pair of the data, given a condition.

    Attributes:
      width: Channels of the first two layers; the others have its half, half, quarter
        and sixteenth. A multiple of 64: norms have groups of 32 channels, as
        published. (Few channels a group would leave little to tell motions by.)
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
        over_channels: dict[str, Any] = dict(
            group_size=32, epsilon=1e-5, reduction_axes=(-1,)
        )
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
        """The logit of a pair at step t in 1..T; the condition has width 0 for none."""
        flat = lambda x: x.reshape(*x.shape[:-2], -1)  # noqa: E731
        codes = step_codes(self.num_steps, self.time_width)[t]
        step = self.time_out(nn.leaky_relu(self.time_hidden(codes), 0.2))
        h = jnp.concatenate([flat(x_prev), flat(x_t), step, condition], axis=-1)
        norms = {1: self.norm_1, 3: self.norm_2}
        for i, layer in enumerate(self.layers):
            h = layer(h)
            h = nn.selu(norms[i](h) if i in norms else h)
        return self.out(h)[..., 0]


class _TemporalBlock(nn.Module):
    """Two convolutions of three frames beside what they are given, added to it."""

    width: int

    def setup(self):
        convolution = functools.partial(
            nn.Conv, self.width, (3,), conv_general_dilated=convolve
        )
        self.first = convolution()
        self.given = nn.Dense(self.width)
        self.second = convolution()

    def __call__(self, x: Array, given: Array) -> Array:
        h = self.first(nn.leaky_relu(x, 0.2))
        h = h + self.given(given)[..., None, :]
        return x + self.second(nn.leaky_relu(h, 0.2))


class TemporalDiscriminator(nn.Module):
    """Logit that (x_{t-1}, x_t) is a pair of the data, by the same weights at any time.

    Five residual blocks of convolutions over frames, the motion halved after the
    second, third and fourth, two linear layers, and a projection on the condition.
    Without norms, so that a gradient penalty bounds all of it. At least eight frames.

    Source: ours; its parts after Huang et al. 2024 ("The GAN is dead; long live the
    GAN!") and Miyato & Koyama 2018 (projection).

    Attributes:
      width: Channels.
    """

    num_steps: int = 10
    width: int = 64
    time_width: int = 128

    def setup(self):
        """Makes the layers."""
        self.given = nn.Dense(self.width)
        self.embed = nn.Dense(self.width)
        self.blocks = [_TemporalBlock(self.width) for _ in range(5)]
        self.hidden = nn.Dense(self.width)
        self.project = nn.Dense(self.width, use_bias=False)
        self.out = nn.Dense(1)

    def __call__(
        self,
        x_prev: Float[Array, "*batch frames features"],
        x_t: Float[Array, "*batch frames features"],
        t: Int[Array, "*batch"],
        condition: Float[Array, "*batch condition"],
    ) -> Float[Array, "*batch"]:
        """The logit of a pair at step t in 1..T; the condition has width 0 for none."""
        codes = step_codes(self.num_steps, self.time_width)[t]
        given = jnp.concatenate([codes, condition], axis=-1)
        given = nn.leaky_relu(self.given(given), 0.2)
        h = self.embed(jnp.concatenate([x_prev, x_t], axis=-1))
        for i, block in enumerate(self.blocks):
            h = block(h, given)
            if i in (1, 2, 3):
                h = nn.avg_pool(h, (2,), (2,))
        h = nn.leaky_relu(h, 0.2)
        h = self.hidden(h.reshape(*h.shape[:-2], -1))
        logit = self.out(nn.leaky_relu(h, 0.2))[..., 0]
        if condition.shape[-1]:
            logit += jnp.sum(self.project(condition) * h, -1) / np.sqrt(self.width)
        return logit
