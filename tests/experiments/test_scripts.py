"""Every script ends bad input with one line, and its help has an example."""

import runpy
import sys

import pytest

from tests.experiments.conftest import FOLDER

# What is wrong -> the line says so. quickstart.py and squ9.py have nothing to read.
WRONG = {
    "aamdm": ("evaluate --run {gone}", "gone"),
    "camdm": ("train --data {gone} --out {out}", "gone"),
    "camdm_transitions": ("--run {gone}", "gone"),
    "dribble": ("--data {gone} --out {out}", "gone"),
    "emdm": ("evaluate --run {gone}", "gone"),
    "evaluator": ("show {gone}", "gone"),
    "prepare_data": ("lafan1 --manual-dir {gone} --out {out}.npz", "gone"),
    "quickstart": ("--out {file}/below", "file/below"),
    "report": ("--runs {gone}", "gone"),
    "serve": ("--run {gone} --port 0", "gone"),
    "smgdiff": ("evaluate --run {gone}", "gone"),
    "squ9": ("--out {file}/below", "file/below"),
    "step_sweep": ("--system mdm --out {out}", "system: unknown"),
}
SCRIPTS = sorted(path.stem for path in FOLDER.glob("*.py"))


@pytest.mark.parametrize("name", SCRIPTS)
def test_bad_input_is_one_line(load, name, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    line, message = WRONG[name]
    places = dict(gone=tmp_path / "gone", out=tmp_path / "out", file=tmp_path / "file")
    script = FOLDER / f"{name}.py"
    monkeypatch.setattr(sys, "argv", [str(script), *line.format(**places).split()])
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(str(script), run_name="__main__")
    assert isinstance(stop.value.code, str)
    assert stop.value.code.startswith("error: ") and "\n" not in stop.value.code
    assert message in stop.value.code


@pytest.mark.parametrize("name", SCRIPTS)
def test_the_help_has_an_example(help_of, name):
    assert f"python experiments/{name}.py" in help_of(name)
