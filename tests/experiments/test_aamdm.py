"""experiments/aamdm.py: train, evaluate and roll out on clips that the tests make."""

import functools
import json
import re
import runpy
import shutil
import sys
import types
from pathlib import Path

import chex
import jax
import numpy as np
import pytest
from PIL import Image

from jaxmotion.data import bvh_text, clips_io, procedural, selection
from jaxmotion.learning import checkpoint
from jaxmotion.systems.aamdm import stored as aamdm_stored
from jaxmotion.systems.aamdm import training as aamdm_training
from tests.experiments.conftest import check_face_steers

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "experiments" / "aamdm.py"
SETTINGS = (
    "--field style --labels --rows aamdm lmm --autoencoder-steps 10 "
    "--polisher-steps 10 --generator-steps 10 --window-steps 10 --batch 8 "
    "--width 32 --balance 0.5"
)
STAGES = (
    "autoencoder",
    "embedded/T5/polisher",
    "embedded/T5/generator",
    "embedded/lmm",
)


@pytest.fixture(scope="module")
def call(invoke):
    """Runs a command line."""
    return functools.partial(invoke, "aamdm")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "clips.npz"
    clips_io.save_clips(path, procedural.make_clips(minutes=2.0))
    return path


@pytest.fixture(scope="module")
def trained(call, data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    call(f"train --data {data} --out {folder} {SETTINGS}")
    return folder


@pytest.fixture(scope="module")
def evaluated(call, trained, data):
    call(
        f"evaluate --run {trained} --data {data} --rollouts 4 --seconds 2 "
        "--long-minutes 0.1 --long-rollouts 2"
    )
    return trained / "evaluation"


def losses(folder):
    return {name: (folder / name / "losses.jsonl").read_text() for name in STAGES}


# --- training ----------------------------------------------------------------------


@pytest.mark.slow
def test_training_leaves_every_stage(trained, data):
    config = json.loads((trained / "config.json").read_text())
    assert config["system"] == "aamdm" and list(config["data"]) == [str(data)]
    assert config["settings"]["labels"] == [] and config["settings"]["fps"] == 60.0
    assert config["settings"]["balance"] == 0.5
    assert "procedural" in config["source"]
    # Sixteen clips and their mirror images.
    assert len(config["split"]["train"]) == 32
    for name in STAGES:
        checkpoints = trained / name / "checkpoints"
        assert checkpoint.latest_step(checkpoints) == 10
        value = checkpoint.load_config(checkpoints)
        assert (value["system"], value["stage"]) == ("aamdm", name)
    for text in losses(trained).values():
        rows = [json.loads(line) for line in text.splitlines()]
        assert [row["step"] for row in rows] == [10]
        for row in rows:
            own = [value for name, value in row.items() if "loss" in name]
            assert own and np.isfinite(own).all()


@pytest.mark.slow
def test_what_is_trained_is_not_trained_again(call, trained, data):
    before = losses(trained)
    call(f"train --data {data} --out {trained} {SETTINGS}")
    assert losses(trained) == before
    for name in STAGES:
        assert checkpoint.latest_step(trained / name / "checkpoints") == 10


@pytest.mark.slow
def test_levels_have_a_row_each(call, trained, tmp_path):
    call(f"levels --run {trained} --samples 50 --latents 4 --out {tmp_path}")
    rows = json.loads((tmp_path / "metrics.json").read_text())["rows"]
    assert len(rows) == 3 + 2 + 2
    for name, cells in rows.items():
        assert 0 < cells["frame_error"]["value"] < 100
        drafted = cells["frame_over_latents"]["value"] > 1e-5
        assert drafted == name.startswith("generator")
    with pytest.raises(ValueError, match="row is 'lmm': expected AAMDM's"):
        call(f"levels --run {trained} --row lmm --out {tmp_path}")


@pytest.mark.slow
def test_a_row_goes_on_from_another_folders(call, trained, data, tmp_path, monkeypatch):
    """Its space is the other's, and its networks begin where those ended."""
    out = tmp_path / "on"
    rows = SETTINGS.replace("aamdm lmm", "aamdm").replace("steps 10", "steps 1")
    rows += " --weight-foot 9 --constant-rate"
    call(f"train --data {data} --out {out} {rows} --init {trained}")
    assert not (out / "autoencoder").exists()

    def parts(folder):
        run = aamdm_training.load_run(folder)
        space = aamdm_training.load_space(run, "embedded")
        chain = dict(drafts=3, polishes=2)
        return space, *aamdm_training.load_networks(run, "embedded", space, **chain)

    (space, networks, config), (first, before, _) = parts(out), parts(trained)
    assert config.weight_foot == 9
    chex.assert_trees_all_equal(space, first)
    # One update.
    chex.assert_trees_all_close(networks, before, atol=0.02)
    with pytest.raises(AssertionError):
        chex.assert_trees_all_close(networks["polisher"], before["polisher"], atol=1e-7)
    call(f"train --data {data} --out {out} {rows} --init {trained}")
    for folder, constant in ((out, True), (trained, None)):
        checkpoints = folder / "embedded/T5/polisher/checkpoints"
        told = checkpoint.load_config(checkpoints)["training"]
        assert told.get("constant") is constant

    load, other = aamdm_training.load_space, jax.tree.map(lambda x: x + 1, first)
    monkeypatch.setattr(
        aamdm_training,
        "load_space",
        lambda run, name: other if run.record.folder == trained else load(run, name),
    )
    run = aamdm_training.load_run(out)
    with pytest.raises(ValueError, match="on: has another space than .*run; use"):
        aamdm_training.start_of(trained, run, width=32)


@pytest.mark.slow
def test_a_row_goes_on_from_an_exported_file(call, trained, data, tmp_path):
    """In a folder that is none's but its own."""
    file, out = tmp_path / "model.npz", tmp_path / "on"
    call(f"export --run {trained} --out {file}")
    rows = SETTINGS.replace("aamdm lmm", "aamdm").replace("steps 10", "steps 1")
    call(f"train --data {data} --out {out} {rows} --init {file}")
    run = aamdm_training.load_run(out)
    space = aamdm_training.load_space(run, "embedded")
    first = aamdm_training.load_space(aamdm_training.load_run(trained), "embedded")
    # As the file has it: in half precision.
    chex.assert_trees_all_close(space, first, rtol=1e-3, atol=1e-6)
    found, _ = aamdm_training.load_networks(
        run, "embedded", space, drafts=3, polishes=2
    )
    _, stored = aamdm_stored.load(file)
    chex.assert_trees_all_close(found, stored, atol=0.02)

    call(f"export --run {trained} --out {tmp_path / 'old.npz'} --no-encoder")
    with pytest.raises(ValueError, match="old.npz: has no encoder: expected a file"):
        aamdm_training.start_of(tmp_path / "old.npz", run, width=32)


# --- evaluation --------------------------------------------------------------------


def test_an_evaluation_of_all_rows_looks_for_those_of_the_papers_tables(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPT.parent)
    known = runpy.run_path(str(SCRIPT))["rows"]
    text = (ROOT / "experiments" / "papers" / "aamdm.toml").read_text()
    lists = re.findall(r"--rows ([a-z0-9_ ]+)", text)
    asked = {name for names in lists for name in names.split()}
    assert "polish2_draft4_frame" in asked
    # Those without drafts have no training of their own, and are asked for by name.
    asked -= {"polish5_draft0", "polish5_draft0_frame", "polish2_held3_frame"}
    assert asked <= {*known.ALL, *known.MORE}


FREE = {"diverged", "div", "fid", "ffr_mann", "ffr_gmd", "speed"}
STEERED = {"diverged_uc", "te_promised", "te_realized", "trajectory_error"}


@pytest.mark.slow
def test_an_evaluation_has_the_data_and_the_trained_rows(evaluated):
    found = json.loads((evaluated / "metrics.json").read_text())
    rows = found["rows"]
    real = [f"data ({x})" for x in ("trained on", "trained on, as short", "held out")]
    assert set(rows) == {*real, "aamdm", "lmm"}
    for name in real:
        assert FREE < set(rows[name])
        assert rows[name]["diverged"]["value"] == 0
        assert rows[name]["diverged"]["samples"] == 4
    for name in ("aamdm", "lmm"):
        assert STEERED | {"fps", "diverged_unbounded"} < set(rows[name])
        assert rows[name]["fps"]["value"] > 0
        assert rows[name]["diverged"]["samples"] == 4
        # Without finite positions there is nothing else; some may be far off.
        free = FREE & set(rows[name])
        assert free in (FREE, {"diverged"})
        assert free == FREE or rows[name]["diverged"]["value"] > 0
    assert 0.0 < rows["data (trained on)"]["speed"]["value"] < 2.0
    assert "procedural" in found["source"]


@pytest.mark.slow
def test_long_rollouts_are_counted(evaluated):
    found = json.loads((evaluated / "metrics.json").read_text())["long"]
    assert found["ticks"] == 360
    for kind in ("free", "steered"):
        assert found[kind]["rollouts"] == 2
        for failure in ("diverged", "frozen"):
            assert 0 <= found[kind][failure] <= 2


@pytest.mark.slow
def test_the_table_has_a_line_for_each_row(evaluated):
    found = json.loads((evaluated / "metrics.json").read_text())["rows"]
    *lines, _, note = (evaluated / "table.md").read_text().splitlines()
    assert "no evaluator" in note
    assert [line.split("|")[1].strip() for line in lines[2:]] == list(found)
    assert len({line.count("|") for line in lines}) == 1


@pytest.mark.slow
def test_other_takes_are_chosen_and_split_as_those_of_training(trained, data, tmp_path):
    run = aamdm_training.load_run(trained)
    same = aamdm_training.with_takes(run, data)
    for mine, own in ((same.train, run.train), (same.held_out, run.held_out)):
        np.testing.assert_array_equal(mine.poses, own.poses)
        np.testing.assert_array_equal(mine.offsets, own.offsets)
    assert same.record is run.record
    path = tmp_path / "others.npz"
    clips = clips_io.load_clips(data)
    clips_io.save_clips(
        path, selection.select(clips, "style", clips.names("style")[:1])
    )
    other = aamdm_training.with_takes(run, path)
    assert 0 < other.train.num_frames < run.train.num_frames


# --- rollouts ----------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "title"),
    [("", "aamdm</h1>"), ("--row lmm --no-steered", "lmm, not steered</h1>")],
)
def test_a_rollout_is_written_as_bvh_gif_and_page(
    call, trained, tmp_path, options, title
):
    out = tmp_path / "seen"
    call(f"rollout --run {trained} --seconds 1 --out {out} {options}")
    motion = bvh_text.read_bvh(out / "rollout.bvh")
    assert motion.values.shape[0] == 60 and np.isfinite(motion.values).all()
    with Image.open(out / "rollout.gif") as image:
        assert image.n_frames > 1
    text = (out / "rollout.html").read_text()
    shown = json.loads(re.search(r"^const data = (.*);$", text, re.M).group(1))
    assert shown["shape"] == [1, 60]
    assert [name for name, *_ in shown["paths"]] == ["commanded", "walked"]
    assert title in text and "procedural" in text


