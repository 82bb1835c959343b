"""experiments/camdm_transitions.py: help, errors, and a tiny run."""

import json
from pathlib import Path

import pytest

from jaxmotion.data import clips_io
from jaxmotion.evaluators import frozen
from tests import samples

FOLDER = Path(__file__).parents[2] / "experiments"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("--run {folder}/none", "none"),
        ("--evaluator {folder}/none.npz", r"none\.npz"),
    ],
)
def test_what_is_missing_is_named(invoke, tmp_path, line, message):
    with pytest.raises((OSError, ValueError), match=message):
        invoke("camdm_transitions", line.format(folder=tmp_path))


@pytest.mark.slow
def test_a_tiny_run_twice_gives_the_same_table(invoke, tmp_path):
    clips = samples.clips()
    clips_io.save_clips(tmp_path / "clips.npz", clips)
    frozen.save(
        tmp_path / "evaluator.npz",
        samples.evaluator(
            "style", labels=samples.STYLES, joints=clips.skeleton.names, frames=60
        ),
    )
    run = tmp_path / "run"
    invoke(
        "camdm",
        f"train --data {tmp_path}/clips.npz --out {run} --no-mirror --contents "
        "--held-out 0.3 --steps 2 --batch 4 --chunk 2 --save-every 2 --width 16 "
        "--depth 1 --diffusion-steps 1 --warmup 1",
    )
    found = []
    for name in "ab":
        invoke(
            "camdm_transitions",
            f"--run {run} --replications 2 --before 1 --limit 1 --contents --chunk 2 "
            f"--evaluator {tmp_path}/evaluator.npz --out {tmp_path / name}",
        )
        found.append(json.loads((tmp_path / name / "metrics.json").read_text()))
    assert found[0]["rows"] == found[1]["rows"]
    assert len(found[0]["rows"]) == 4
    for row in found[0]["rows"].values():
        assert 0 <= row["success"]["value"] <= 100
        assert row["transition_time"]["samples"] == 2
    assert found[0]["rollouts"] == 4 and found[0]["jax"] and found[0]["git_commit"]
    assert "4 rollouts a row" in (tmp_path / "a" / "table.md").read_text()
