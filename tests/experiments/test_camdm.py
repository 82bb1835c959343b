"""experiments/camdm.py: train, evaluate and roll out on clips that the tests make."""

import argparse
import dataclasses
import functools
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxmotion.data import bvh, bvh_text, clips_io, windows
from jaxmotion.evaluation import columns
from jaxmotion.learning import checkpoint
from jaxmotion.motion import trajectory
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import published as camdm_published
from jaxmotion.systems.camdm import release as camdm_release
from jaxmotion.systems.camdm import training as camdm_training
from tests import samples

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "experiments" / "camdm.py"
SIZES = (
    "--width 16 --depth 1 --batch 4 --diffusion-steps 2 --held-out 0.4 --warmup 1 "
    "--chunk 1 --save-every 2"
)


@pytest.fixture(scope="module")
def call(invoke):
    """Runs a command line."""
    return functools.partial(invoke, "camdm")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "clips.npz"
    clips_io.save_clips(path, samples.clips())
    return path


@pytest.fixture(scope="module")
def other(data):
    """Other clips of the same skeleton and styles."""
    clips = samples.clips()
    path = data.with_name("other.npz")
    moved = clips.root_position + 0.01
    clips_io.save_clips(path, dataclasses.replace(clips, root_position=moved))
    return path


def contents(folder):
    """Content of every file, and the folders."""
    return {
        path: path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


@pytest.fixture(scope="module")
def trained(call, data, tmp_path_factory):
    """A run of two steps."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    call(f"train --data {data} --out {folder} {SIZES} --steps 2")
    return folder


def how(folder):
    """Settings of the newest checkpoint."""
    return checkpoint.load_config(folder / "motion" / "checkpoints")["training"]


@pytest.mark.slow
def test_training_leaves_a_run_that_goes_on(data, trained):
    assert checkpoint.latest_step(trained / "motion" / "checkpoints") == 2
    config = json.loads((trained / "config.json").read_text())
    assert config["model"]["labels"] == list(samples.STYLES)
    assert config["settings"]["sizes"]["depth"] == 1
    assert list(config["data"]) == [str(data)]
    assert how(trained)["steps"] == 2
    rows = [
        json.loads(x)
        for x in (trained / "motion" / "losses.jsonl").read_text().splitlines()
    ]
    assert [row["step"] for row in rows] == [1, 2]
    assert all(np.isfinite(row["loss"]) for row in rows)


@pytest.mark.slow
def test_a_preset_says_how_to_train_unless_an_option_does(call, data, tmp_path):
    fields = "optimizer learning_rate batch warmup max_norm ema".split()

    def trained_with(line):
        out = tmp_path / "run"
        sizes = SIZES.replace("--batch 4", "").replace("--warmup 1", "")
        call(f"train --data {data} --out {out} {sizes} --steps 1 {line}")
        return [how(out)[name] for name in fields]

    found = trained_with("--preset paper --ema 0.9 --batch 3")
    assert found == ["adamw", 1e-4, 3, 0, 0.0, 0.9]


@pytest.mark.slow
def test_other_settings_can_be_meant(call, data, trained, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(trained, folder)
    # Where the data lie, and how often it saves, changes nothing that is trained.
    moved = tmp_path / "moved.npz"
    shutil.copy(data, moved)
    same = SIZES.replace("--save-every 2", "--save-every 1")
    call(f"train --data {moved} --out {folder} {same} --steps 2")
    call(f"train --data {data} --out {folder} {SIZES} --steps 4 --batch 2 --override")
    assert checkpoint.latest_step(folder / "motion" / "checkpoints") == 4
    assert how(folder)["batch"] == 2 and how(folder)["steps"] == 4


def check_rollout(folder, seconds):
    frames = round(30 * seconds)
    assert bvh_text.read_bvh(folder / "rollout.bvh").values.shape[0] == frames
    with Image.open(folder / "rollout.gif") as image:
        assert image.n_frames > 1
    text = (folder / "rollout.html").read_text()
    data = json.loads(re.search(r"^const data = (.*);$", text, re.M).group(1))
    assert data["shape"] == [1, frames]
    assert [name for name, *_ in data["paths"]] == ["commanded", "walked"]
    assert "procedural walker" in text


def check_evaluation(folder, rollouts):
    found = json.loads((folder / "metrics.json").read_text())
    assert set(found["rows"]) == {
        "held-out (ground truth)",
        "training half vs half (noise floor)",
        "rollouts",
    }
    released = {
        row: {name for name in cells if "camdm_release" in name}
        for row, cells in found["rows"].items()
    }
    every = {column for column, _ in camdm_release.COLUMNS.values()}
    assert released["rollouts"] == every
    # For clips that nobody steered there is no error of direction or facing.
    steered = {name for name in every if columns.COLUMNS[name].unit == "°"}
    assert released["held-out (ground truth)"] == every - steered
    for name in every:
        assert found["rows"]["rollouts"][name]["samples"] == rollouts
    assert found["health"]["rollouts"] == rollouts
    assert set(found["speeds"]) == set(samples.STYLES)
    assert found["arguments"]["course"] == "forward"
    assert "procedural" in found["source"]
    assert "(trained here)" in (folder / "table.md").read_text().splitlines()[-1]


@pytest.mark.slow
def test_a_rollout_is_written_as_bvh_gif_and_page(call, trained, tmp_path):
    out = tmp_path / "seen"
    call(
        f"rollout --run {trained} --style neutral --to-style zombie --seconds 1 "
        f"--out {out}"
    )
    check_rollout(out, 1.0)
    assert "neutral to zombie" in (out / "rollout.html").read_text()


@pytest.mark.slow
def test_an_evaluation_writes_its_table(call, trained):
    call(
        f"evaluate --run {trained} --rollouts 2 --seconds 4 --evaluator-steps 2 "
        "--chunk 2"
    )
    check_evaluation(trained / "evaluation", 2)
    # Without the last plan's own path the same characters walk another way.
    call(
        f"evaluate --run {trained} --rollouts 2 --seconds 4 --evaluator-steps 2 "
        f"--chunk 2 --no-extend --out {trained / 'no_hfte'}"
    )
    check_evaluation(trained / "no_hfte", 2)
    with_, without = (
        json.loads((trained / name / "metrics.json").read_text())["rows"]["rollouts"]
        for name in ("evaluation", "no_hfte")
    )
    assert with_["jerk"] != without["jerk"]


@pytest.mark.slow
def test_one_style_trains_with_clips_held_out_by_name(call, data, tmp_path):
    names = clips_io.load_clips(data).clip_names
    held_out = [name for name in names if "neutral" in name][:2]
    call(
        f"train --data {data} --out {tmp_path} {SIZES} --steps 2 --labels neutral "
        f"--held-out-clips {' '.join(held_out)}"
    )
    model, _ = camdm_model.load(tmp_path)
    assert model.labels == ("neutral",)
    run = camdm_training.load_run(tmp_path)
    assert list(run.held_out.clip_names) == held_out
    call(f"rollout --run {tmp_path} --style neutral --seconds 1")


@pytest.mark.slow
def test_steering_is_measured_beside_data_and_by_frame_of_the_plan(
    invoke, data, trained, tmp_path
):
    held_out = " ".join(camdm_training.load_run(trained).held_out.clip_names)
    invoke(
        "steering",
        f"--model {trained} --data {data} --held-out-clips {held_out} --speeds 0 1 "
        f"--courses turn_around --rollouts 2 --seconds 14 --out {tmp_path}",
    )
    found = json.loads((tmp_path / "metrics.json").read_text())
    rows = found["rows"]
    title = "turn around at 1.4 m/s"
    made = ["straight at 0 m/s", "straight at 1 m/s", title]
    locked = [f"{name}, locked feet" for name in made]
    assert {*made, *locked, f"{title}, the springs themselves"} < {*rows}
    assert rows["straight at 0 m/s"]["creep"]["samples"] == 2
    data = rows["training, about 1 m/s"]
    assert data["windows"]["value"] > 0
    assert 0.8 < data["speed"]["value"] < 1.2
    assert rows[made[1]]["foot_slide"] != rows[locked[1]]["foot_slide"]
    assert set(found["by_frame_of_the_plan"]) == {*made, *locked}
    assert len(found["by_frame_of_the_plan"][made[1]]["jerk"]) == 15
    assert f"{title}, turn" in found["by_time_since_a_command"]
    text = (tmp_path / "table.md").read_text()
    assert "| straight at 1 m/s, jerk, m/s³ |" in text


@pytest.mark.slow
def test_a_student_is_taken_by_all_that_takes_a_run(
    call, invoke, data, trained, tmp_path
):
    folder = tmp_path / "student"
    sizes = "--batch 4 --warmup 1 --chunk 1 --save-every 2"
    line = f"distill --run {trained} --out {folder} --visit 2 {sizes} --steps"
    call(f"{line} 2")
    with pytest.raises(ValueError, match="steps is 2, given 4"):
        call(f"{line} 4")
    call(f"{line} 4 --override")
    assert checkpoint.latest_step(folder / "motion" / "checkpoints") == 4
    call(
        f"evaluate --run {folder} --rollouts 2 --seconds 4 --evaluator-steps 2 "
        "--chunk 2"
    )
    check_evaluation(folder / "evaluation", 2)
    held_out = camdm_training.load_run(folder).held_out.clip_names[0]
    course = "--speeds 1 --courses turn_around --rollouts 2 --seconds 5"
    line = f"--model {folder} --data {data} --held-out-clips {held_out} {course}"
    rows = {}
    for visit in ("2", "1 2"):
        out = tmp_path / visit.replace(" ", "_")
        invoke("steering", f"{line} --visit {visit} --out {out}")
        rows[visit] = json.loads((out / "metrics.json").read_text())["rows"]
    assert rows["2"] != rows["1 2"]
    call(f"rollout --run {folder} --style zombie --seconds 1")
    call(f"export --run {folder} --out {tmp_path / 'student.npz'}")
    assert camdm_model.load(tmp_path / "student.npz")[0].steps == (2,)


@pytest.mark.slow
def test_an_export_has_poses_of_the_models_own(call, trained, tmp_path):
    call(f"export --run {trained} --out {tmp_path / 'model.npz'} --starts 2")
    model, _ = camdm_model.load(tmp_path / "model.npz")
    lead = (len(model.labels), 2, model.config.past)
    assert model.starts.root_position.shape == (*lead, 3)
    path = trajectory.root_trajectory(
        model.skeleton, jax.tree.map(lambda x: x[1, 1], model.starts)
    )
    np.testing.assert_allclose(path.position[-1], 0.0, atol=1e-4)
    np.testing.assert_allclose(path.facing[-1], [0.0, 1.0], atol=1e-4)


@pytest.fixture(scope="module")
def released(call, data, tmp_path_factory):
    """The authors' checkpoint of the walker's skeleton, and what becomes of it."""
    torch = pytest.importorskip("torch")
    from tests.reference import published_torch as peers

    folder = tmp_path_factory.mktemp("released")
    clips = samples.clips()
    motion = windows.cut(clips, jnp.array(0), 3)
    content = bvh.bvh_from_motion(clips.skeleton, motion)
    bvh_text.write_bvh(folder / "skeleton.bvh", content)
    peer = peers.Camdm(clips.skeleton.num_joints, len(samples.STYLES))
    content = {"state_dict": peers.randomize(peer, 0).state_dict()}
    torch.save(content | {"config": argparse.Namespace(name="x")}, folder / "best.pt")
    styles = folder / "styles.json"
    styles.write_text(json.dumps({"styles": samples.STYLES}))
    call(
        f"import --weights {folder}/best.pt --skeleton {folder}/skeleton.bvh "
        f"--labels {styles} --data {data} --out {folder}/released --held-out 0.4"
    )
    return folder


@pytest.mark.slow
def test_released_weights_become_a_model_that_rolls_out(call, released):
    model, params = camdm_model.load(released / "released")
    assert model.config.num_steps == 4 and model.config.norm == "post"
    assert model.labels == samples.STYLES
    assert model.skeleton.feet == samples.clips().skeleton.feet
    direct, again = camdm_published.load(
        released / "best.pt", skeleton=model.skeleton, labels=model.labels
    )
    assert direct.config == model.config
    jax.tree.map(np.testing.assert_array_equal, params, again)
    call(f"rollout --run {released}/released --style zombie --seconds 1")
    folder = released / "released" / "rollout"
    assert bvh_text.read_bvh(folder / "rollout.bvh").values.shape[0] == 30


@pytest.mark.slow
def test_released_weights_are_evaluated(call, released):
    call(
        f"evaluate --run {released}/released --rollouts 2 --seconds 4 "
        "--evaluator-steps 2 --chunk 2"
    )
    folder = released / "released" / "evaluation"
    assert json.loads((folder / "metrics.json").read_text())["rows"]["rollouts"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "option, message",
    [
        ("--skeleton {data}", "clips.npz"),
        ("--weights {data}", "clips.npz: no PyTorch's file"),
        ("--weights {folder}/gone.pt", "no weights file .*gone.pt"),
        ("--labels {folder}/gone.json", "gone.json"),
        ("--labels {folder}/skeleton.bvh", "skeleton.bvh: not JSON"),
    ],
)
def test_bad_weights_leave_nothing_behind(call, data, released, option, message):
    out = released / "bad"
    with pytest.raises((ValueError, OSError), match=message) as caught:
        call(
            f"import --weights {released}/best.pt --skeleton {released}/skeleton.bvh "
            f"--labels {released}/styles.json --out {out} "
            + option.format(data=data, folder=released)
        )
    assert "\n" not in str(caught.value) and not out.exists()


BAD = [
    ("train --data {gone} --out {out}", OSError, "gone"),
    ("train --data {data} --out {out} --label mood", ValueError, "field 'mood'"),
    ("train --data {data} --out {file}/below", OSError, "plain/below"),
    (
        "train --data {data} --out {run} {sizes} --steps 2 --depth 2",
        ValueError,
        "run/config.json: made otherwise: sizes.depth is 1, given 2; use another",
    ),
    (
        "train --data {data} --out {run} {sizes} --steps 2 --seed 7 --learning-rate .1",
        ValueError,
        "learning_rate is 0.001, given 0.1; seed is 0, given 7",
    ),
    (
        "train --data {data} --out {run} {sizes} --steps 1 --override",
        ValueError,
        "has 2 steps, expected at most the 1 to train",
    ),
    (
        "train --data {other} --out {run} {sizes} --steps 2",
        ValueError,
        "run/config.json: field 'data' is .*other.npz .*: other data",
    ),
    (
        "train --data {data} --out {out} {sizes} --steps 2 --init {run} --depth 2",
        ValueError,
        "run: expected a model .*config.depth is 1, given 2",
    ),
    ("train --data {data} --out {out} --devices 64", ValueError, "devices is 64, "),
    (
        "distill --run {run} --out {out}",
        ValueError,
        r"steps are \(8,\), expected increasing ones in 1..2, the last 2",
    ),
    ("distill --run {gone} --out {out}", OSError, "gone"),
    ("distill --run {run} --out {file}/below --visit 2", OSError, "plain/below"),
    ("distill --run {run} --out {run} --visit 2", ValueError, "other data; use anoth"),
    ("export --run {run} --out {empty}", OSError, "empty is a folder"),
    ("rollout --run {empty} --style neutral", OSError, "empty"),
    ("rollout --run {run} --style sad", ValueError, "the model has neutral, zombie"),
    ("rollout --run {run} --style zombie --to-style sad", ValueError, "label 'sad'"),
    ("rollout --run {run} --style zombie --data {gone}", OSError, "gone"),
    ("rollout --run {run} --style zombie --out {file}/below", OSError, "plain/below"),
    ("evaluate --run {empty}", OSError, "empty"),
    ("evaluate --run {run} --seconds 2", ValueError, "too short to measure"),
]


@pytest.mark.slow
@pytest.mark.parametrize("line, error, message", BAD)
def test_what_is_wrong_is_named_before_any_work(
    call, data, other, trained, tmp_path, line, error, message
):
    (tmp_path / "plain").write_text("")
    (tmp_path / "empty").mkdir()
    places = dict(
        gone=tmp_path / "gone.npz",
        out=tmp_path / "out",
        file=tmp_path / "plain",
        empty=tmp_path / "empty",
        run=trained,
        data=data,
        other=other,
        sizes=SIZES,
    )
    before = contents(trained), contents(tmp_path)
    with pytest.raises(error, match=message.format()):
        call(line.format(**places))
    assert (contents(trained), contents(tmp_path)) == before


def test_from_a_shell_an_error_is_one_line(tmp_path):
    line = f"train --data {tmp_path}/gone.npz --out {tmp_path}/out"
    command = [sys.executable, str(SCRIPT), *line.split()]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.strip().splitlines()[-1].startswith("error: ")
    assert "gone.npz" in done.stderr and "Traceback" not in done.stderr
