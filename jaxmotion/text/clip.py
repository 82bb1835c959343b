"""CLIP's text tower from a local folder in the layout of the Hugging Face hub.

The folder holds model.safetensors, config.json and tokenizer.json, or in place of the
first two OpenAI's own file, such as ViT-B-32.pt. The image tower in the weights, if
any, is not read, and no code of theirs is run. Nothing is downloaded.

Source: layout of the released ViT-B/32 on the hub (openai/clip-vit-base-patch32), and
of OpenAI's TorchScript archives.
"""

import dataclasses
import functools
import json
import os
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.networks import blocks
from jaxmotion.networks.clip import EPSILON, ClipText
from jaxmotion.networks.weight_files import Stored, arrays, read_weights
from jaxmotion.text import files
from jaxmotion.typing import Params

START, END = "<|startoftext|>", "<|endoftext|>"
_BATCHES = 1, 8, 64
_STEP = 16  # lengths are multiples of it, so that few are compiled

# Attribute of the network -> field of the text tower's config.
_SIZES = {
    "vocabulary": "vocab_size",
    "context": "max_position_embeddings",
    "width": "hidden_size",
    "depth": "num_hidden_layers",
    "heads": "num_attention_heads",
    "hidden": "intermediate_size",
    "dimensions": "projection_dim",
}
# Fields that the network has no choice of.
_FIXED = {"hidden_act": "quick_gelu", "layer_norm_eps": EPSILON}
# Old configs say 2, and their code then takes the largest id.
_OLD_END = 2

# Name of a parameter -> key in the weights.
_MODULES = {
    "token_embedding": "text_model.embeddings.token_embedding",
    "position_embedding": "text_model.embeddings.position_embedding",
    "norm_out": "text_model.final_layer_norm",
    "projection": "text_projection",
}
_LAYERS = "text_model.encoder.layers."
_IN_LAYER = {
    "query": "self_attn.q_proj",
    "key": "self_attn.k_proj",
    "value": "self_attn.v_proj",
    "out": "self_attn.out_proj",
    "expand": "mlp.fc1",
    "contract": "mlp.fc2",
    "norm_1": "layer_norm1",
    "norm_2": "layer_norm2",
}
# What OpenAI's file calls those.
_OPENAI = {
    "token_embedding.weight": "text_model.embeddings.token_embedding.weight",
    "positional_embedding": "text_model.embeddings.position_embedding.weight",
    "ln_final.weight": "text_model.final_layer_norm.weight",
    "ln_final.bias": "text_model.final_layer_norm.bias",
}
_OPENAI_IN_LAYER = {
    "attn.out_proj": "self_attn.out_proj",
    "mlp.c_fc": "mlp.fc1",
    "mlp.c_proj": "mlp.fc2",
    "ln_1": "layer_norm1",
    "ln_2": "layer_norm2",
}
_OPENAI_HEAD = 64  # channels of a head


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ClipModel:
    """A text tower with its tokenizer.

    The fingerprint, eight hexadecimal digits, changes with weights and tokenizer.
    """

    network: ClipText
    params: Params
    tokenizer: Any
    fingerprint: str


def load_clip(folder: str | os.PathLike) -> ClipModel:
    """Reads a text tower.

    The folder has model.safetensors, config.json and tokenizer.json, or one .pt file of
    OpenAI's and tokenizer.json. Sizes that the config does not name are those of
    ViT-B/32, as on the hub.

    Raises:
      FileNotFoundError: if a file is missing; names all that are.
      ValueError: if a file is damaged or does not fit the others; names its fields or
        keys (five at most), what was expected and what was found.
    """
    folder = Path(folder)
    names = ["config.json", "tokenizer.json", "model.safetensors"]
    originals = sorted(folder.glob("*.pt"))
    if not (folder / names[2]).is_file() and len(originals) == 1:
        names = [names[1], originals[0].name]
    absent = [name for name in names if not (folder / name).is_file()]
    if absent:
        raise FileNotFoundError(f"{folder} has no {', '.join(absent)}")
    *config, vocabulary, weights = (folder / name for name in names)
    if config:
        network, config_end = _read_config(config[0])
        stored = arrays(read_weights(weights))
    else:
        network, stored = _read_openai(weights)
        config_end = None
    tokenizer = files.read_tokenizer(vocabulary)
    end = _check_tokenizer(vocabulary, tokenizer, network)
    if config_end not in (None, _OLD_END, end):
        raise ValueError(
            f"{config[0]}: eos_token_id is {config_end}, but {END} is {end} in "
            f"{vocabulary.name}"
        )
    network = network.clone(end_of_text=end)
    params = _take_weights(weights, stored, network)
    digest = zlib.crc32(vocabulary.read_bytes())
    if network.heads * _OPENAI_HEAD != network.width:  # which no array's shape tells
        digest = zlib.crc32(str(network.heads).encode(), digest)
    for leaf in jax.tree.leaves(params):
        digest = zlib.crc32(np.asarray(leaf).tobytes(), digest)
    return ClipModel(
        network=network, params=params, tokenizer=tokenizer, fingerprint=f"{digest:08x}"
    )


