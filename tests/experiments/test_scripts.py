"""Every script ends bad input with one line, and its help has an example."""

import dataclasses
import runpy
import sys
import typing

import pytest

from jaxmotion import cli
from tests.experiments.conftest import FOLDER

# What is wrong -> the line says so. quickstart.py and squ9.py have nothing to read.
WRONG = {
    "aamdm": ("evaluate --run {gone}", "gone"),
    "camdm": ("train --data {gone} --out {out}", "gone"),
    "camdm_transitions": ("--run {gone}", "gone"),
    "curves": ("--run {gone}", "gone"),
    "dribble": ("--data {gone} --out {out}", "gone"),
    "emdm": ("evaluate --run {gone}", "gone"),
    "evaluator": ("show {gone}", "gone"),
    "export": ("--model locomotion --format fbx --out {out}", "onnx, stablehlo"),
    "goals": ("--model {gone} --out {out}", "gone"),
    "few_steps": ("--run {gone} --out {out}", "gone"),
    "next_frame": ("--run {gone} --out {out}", "gone"),
    "optimizers": ("--run {gone} --out {out}", "gone"),
    "prepare_data": ("lafan1 --manual-dir {gone} --out {out}.npz", "gone"),
    "quickstart": ("--out {file}/below", "file/below"),
    "report": ("--runs {gone}", "gone"),
    "robot": ("--robot {gone}.xml --out {out}", "gone"),
    "samplers": ("--data {gone} --held-out-clips a --out {out}", "gone"),
    "seeds": ("-- camdm train --data {gone} --out {out}", "gone"),
    "serve": ("--run {gone} --port 0", "gone"),
    "steer": ("--run {gone} --port 0 --no-open", "gone"),
    "steering": ("--data {gone} --held-out-clips a --out {out}", "gone"),
    "smgdiff": ("evaluate --run {gone}", "gone"),
    "squ9": ("--out {file}/below", "file/below"),
    "token_span": ("--data {gone} --out {out}", "gone"),
    "train_queue": ("--runs {file}/below --only aamdm", "file/below"),
    "step_sweep": ("--system mdm --out {out}", "system: unknown"),
}
SCRIPTS = sorted(path.stem for path in FOLDER.glob("*.py"))


@pytest.mark.parametrize("name", SCRIPTS)
def test_bad_input_is_one_line(load, name, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    line, message = WRONG[name]
    places = dict(gone=tmp_path / "gone", out=tmp_path / "out", file=tmp_path / "file")
    path = FOLDER / f"{name}.py"
    monkeypatch.setattr(sys, "argv", [str(path), *line.format(**places).split()])
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(str(path), run_name="__main__")
    assert isinstance(stop.value.code, str)
    assert stop.value.code.startswith("error: ") and "\n" not in stop.value.code
    assert message in stop.value.code


def commands(module):
    """The dataclasses of a script's command lines."""
    for value in vars(module).values():
        if dataclasses.is_dataclass(value) and value.__module__ == module.__name__:
            yield value


def numbers(command):
    """Its options that are numbers, None for the default or not."""
    for name, hint in typing.get_type_hints(command).items():
        if {int, float} & {hint, *typing.get_args(hint)}:
            yield name


@pytest.mark.parametrize("name", SCRIPTS)
def test_every_number_has_a_range_that_its_default_is_in(load, name):
    for command in commands(load(name)):
        known = {x.name: x for x in dataclasses.fields(command)}
        for option in numbers(command):
            assert option in cli.LIMITS, f"{name}: {option}"
            default = known[option].default
            for one in default if isinstance(default, tuple) else (default,):
                assert one is None or one in cli.LIMITS[option]


# One of each kind of mistake; before, most were noticed after minutes, or never.
OUT_OF_RANGE = [
    ("aamdm", "train --previous-noise nan"),
    ("aamdm", "evaluate --long-rollouts 0"),
    ("camdm", "train --batch 0"),
    ("camdm", "train --diffusion-steps 0"),
    ("camdm", "train --learning-rate nan"),
    ("camdm", "train --ema 1"),
    ("camdm", "train --held-out 1"),
    ("camdm", "train --devices 0"),
    ("camdm", "train --seed 4294967296"),
    ("camdm", "evaluate --rollouts 0"),
    ("camdm", "rollout --seconds 0"),
    ("camdm_transitions", "--before 0"),
    ("dribble", "--off-ball -0.1"),
    ("emdm", "train --fps 0"),
    ("emdm", "evaluate --evaluator-steps 0"),
    ("emdm", "sample --scale nan"),
    ("evaluator", "train --updates 0"),
    ("prepare_data", "--seed -1 procedural --out {out}.npz"),
    ("quickstart", "--minutes inf --out {out}"),
    ("robot", "--fps 0 --robot g1.xml"),
    ("serve", "--max-clients 0"),
    ("steer", "--port 70000"),
    ("steering", "--speeds 1 nan --data d.npz --held-out-clips a"),
    ("smgdiff", "train --draft-steps -1"),
    ("smgdiff", "rollout --last-sigma 0"),
    ("squ9", "--length 0 --out {out}"),
    ("step_sweep", "--replications 0 --system camdm"),
]


@pytest.mark.parametrize(("name", "line"), OUT_OF_RANGE)
def test_an_option_out_of_range_is_named_before_any_work(invoke, name, line, tmp_path):
    option = next(x for x in line.split() if x.startswith("--"))
    with pytest.raises(ValueError, match=f"^{option} is .*, expected .*in "):
        invoke(name, line.format(out=tmp_path / "out"))
    assert list(tmp_path.iterdir()) == []


def test_fewer_steps_than_a_row_of_losses_are_refused(invoke, tmp_path):
    with pytest.raises(ValueError, match="--steps is 49, expected at least 50"):
        invoke("quickstart", f"--steps 49 --out {tmp_path / 'out'}")


@pytest.mark.parametrize("name", SCRIPTS)
def test_the_help_has_an_example(help_of, name):
    assert f"python experiments/{name}.py" in help_of(name)
