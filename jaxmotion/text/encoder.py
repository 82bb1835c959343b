"""One interface for all text encoders, and a cache of what they found.

Three kinds, by what they need: CLIP (what the papers use) needs its weights in a
folder; WordLlama needs a package, and forgets the order of words; hashed n-grams need
nothing, and know no synonyms.
"""

import dataclasses
import functools
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxmotion import files
from jaxmotion.text import clip, hashing, wordllama

_FORMAT = "jaxmotion-text-vectors"
_VERSION = 1
# Encoders that `make_encoder` knows by name; any other name is a folder of CLIP.
OWN = ("wordllama", "hashed")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TextEncoder:
    """A function from texts to vectors, with its name.

    Attributes:
      name: For tables of results, and to tell caches apart: other vectors, other name.
      embed: The function itself; `encode` checks what goes in and comes out.
    """

    name: str
    dimensions: int
    embed: Callable[[Sequence[str]], np.ndarray]

    def encode(self, texts: Sequence[str]) -> Float[np.ndarray, "texts dimensions"]:
        """Vectors of texts, float32; runs of white space count as one space.

        A `ValueError` names a text that is empty, or that the encoder cannot take.
        """
        plain = plain_texts(texts)
        if not plain:
            return np.zeros((0, self.dimensions), np.float32)
        vectors = self.embed(plain)
        expected = (len(plain), self.dimensions)
        if vectors.shape != expected or vectors.dtype != np.float32:
            raise ValueError(
                f"{self.name} should return float32 of shape {expected}, found "
                f"{vectors.dtype} of {vectors.shape}"
            )
        return vectors


def plain_texts(texts: Sequence[str]) -> list[str]:
    """Texts, single spaces between words; a `ValueError` gives an empty one's index."""
    if isinstance(texts, str):
        raise ValueError(f"expected a sequence of texts, found one: {texts!r}")
    plain = [" ".join(text.split()) for text in texts]
    if "" in plain:
        index = plain.index("")
        raise ValueError(f"text {index} is empty: {texts[index]!r}")
    return plain


def hashed_encoder(*, dimensions: int) -> TextEncoder:
    """Hashed n-grams; see `jaxmotion.text.hashing`."""
    return TextEncoder(
        name=f"hashed n-grams {dimensions}",
        dimensions=dimensions,
        embed=functools.partial(hashing.encode, dimensions=dimensions),
    )


def wordllama_encoder() -> TextEncoder:
    """WordLlama; see `jaxmotion.text.wordllama`, also for what is raised."""
    model = wordllama.load_wordllama()
    dimensions = model.embedding.shape[1]
    return TextEncoder(
        name=f"WordLlama {dimensions} (bag of tokens)",
        dimensions=dimensions,
        embed=functools.partial(wordllama.encode, model),
    )


def clip_encoder(
    folder: str | os.PathLike, *, max_tokens: int | None = None
) -> TextEncoder:
    """CLIP's text tower; see `jaxmotion.text.clip`, also for what is raised.

    The folder has its weights, config and tokenizer; the encoder's name has the
    folder's, and a fingerprint of what is in it. Longer texts are cut to `max_tokens`
    (22 in EMDM and MDM on HumanML3D); None: a text beyond the context is an error.
    """
    model = clip.load_clip(folder)
    network, called = model.network, Path(folder).resolve().name
    cut = "" if max_tokens is None else f", {max_tokens} tokens"
    return TextEncoder(
        name=f"CLIP {network.dimensions} ({called} {model.fingerprint}{cut})",
        dimensions=network.dimensions,
        embed=functools.partial(clip.encode, model, max_tokens=max_tokens),
    )


