"""What a table was made with."""

import dataclasses
import importlib.metadata
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxmotion import reporting
from jaxmotion.evaluation import table
from jaxmotion.learning import checkpoint


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


def test_arguments_are_json():
    @dataclasses.dataclass
    class Arguments:
        out: Path = Path("runs/a")
        steps: int = 3
        speed: float | None = None
        contents: tuple[str, ...] = ("walk",)

    found = json.loads(json.dumps(reporting.arguments_json(Arguments())))
    assert found == dict(out="runs/a", steps=3, speed=None, contents=["walk"])


def test_a_run_folder_says_what_was_trained_on_what(tmp_path):
    """So that tables of several trainings can be told from one and the same twice."""

    @dataclasses.dataclass
    class Arguments:
        run: Path

    assert "seeds" not in reporting.provenance(Arguments(tmp_path / "file.npz"))
    (tmp_path / "config.json").write_text('{"files": {"train.npz": "f00d"}}')
    for stage, seed in (("motion", 3), ("deep/er", 3), ("other", 5)):
        how = {"model": {"width": 8}, "training": {"seed": seed, "steps": 9}}
        done = 4 if stage == "other" else 9
        checkpoint.save(tmp_path / stage / "checkpoints", done, {"x": np.ones(2)}, how)
    # Neither a stage that is made without training nor one that has just begun.
    checkpoint.save(tmp_path / "space" / "checkpoints", 0, {"x": np.ones(2)}, {})
    (tmp_path / "begun" / "checkpoints").mkdir(parents=True)
    # 120 updates at 1 per second; a damaged file of losses costs no evaluation.
    rows = [{"step": 60 * i, "steps_per_second": 1.0} for i in (1, 2)]
    text = "".join(f"{json.dumps(row)}\n" for row in rows)
    (tmp_path / "motion" / "losses.jsonl").write_text(text)
    (tmp_path / "other" / "losses.jsonl").write_text("[]\n")
    found = json.loads(json.dumps(reporting.provenance(Arguments(tmp_path))))
    assert found["seeds"] == {"training": [3, 5]}
    assert found["training"] == {
        "motion": {"steps": 9},
        "deep/er": {"steps": 9},
        "other": {"steps": 4, "of": 9},
    }
    assert found["models"] == dict.fromkeys(found["training"], {"width": 8})
    assert found["data"] == {"train.npz": "f00d"}
    assert found["minutes"] == {"motion": 2.0}
    reporting.write_table(tmp_path, {}, found)
    assert (tmp_path / "table.md").read_text().endswith("other has 4 of 9 updates.\n")


def test_rows_that_a_new_table_lacks_stay(tmp_path, capsys):
    def write(value, *names):
        reporting.write_table(
            tmp_path, {name: {"fid": table.Cell(value=value)} for name in names}, {}
        )

    def rows(name):
        return json.loads((tmp_path / name).read_text())["rows"]

    write(1.0, "long", "short")
    write(2.0, "long", "short")
    write(3.0, "short", "long", "other")  # all again
    assert [path.name for path in tmp_path.glob("*.json")] == ["metrics.json"]
    write(4.0, "short")
    assert "rows of before (long, other) are in" in capsys.readouterr().out
    write(5.0, "new")
    assert {*rows("metrics.1.json")} == {"short", "long", "other"}
    assert {*rows("metrics.2.json")} == {"short"}
    assert {*rows("metrics.json")} == {"new"}
    (tmp_path / "metrics.json").write_text("[1")
    write(6.0, "short")
    assert {*rows("metrics.json")} == {"short"}
