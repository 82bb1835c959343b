"""The two denoisers of CAMDM's ablation, with the interface of the full one.

* `SingleTokenTransformer` (without separate condition tokens): all conditions are
  mapped to one token, to which the time embedding is added, as MDM does.
* `CamdmMlp`: all conditions, the time and the noisy sample are one vector.

The paper gives no more than "a single token" and "8 layers"; sizes are ours.

Source: Chen et al. 2024 (CAMDM), section 4.3 and table 3.
"""

import dataclasses
from typing import Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxmotion.networks import blocks
from jaxmotion.networks.transformer import Denoising


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class FlatContext:
    """What one condition contributes to all steps, 0..T, which a batch shares."""

    condition: Float[Array, "*batch width"]
    steps: Float[Array, "*stack steps width"]


def flatten_condition(
    past: Float[Array, "*batch past features"],
    path: Float[Array, "*batch future 2"],
    facing: Float[Array, "*batch future 6"],
    keep_past: Bool[Array, "*batch"],
) -> Float[Array, "*batch channels"]:
    """All frame streams of a condition as one vector; a dropped past is zero.

    Path is in meters, facings are 6D rotations.
    """
    kept = jnp.where(keep_past[..., None, None], past, 0.0)
    flat = [x.reshape(*x.shape[:-2], -1) for x in (kept, path, facing)]
    return jnp.concatenate(flat, axis=-1)


class _OneVectorCondition(Denoising):
    """Shared part: label and frame streams to one vector, embeddings of the steps."""

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

    def _setup_condition(self):
        self.embed_time = blocks.TimeEmbedding(self.width)
        self.embed_label = blocks.LabelEmbedding(self.num_labels, self.width)
        self.embed_condition = nn.Dense(self.width)
        self.out_condition = nn.Dense(self.width)
        self.drop = nn.Dropout(self.dropout)

    def encode(
        self,
        past: Float[Array, "*batch past features"],
        path: Float[Array, "*batch future 2"],
        facing: Float[Array, "*batch future 6"],
        label: Int[Array, "*batch"],
        keep_past: Bool[Array, "*batch"],
        *,
        train: bool = False,
    ) -> FlatContext:
        """What does not depend on the noisy sample; arguments as the full network's.

        The context has no dropout.
        """
        del train
        flat = flatten_condition(past, path, facing, keep_past)
        x = jnp.concatenate([flat, self.embed_label(label)], axis=-1)
        return FlatContext(
            condition=self.out_condition(nn.silu(self.embed_condition(x))),
            steps=self.embed_time(self.num_steps),
        )


class SingleTokenTransformer(_OneVectorCondition):
    """The transformer without separate condition tokens: 1 + 45 tokens.

    The attributes are as those of the full network.
    """

    frames_per_token: int = 1
    token_margin: int = 0
    token_window: blocks.Window = "hann"
    norm: Literal["post", "pre"] = "post"

    def setup(self):
        """Makes embeddings and layers."""
        self._setup_condition()
        self.embed_noisy = nn.Dense(self.width)
        blocks.set_up_layers(self)

    def denoise(
        self,
        context: FlatContext,
        x_t: Float[Array, "*batch future features"],
        t: Int[Array, "*#batch"],
        *,
        train: bool = False,
    ) -> Float[Array, "*batch future features"]:
        """The clean sample, predicted from step t in 1..T."""
        step = jnp.broadcast_to(
            blocks.row_of(context.steps, t), context.condition.shape
        )
        first = (context.condition + step)[..., None, :]
        noisy = self.embed_noisy(blocks.fold_frames(x_t, self.frames_per_token))
        x = jnp.concatenate([first, noisy], axis=-2)
        positions = blocks.sinusoidal_positions(x.shape[-2], self.width)
        x = blocks.add_rows(x, positions)
        x = self.drop(x, deterministic=not train)
        for i, layer in enumerate(self.layers, start=1):
            last = noisy.shape[-2] if i == self.depth else None
            x = layer(x, train=train, last=last)
        return blocks.frames_of(self, x)


class CamdmMlp(_OneVectorCondition):
    """A residual multilayer perceptron on one vector."""

    def setup(self):
        """Makes embeddings and layers."""
        self._setup_condition()
        self.embed_noisy = nn.Dense(self.hidden)
        self.layers = [nn.Dense(self.hidden) for _ in range(self.depth)]
        self.norms = [nn.LayerNorm(epsilon=1e-5) for _ in range(self.depth)]
        self.out = nn.Dense(self.future * self.features)

    def denoise(
        self,
        context: FlatContext,
        x_t: Float[Array, "*batch future features"],
        t: Int[Array, "*#batch"],
        *,
        train: bool = False,
    ) -> Float[Array, "*batch future features"]:
        """The clean sample, predicted from step t in 1..T."""
        batch = x_t.shape[:-2]
        step = jnp.broadcast_to(
            blocks.row_of(context.steps, t), context.condition.shape
        )
        flat = x_t.reshape(*batch, -1)
        x = jnp.concatenate([flat, context.condition, step], axis=-1)
        x = self.embed_noisy(x)
        for layer, norm in zip(self.layers, self.norms, strict=True):
            hidden = jax.nn.gelu(layer(x), approximate=False)
            x = norm(x + self.drop(hidden, deterministic=not train))
        return self.out(x).reshape(*batch, self.future, self.features)
