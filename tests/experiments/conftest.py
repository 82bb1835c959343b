"""Scripts of experiments/, run as their users do but in this process."""

import importlib
import re
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxmotion as jm
from jaxmotion.control import steering

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


def check_face_steers(run):
    """A run loaded twice and steered with other values is one program."""
    found = []
    for seed in range(2):
        model = jm.load(run)
        states = model.start(2, seed=seed)
        commands = jm.commands("forward", model, 2, seconds=0.1, speed=0.5 + seed)
        found.append(jm.rollout(model, jax.random.key(seed), states, commands))
        counted = counted if seed else steering._rollouts._cache_size()
    assert steering._rollouts._cache_size() == counted
    assert np.isfinite(np.asarray(found[1].root_position)).all()
    assert np.abs(found[0].root_position - found[1].root_position).max() > 1e-4
