"""CAMDM's denoiser: a transformer encoder with one token per condition and frame.

Tokens in order (147 for 10 past and 45 future frames):

    [time 1] [style 1] [path 45] [facing 45] [past 10] [noisy future 45]

Every stream has its own linear embedding; sinusoidal positions are added to all tokens;
the last 45 tokens go through a linear layer and are the prediction of x_0.

Sampling runs the network many times under one condition. So it is cut in two:
`encode` does what does not depend on x_t (condition tokens with their positions, the
first layer's projections of them, the embeddings of all steps), `denoise` the rest; the
last layer is computed for the output tokens only. `__call__` composes the two.

With attention="prefix" (not in the paper) condition tokens attend among themselves
only. Their keys and values are then the same in all steps, for all layers, and belong
to what `encode` computes once: a step runs 46 tokens instead of 147, and in training
several noise levels share one encoded condition. It is another network, which must be
trained so.

With `frames_per_token` = n > 1 (not in the paper) each token of the four frame streams
holds n neighboring frames; 5 leaves 31 tokens, for machines without an accelerator.

Source: Chen et al. 2024 (CAMDM), section 3.2 and figure 2; sizes of the released code.
"""

import dataclasses
from typing import Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmotion.networks import blocks


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Context:
    """What one condition contributes to all denoising steps.

    Attributes:
      projections: The first layer's queries, keys and values of them.
      steps: Embeddings of steps 0..T, with the time token's position; one table for
        a batch (guidance stacks whole contexts).
      last: The last past pose, and whether the past is kept; None unless predictions
        continue it.
    """

    tokens: Float[Array, "*batch condition width"]
    projections: blocks.Projections
    steps: Float[Array, "*stack steps width"]
    last: tuple[Float[Array, "*batch features"], Bool[Array, "*batch"]] | None = None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PrefixContext:
    """What one condition contributes to all denoising steps, with prefix attention.

    Attributes:
      layers: Keys and values of the condition tokens in each layer.
    """

    layers: tuple[blocks.Prefix, ...]
    steps: Float[Array, "*stack steps width"]
    last: tuple[Float[Array, "*batch features"], Bool[Array, "*batch"]] | None = None


def continuing(
    frames: Float[Array, "*batch future features"],
    last: Float[Array, "*batch features"],
    keep_past: Bool[Array, "*batch"],
    *,
    half_life: float,
    moved: int,
) -> Float[Array, "*batch future features"]:
    """Frames moved so that they go on from the last past pose.

    Where the frames would have been one frame earlier is extrapolated from the first
    two; the last pose's offset to that decays over the frames, with a half-life in
    frames. A network alone misses a pose that it is given by some 2 cm a joint, which
    is a jump where plans meet. Only the first `moved` channels are, and nothing where
    the past is not kept.
    """
    offset = last - (2.0 * frames[..., 0, :] - frames[..., 1, :])
    offset = jnp.where(keep_past[..., None], offset, 0.0)
    *_, number, channels = frames.shape
    fade = 0.5 ** (np.arange(1, number + 1) / half_life)
    fades = np.outer(fade, np.arange(channels) < moved).astype(frames.dtype)
    fades = fades.reshape((1,) * (frames.ndim - 2) + fades.shape)
    # Not an einsum: its outer product has no ONNX form.
    return frames + fades * offset[..., None, :]


class Denoising(nn.Module):
    """A denoiser of the future in two parts, `encode` and `denoise`."""

    def __call__(
        self,
        x_t: Float[Array, "*batch future features"],
        t: Int[Array, "*#batch"],
        past: Float[Array, "*batch past features"],
        path: Float[Array, "*batch future 2"],
        facing: Float[Array, "*batch future 6"],
        label: Int[Array, "*batch"],
        keep_past: Bool[Array, "*batch"],
        *,
        train: bool = False,
    ) -> Float[Array, "*batch future features"]:
        """`encode`, then `denoise`; training needs rngs={"dropout": key}."""
        context = self.encode(past, path, facing, label, keep_past, train=train)
        return self.denoise(context, x_t, t, train=train)


