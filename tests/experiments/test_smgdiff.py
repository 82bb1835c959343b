"""experiments/smgdiff.py: train, evaluate and roll out; dribble.py makes its data."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxmotion.data import bvh_text, clips_io
from jaxmotion.data.ball_clips import load_ball_clips, save_ball_clips
from tests import ball_walker
from tests.experiments.conftest import check_face_steers

ROOT = Path(__file__).parents[2]
SIZES = (
    "--width 16 --depth 1 --steps 10 --draft-steps 10 --path-steps 10 --batch 4 "
    "--held-out 0.3 --balance 0.5"
)
SHORT = "--windows 8 --replications 2 --evaluator-steps 20 --starts 2 --repeats 2"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "ball.npz"
    save_ball_clips(path, ball_walker.clips(80))
    return path


@pytest.fixture(scope="module")
def trained(invoke, data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    invoke("smgdiff", f"train --data {data} --out {folder} {SIZES}")
    return folder


@pytest.mark.slow
def test_schedules_stand_beside_real_clips(invoke, trained):
    line = f"evaluate --run {trained} --tables schedules steps {SHORT} --schedules"
    invoke("smgdiff", line, "none", "end 2")
    for name, wanted in (("schedules", "none"), ("steps", "8 steps")):
        report = json.loads(
            (trained / "evaluation" / name / "metrics.json").read_text()
        )
        assert {"real (held-out clips)", "real (training clips)", wanted} <= set(
            report["rows"]
        )
        row = report["rows"][wanted]
        assert row["fid"]["samples"] == 2 and row["plan_time"]["value"] > 0
        assert 0 <= row["skill_accuracy"]["value"] <= 1
        assert report["source"] and report["jax"]


@pytest.mark.slow
def test_paths_vary_beside_peoples(invoke, trained):
    invoke("smgdiff", f"evaluate --run {trained} --tables spread --windows 8")
    report = json.loads((trained / "evaluation/spread/metrics.json").read_text())
    straight, made = (
        report["rows"][name] for name in ("straight paths", "generator, T = 1")
    )
    assert straight["spread after 0.5 s, cm"]["value"] == 0
    assert made["energy score after 1 s, cm"]["value"] > 0


@pytest.mark.slow
def test_a_rollout_is_a_motion_with_a_ball(invoke, trained, capsys):
    invoke("smgdiff", f"rollout --run {trained} --seconds 2 --schedule none")
    out = trained / "rollout"
    assert len(bvh_text.read_bvh(out / "rollout.bvh").values) == 60
    lines = (out / "rollout_ball.csv").read_text().splitlines()
    assert lines[0] == "seconds,x,y,z,touch" and len(lines) == 61
    numbers = np.array([line.split(",") for line in lines[1:]], float)
    assert np.isfinite(numbers).all()
    with Image.open(out / "rollout.gif") as image:
        assert image.n_frames == 30
    assert '"ball":{' in (out / "rollout.html").read_text()
    assert "from the root" in capsys.readouterr().out


@pytest.mark.slow
def test_dribble_makes_skills_of_labels(invoke, tmp_path):
    from jaxmotion.data import procedural

    source, out = tmp_path / "clips.npz", tmp_path / "ball.npz"
    clips_io.save_clips(source, procedural.make_clips(minutes=1.0))
    styles = " ".join(procedural.make_clips(minutes=1.0).names("style")[:3])
    invoke(
        "dribble",
        f"--data {source} --out {out} --field style --dribble {styles} --sprint none "
        "--stand none --celebrate none",
    )
    data = load_ball_clips(out)
    assert data.clips.names("skill") == ("dribble", "off_ball")
    assert bool(data.touch.any()) and "synthetic ball" in data.clips.source
    again = tmp_path / "again.npz"
    invoke(
        "dribble",
        f"--data {source} --out {again} --field style --dribble {styles} --sprint "
        f"{styles} --stand none --celebrate none --draws 2 --sprint-draws 3",
    )
    drawn = load_ball_clips(again)
    assert drawn.clips.source == f"{data.clips.source}, 2 draws (3 of sprint)"
    skill = np.asarray(drawn.clips.labels["skill"])
    names = drawn.clips.names("skill")
    seen = {
        (names[s], clip.partition("#")[2])
        for s, clip in zip(skill, drawn.clips.clip_names, strict=True)
    }
    assert seen == {
        *((name, draw) for name in ("dribble", "off_ball") for draw in ("", "2")),
        *(("sprint", draw) for draw in ("", "2", "3")),
    }
    # The first draw is what one draw alone is.
    alone, first = data.clips.clip_names, drawn.clips.clip_names
    assert first[: len(alone)] != alone and set(alone) <= set(first)
    with pytest.raises(FileExistsError, match="--overwrite"):
        invoke("dribble", f"--data {source} --out {out}")
    with pytest.raises(
        ValueError, match="--dribble: unknown style .none2.*give labels"
    ):
        invoke("dribble", f"--data {source} --out {out}2 --field style --dribble none2")


BAD = {
    "train --data {data} --out {new} --stages motion": "unknown stage 'motion'",
    "train --data {none} --out {new}": "no clips file .*none.npz.*dribble.py",
    f"train --data {{data}} --out {{run}} {SIZES} --width 24": "width is 16, given 24",
    f"train --data {{data}} --out {{run}} {SIZES} --held-out 0.2": "held_out is 0.3, g",
    f"train --data {{data}} --out {{run}} {SIZES} --seed 3": "seed is 0, given 3",
    f"train --data {{data}} --out {{run}} {SIZES} --stages motion_8 --draft-steps 0": (
        "motion_8: .*draft_steps is 10, given 0"
    ),
    "evaluate --run {none}": "no such file: expected a run folder",
    f"evaluate --run {{run}} {SHORT} --schedules middle": "unknown schedule 'middle'",
    "rollout --run {run} --skills dive": "unknown label 'dive'",
    "rollout --run {run} --seconds 0.01": "too short",
    "rollout --run {run} --paths paths_7": "no checkpoint",
}


@pytest.mark.slow
@pytest.mark.parametrize("line", BAD)
def test_bad_input_is_one_clear_error(invoke, trained, data, tmp_path, line):
    places = dict(
        data=data, run=trained, new=tmp_path / "new", none=tmp_path / "none.npz"
    )
    before = {x: x.read_bytes() for x in trained.rglob("*") if x.is_file()}
    with pytest.raises((OSError, ValueError), match=BAD[line]):
        invoke(
            "smgdiff",
            line.format(**places) + " " + (SHORT if "evaluate" in line else ""),
        )
    assert list(tmp_path.iterdir()) == []
    assert {x: x.read_bytes() for x in trained.rglob("*") if x.is_file()} == before


@pytest.mark.slow
def test_a_run_is_steered_by_the_face(trained):
    check_face_steers(trained)
