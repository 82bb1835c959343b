"""Published evaluators: their weights as parameters, and what they read.

Source: released code and weights of Guo et al. 2022 (T2M), Guo et al. 2020
(Action2Motion, as released with EMDM), and Chen et al. 2024 (CAMDM).
"""

import os
from typing import Any

from jaxmotion.evaluators.text_motion import TAGS, WORD_SIZE, MatcherConfig
from jaxmotion.networks.torch_layers import Layers
from jaxmotion.networks.weight_files import Stored, arrays, read_weights
from jaxmotion.typing import Params

_MODULES = ("movement_encoder", "motion_encoder", "text_encoder")


def load_matcher(
    path: str | os.PathLike, *, config: MatcherConfig | None = None
) -> Params:
    """Reads published weights of the text-motion evaluator; runs no code of the file.

    Means and deviations of the features are files of their own there.

    The file is PyTorch's with the three encoders' state dicts (released as
    text_mot_match/model/finest.tar), or .safetensors with the same arrays as
    "text_encoder.gru.weight_ih_l0" and so on; its size by default HumanML3D's. A
    `ValueError` says if it is damaged or foreign, and names all arrays that are
    missing, unknown or of another shape.
    """
    path, c = os.fspath(path), config or MatcherConfig()
    weights = arrays(read_weights(path))
    if not path.endswith(".safetensors"):  # with optimizers and counters beside them
        kept = {x: y for x, y in weights.items() if x.split(".")[0] in _MODULES}
        found = {x.split(".")[0] for x in kept}
        if found != set(_MODULES):
            raise ValueError(
                f"{path} should have {', '.join(_MODULES)}, found {sorted(found)}"
            )
        weights = kept
    layers = Layers(path, weights, what="the evaluator")
    width = c.movement_width
    params = {
        "movement": {
            "convolution_1": layers.convolution(
                "movement_encoder.main.0", c.num_features, width, 4
            ),
            "convolution_2": layers.convolution(
                "movement_encoder.main.3", width, width, 4
            ),
            "out": layers.linear("movement_encoder.out_net", width, width),
        },
        "motion": _sequence(layers, "motion_encoder", width, c.motion_width, c),
        "text": {
            "tags": layers.linear("text_encoder.pos_emb", len(TAGS), WORD_SIZE),
            "sequence": _sequence(layers, "text_encoder", WORD_SIZE, c.text_width, c),
        },
    }
    return layers.finish(params)


def _sequence(
    layers: Layers, name: str, channels: int, width: int, config: MatcherConfig
) -> dict[str, Any]:
    """A `SequenceEncoder`."""
    return {
        "input": layers.linear(f"{name}.input_emb", channels, width),
        "start": layers.take(f"{name}.hidden", 2, 1, width)[:, 0],
        "forward": layers.gru(f"{name}.gru", "l0", width, width),
        "backward": layers.gru(f"{name}.gru", "l0_reverse", width, width),
        "hidden": layers.linear(f"{name}.output_net.0", 2 * width, width),
        "norm": layers.norm(f"{name}.output_net.1", width),
        "out": layers.linear(f"{name}.output_net.3", width, config.embedding),
    }


def _state(content: dict[str, Any], field: str) -> dict[str, Stored]:
    """Arrays of a state dict, which may be under a field or be the whole file."""
    inner = content.get(field)
    return arrays(inner if isinstance(inner, dict) else content)


def load_style_classifier(
    path: str | os.PathLike, *, frames: int = 60
) -> tuple[Params, tuple[str, ...]]:
    """Parameters of `network.StyleClassifier`, and the names of the styles.

    Reads CAMDM's style classifier (100style_position_classifier.pth), a file of PyTorch
    with its state dict under "state_dict", and "class_names"; runs no code. A window
    has `frames` frames.

    A `ValueError` says if it is damaged or foreign, and names all arrays that are
    missing, unknown or of another shape.
    """
    path = os.fspath(path)
    content = read_weights(path)
    layers = Layers(path, _state(content, "state_dict"), what="the style classifier")
    _, channels, _ = layers.shape("conv1.weight", 3)
    classes, _ = layers.shape("fc3.weight", 2)
    first, second, hidden, features = 64, 128, 1024, 512
    names = content.get("class_names")
    if not isinstance(names, list) or len(names) != classes:
        raise ValueError(
            f"{path}: field 'class_names' should list the names of {classes} styles"
        )

    def block(i: int, inputs: int, outputs: int) -> dict[str, Any]:
        return {
            "main": layers.convolution(f"conv{i}", inputs, outputs, 3),
            "norm": layers.batch_norm(f"bn{i}", outputs),
            "side": layers.convolution(f"residual1x1_{i}", inputs, outputs, 1),
        }

    fc1 = layers.linear("fc1", second * frames, hidden)
    # PyTorch flattens [channels, frames], we [frames, channels].
    kernel = fc1["kernel"].reshape(second, frames, hidden).swapaxes(0, 1)
    params = {
        "convolution_1": block(1, channels, first),
        "convolution_2": block(2, first, second),
        "hidden": {"kernel": kernel.reshape(-1, hidden), "bias": fc1["bias"]},
        "hidden_norm": layers.batch_norm("bn3", hidden),
        "feature": layers.linear("fc2", hidden, features),
        "feature_norm": layers.batch_norm("bn4", features),
        "out": layers.linear("fc3", features, classes),
    }
    return layers.finish(params), tuple(map(str, names))
