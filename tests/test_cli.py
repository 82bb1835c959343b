"""How a script starts and ends."""

import dataclasses

import pytest

from jaxmotion import cli
from jaxmotion.learning.loop import TrainingDiverged


@dataclasses.dataclass(frozen=True)
class Options:
    steps: int = 7
    rate: float | None = None
    out: str = "here"


@dataclasses.dataclass(frozen=True)
class Settings:
    steps: int = 1
    rate: float = 0.5
    own: int = 3


def test_settings_take_the_options_of_their_names_that_are_given():
    assert cli.given(Settings, Options()) == {"steps": 7}
    found = Settings(**cli.given(Settings, Options(rate=0.0)))
    assert found == Settings(steps=7, rate=0.0, own=3)


def raising(error):
    def main():
        raise error

    return main


@pytest.mark.parametrize(
    "error",
    [
        FileNotFoundError("clips.npz: no such file"),
        ValueError("clips.npz: field 'fps'"),
        TrainingDiverged("loss is nan at step 3"),
    ],
)
def test_bad_input_is_one_line(error):
    with pytest.raises(SystemExit) as stop:
        cli.start(raising(error))
    assert stop.value.code == f"error: {error}"


@pytest.mark.parametrize("words", ["", "stopped at step 3; saved in runs/x"])
def test_after_ctrl_c_it_says_what_was_saved(capsys, words):
    with pytest.raises(SystemExit) as stop:
        cli.start(raising(KeyboardInterrupt(words)))
    assert stop.value.code == 130
    assert capsys.readouterr().err == (words and words + "\n")


def test_mistakes_of_the_program_are_not_hidden():
    with pytest.raises(KeyError):
        cli.start(raising(KeyError("x")))


def test_a_script_that_ends_well_returns():
    assert cli.start(lambda: None) is None


@pytest.mark.parametrize("words", [("all",), ("host:1", "2"), ("host:1", "2", "x")])
def test_processes_that_cannot_be_joined_are_refused(words):
    assert cli.join_processes(()) is None
    with pytest.raises(ValueError, match="--distributed .*: expected auto, or an ad"):
        cli.join_processes(words)
