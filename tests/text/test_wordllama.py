"""WordLlama against the package's own pooling, without network and cache."""

import concurrent.futures
import importlib.util
import itertools
import logging
import os
import subprocess
import sys

import numpy as np
import pytest

from jaxmotion.text import wordllama

pytest.importorskip("wordllama")

TEXTS = [
    "a person turns left",
    "a person turns right",
    "an elderly person walks and turns left",
    "A man does a café-style 3-step dance.",
    "a person walks and then runs",
    "a person runs and then walks",
]


@pytest.fixture(scope="module")
def model():
    return wordllama.load_wordllama()


def test_against_the_package(model):
    """Its import sets the root logger's level, and its loader needs a folder."""
    root = logging.getLogger()
    level, handlers = root.level, list(root.handlers)
    import wordllama as package

    root.setLevel(level)
    root.handlers[:] = handlers
    folder = os.path.dirname(package.__file__)
    theirs = package.WordLlama.load(cache_dir=folder, disable_download=True)
    found = wordllama.encode(model, TEXTS)
    assert found.dtype == np.float32
    assert found.shape == (len(TEXTS), 256)
    np.testing.assert_allclose(found, theirs.embed(TEXTS), atol=1e-5)
    assert found.std() > 0.1


@pytest.mark.slow
def test_neither_network_nor_cache_folder_nor_logging_is_touched(tmp_path):
    code = """
import logging, socket
def refuse(*_, **__):
    raise AssertionError("network")
socket.socket.connect = socket.getaddrinfo = refuse
from jaxmotion.text import wordllama
print(wordllama.encode(wordllama.load_wordllama(), ["a person turns left"]).shape)
assert logging.getLogger().level == logging.WARNING
"""
    env = os.environ | {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True
    )
    assert done.stdout.strip() == "(1, 256)", done.stderr
    assert not list(tmp_path.iterdir())


def test_deterministic_alone_together_and_in_threads(model):
    together = wordllama.encode(model, TEXTS)
    alone = np.concatenate([wordllama.encode(model, [text]) for text in TEXTS])
    np.testing.assert_array_equal(alone, together)
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        for found in pool.map(lambda _: wordllama.encode(model, TEXTS), range(20)):
            np.testing.assert_array_equal(found, together)


def test_sides_differ_but_order_is_lost(model):
    unit = wordllama.encode(model, TEXTS)
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    assert unit[0] @ unit[1] < 0.9
    assert unit[0] @ unit[2] > unit[1] @ unit[2]
    np.testing.assert_allclose(unit[4], unit[5], atol=1e-6)


def test_left_and_right_are_linearly_separable_in_new_sentences(model):
    """Fitted on some people and verbs, asked about others."""

    def sentences(people, verbs):
        parts = list(itertools.product(people, verbs, ("left", "right")))
        texts = [f"{who} {does} to the {side}" for who, does, side in parts]
        side = np.array([1.0 if part[-1] == "left" else -1.0 for part in parts])
        return wordllama.encode(model, texts), side

    x, y = sentences(("a man", "someone", "the dancer"), ("walks", "turns", "leans"))
    weights = np.linalg.lstsq(x, y, rcond=1e-3)[0]
    x, y = sentences(("an elderly woman", "he"), ("jumps", "runs slowly", "crawls"))
    np.testing.assert_array_equal(np.sign(x @ weights), y)


def test_missing_package_and_missing_files(monkeypatch, tmp_path):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install .jaxmotion\[text\]"):
        wordllama.load_wordllama()
    empty = importlib.util.spec_from_file_location("w", tmp_path / "__init__.py")
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: empty)
    with pytest.raises(FileNotFoundError, match="has no weights/.*, tokenizers/"):
        wordllama.load_wordllama()
