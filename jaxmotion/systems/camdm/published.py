"""CAMDM's released weights as a model of ours.

Read are a checkpoint of its training (best.pt, weights_20.pt) and its four ONNX files.
Step t here is index t - 1 there (`blocks.TimeEmbedding`); poses have the same layout,
joint by joint with 6D rotations in rows, then the root's position.

Source: released code of CAMDM (Chen et al. 2024).
"""

import json
import os
from pathlib import Path
from typing import Any

from jaxmotion.files import read_bytes
from jaxmotion.motion.facing import plain_names
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.networks.torch_layers import Layers
from jaxmotion.networks.weight_files import arrays, read_weights
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm.model import Model
from jaxmotion.typing import Params

# Beside an ONNX file.
STYLES = "100style_conditions.json"


def load(
    path: str | os.PathLike,
    *,
    skeleton: Skeleton,
    labels: tuple[str, ...] | None = None,
) -> tuple[Model, Params]:
    """Reads released weights; runs no code of the file.

    Frames, steps and heads are those that a checkpoint of PyTorch states, else those of
    a <name>.config.json beside the file, else the release's 10, 45, 4 and 4.

    Args:
      labels: Names of the styles; None for those of "100style_conditions.json" beside
        the file.

    Raises:
      FileNotFoundError: if there is no such file, or no names of styles.
      ValueError: if a file is damaged or foreign, arrays are missing, unknown or of
        another shape (names them all), or skeleton or labels do not fit.
    """
    path = Path(path)
    content = read_weights(path)
    weights = arrays(_object(content.get("state_dict")) or content)
    layers = Layers(os.fspath(path), weights, what="CAMDM's network")
    stated = _stated(path, content)
    width, features = layers.shape("future_motion_process.poseEmbedding.weight", 2)
    number, _ = layers.shape("embed_style.action_embedding", 2)
    hidden, _ = layers.shape("seqEncoder.layers.0.linear1.weight", 2)
    depth = layers.count("seqEncoder.layers.")
    _check_skeleton(path, skeleton, features, stated)
    config = camdm_model.Config(
        num_joints=skeleton.num_joints,
        num_labels=number,
        past=stated["past"],
        future=stated["future"],
        num_steps=stated["steps"],
        width=width,
        depth=depth,
        heads=stated["heads"],
        hidden=hidden,
    )
    params: dict[str, Any] = {
        "embed_time": layers.time_embedding("embed_timestep.time_embed", width),
        "embed_label": {
            "embedding": layers.take("embed_style.action_embedding", number, width)
        },
        "embed_path": layers.linear("traj_trans_process.poseEmbedding", 2, width),
        "embed_facing": layers.linear("traj_pose_process.poseEmbedding", 6, width),
        "embed_past": layers.linear(
            "past_motion_process.poseEmbedding", features, width
        ),
        "embed_noisy": layers.linear(
            "future_motion_process.poseEmbedding", features, width
        ),
        "out": layers.linear("output_process.poseFinal", width, features),
    }
    for i in range(depth):
        name = f"seqEncoder.layers.{i}"
        params[f"layers_{i}"] = layers.encoder_layer(name, width, hidden)
    # The table of positions, and the numbers of an ONNX file's operators.
    ignore = ("sequence_pos_encoder.", "embed_timestep.sequence_pos_encoder.", "onnx::")
    params = layers.finish(params, ignore=ignore)
    if width % config.heads:
        raise ValueError(f"{path}: {config.heads} heads do not divide width {width}")
    labels = _styles(path, number) if labels is None else labels
    if len(labels) != number:
        raise ValueError(f"{path}: {number} styles, but {len(labels)} names of styles")
    source = "100STYLE (CC BY 4.0); weights released with CAMDM"
    return Model(config=config, skeleton=skeleton, labels=labels, source=source), params


def _object(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _stated(path: Path, content: dict[str, Any]) -> dict[str, Any]:
    """What a file, or the JSON beside it, says of the model."""
    config = _object(content.get("config"))
    arch, diff = _object(config.get("arch")), _object(config.get("diff"))
    found = {
        "past": arch.get("past_frame"),
        "future": arch.get("future_frame"),
        "heads": arch.get("num_heads"),
        "steps": diff.get("diffusion_steps"),
    }
    beside = path.with_suffix(".config.json")
    value = _read_json(beside) if beside.exists() else {}
    names = ("past_points", "future_points", "heads", "diffusion_steps")
    for field, name, default in zip(found, names, (10, 45, 4, 4), strict=True):
        if found[field] is None:
            found[field] = value.get(name, default)
        number: Any = found[field]
        if type(number) is not int or not 1 <= number <= 1000:
            raise ValueError(
                f"{path}: states {name} {found[field]!r}, expected 1 to 1000"
            )
    return found | {"joints": value.get("joint_names")}


def _read_json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(read_bytes(path))
    except ValueError as error:
        raise ValueError(f"{path}: not JSON ({error})") from None
    if not isinstance(value, dict):
        raise ValueError(f"{path}: expected a JSON object")
    return value


def _check_skeleton(
    path: Path, skeleton: Skeleton, features: int, stated: dict[str, Any]
) -> None:
    if features != 6 * (skeleton.num_joints + 1):
        raise ValueError(
            f"{path}: the model has {features / 6 - 1:g} joints, the skeleton "
            f"{skeleton.num_joints}"
        )
    plain = lambda name: name.lower().split(":")[-1].replace("_", "")  # noqa: E731
    expected = stated["joints"]
    if expected is not None and list(map(plain, expected)) != plain_names(skeleton):
        raise ValueError(
            f"{path}: the skeleton's joints should be {', '.join(expected)}, found "
            f"{', '.join(skeleton.names)}"
        )


def read_styles(path: Path) -> tuple[str, ...]:
    """Names from a JSON file's list "styles"; a `ValueError` names one without it."""
    styles = _read_json(path).get("styles")
    if not isinstance(styles, list) or not all(isinstance(x, str) for x in styles):
        raise ValueError(f"{path}: field 'styles' should be a list of names")
    return tuple(styles)


def _styles(path: Path, number: int) -> tuple[str, ...]:
    beside = path.parent / STYLES
    if not beside.exists():
        raise FileNotFoundError(
            f"{path} does not name its {number} styles, and there is no {STYLES} "
            "beside it: give the names"
        )
    return read_styles(beside)
