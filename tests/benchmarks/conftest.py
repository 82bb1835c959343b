"""Modules of benchmarks/, imported as a script there finds its neighbors."""

import importlib
from pathlib import Path

import pytest

from jaxmotion.systems import registry
from tests import tiny

FOLDER = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def load():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FOLDER))
        yield importlib.import_module


@pytest.fixture(autouse=True)
def _drawn_networks(monkeypatch):
    """Parameters are drawn by NumPy: those of full sizes take seconds to compile."""
    for system in registry.SYSTEMS.values():
        model = system.room("model")
        monkeypatch.setattr(
            model,
            "init",
            lambda key, config, init=model.init: tiny.random_params(init, config),
        )
