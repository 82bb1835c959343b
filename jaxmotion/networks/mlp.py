"""MLPs that read a noisy vector, a step and a condition at every layer.

    h = silu(W_0 [x_t, c, e_t, z])
    h = silu(norm(W_i [h, x_t, c, e_t, z]))        i = 1..depth - 1
    y = W_out [h, x_t, c, e_t, z]

c is the condition (a previous frame), e_t the step's embedding, z a latent.

What c adds to the layers' sums is the same in all steps of a sampler, what e_t adds is
so for all samples: `layout` turns the weights so that either is one product for all
layers, `encode` does that of the condition once, and `denoise` the rest. `__call__`
composes the three.

Source: the network of AMDM (Shi et al. 2024), whose every layer reads its inputs again;
sizes by us, since Li et al. 2024 (AAMDM) do not give theirs.
"""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.networks import blocks
from jaxmotion.typing import Params


class MlpWeights(NamedTuple):
    """Parameters as sampling reads them; the layers' sums stand side by side.

    Attributes:
      steps: What the steps 0..T add to the sums, with the biases.
      condition: Weights of the condition for the sums.
      inputs: Weights of the noisy vector and the latent.
      hidden: Weights of each layer's hidden channels, but the first's.
    """

    steps: Float[Array, "rows sums"]
    condition: Float[Array, "condition sums"]
    inputs: Float[Array, "inputs sums"]
    hidden: tuple[Float[Array, "width outputs"], ...]
    norms: tuple[Params, ...]


class _Linear(nn.Module):
    """Parameters of an `nn.Dense` of known size."""

    inputs: int
    outputs: int

    @nn.compact
    def __call__(self) -> Params:
        shape, kernel = (self.inputs, self.outputs), nn.initializers.lecun_normal()
        zeros = nn.initializers.zeros
        return {
            "kernel": self.param("kernel", kernel, shape),
            "bias": self.param("bias", zeros, (self.outputs,)),
        }


class _Norm(nn.Module):
    """Parameters of an `nn.GroupNorm`."""

    width: int

    @nn.compact
    def __call__(self) -> Params:
        ones, zeros = nn.initializers.ones, nn.initializers.zeros
        return {
            "scale": self.param("scale", ones, (self.width,)),
            "bias": self.param("bias", zeros, (self.width,)),
        }


def _group_norm(
    x: Float[Array, "*batch width"], params: Params, groups: int
) -> Float[Array, "*batch width"]:
    """Over the channels of a sample's groups, epsilon 1e-6, as `nn.GroupNorm` does.

    In one shape throughout: Flax's repeats statistics over channels, and XLA takes
    3.4 times as long for it on a CPU from 256 samples on.
    """
    split = lambda y: y.reshape(*y.shape[:-1], groups, -1)  # noqa: E731
    g = split(x)
    mean = jnp.mean(g, axis=-1, keepdims=True)
    variance = jnp.mean(jnp.square(g), axis=-1, keepdims=True) - jnp.square(mean)
    scale, bias = (
        jnp.broadcast_to(split(params[name]), g.shape) for name in ("scale", "bias")
    )
    scale = jax.lax.rsqrt(jnp.maximum(variance, 0.0) + 1e-6) * scale
    return ((g - mean) * scale + bias).reshape(x.shape)


class ConditionedMlp(nn.Module):
    """Maps a noisy vector, its step and a condition to a vector.

    The width is a multiple of 16; the step's embedding is even.
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
        """A vector of `features` channels; t in 1..T is one for all or one a sample.

        The latent is a generator's noise; None for none.
        """
        time = blocks.TimeEmbedding(self.time_width, name="TimeEmbedding_0")
        time(self.num_steps)
        given = x_t.shape[-1] + condition.shape[-1] + self.time_width
        given += 0 if latent is None else latent.shape[-1]
        params = {"TimeEmbedding_0": time.variables["params"]}
        for i in range(self.depth + 1):
            inputs = given + (self.width if i else 0)
            outputs = self.width if i < self.depth else self.features
            params[f"Dense_{i}"] = _Linear(inputs, outputs, name=f"Dense_{i}")()
        for i in range(self.depth - 1):
            params[f"GroupNorm_{i}"] = _Norm(self.width, name=f"GroupNorm_{i}")()
        weights = self.layout(params, condition.shape[-1])
        return self.denoise(weights, self.encode(weights, condition), x_t, t, latent)

    def layout(self, params: Params, size: int) -> MlpWeights:
        """Parameters as the methods below read them, for conditions of a size."""
        hidden, rows, biases = [], [], []
        for i in range(self.depth + 1):
            layer, first = params[f"Dense_{i}"], (self.width if i else 0)
            hidden.append(layer["kernel"][:first])
            rows.append(layer["kernel"][first:])
            biases.append(layer["bias"])
        ends = np.cumsum([self.features, size, self.time_width])
        noisy, given, step, latent = jnp.split(jnp.concatenate(rows, axis=-1), ends)
        time = blocks.TimeEmbedding(self.time_width, parent=None)
        table = blocks.apply(params["TimeEmbedding_0"], time, self.num_steps)
        return MlpWeights(
            steps=blocks.add_rows(table @ step, jnp.concatenate(biases)),
            condition=given,
            inputs=jnp.concatenate([noisy, latent]),
            hidden=tuple(hidden[1:]),
            norms=tuple(params[f"GroupNorm_{i}"] for i in range(self.depth - 1)),
        )

    def encode(
        self, weights: MlpWeights, condition: Float[Array, "*batch condition"]
    ) -> Float[Array, "*batch sums"]:
        """What does not depend on the noisy vector."""
        return condition @ weights.condition

    def denoise(
        self,
        weights: MlpWeights,
        context: Float[Array, "*batch sums"],
        x_t: Float[Array, "*batch features"],
        t: Int[Array, "*#batch"],
        latent: Float[Array, "*batch latent"] | None = None,
    ) -> Float[Array, "*batch out"]:
        """The vector, of an encoded condition; arguments as for `__call__`."""
        given = x_t if latent is None else jnp.concatenate([x_t, latent], axis=-1)
        sums = given @ weights.inputs + context
        sums = sums + jnp.broadcast_to(blocks.row_of(weights.steps, t), sums.shape)
        borders = self.width * np.arange(1, self.depth + 1)
        first, *parts, last = jnp.split(sums, borders, axis=-1)
        *kernels, out = weights.hidden
        h = nn.silu(first)
        for kernel, part, norm in zip(kernels, parts, weights.norms, strict=True):
            h = nn.silu(_group_norm(h @ kernel + part, norm, self.groups))
        return h @ out + last


class PairDiscriminator(nn.Module):
    """Logit that (x_{t-1}, x_t) is a pair of the data; the step's embedding is even."""

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
        step = blocks.TimeEmbedding(self.time_width)(self.num_steps)[t]
        step = jnp.broadcast_to(step, (*x_t.shape[:-1], self.time_width))
        h = jnp.concatenate([x_prev, x_t, condition, step], axis=-1)
        for _ in range(self.depth):
            h = nn.leaky_relu(nn.Dense(self.width)(h), 0.2)
        return nn.Dense(1)(h)[..., 0]
