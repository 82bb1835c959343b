"""The registry: every system's package has a record, and importing it is cheap."""

from pathlib import Path

import pytest

from jaxmotion.systems import registry


def test_every_package_is_registered():
    folder = Path(registry.__file__).parent
    packages = {path.parent.name for path in folder.glob("*/__init__.py")}
    assert packages == set(registry.SYSTEMS)
    for name, system in registry.SYSTEMS.items():
        assert registry.get(name) is system and system.name == name
        assert system.room("model").__name__ == f"jaxmotion.systems.{name}.model"


def test_an_unknown_system_is_refused_in_one_line():
    with pytest.raises(ValueError, match=r"'camd', expected one of camdm, .*smgdiff$"):
        registry.get("camd")
