"""The interface, the choice by name, and the cache."""

import json
import os

import numpy as np
import pytest

from jaxmotion.text import clip, encoder, wordllama
from tests.text import samples

TEXTS = ["a person turns left", "a person jumps", "a person turns left", "he runs"]


class Counting:
    """Hashed n-grams that remember what they were asked."""

    def __init__(self, name="counting"):
        self.asked = []
        hashed = encoder.hashed_encoder(dimensions=8)

        def embed(texts):
            self.asked.append(list(texts))
            return hashed.embed(texts)

        self.encoder = encoder.TextEncoder(name=name, dimensions=8, embed=embed)


@pytest.fixture
def cached(tmp_path):
    """A cache with the first two texts."""
    path = tmp_path / "new" / "texts.npz"
    encoder.encode_unique(Counting().encoder, TEXTS[:2], cache=path)
    return path


def rewrite(path, *, drop=None, vectors=None, **header):
    with np.load(path) as file:
        fields = {name: file[name] for name in file.files}
    text = json.loads(fields["header"].tobytes()) | header
    text.pop(drop, None)
    fields["header"] = np.frombuffer(json.dumps(text).encode(), np.uint8)
    if vectors is not None:
        fields["vectors"] = vectors
    np.savez(path, **fields)


def test_names_and_sizes(tmp_path):
    samples.folder(tmp_path)
    prints = clip.load_clip(tmp_path).fingerprint
    cases = {
        "hashed": ("hashed n-grams 256", 256),
        "wordllama": ("WordLlama 256 (bag of tokens)", 256),
        str(tmp_path): (f"CLIP 7 ({tmp_path.name} {prints})", 7),
    }
    for name, (shown, dimensions) in cases.items():
        made = encoder.make_encoder(name)
        assert (made.name, made.dimensions) == (shown, dimensions)
        found = made.encode(["a person turns left", "a  person\tturns left "])
        assert found.shape == (2, dimensions)
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found[0], found[1])
        assert made.encode([]).shape == (0, dimensions)


def test_clip_with_cut_texts_has_another_name(tmp_path):
    samples.folder(tmp_path)
    whole = encoder.clip_encoder(tmp_path)
    cut = encoder.clip_encoder(tmp_path, max_tokens=4)
    assert cut.name == whole.name.removesuffix(")") + ", 4 tokens)"
    a, b = cut.encode(["a person turns left", "a person walks"])
    np.testing.assert_allclose(a, b, atol=1e-6)
    assert np.abs(np.subtract(*whole.encode(["a person turns left", "left"]))).max() > 0


def test_wordllama_is_the_mean_of_its_tokens():
    made = encoder.make_encoder("wordllama")
    expected = wordllama.encode(wordllama.load_wordllama(), TEXTS)
    np.testing.assert_array_equal(made.encode(TEXTS), expected)


def test_unknown_name():
    with pytest.raises(ValueError, match="'wordllama', 'hashed' or a folder.*'clip'"):
        encoder.make_encoder("clip")


@pytest.mark.parametrize("empty", ["", " ", "\t\n"])
def test_empty_texts_are_refused_with_their_index(empty):
    counting = Counting()
    for call in (
        counting.encoder.encode,
        lambda texts: encoder.encode_unique(counting.encoder, texts),
    ):
        with pytest.raises(ValueError, match="text 2 is empty"):
            call(["he runs", "he runs", empty])
        with pytest.raises(ValueError, match="expected a sequence of texts"):
            call("he runs")
    assert not counting.asked


def test_an_encoder_that_returns_something_else_is_caught():
    made = encoder.TextEncoder(
        name="wrong", dimensions=3, embed=lambda texts: np.zeros((len(texts), 2))
    )
    with pytest.raises(ValueError, match=r"wrong should return.*\(1, 3\).*\(1, 2\)"):
        made.encode(["he runs"])


def test_unique_texts_are_encoded_once_in_order():
    counting = Counting()
    texts = [*TEXTS, "he  runs"]
    vectors, index = encoder.encode_unique(counting.encoder, texts)
    assert counting.asked == [[TEXTS[0], TEXTS[1], TEXTS[3]]]
    assert index.tolist() == [0, 1, 0, 2, 2]
    np.testing.assert_array_equal(vectors[index], counting.encoder.encode(texts))


def test_no_texts():
    vectors, index = encoder.encode_unique(Counting().encoder, [])
    assert vectors.shape == (0, 8)
    assert index.shape == (0,)


def test_only_what_the_cache_lacks_is_encoded(cached):
    counting = Counting()
    texts = [*TEXTS, "naïve é\N{GRINNING FACE} jump"]
    vectors, index = encoder.encode_unique(counting.encoder, texts, cache=cached)
    assert counting.asked == [texts[3:]]
    fresh = encoder.encode_unique(counting.encoder, texts)
    np.testing.assert_array_equal(vectors, fresh.vectors)
    np.testing.assert_array_equal(index, fresh.index)
    before = cached.stat().st_mtime_ns
    counting = Counting()
    again = encoder.encode_unique(counting.encoder, texts[::-1], cache=cached)
    assert not counting.asked
    np.testing.assert_array_equal(again.vectors[again.index], vectors[index][::-1])
    assert cached.stat().st_mtime_ns == before
    assert os.listdir(cached.parent) == ["texts.npz"]


def test_damaged_and_foreign_caches_are_named(cached):
    def read():
        encoder.encode_unique(Counting().encoder, TEXTS, cache=cached)

    cached.write_bytes(cached.read_bytes()[:-30])
    with pytest.raises(ValueError, match="texts.npz: not a text vector file"):
        read()
    np.savez(cached, weights=np.zeros(3))
    with pytest.raises(ValueError, match="texts.npz: not a text vector.*header"):
        read()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"encoder": "other"}, "'encoder' should be 'counting', found 'other'"),
        ({"version": 2}, "field 'version' should be 1, found 2"),
        ({"drop": "texts"}, "not a text vector file.*texts"),
        ({"texts": "he runs"}, "field 'texts' should be a list of texts"),
        ({"texts": ["he runs", 3]}, "field 'texts' should be a list of texts"),
        ({"texts": ["he runs"] * 2}, "field 'texts' has a text twice"),
        ({"texts": ["he runs"]}, r"'vectors' should be .*\(1, 8\).*\(2, 8\)"),
        ({"vectors": np.zeros((2, 8))}, "'vectors' should be float32.*found float64"),
        (
            {"vectors": np.full((2, 8), np.nan, np.float32)},
            "'vectors' is not finite for 'a person turns left'",
        ),
    ],
)
def test_caches_that_do_not_fit_are_refused(cached, changes, message):
    rewrite(cached, **changes)
    with pytest.raises(ValueError, match=f"texts.npz: .*{message}|{message}"):
        encoder.encode_unique(Counting().encoder, TEXTS, cache=cached)
