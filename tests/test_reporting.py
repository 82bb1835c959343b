"""What a table was made with."""

import importlib.metadata
import json
import subprocess
import sys

import pytest

from jaxmotion import reporting


def test_it_names_versions_hardware_and_command():
    found = json.loads(json.dumps(reporting.provenance()))
    assert found["jax"] == importlib.metadata.version("jax")
    assert found["jaxlib"] == importlib.metadata.version("jaxlib")
    assert found["cores"] >= 1 and found["cpu"] and found["devices"]
    assert found["command"].split()[1] == sys.argv[0]


def test_without_git_there_is_no_commit(monkeypatch):
    def missing(*args, **kwargs):
        raise FileNotFoundError("git")

    monkeypatch.setattr(subprocess, "run", missing)
    assert reporting.git_commit() is None


@pytest.mark.parametrize("changed", ["", " M file"])
def test_a_commit_says_whether_files_differ(monkeypatch, changed):
    def git(words, **kwargs):
        text = changed if "status" in words else "0123abc"
        return subprocess.CompletedProcess(words, 0, stdout=text + "\n")

    monkeypatch.setattr(subprocess, "run", git)
    assert reporting.git_commit() == "0123abc" + ("+" if changed else "")
