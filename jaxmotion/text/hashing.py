"""Hashed n-grams: a sentence as a vector without any trained weights.

The features of a sentence are its words (without case), its pairs of neighboring
words, with an edge before the first and after the last, and the groups of three
letters of its words. Each adds its value, with a sign, to one of D components:

    v_i = sum over features f with h(f) = i of  s(f) count(f) weight(f)

The sign keeps inner products unbiased where features collide. Pairs see the order of
words, groups of letters that two words are related ("turn", "turns").

Source: Weinberger et al. 2009, "Feature Hashing for Large Scale Multitask Learning",
section 2; bucket and sign from BLAKE2b, which is the same on all machines.
"""

import functools
import hashlib
import re
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

_WORD = re.compile(r"[^\W_]+(?:'[^\W_]+)?")
_EDGE = ""


def features(text: str) -> Iterator[tuple[str, float]]:
    """Features of a sentence with their weights; one that occurs twice comes twice.

    Words and pairs weigh 1; the groups of letters of a word have a Euclidean length of
    1 together, so that long words do not drown the rest.
    """
    words = _WORD.findall(text.lower())
    for word in words:
        yield f"word {word}", 1.0
        edged = f"<{word}>"
        groups = [edged[i : i + 3] for i in range(len(edged) - 2)]
        for group in groups:
            yield f"letters {group}", len(groups) ** -0.5
    if words:
        edged = [_EDGE, *words, _EDGE]
        for pair in zip(edged[:-1], edged[1:], strict=True):
            yield f"pair {' '.join(pair)}", 1.0


@functools.lru_cache(maxsize=1 << 18)
def _hash(feature: str) -> int:
    """64 bits."""
    return int.from_bytes(hashlib.blake2b(feature.encode(), digest_size=8).digest())


def encode(
    texts: Sequence[str], *, dimensions: int
) -> Float[np.ndarray, "texts dimensions"]:
    """Hashed n-grams of texts, of at least one dimension: float32 vectors of length 1.

    A `ValueError` names a text without words.
    """
    if dimensions < 1:
        raise ValueError(f"dimensions should be positive, found {dimensions}")
    vectors = np.zeros((len(texts), dimensions))
    for vector, text in zip(vectors, texts, strict=True):
        for feature, weight in features(text):
            bits = _hash(feature)
            # The lowest bit is the sign, the others the component.
            vector[(bits >> 1) % dimensions] += weight if bits & 1 else -weight
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    if not lengths.all():
        index = int(np.argmin(lengths))
        raise ValueError(f"text {index} has no words to hash: {texts[index]!r}")
    return (vectors / lengths).astype(np.float32)