def _read_config(path: Path) -> tuple[ClipText, Any]:
    """The network of a config, and the end-of-text id that it names, if any."""
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not JSON ({error})") from None
    text = config.get("text_config", config) if isinstance(config, dict) else None
    if not isinstance(text, dict):
        raise ValueError(f"{path}: neither it nor its text_config is a JSON object")
    # The projection belongs to the whole model, whose config overrules the tower's.
    found = dict(text)
    if "projection_dim" in config:
        found["projection_dim"] = config["projection_dim"]
    wrong = [
        f"{field} should be a positive integer, found {found[field]!r}"
        for field in _SIZES.values()
        if field in found and not (type(found[field]) is int and found[field] > 0)
    ]
    wrong += [
        f"{field} should be {expected!r}, found {found[field]!r}"
        for field, expected in _FIXED.items()
        if found.get(field, expected) != expected
    ]
    if wrong:
        raise ValueError(f"{path}: {'; '.join(wrong)}")
    network = ClipText(
        **{name: found[field] for name, field in _SIZES.items() if field in found}
    )
    if network.width % network.heads:
        raise ValueError(
            f"{path}: {network.heads} heads do not divide hidden_size {network.width}"
        )
    return network, found.get("eos_token_id")


def _check_tokenizer(path: Path, tokenizer: Any, network: ClipText) -> int:
    """Id of the end of a text; raises if the tokenizer is not one of CLIP's."""
    for token in (START, END):
        if tokenizer.token_to_id(token) is None:
            raise ValueError(f"{path}: knows no token {token}")
    if (largest := max(tokenizer.get_vocab().values())) >= network.vocabulary:
        raise ValueError(
            f"{path}: token id {largest} is beyond vocab_size {network.vocabulary}"
        )
    return tokenizer.token_to_id(END)


def _keys(network: ClipText) -> Iterator[tuple[tuple, str, tuple[int, ...], bool]]:
    """Path, key in the weights, shape there, and whether it is transposed there."""
    shapes = jax.eval_shape(
        network.init, jax.random.key(0), jnp.zeros((1, 1), jnp.int32)
    )["params"]
    for path, leaf in jax.tree_util.tree_leaves_with_path(shapes):
        *modules, kind = (str(entry.key) for entry in path)
        if len(modules) == 2:
            layer = modules[0].removeprefix("layers_")
            stem = f"{_LAYERS}{layer}.{_IN_LAYER[modules[1]]}"
        else:
            stem = _MODULES[modules[0]]
        transposed = kind == "kernel"  # a linear layer of PyTorch is [out, in]
        key = f"{stem}.{'bias' if kind == 'bias' else 'weight'}"
        shape = leaf.shape[::-1] if transposed else leaf.shape
        yield (*modules, kind), key, shape, transposed


def _read_openai(path: Path) -> tuple[ClipText, dict[str, Stored]]:
    """The network that an archive of OpenAI's has, its arrays named as on the hub."""
    named: dict[str, Stored] = {}
    found = arrays(read_weights(path))
    for name, stored in found.items():
        prefix, _, rest = name.partition("transformer.resblocks.")
        if name in _OPENAI:
            named[_OPENAI[name]] = stored
        elif name == "text_projection":
            named["text_projection.weight"] = _part(stored, slice(None), turned=True)
        elif not prefix and rest:
            layer, _, inner = rest.partition(".")
            stem = f"{_LAYERS}{layer}"
            module, _, kind = inner.rpartition(".")
            if inner.startswith("attn.in_proj_"):  # the three one below the other
                rows = stored.shape[0] // 3
                for i, letter in enumerate("qkv"):
                    key = (
                        f"self_attn.{letter}_proj.{inner.removeprefix('attn.in_proj_')}"
                    )
                    part = slice(i * rows, (i + 1) * rows)
                    named[f"{stem}.{key}"] = _part(stored, part)
            elif module in _OPENAI_IN_LAYER:
                named[f"{stem}.{_OPENAI_IN_LAYER[module]}.{kind}"] = stored
    sizes = {}
    for key, axes in (
        ("token_embedding.weight", ("vocabulary", "width")),
        ("positional_embedding", ("context", "width")),
        ("text_projection", ("width", "dimensions")),
        ("transformer.resblocks.0.mlp.c_fc.weight", ("hidden", "width")),
    ):
        shape = found[key].shape if key in found else ()
        if len(shape) != 2 or 0 in shape:
            raise ValueError(
                f"{path}: {key} should have two axes, found "
                f"{shape if key in found else 'nothing'}"
            )
        sizes |= dict(zip(axes, shape, strict=True))
    layers = {key.split(".")[3] for key in named if ".layers." in key}
    heads = sizes["width"] // _OPENAI_HEAD
    if heads * _OPENAI_HEAD != sizes["width"]:
        raise ValueError(
            f"{path}: {sizes['width']} channels are no multiple of {_OPENAI_HEAD}"
        )
    return ClipText(**sizes, depth=len(layers), heads=heads), named


