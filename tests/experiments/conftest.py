"""Scripts of experiments/, run as their users do but in this process."""

import importlib
import re
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "experiments"


@pytest.fixture(scope="module")
def load():
    """Imports modules as a script of experiments/ finds them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FOLDER))
        yield importlib.import_module


@pytest.fixture(scope="module")
def invoke(load):
    """Runs a script's command line; what has spaces of its own comes after it."""
    with pytest.MonkeyPatch.context() as patch:

        def call(script, line, *more):
            patch.setattr(
                sys, "argv", [str(FOLDER / f"{script}.py"), *line.split(), *more]
            )
            load(script).main()

        yield call


@pytest.fixture
def help_of(invoke, capsys):
    """What a script prints for --help, without boxes and line breaks."""

    def read(script, command=""):
        with pytest.raises(SystemExit) as stop:
            invoke(script, f"{command} --help")
        assert stop.value.code == 0
        return re.sub(r"[│\s]+", " ", capsys.readouterr().out)

    return read
