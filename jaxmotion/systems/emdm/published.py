"""EMDM's released weights as networks of ours.

Read are its checkpoints (000002700.pth: the generator's moving average as "netG_dict")
and what its training resumes from (content_*.pth: both networks). The discriminator
there flattens motions joint by joint with frames innermost, [J, D, F]; here frames come
first, [F, J, D].

Source: released code of EMDM (Zhou et al. 2024).
"""

import dataclasses
import os
from typing import Any

import numpy as np

from jaxmotion.networks.torch_layers import Layers
from jaxmotion.networks.weight_files import arrays, read_weights
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.typing import Params

_LATENT_LAYERS = 5
_STEP_WIDTH = 128
# A table of positions, and the text encoder, which has a file of its own.
_IGNORED = (
    "sequence_pos_encoder.",
    "embed_timestep.sequence_pos_encoder.",
    "clip_model.",
    "rot2xyz.",
)


def load(
    path: str | os.PathLike, *, frames: int, num_steps: int = 10, heads: int = 32
) -> tuple[emdm_model.Config, dict[str, Params]]:
    """Configuration and parameters, "generator" and perhaps "discriminator".

    Reads released weights; runs no code of the file.

    Args:
      frames: Longest motion: 60 (HumanAct12), 196 (HumanML3D, KIT-ML).
      num_steps: T; a checkpoint does not say.
      heads: Attention heads of the generator; a checkpoint does not say.

    A `ValueError` says if the file is damaged or foreign, and names all arrays that are
    missing, unknown or of another shape.
    """
    path = os.fspath(path)
    content = read_weights(path)
    if not isinstance(content.get("netG_dict"), dict):
        raise ValueError(
            f"{path} should have netG_dict, found {', '.join(map(str, content))}"
        )
    config, params = _generator(path, content["netG_dict"], frames, num_steps, heads)
    found = {"generator": params}
    if isinstance(content.get("netD_dict"), dict) and config.latent:
        config, weights = _discriminator(path, content["netD_dict"], config)
        found["discriminator"] = weights
    return config, found


def _generator(
    path: str, state: dict[str, Any], frames: int, num_steps: int, heads: int
) -> tuple[emdm_model.Config, Params]:
    layers = Layers(path, arrays(state), what="EMDM's generator")
    width, features = layers.shape("input_process.poseEmbedding.weight", 2)
    hidden, _ = layers.shape("seqTransEncoder.layers.0.linear1.weight", 2)
    depth = layers.count("seqTransEncoder.layers.")
    if width % heads:
        raise ValueError(f"{path}: {heads} heads do not divide width {width}")
    params: dict[str, Any] = {
        "embed_time": layers.time_embedding("embed_timestep.time_embed", width),
        "embed_noisy": layers.linear("input_process.poseEmbedding", features, width),
        "out": layers.linear("output_process.poseFinal", width, features),
    }
    for i in range(depth):
        name = f"seqTransEncoder.layers.{i}"
        params[f"layers_{i}"] = layers.encoder_layer(name, width, hidden)
    condition, size = "none", 0
    if "embed_text.weight" in layers.weights:
        condition, (_, size) = "text", layers.shape("embed_text.weight", 2)
        params["embed_condition"] = layers.linear("embed_text", size, width)
    elif (table := "embed_action.action_embedding") in layers.weights:
        condition, (size, _) = "action", layers.shape(table, 2)
        params["embed_condition"] = {"kernel": layers.take(table, size, width)}
    latent = 0
    if "z_transform.0.weight" in layers.weights:
        _, latent = layers.shape("z_transform.0.weight", 2)
        params["embed_latent"] = {
            f"layers_{i}": layers.linear(
                f"z_transform.{2 * i}", width if i else latent, width
            )
            for i in range(_LATENT_LAYERS)
        }
    params = layers.finish(params, ignore=_IGNORED)
    text = condition == "text"
    config = emdm_model.Config(
        features=features,
        frames=frames,
        condition=condition,
        condition_size=size,
        num_steps=num_steps,
        latent=latent,
        width=width,
        depth=depth,
        heads=heads,
        hidden=hidden,
        mask_frames=False,
        weight_recon=100.0 if text else 1.0,
        weight_position=0.0 if text else 1.0,
        weight_velocity=0.0 if text else 1.0,
        weight_foot=0.0 if text else 1.0,
    )
    return config, params


def _discriminator(
    path: str, state: dict[str, Any], config: emdm_model.Config
) -> tuple[emdm_model.Config, Params]:
    layers = Layers(path, arrays(state), what="EMDM's discriminator")
    full, inputs = layers.shape("fc1.weight", 2)
    motion = config.frames * config.features
    conditional = inputs != 2 * motion + _STEP_WIDTH
    seen = 2 * motion + _STEP_WIDTH + conditional * config.condition_size
    sizes = (full, full, full // 2, full // 2, full // 4, full // 16)
    params: dict[str, Any] = {
        "time_hidden": layers.linear("t_embed.main.0", _STEP_WIDTH, _STEP_WIDTH),
        "time_out": layers.linear("t_embed.main.2", _STEP_WIDTH, _STEP_WIDTH),
        "norm_1": layers.norm("gn1", full),
        "norm_2": layers.norm("gn2", full // 2),
        "out": layers.linear("fc7", full // 16, 1),
    }
    for i, (before, size) in enumerate(zip((seen, *sizes), sizes, strict=False)):
        params[f"layers_{i}"] = layers.linear(f"fc{i + 1}", before, size)
    first = params["layers_0"]["kernel"]
    both = first[: 2 * motion].reshape(2, config.features, config.frames, full)
    params["layers_0"]["kernel"] = np.concatenate(
        [both.swapaxes(1, 2).reshape(2 * motion, full), first[2 * motion :]]
    )
    params = layers.finish(params)
    sized = {"discriminator_width": full, "discriminator_condition": conditional}
    return dataclasses.replace(config, **sized), params
