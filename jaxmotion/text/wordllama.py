"""WordLlama: the mean of trained token embeddings, small enough for any machine.

The wheel of the package `wordllama` (MIT) carries a tokenizer and 32000 embeddings of
256 components, distilled from those of a large language model and trained on pairs of
sentences. Only these two files are used. Importing the package would set the level of
the root logger, and its own loader (0.4.0) looks for the tokenizer in a folder that
does not exist and then downloads it.

A mean forgets the order of tokens: "left, then right" is "right, then left".

Source: https://github.com/dleemiller/WordLlama
"""

import dataclasses
import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxmotion.text import files

_WEIGHTS = "weights/l2_supercat_256.safetensors"
_TOKENIZER = "tokenizers/l2_supercat_tokenizer_config.json"


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class WordLlama:
    """Token embeddings with their tokenizer.

    The tokenizer is of the package `tokenizers`; the embedding has one row a token.
    """

    tokenizer: Any
    embedding: Float[np.ndarray, "tokens dimensions"]


def load_wordllama() -> WordLlama:
    """Reads the two files from where the package is installed; needs no network.

    `FileNotFoundError` if it does not carry them, `ModuleNotFoundError` without
    `wordllama`, `tokenizers` or `safetensors`.
    """
    found = importlib.util.find_spec("wordllama")
    if found is None or found.origin is None:
        raise files.missing("wordllama")
    folder = Path(found.origin).parent
    absent = [name for name in (_WEIGHTS, _TOKENIZER) if not (folder / name).is_file()]
    if absent:
        raise FileNotFoundError(
            f"the installed package wordllama has no {', '.join(absent)}; 0.4.0 has"
        )
    with files.require("safetensors").safe_open(folder / _WEIGHTS, "numpy") as file:
        embedding = file.get_tensor("embedding.weight").astype(np.float32)
    return WordLlama(
        tokenizer=files.read_tokenizer(folder / _TOKENIZER), embedding=embedding
    )


def encode(
    model: WordLlama, texts: Sequence[str]
) -> Float[np.ndarray, "texts dimensions"]:
    """Means of token embeddings, not normalized (their length is about 4), float32.

    Case matters, no text is empty, and none depends on the texts beside it.
    """
    encodings = model.tokenizer.encode_batch(list(texts), add_special_tokens=False)
    vectors = np.empty((len(texts), model.embedding.shape[1]), np.float32)
    for vector, encoding in zip(vectors, encodings, strict=True):
        vector[:] = model.embedding[encoding.ids].mean(axis=0)
    return vectors
