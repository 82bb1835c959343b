"""experiments/export.py: what the page is made of, and what ends it in one line."""

from pathlib import Path

import pytest

from jaxmotion.export import web
from tests.viz.strider import strider


@pytest.fixture
def script(load, monkeypatch):
    """The script, which finds two models and writes nothing."""
    script, written = load("export"), []
    known = {name: strider()[0] for name in ("one", "two", Path("runs/own.npz"))}

    def found(source, **options):
        if source not in known:
            raise ValueError(f"{source} is no model")
        return known[source]

    monkeypatch.setattr(script.jm, "load", found)
    monkeypatch.setattr(web, "check", lambda: None)
    monkeypatch.setattr(
        web, "write_page", lambda folder, names, **more: written.append(names)
    )
    monkeypatch.setattr(
        web,
        "write_character",
        lambda folder, name, *args, **more: written.append((folder, name)),
    )
    script.written = written
    return script


def test_the_page_has_a_folder_for_each_model(script, tmp_path, capsys):
    script.export(script.Config(format="web", model=("two", "one"), out=tmp_path))
    want = [["two", "one"], (tmp_path / "two", "two"), (tmp_path / "one", "one")]
    assert script.written == want
    assert f"python -m http.server -d {tmp_path}" in capsys.readouterr().out
    script.written.clear()
    run = Path("runs/own.npz")
    script.export(script.Config(format="web", run=run, out=tmp_path))
    assert script.written == [["own"], (tmp_path / "own", "own")]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"format": "web", "model": ("one", "three")}, "three is no model"),
        ({"format": "web"}, "expected either --model or --run"),
        ({"format": "onnx", "model": ("one", "two")}, "--model has 2 names"),
        (
            {"format": "web", "model": ("one",), "steps": (9,)},
            "--steps has 9, expected",
        ),
        ({"format": "glb", "model": ("one",)}, "expected one of onnx, stablehlo, web"),
    ],
)
def test_wrong_options_write_nothing(script, tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        script.export(script.Config(out=tmp_path, **options))
    assert not script.written