# --- errors ------------------------------------------------------------------------

BAD = [
    ("train --data {data} --out {out} --rows amdm6", "unknown row 'amdm6'.*lmm"),
    ("train --data {data} --out {out} --rows polish0_held3", "'polish0_held3': there"),
    ("train --data {data} --out {out} --rows", "--rows is empty, expected names"),
    (
        "train --data {gone} --out {out} {settings}",
        "no clips file .*gone.npz.*makes it",
    ),
    ("train --data {data} --out {file}/below {settings}", "plain/below"),
    ("train --data {data} --out {out} --field mood", "field 'mood'"),
    (
        "train --data {data} --out {out} {settings} --init {run}",
        r"init is .*run, but rows are \('aamdm', 'lmm'\): expected 'aamdm'",
    ),
    (
        "train --data {data} --out {out} {settings} --rows aamdm --width 16 "
        "--init {run}",
        "run: expected a model like the one to train: width is 32, given 16",
    ),
    ("train --data {data} --out {out} {settings} --fps 24", "resampled to 24"),
    (
        "train --data {data} --out {run} {settings} --fps 120",
        "{run}/config.json: made otherwise: fps is 60.0, given 120.0",
    ),
    (
        "train --data {data} --out {run} {settings} --width 48",
        "T5/polisher: of another model: width is 32, given 48",
    ),
    (
        "train --data {other} --out {run} {settings}",
        "{run}/config.json: .* other data",
    ),
    ("evaluate --run {gone}", "{gone}"),
    ("evaluate --run {begun}", "{begun}: no row was trained to its end"),
    ("evaluate --run {run} --rows amdm6", "unknown row 'amdm6'"),
    ("evaluate --run {run} --rows mvae", "mvae"),
    ("evaluate --run {run} --out {file}/below", "plain/below"),
    ("evaluate --run {run} --seconds 60 --rows lmm", "3600 frames of a window"),
    ("rollout --run {run} --row amdm6", "unknown row 'amdm6'"),
    ("rollout --run {run} --row mvae", "full_pose.*no checkpoint"),
    ("rollout --run {run} --row polish1_draft3", "T4.*no checkpoint"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("line", "message"), BAD)
def test_what_is_wrong_is_said_in_one_line(
    call, trained, data, tmp_path, monkeypatch, line, message
):
    """`sys.exit` of a string prints it and exits with 1."""
    (tmp_path / "plain").write_text("")
    (tmp_path / "empty").mkdir()
    begun = tmp_path / "begun"
    shutil.copytree(trained, begun, ignore=shutil.ignore_patterns("T5", "lmm"))
    places = dict(
        begun=begun,
        gone=tmp_path / "gone.npz",
        other=__file__,
        out=tmp_path / "out",
        file=tmp_path / "plain",
        empty=tmp_path / "empty",
        run=trained,
        data=data,
        settings=SETTINGS,
    )
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *line.format(**places).split()])
    before = losses(trained)
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(str(SCRIPT), run_name="__main__")
    assert isinstance(stop.value.code, str)
    assert stop.value.code.startswith("error: ") and "\n" not in stop.value.code
    assert re.search(message.format(**places), stop.value.code)
    assert losses(trained) == before


@pytest.mark.slow
def test_a_run_is_steered_by_the_face(trained):
    check_face_steers(trained)


@pytest.mark.parametrize(
    ("row", "features", "width"),
    [("amdm5", 350, 512), ("amdm200", 512, 512), ("amdm5_embedded", 64, 256)],
)
def test_amdm_is_no_narrower_than_a_frame(load, row, features, width):
    """It tells the noise of all channels, which a narrower layer does not pass on."""
    rows = load("baselines.rows")
    space = types.SimpleNamespace(num_features=features)
    assert rows._config(row, space, rows.Sizes()).width == width
    assert rows._config("aamdm", space, rows.Sizes()).width == 256
