"""Layers of PyTorch as parameters of Flax.

A weight [out, in] becomes a kernel [in, out], that of a convolution [out, in, width]
becomes [width, in, out]. Attention has its three projections one below the other. So
has a GRU its gates r, z, n; the two biases of r and of z are added, those of n stay
apart, because one of them is inside the product with r (evaluators/network.py).
"""

from collections.abc import Collection, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.networks.weight_files import Stored
from jaxmotion.typing import Params


class Layers:
    """Takes arrays by name; `finish` tells of all that did not fit at once."""

    def __init__(self, path: str, weights: Mapping[str, Stored], *, what: str):
        self.path, self.weights, self.what = path, weights, what
        self.missing: list[str] = []
        self.differ: list[str] = []
        self.used: set[str] = set()

    def shape(self, name: str, axes: int) -> tuple[int, ...]:
        """Shape that others follow; `ValueError` for no array, or one of other axes."""
        found = self.weights[name].shape if name in self.weights else None
        if found is None or len(found) != axes or 0 in found:
            raise ValueError(
                f"{self.path} does not fit {self.what}; {name} should have {axes} "
                f"axes, found {'nothing' if found is None else found}"
            )
        return found

    def count(self, stem: str) -> int:
        """How many numbered layers begin with a stem."""
        numbers = {
            name.removeprefix(stem).split(".")[0]
            for name in self.weights
            if name.startswith(stem)
        }
        return len(numbers)

    def take(self, name: str, *shape: int) -> np.ndarray:
        """An array of a shape as float32; zeros in its place if it does not fit."""
        self.used.add(name)
        stored = self.weights.get(name)
        if stored is not None and stored.shape == shape:
            return np.asarray(stored.read(), np.float32)
        if stored is None:
            self.missing.append(name)
        else:
            self.differ.append(f"{name} {stored.shape} instead of {shape}")
        return np.zeros(shape, np.float32)

    def finish(self, params: Params, *, ignore: Collection[str] = ()) -> Params:
        """The parameters on the device; names may be left that begin as `ignore` says.

        A `ValueError` names all arrays that are missing, unknown, of another shape or
        not finite.
        """
        told = {
            "missing": sorted(self.missing),
            "unknown": sorted(
                name
                for name in set(self.weights) - self.used
                if not name.startswith(tuple(ignore))
            ),
            "of another shape": sorted(self.differ),
        }
        if any(told.values()):
            parts = [f"{kind}: {', '.join(x)}" for kind, x in told.items() if x]
            raise ValueError(
                f"{self.path} does not fit {self.what}; " + "; ".join(parts)
            )
        if not all(np.isfinite(x).all() for x in jax.tree.leaves(params)):
            raise ValueError(
                f"{self.path}: the weights have numbers that are not finite"
            )
        return jax.tree.map(jnp.asarray, params)

    def linear(self, name: str, inputs: int, outputs: int) -> dict[str, Any]:
        return {
            "kernel": self.take(f"{name}.weight", outputs, inputs).T,
            "bias": self.take(f"{name}.bias", outputs),
        }

    def convolution(
        self, name: str, inputs: int, outputs: int, width: int
    ) -> dict[str, Any]:
        return {
            "kernel": self.take(f"{name}.weight", outputs, inputs, width).T,
            "bias": self.take(f"{name}.bias", outputs),
        }

    def norm(self, name: str, width: int) -> dict[str, Any]:
        """A layer or group norm."""
        return {
            "scale": self.take(f"{name}.weight", width),
            "bias": self.take(f"{name}.bias", width),
        }

    def batch_norm(self, name: str, width: int) -> dict[str, Any]:
        self.used.add(f"{name}.num_batches_tracked")
        return self.norm(name, width) | {
            "mean": self.take(f"{name}.running_mean", width),
            "variance": self.take(f"{name}.running_var", width),
        }

    def encoder_layer(self, name: str, width: int, hidden: int) -> dict[str, Any]:
        """A `blocks.EncoderLayer`."""
        weight = self.take(f"{name}.self_attn.in_proj_weight", 3 * width, width).T
        bias = self.take(f"{name}.self_attn.in_proj_bias", 3 * width)
        return {
            "query": {"kernel": weight[:, :width], "bias": bias[:width]},
            "key_value": {"kernel": weight[:, width:], "bias": bias[width:]},
            "out": self.linear(f"{name}.self_attn.out_proj", width, width),
            "expand": self.linear(f"{name}.linear1", width, hidden),
            "contract": self.linear(f"{name}.linear2", hidden, width),
            "norm_1": self.norm(f"{name}.norm1", width),
            "norm_2": self.norm(f"{name}.norm2", width),
        }

    def time_embedding(self, name: str, width: int) -> dict[str, Any]:
        """A `blocks.TimeEmbedding`."""
        return {
            "hidden": self.linear(f"{name}.0", width, width),
            "out": self.linear(f"{name}.2", width, width),
        }

    def gru(self, name: str, layer: str, inputs: int, hidden: int) -> dict[str, Any]:
        """One layer and direction of a GRU, such as "l0" or "l0_reverse"."""

        def gates(array: str, *shape: int) -> list[np.ndarray]:
            return np.split(self.take(f"{name}.{array}_{layer}", *shape), 3)

        cell = {}
        for gate, w_i, w_h, b_i, b_h in zip(
            "rzn",
            gates("weight_ih", 3 * hidden, inputs),
            gates("weight_hh", 3 * hidden, hidden),
            gates("bias_ih", 3 * hidden),
            gates("bias_hh", 3 * hidden),
            strict=True,
        ):
            apart = gate == "n"
            cell[f"i{gate}"] = {"kernel": w_i.T, "bias": b_i if apart else b_i + b_h}
            cell[f"h{gate}"] = {"kernel": w_h.T} | ({"bias": b_h} if apart else {})
        return {"cell": cell}
