"""Errors of what comes from outside."""

import sys

import pytest

from jaxmotion.text import files
from tests.text import samples


@pytest.mark.parametrize("package", ["tokenizers", "safetensors", "wordllama"])
def test_a_missing_package_says_how_to_install_it(monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    match = rf"{package}.*pip install \"jaxmotion\[text\]\""
    with pytest.raises(ModuleNotFoundError, match=match) as caught:
        files.require(package)
    assert caught.value.name == package


def test_a_package_that_misses_another_is_not_called_missing(tmp_path, monkeypatch):
    (tmp_path / "has_hole.py").write_text("import surely_not_there")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ModuleNotFoundError, match="surely_not_there") as caught:
        files.require("has_hole")
    assert "jaxmotion" not in str(caught.value)


def test_tokenizer_neither_pads_nor_cuts(tmp_path):
    samples.tokenizer().save(str(tmp_path / "tokenizer.json"))
    found = files.read_tokenizer(tmp_path / "tokenizer.json")
    few, many = found.encode_batch(["left", "left " * 30], add_special_tokens=False)
    assert (len(few.ids), len(many.ids)) == (1, 30)


def test_missing_and_damaged_tokenizers_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="none.json"):
        files.read_tokenizer(tmp_path / "none.json")
    (tmp_path / "bad.json").write_text("{}")
    with pytest.raises(ValueError, match="bad.json: not a tokenizer"):
        files.read_tokenizer(tmp_path / "bad.json")
