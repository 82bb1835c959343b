"""experiments/steer.py: what ends it in one line, before anything is loaded."""

import socket
import sys

import pytest


@pytest.fixture
def script(load, monkeypatch):
    script = load("steer")
    monkeypatch.setattr(script, "load", None)
    return script


def test_an_occupied_port(script):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(OSError, match=f"cannot listen on 127.0.0.1:{port}: Addr"):
            script.steer(script.Config(port=port))


def test_a_missing_extra(script, monkeypatch):
    monkeypatch.setitem(sys.modules, "websockets", None)
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", None)
    with pytest.raises(ValueError, match=r"websockets: pip install -e \"\.\[viewer\]"):
        script.steer(script.Config(port=0))


def test_too_many_characters(script):
    with pytest.raises(ValueError, match="--characters is 65, expected at most 64"):
        script.steer(script.Config(characters=65, port=0))
    with pytest.raises(ValueError, match="--characters is 0, expected"):
        script.steer(script.Config(characters=0, port=0))


def test_a_rig_that_is_none(script, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"gone\.glb"):
        script.steer(script.Config(rig=tmp_path / "gone.glb", port=0))
    path = tmp_path / "x.glb"
    path.write_bytes(b"glTF")
    with pytest.raises(ValueError, match=r"x\.glb: expected binary glTF"):
        script.steer(script.Config(rig=path, port=0))
