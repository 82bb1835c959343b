"""experiments/export.py: what the page is made of, and what ends it in one line."""

import json
from pathlib import Path

import pytest

from jaxmotion.export import web
from tests.viz.strider import strider


@pytest.fixture
def script(load, monkeypatch):
    """The script, which finds three models and writes little."""
    script, written = load("export"), []
    known = {name: strider()[0] for name in ("one", "two", Path("runs/own.npz"))}

    def found(source, **options):
        if source not in known:
            raise ValueError(f"{source} is no model")
        return known[source]

    monkeypatch.setattr(script.jm, "load", found)
    monkeypatch.setattr(web, "check", lambda: None)

    def write(folder, *args, **more):
        """A page or a character, of one file."""
        written.append(path := folder / "some.bin")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"of the export")
        return [path]

    monkeypatch.setattr(web, "write_page", write)
    monkeypatch.setattr(web, "write_character", write)
    script.written = written
    return script


def test_the_page_has_a_folder_for_each_model(script, tmp_path, capsys):
    script.export(script.Config(format="web", model=("two", "one"), out=tmp_path))
    places = ("some.bin", "two/some.bin", "one/some.bin")
    assert script.written == [tmp_path / x for x in places]
    assert f"python -m http.server -d {tmp_path}" in capsys.readouterr().out
    listed = json.loads((tmp_path / "models.json").read_text())
    assert listed == {"models": ["two", "one"], "files": sorted(places)}


def test_an_export_replaces_its_own_earlier_one_and_nothing_else(script, tmp_path):
    site, run = tmp_path / "site", Path("runs/own.npz")
    script.export(script.Config(format="web", model=("two", "one"), out=site))
    own = ["CNAME", "one/notes.txt", ".git/config", "../outside"]
    for name in own:
        (site / name).parent.mkdir(exist_ok=True)
        (site / name).write_text("not of the export")
    # A list that somebody changed reaches nothing outside the folder.
    listed = json.loads((site / "models.json").read_text())
    listed["files"] += ["../outside", str(tmp_path / "outside"), "gone.bin"]
    (site / "models.json").write_text(json.dumps(listed))
    script.export(script.Config(format="web", run=run, out=site))
    left = {x.relative_to(site).as_posix() for x in site.rglob("*") if x.is_file()}
    assert left == {*own[:3], "models.json", "some.bin", "own/some.bin"}
    assert all((site / name).read_text() == "not of the export" for name in own)
    assert not (site / "two").exists()


def test_graphs_of_the_export_before_are_taken_away(script, tmp_path, monkeypatch):
    functions = {name: None for name in ("plan", "advance")}
    monkeypatch.setattr(script, "steered", lambda character: (functions, {}, {}, {}))
    monkeypatch.setattr(script.graph, "make", lambda name, *given: name)
    listed = lambda made, file, **options: {"file": file}  # noqa: E731
    monkeypatch.setattr(script.graph, "to_json", listed)
    for writer in script.FORMATS.values():
        monkeypatch.setattr(writer, "check", lambda: None)
        write = lambda path, made, **options: path.write_text(made)  # noqa: E731
        monkeypatch.setattr(writer, "write", write)
    (tmp_path / "notes.onnx").write_text("not of the export")
    for name in ("player.py", "start.npz"):
        (tmp_path / name).write_text("of before")
    options = {"model": ("one",), "out": tmp_path}
    script.export(script.Config(**options, format="onnx", batch="4"))
    before = {path.name: path.read_text() for path in tmp_path.iterdir()}
    functions["gone"] = None  # an export that ends at its last graph

    def made(name, *given):
        if name == "gone":
            raise KeyboardInterrupt
        return f"new {name}"

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(script.graph, "make", made)
        script.export(script.Config(**options, format="onnx", batch="4"))
    found = [path for path in tmp_path.iterdir() if path.is_file()]
    assert {path.name: path.read_text() for path in found} == before
    functions.pop("gone")
    functions.pop("plan")
    functions["tick"] = None
    script.export(script.Config(**options, format="stablehlo"))
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {
        "advance.stablehlo",
        "tick.stablehlo",
        "character.json",
        "notes.onnx",
    }
    for content in ("{}", '{"graphs": {"plan": {"file": "../plan.onnx"}}}'):
        (tmp_path / "character.json").write_text(content)
        with pytest.raises(ValueError, match=r"character.json lists no graphs: exp"):
            script.export(script.Config(**options, format="stablehlo"))


@pytest.mark.parametrize("content", ['{"models": ["one"]}', "[]", "no JSON"])
def test_an_export_that_lists_no_files_is_left_alone(script, tmp_path, content):
    (tmp_path / "models.json").write_text(content)
    with pytest.raises(ValueError, match=r"models.json does not list the files of the"):
        script.export(script.Config(format="web", model=("one",), out=tmp_path))
    assert not script.written and (tmp_path / "models.json").read_text() == content


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
        (
            {"model": ("one",), "steps": (4,)},
            "--steps is .4,., but the format onnx has",
        ),
        ({"model": ("one",), "scale": 2.0}, "but a model that is steered has no such"),
        (
            {"format": "web", "model": ("one",), "batch": "any"},
            "but a page has no such",
        ),
    ],
)
def test_wrong_options_write_nothing(script, tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        script.export(script.Config(out=tmp_path, **options))
    assert not script.written
