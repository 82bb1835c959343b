"""The published text-motion evaluator: PyTorch's weights as Flax parameters.

A layer of PyTorch is transposed: `weight` [out, in] becomes `kernel` [in, out], that of
a convolution [out, in, width] becomes [width, in, out]. A GRU keeps its gates r, z, n
one below the other; the two biases of r and of z are added, those of n stay apart,
because one of them is inside the product with r (see networks/matching.py).

Source: released code and weights of Guo et al. 2022 (T2M).
"""

import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.learning.matching import TAGS, WORD_SIZE, MatcherConfig
from jaxmotion.typing import Params

_MODULES = ("movement_encoder", "motion_encoder", "text_encoder")
Weights = dict[str, np.ndarray]


def load_matcher(
    path: str | os.PathLike, *, config: MatcherConfig | None = None
) -> Params:
    """Reads published weights of the evaluator; runs no code from the file.

    Means and deviations of the features are files of their own there.

    Args:
      path: A file of PyTorch with the three encoders' state dicts (released as
        text_mot_match/model/finest.tar), or a .safetensors file with the same arrays
        as "text_encoder.gru.weight_ih_l0" and so on.
      config: Its size; None for HumanML3D's.

    Returns:
      Parameters for `learning.matching`.

    Raises:
      FileNotFoundError: if there is no such file.
      ImportError: if the package that reads such files is missing.
      ValueError: if the file is damaged or foreign, or arrays are missing, unknown or
        of another shape; names them all.
    """
    path = os.fspath(path)
    if not os.path.exists(path):
        raise FileNotFoundError(f"no weights file {path!r}")
    read = _read_safetensors if path.endswith(".safetensors") else _read_torch
    weights = read(path)
    _check(path, weights, _shapes(config or MatcherConfig()))
    params = {
        "movement": {
            "convolution_1": _linear(weights, "movement_encoder.main.0"),
            "convolution_2": _linear(weights, "movement_encoder.main.3"),
            "out": _linear(weights, "movement_encoder.out_net"),
        },
        "motion": _sequence(weights, "motion_encoder"),
        "text": {
            "tags": _linear(weights, "text_encoder.pos_emb"),
            "sequence": _sequence(weights, "text_encoder"),
        },
    }
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), params)


def _read_torch(path: str) -> Weights:
    """Arrays of a file of PyTorch, named as in safetensors."""
    try:
        import torch
    except ImportError:
        raise ImportError(
            f'{path} needs PyTorch to read: pip install "jaxmotion[parity]"'
        ) from None
    try:
        file = torch.load(path, weights_only=True, map_location="cpu")
    except Exception as error:  # PyTorch has no kind of its own for this
        raise _unreadable(path, error) from error
    found = sorted(map(str, file)) if isinstance(file, dict) else type(file).__name__
    if not isinstance(file, dict) or not set(_MODULES) <= set(file):
        raise ValueError(f"{path} should have {', '.join(_MODULES)}, found {found}")
    return {
        f"{module}.{name}": tensor.float().numpy()
        for module in _MODULES
        for name, tensor in file[module].items()
    }


def _read_safetensors(path: str) -> Weights:
    try:
        from safetensors import numpy as safetensors
    except ImportError:
        raise ImportError(
            f'{path} needs safetensors to read: pip install "jaxmotion[text]"'
        ) from None
    try:
        return safetensors.load_file(path)
    except Exception as error:  # an extension's error, not exported everywhere
        raise _unreadable(path, error) from error


def _unreadable(path: str, error: Exception) -> ValueError:
    return ValueError(
        f"{path}: not a file of weights alone, or a damaged one "
        f"({type(error).__name__})"
    )


def _shapes(config: MatcherConfig) -> dict[str, tuple[int, ...]]:
    """Shape of each array of a published file."""
    c = config
    shapes = {}

    def layer(name: str, *weight: int) -> None:
        shapes[f"{name}.weight"] = weight
        shapes[f"{name}.bias"] = weight[:1]

    def sequence(name: str, channels: int, width: int) -> None:
        shapes[f"{name}.hidden"] = (2, 1, width)
        layer(f"{name}.input_emb", width, channels)
        for direction in ("l0", "l0_reverse"):
            for kind in ("ih", "hh"):
                shapes[f"{name}.gru.weight_{kind}_{direction}"] = (3 * width, width)
                shapes[f"{name}.gru.bias_{kind}_{direction}"] = (3 * width,)
        layer(f"{name}.output_net.0", width, 2 * width)
        layer(f"{name}.output_net.1", width)
        layer(f"{name}.output_net.3", c.embedding, width)

    layer("movement_encoder.main.0", c.movement_width, c.num_features, 4)
    layer("movement_encoder.main.3", c.movement_width, c.movement_width, 4)
    layer("movement_encoder.out_net", c.movement_width, c.movement_width)
    sequence("motion_encoder", c.movement_width, c.motion_width)
    sequence("text_encoder", WORD_SIZE, c.text_width)
    layer("text_encoder.pos_emb", WORD_SIZE, len(TAGS))
    return shapes


def _check(path: str, weights: Weights, shapes: dict[str, tuple[int, ...]]) -> None:
    missing = sorted(set(shapes) - set(weights))
    unknown = sorted(set(weights) - set(shapes))
    differ = [
        f"{name} {weights[name].shape} instead of {shape}"
        for name, shape in sorted(shapes.items())
        if name in weights and weights[name].shape != shape
    ]
    kinds = {"missing": missing, "unknown": unknown, "of another shape": differ}
    told = [f"{kind}: {', '.join(names)}" for kind, names in kinds.items() if names]
    if told:
        raise ValueError(f"{path} does not fit the evaluator; " + "; ".join(told))


def _linear(weights: Weights, name: str) -> dict[str, Any]:
    """A linear layer or a convolution: the axes of its weight in reverse order."""
    return {"kernel": weights[f"{name}.weight"].T, "bias": weights[f"{name}.bias"]}


def _gru(weights: Weights, name: str, direction: str) -> dict[str, Any]:
    """One direction of a GRU."""

    def gates(array: str) -> list[np.ndarray]:
        return np.split(weights[f"{name}.gru.{array}_{direction}"], 3)

    cell = {}
    for gate, w_i, w_h, b_i, b_h in zip(
        "rzn",
        *map(gates, ("weight_ih", "weight_hh", "bias_ih", "bias_hh")),
        strict=True,
    ):
        apart = gate == "n"
        cell[f"i{gate}"] = {"kernel": w_i.T, "bias": b_i if apart else b_i + b_h}
        cell[f"h{gate}"] = {"kernel": w_h.T} | ({"bias": b_h} if apart else {})
    return {"cell": cell}


def _sequence(weights: Weights, name: str) -> dict[str, Any]:
    """A `SequenceEncoder`."""
    return {
        "input": _linear(weights, f"{name}.input_emb"),
        "start": weights[f"{name}.hidden"][:, 0],
        "forward": _gru(weights, name, "l0"),
        "backward": _gru(weights, name, "l0_reverse"),
        "hidden": _linear(weights, f"{name}.output_net.0"),
        "norm": {
            "scale": weights[f"{name}.output_net.1.weight"],
            "bias": weights[f"{name}.output_net.1.bias"],
        },
        "out": _linear(weights, f"{name}.output_net.3"),
    }