class CamdmTransformer(Denoising):
    """The denoiser.

    Attributes:
      dropout: Rate, after the positions and in every layer.
      frames_per_token: Frames of one token (ours; 1 in the paper).
      token_margin: Frames beyond its own, on either side, that an output token predicts
        and shares with its neighbors (ours; 0 in the paper).
      token_window: How shared frames are cross-faded: "hann" (sin^2) or "trapezoid";
        see `blocks.unfold_weights`.
      norm: Layer norms after each sum ("post", the paper's) or before each branch
        ("pre", ours: learns the legs' phase in a tenth of the steps), with one more
        norm before the output.
      attention: "full" (the paper's), or "prefix" (ours): condition tokens attend among
        themselves only, see neither the step nor the noisy frames, and are computed
        once per plan.
      frame_kernel: Frames of a convolution over time that is added to the predicted
        frames, and starts as zero (ours; odd, 0 for none in the paper).
      seam_half_life: Half-life, frames, of the offset that makes a prediction go on
        from the last past pose, as far as it is kept (ours; 0 for no such offset in the
        paper).
      seam_features: Leading channels that it moves; 0 for all.
    """

    features: int
    past: int = 10
    future: int = 45
    num_labels: int = 100
    num_steps: int = 8
    width: int = 256
    depth: int = 4
    heads: int = 4
    hidden: int = 1024
    dropout: float = 0.2
    frames_per_token: int = 1
    token_margin: int = 0
    token_window: blocks.Window = "hann"
    norm: Literal["post", "pre"] = "post"
    attention: Literal["full", "prefix"] = "full"
    frame_kernel: int = 0
    seam_half_life: float = 0.0
    seam_features: int = 0

    def setup(self):
        """Makes embeddings and layers."""
        self.embed_time = blocks.TimeEmbedding(self.width)
        self.embed_label = blocks.LabelEmbedding(self.num_labels, self.width)
        self.embed_path = nn.Dense(self.width)
        self.embed_facing = nn.Dense(self.width)
        self.embed_past = nn.Dense(self.width)
        self.embed_noisy = nn.Dense(self.width)
        blocks.set_up_layers(self)
        if self.frame_kernel:
            self.smooth = nn.Conv(
                self.features,
                (self.frame_kernel,),
                kernel_init=nn.initializers.zeros,
                use_bias=False,
            )
        self.drop = nn.Dropout(self.dropout)

    @property
    def num_outputs(self) -> int:
        """Tokens of the predicted frames."""
        return self.future // self.frames_per_token

    @property
    def num_tokens(self) -> int:
        """All tokens of a forward pass."""
        return 2 + (3 * self.future + self.past) // self.frames_per_token

    def encode(
        self,
        past: Float[Array, "*batch past features"],
        path: Float[Array, "*batch future 2"],
        facing: Float[Array, "*batch future 6"],
        label: Int[Array, "*batch"],
        keep_past: Bool[Array, "*batch"],
        *,
        train: bool = False,
    ) -> Context | PrefixContext:
        """What does not depend on the noisy sample.

        The path is ground positions (x, z), meters from the last pose, facings are 6D
        rotations. Where `keep_past` is False the past is zeroed (its token is then the
        bias), which is the null condition of classifier-free guidance.
        """
        n = self.frames_per_token
        kept = jnp.where(keep_past[..., None, None], past, 0.0)
        tokens = jnp.concatenate(
            [
                self.embed_label(label)[..., None, :],
                self.embed_path(blocks.fold_frames(path, n)),
                self.embed_facing(blocks.fold_frames(facing, n)),
                self.embed_past(blocks.fold_frames(kept, n)),
            ],
            axis=-2,
        )
        positions = self.positions()
        own = positions[1 : -self.num_outputs]
        tokens = self._drop(blocks.add_rows(tokens, own), train)
        steps = blocks.add_rows(self.embed_time(self.num_steps), positions[0])
        first = self.layers[0].project(tokens)
        last = (past[..., -1, :], keep_past) if self.seam_half_life else None
        if self.attention == "full":
            return Context(tokens=tokens, projections=first, steps=steps, last=last)
        layers = [first]
        for before, layer in zip(self.layers[:-1], self.layers[1:], strict=True):
            tokens = before.attend(tokens, layers[-1], train=train)
            layers.append(layer.project(tokens))
        kept = tuple(blocks.prefix_of(x) for x in layers)
        return PrefixContext(layers=kept, steps=steps, last=last)

    def denoise(
        self,
        context: Context | PrefixContext,
        x_t: Float[Array, "*batch future features"],
        t: Int[Array, "*#batch"],
        *,
        train: bool = False,
    ) -> Float[Array, "*batch future features"]:
        """The clean sample, predicted from step t in 1..T, one for all or a sample."""
        batch, outputs = x_t.shape[:-2], self.num_outputs
        step = jnp.broadcast_to(blocks.row_of(context.steps, t), (*batch, self.width))
        noisy = blocks.add_rows(
            self.embed_noisy(blocks.fold_frames(x_t, self.frames_per_token)),
            self.positions()[-outputs:],
        )
        ends = jnp.concatenate(
            [
                self._drop(step, train)[..., None, :],
                self._drop(noisy, train),
            ],
            axis=-2,
        )
        if isinstance(context, PrefixContext):
            x = ends
            for i, (layer, prefix) in enumerate(
                zip(self.layers, context.layers, strict=True), start=1
            ):
                last = outputs if i == self.depth else None
                x = layer(x, train=train, last=last, prefix=prefix)
        else:
            x = self._attend_to_all(context, ends, train)
        frames = blocks.frames_of(self, x)
        if self.frame_kernel:
            frames = frames + self.smooth(frames)
        if context.last is None:
            return frames
        moved = self.seam_features or self.features
        return continuing(
            frames, *context.last, half_life=self.seam_half_life, moved=moved
        )

    def _attend_to_all(self, context: Context, ends: Array, train: bool) -> Array:
        """The layers over all tokens; `ends` are those of the step and the frames."""
        outputs = self.num_outputs
        # Attention does not see the order of its tokens, so the changing ones can
        # stand together behind the ones whose projections are already there.
        first = self.layers[0]
        projections = jax.tree.map(
            lambda fixed, new: jnp.concatenate([fixed, new], axis=-3),
            context.projections,
            first.project(ends),
        )
        if self.depth == 1:
            last_queries = projections.query[..., -outputs:, :, :]
            projections = projections._replace(query=last_queries)
            x = first.attend(ends[..., 1:, :], projections, train=train)
        else:
            x = jnp.concatenate([context.tokens, ends], axis=-2)
            x = first.attend(x, projections, train=train)
        for i, layer in enumerate(self.layers[1:], start=2):
            x = layer(x, train=train, last=outputs if i == self.depth else None)
        return x

    def positions(self) -> Float[Array, "tokens width"]:
        """Position codes, one row a token, in the order of the module's docstring."""
        return blocks.sinusoidal_positions(self.num_tokens, self.width)

    def _drop(self, x: Array, train: bool) -> Array:
        return self.drop(x, deterministic=not train)