def _part(stored: Stored, rows: slice, *, turned: bool = False) -> Stored:
    """Some rows of an array, or its transpose."""
    shape = (len(range(stored.shape[0])[rows]), *stored.shape[1:])
    if turned:
        return Stored(shape[::-1], lambda: stored.read()[rows].T)
    return Stored(shape, lambda: stored.read()[rows])


def _take_weights(path: Path, stored: dict[str, Stored], network: ClipText) -> Params:
    """Parameters of the network, float32."""
    params, wrong = {}, []
    layers = {key.split(".")[3] for key in stored if key.startswith(_LAYERS)}
    if len(layers) > network.depth:
        wrong.append(f"{len(layers)} layers, expected {network.depth}")
    for modules, key, shape, transposed in _keys(network):
        if key not in stored:
            wrong.append(f"{key} is missing")
        elif stored[key].shape != shape:
            wrong.append(f"{key} has shape {stored[key].shape}, expected {shape}")
        if wrong:
            continue
        leaf = jnp.asarray(stored[key].read(), jnp.float32)
        at = params
        for name in modules[:-1]:
            at = at.setdefault(name, {})
        at[modules[-1]] = leaf.T if transposed else leaf
    if wrong:
        more = "; ..." if len(wrong) > 5 else ""
        raise ValueError(
            f"{path}: {len(wrong)} keys do not fit: {'; '.join(wrong[:5])}{more}"
        )
    return params


def tokenize(
    model: ClipModel, texts: Sequence[str], *, max_tokens: int | None = None
) -> Int[np.ndarray, "texts tokens"]:
    """Token ids of texts, with the tokens of start and end.

    Rows have one length, filled up with the end-of-text token. Longer texts are cut to
    `max_tokens`, those of start and end included (22 in EMDM and MDM on HumanML3D);
    None: a text beyond the context is an error.

    A `ValueError` names the text that is too long (with limit and length), or contains
    a token of start or end; or a limit not in 3..context.
    """
    network = model.network
    if max_tokens is not None and not 3 <= max_tokens <= network.context:
        raise ValueError(
            f"max_tokens should be in 3..{network.context}, found {max_tokens}"
        )
    start, end = model.tokenizer.token_to_id(START), network.end_of_text
    rows = []
    encodings = model.tokenizer.encode_batch(list(texts), add_special_tokens=False)
    for index, encoding in enumerate(encodings):
        inner = encoding.ids
        if start in inner or end in inner:
            raise ValueError(
                f"text {index}, {texts[index]!r}, contains {START}, {END} or what the "
                "tokenizer does not know"
            )
        if max_tokens is not None:
            inner = inner[: max_tokens - 2]
        if len(inner) + 2 > network.context:
            raise ValueError(
                f"text {index} has {len(inner) + 2} tokens, with start and end; the "
                f"limit is {network.context} (max_tokens cuts): {texts[index]!r}"
            )
        rows.append([start, *inner, end])
    ids = np.full((len(rows), max(map(len, rows), default=0)), end, np.int32)
    for row, found in zip(ids, rows, strict=True):
        row[: len(found)] = found
    return ids


@functools.partial(jax.jit, static_argnames="network")
def _forward(
    params: Params, ids: Int[Array, "batch tokens"], *, network: ClipText
) -> Float[Array, "batch dimensions"]:
    return blocks.apply(params, network, ids)


def encode(
    model: ClipModel, texts: Sequence[str], *, max_tokens: int | None = None
) -> Float[np.ndarray, "texts dimensions"]:
    """Vectors of texts, float32, not normalized: what EMDM and MDM take as condition.

    For `max_tokens`, and what is raised, see `tokenize`.
    """
    network, ids = model.network, tokenize(model, texts, max_tokens=max_tokens)
    vectors = np.zeros((len(ids), network.dimensions), np.float32)
    # Whole batches of like and few lengths: little padding, few programs to compile.
    lengths = 1 + np.sum(ids != network.end_of_text, axis=-1)
    order = np.argsort(lengths, kind="stable")
    size = next((n for n in _BATCHES if len(ids) <= n), _BATCHES[-1])
    for first in range(0, len(ids), size):
        rows = order[first : first + size]
        tokens = min(-(-lengths[rows[-1]] // _STEP) * _STEP, network.context)
        batch = np.full((size, tokens), network.end_of_text, np.int32)
        part = ids[rows, :tokens]
        batch[: len(rows), : part.shape[1]] = part
        found = _forward(model.params, jnp.asarray(batch), network=network)
        vectors[rows] = np.asarray(found)[: len(rows)]
    return vectors