def make_encoder(name: str, *, max_tokens: int | None = None) -> TextEncoder:
    """The encoder "wordllama", "hashed" (256 components), or a folder's CLIP.

    For `max_tokens` see `clip_encoder`; the others read any text whole.

    `ModuleNotFoundError` if a package is missing, with how to install it; `ValueError`
    if it is none of the three, see also `clip.load_clip`.
    """
    if name == "wordllama":
        return wordllama_encoder()
    if name == "hashed":
        return hashed_encoder(dimensions=256)
    if not Path(name).is_dir():
        raise ValueError(
            f"text encoder should be 'wordllama', 'hashed' or a folder with CLIP's "
            f"weights; {name!r} is neither, and no such folder exists"
        )
    return clip_encoder(name, max_tokens=max_tokens)


class UniqueTexts(NamedTuple):
    """Every text once: the vectors of all are vectors[index].

    Vectors are in the order of first appearance.
    """

    vectors: Float[np.ndarray, "unique dimensions"]
    index: Int[np.ndarray, " texts"]


def encode_unique(
    encoder: TextEncoder,
    texts: Sequence[str],
    *,
    cache: str | os.PathLike | None = None,
) -> UniqueTexts:
    """Encodes every text once, and none that the cache has.

    The cache is an npz file, made or extended with what was missing; one for each
    encoder. With the vectors of the different texts comes where each text is among
    them.

    A `ValueError` gives the index of an empty text, or names the cache's file and field
    if it is damaged, foreign or of another encoder.
    """
    plain = plain_texts(texts)
    rows = {text: row for row, text in enumerate(dict.fromkeys(plain))}
    known = {}
    if cache is not None and os.path.exists(cache):
        known = _read_cache(os.fspath(cache), encoder)
    missing = [text for text in rows if text not in known]
    known.update(zip(missing, encoder.encode(missing), strict=True))
    if cache is not None and missing:
        _write_cache(os.fspath(cache), encoder, known)
    vectors = np.zeros((len(rows), encoder.dimensions), np.float32)
    for text, row in rows.items():
        vectors[row] = known[text]
    return UniqueTexts(vectors, np.array([rows[text] for text in plain], np.int32))


def _write_cache(path: str, encoder: TextEncoder, known: dict[str, np.ndarray]) -> None:
    header = {"format": _FORMAT, "version": _VERSION, "encoder": encoder.name}
    # Texts as JSON: NumPy's strings all take the room of the longest.
    text = json.dumps(header | {"texts": list(known)}).encode()
    arrays = {
        "header": np.frombuffer(text, np.uint8),
        "vectors": np.stack(list(known.values())),
    }
    files.write_arrays(path, arrays)


def _read_cache(path: str, encoder: TextEncoder) -> dict[str, np.ndarray]:
    """Texts and vectors of a cache; checks every field."""
    fields = files.read_arrays(path, name=path, what="text vector")
    try:
        header, vectors = json.loads(fields["header"].tobytes()), fields["vectors"]
        found = {key: header[key] for key in ("format", "version", "encoder", "texts")}
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"{path}: not a text vector file, or a damaged one ({error})"
        ) from None
    wanted = {"format": _FORMAT, "version": _VERSION, "encoder": encoder.name}
    for key, value in wanted.items():
        if found[key] != value:
            raise ValueError(
                f"{path}: field {key!r} should be {value!r}, found {found[key]!r}; "
                "give another file"
            )
    texts = found["texts"]
    if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
        raise ValueError(f"{path}: field 'texts' should be a list of texts")
    if len(set(texts)) != len(texts):
        raise ValueError(f"{path}: field 'texts' has a text twice")
    expected = (len(texts), encoder.dimensions)
    if vectors.shape != expected or vectors.dtype != np.float32:
        raise ValueError(
            f"{path}: field 'vectors' should be float32 of shape {expected}, found "
            f"{vectors.dtype} of {vectors.shape}"
        )
    if not np.isfinite(vectors).all():
        text = texts[int(np.argwhere(~np.isfinite(vectors))[0, 0])]
        raise ValueError(f"{path}: field 'vectors' is not finite for {text!r}")
    return dict(zip(texts, vectors, strict=True))
