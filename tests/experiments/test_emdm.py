"""experiments/emdm.py: train, evaluate and sample, from actions, texts and nothing."""

import dataclasses
import functools
import json
import string

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxmotion.data import bvh_text, clips_io, procedural
from jaxmotion.learning import runs
from jaxmotion.systems.emdm import data as emdm_data
from jaxmotion.systems.emdm import levels
from jaxmotion.systems.emdm import published as emdm_published
from jaxmotion.systems.emdm import sampler as emdm_sampler
from jaxmotion.systems.emdm import training as emdm_training

SIZES = (
    "--steps 10 --ddpm-steps 10 --batch 8 --width 16 --hidden 16 --depth 1 "
    "--discriminator-width 64 --merge"
)


@pytest.fixture(scope="module")
def call(invoke):
    """Runs a command line; sentences come after it."""
    return functools.partial(invoke, "emdm")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """The walker with labels of the captions' grammar."""
    path = tmp_path_factory.mktemp("data") / "clips.npz"
    clips = procedural.make_clips(minutes=2.0)
    numbers = np.arange(clips.num_clips)
    labels = {
        "content": jnp.asarray(numbers % 2, jnp.int32),
        "style": jnp.asarray(numbers // 2 % 3, jnp.int32),
    }
    names = (("content", ("run", "walk")), ("style", ("elderly", "normal", "youthful")))
    clips = dataclasses.replace(clips, labels=labels, label_names=names)
    clips_io.save_clips(path, clips)
    return path


@pytest.fixture(scope="module")
def actions(call, data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "actions"
    call(
        f"train --task action --data {data} --out {folder} --least 2 --held-out 0.3 "
        f"--frames 20 --rows emdm ddpm_50 {SIZES}"
    )
    return folder


@pytest.fixture(scope="module")
def texts(call, data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "texts"
    call(
        f"train --task text --data {data} --out {folder} --encoder hashed "
        f"--held-out 0.3 --unseen walk/elderly --frames 40 --rows emdm {SIZES}"
    )
    return folder


def rows_of(folder):
    return json.loads((folder / "metrics.json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("row", ["emdm", "ddpm_50"])
def test_levels_have_a_row_each(call, actions, tmp_path, row):
    call(f"levels --run {actions} --row {row} --samples 16 --out {tmp_path}")
    rows = rows_of(tmp_path)["rows"]
    assert len(rows) == 10
    for cells in rows.values():
        assert 0 < cells["prediction_error"]["value"] < 10
        assert cells["spread"]["value"] > 0
        assert (cells["over_latents"]["value"] > 0) == (row == "emdm")


@pytest.mark.slow
def test_levels_of_a_network_that_says_nothing_are_those_of_the_mean(actions):
    run = emdm_data.load_run(actions)
    model, params = emdm_sampler.load(actions, row="emdm")
    params = dict(params) | {"out": jax.tree.map(jnp.zeros_like, params["out"])}
    rows = levels.level_table(params, run, model, number=64, seed=3)
    motions = emdm_data.make_task(run, model.config, conditional=True)
    x_0 = motions.batch(jax.random.split(jax.random.key(3))[0], motions.data, 64).x_0
    for cells in rows.values():
        wanted = np.sqrt(np.mean(np.square(np.asarray(x_0, np.float64))))
        np.testing.assert_allclose(cells["prediction_error"].value, wanted, rtol=1e-5)
        assert cells["over_latents"].value == 0
        np.testing.assert_allclose(cells["spread"].value, 0, atol=1e-5)
    other = dataclasses.replace(model, labels=("jump", *model.labels[1:]))
    with pytest.raises(ValueError, match="actions are"):
        levels.level_table(params, run, other, number=8, seed=0)


@pytest.mark.slow
def test_actions_are_scored_beside_real_motions(call, actions):
    call(f"evaluate --run {actions} --samples 40 --replications 2 --evaluator-steps 20")
    report = rows_of(actions / "evaluation")
    rows = report["rows"]
    assert set(rows) == {
        "real (training clips)",
        "real (held-out clips)",
        "emdm",
        "ddpm_50",
    }
    for name, row in rows.items():
        expected = {"fid", "accuracy", "diversity", "multimodality", "deviation"}
        assert expected <= set(row), name
        assert 0 < row["deviation"]["value"] < 100, name  # cm
        assert 0 <= row["accuracy"]["value"] <= 1 and row["fid"]["value"] >= 0
        assert 0 < row["nearest"]["value"] < 200, name  # cm
        # Of training clips' own windows none is the nearest of another clip.
        assert ("copied" in row) == (name != "real (training clips)")
        assert row["fid"]["samples"] == 2 and row["fid"]["low"] is not None
    assert rows["emdm"]["network_calls"]["value"] == 10
    assert rows["ddpm_50"]["network_calls"]["value"] == 50
    assert rows["emdm"]["frame_time"]["value"] > 0
    assert report["evaluator"]["network"].startswith("GRU") and report["jax"]
    assert "procedural" in report["evaluator"]["network"].lower()


@pytest.mark.slow
def test_samples_of_actions_are_motions(call, actions, tmp_path):
    call(f"sample --run {actions} --action run walk run --frames 12 --out {tmp_path}")
    runs = [(tmp_path / f"{name}.bvh").read_text() for name in ("run", "run_2")]
    assert runs[0] != runs[1]
    for name in ("run", "walk", "run_2"):
        motion = bvh_text.read_bvh(tmp_path / f"{name}.bvh")
        assert motion.values.shape[0] == 12
        assert (tmp_path / f"{name}.html").stat().st_size > 1000
        with Image.open(tmp_path / f"{name}.gif") as image:
            assert image.n_frames > 1


@pytest.mark.slow
def test_motions_from_nothing(call, data, tmp_path):
    folder = tmp_path / "none"
    call(
        f"train --task none --data {data} --out {folder} --least 2 --held-out 0.3 "
        f"--frames 20 {SIZES}"
    )
    call(f"evaluate --run {folder} --samples 20 --replications 2 --evaluator-steps 20")
    row = rows_of(folder / "evaluation")["rows"]["emdm"]
    assert "accuracy" not in row and row["fid"]["value"] >= 0
    call(f"sample --run {folder} --out {tmp_path / 'out'}")
    assert (tmp_path / "out" / "motion.bvh").exists()


@pytest.mark.slow
def test_texts_are_scored_and_sampled(call, texts, tmp_path):
    call(f"evaluate --run {texts} --samples 64 --replications 2 --evaluator-steps 20")
    rows = rows_of(texts / "evaluation")["rows"]
    assert {"real (training clips)", "real (held-out clips)", "real (unseen pairs)"} < (
        set(rows)
    )
    row = rows["emdm"]
    for column in ("r_precision_1", "r_precision_3", "r_precision_3_unseen"):
        assert 0 <= row[column]["value"] <= 1
    assert row["r_precision_1"]["value"] <= row["r_precision_3"]["value"]
    assert {"fid", "mm_dist", "diversity", "multimodality"} <= set(row)
    report = rows_of(texts / "evaluation")
    assert "hashed" in report["evaluator"]["texts"]
    assert "unit" in report["evaluator"]["texts"]
    note = "Beyond the end of generated motions the evaluator sees "
    assert f"{note}zeros." in (texts / "evaluation" / "table.md").read_text()
    call(
        f"evaluate --run {texts} --samples 64 --replications 2 --evaluator-steps 20 "
        f"--padding kept --out {tmp_path / 'kept'}"
    )
    kept = rows_of(tmp_path / "kept")["rows"]
    assert kept["real (held-out clips)"] == rows["real (held-out clips)"]
    for column in ("fid", "mm_dist", "multimodality"):
        assert kept["emdm"][column]["value"] != row[column]["value"]
    table = (tmp_path / "kept" / "table.md").read_text()
    assert f"{note}the model's output, as in the released evaluation." in table
    call(
        f"sample --run {texts} --frames 24 --out {tmp_path / 'samples'}",
        "--text",
        "an elderly person walks",
    )
    names = {path.name for path in (tmp_path / "samples").iterdir()}
    stem = "an_elderly_person_walks"
    assert {f"{stem}.bvh", f"{stem}.gif", f"{stem}.html"} == names


@pytest.mark.slow
def test_what_was_held_out_is_not_trained_on(texts):
    with np.load(texts / "data" / "motions.npz") as file:
        split, names = file["split"], file["split_names"].tolist()
        owner, captions = file["caption_clip"], file["captions"]
    trained = captions[split[owner] == names.index("train")]
    unseen = captions[split[owner] == names.index("val")]
    assert unseen.size and not set(trained) & set(unseen)


BAD = {
    "sample --run {actions} --action jump": "unknown action 'jump'",
    "sample --run {actions} --action run --frames 21": "21 frames, the model makes",
    "sample --run {actions} --text walk": "not from 'text'",
    "sample --run {actions}": "expected --action",
    "sample --run {texts} --text TEXT:": "empty",
    "sample --run {texts} --text TEXT:" + "very_" * 80: "expected at most 75",
    "sample --run {texts} --text walk --row naive": "checkpoint",
    "sample --run {texts} --text walk --row other": "unknown row 'other'",
    "sample --run {data} --action run": "cannot write here",
    "sample --run {new} --action run": "no such file: expected a run folder",
    "train --task action --data {data} --out {actions} --least 2 --fps 9": "fps is",
    "train --task action --data {data} --out {actions} --least 2 --fps 10 --merge": (
        "made otherwise"
    ),
    "train --data {data} --out {new} --merge walk": "expected old=new",
    "train --data {data} --out {new} --merge hop=walk": "merge: unknown content",
    "train --data {data} --out {new} --merge --least 999": "has 999 clips",
    "train --task text --data {data} --out {new} --encoder nowhere": "'nowhere'",
    "train --task text --data {data} --out {new} --unseen walk/x": "'walk/x'",
    "train --out {new} --rows ddim_10": "samples 'ddpm_1000'",
    "train --task text --data {data} --out {new} --encoder hashed --text-form "
    "released": "text form is 'released'.*encoder is 'hashed'",
    "evaluate --run {texts} --matcher finest.tar": (
        "matcher is finest.tar and glove is None.*our_vab_data.npy, our_vab_words.pkl"
    ),
    "evaluate --run {texts} --foot-lock": "foot_lock is on, but .*expected off",
    "evaluate --run {texts} --glove glove": "matcher is None and glove is glove",
    "evaluate --run {texts} --matcher {new}/finest.tar --glove glove": (
        "expected mean.npy and std.npy of the evaluator's meta folder"
    ),
    "evaluate --run {actions} --matcher finest.tar --glove glove": (
        "matcher is finest.tar.*does not make motions from texts"
    ),
    "evaluate --run {actions} --padding kept": "padding is 'kept'",
    "evaluate --run {actions} --samples 3": "samples is 3",
    "evaluate --run {texts} --samples 3": "samples is 3",
}


@pytest.mark.slow
@pytest.mark.parametrize("line", BAD)
def test_bad_input_is_one_clear_error(call, line, actions, texts, data, tmp_path):
    places = dict(actions=actions, texts=texts, data=data, new=tmp_path / "new")
    words = line.format(**places).split()
    words = [
        word.removeprefix("TEXT:").replace("_", " ")
        if word.startswith("TEXT:")
        else word
        for word in words
    ]
    with pytest.raises(
        (OSError, ValueError), match="(?i)" + BAD[line].replace("--", "-.")
    ):
        call("", *words)
    assert list(tmp_path.iterdir()) == []  # not even the folder of a typing error


@pytest.fixture(scope="module")
def released(call, data, tmp_path_factory):
    """The authors' checkpoint beside a run folder of texts with data alone."""
    torch = pytest.importorskip("torch")
    from tests.reference import published_torch as peers
    from tests.text import samples

    folder = tmp_path_factory.mktemp("released")
    (folder / "clip").mkdir()
    with pytest.MonkeyPatch.context() as patch:  # a tokenizer of all letters
        patch.setattr(samples, "_byte_pairs", samples._byte_pairs.__wrapped__)
        letters = " ".join(f"{x} {x}{x}" for x in string.ascii_lowercase)
        patch.setattr(samples, "SENTENCES", (*samples.SENTENCES, letters))
        samples.folder(folder / "clip")
    call(
        f"train --task text --data {data} --out {folder}/run --held-out 0.3 "
        f"--encoder {folder}/clip --unseen walk/elderly --frames 40 --rows none"
    )
    size = samples.SIZES["dimensions"]
    peer = peers.randomize(peers.EmdmGenerator("text", size, 263), 0)
    torch.save({"netG_dict": peer.state_dict(), "epoch": 3}, folder / "t2m.pth")
    return folder


@pytest.mark.slow
def test_released_weights_become_a_row(call, released, tmp_path):
    line = f"import --weights {released}/t2m.pth --run {released}/run"
    with pytest.raises(ValueError, match="32 heads do not divide width 16"):
        call(line)
    assert not (released / "run" / "emdm").exists()
    call(f"{line} --heads 4")
    params, config = emdm_training.load_row(runs.load(released / "run"), "emdm")
    assert (config.frames, config.num_steps, config.latent) == (40, 10, 5)
    wanted = emdm_published.load(released / "t2m.pth", frames=40, heads=4)
    assert config == wanted[0]
    jax.tree.map(np.testing.assert_array_equal, params, wanted[1]["generator"])
    run = f"sample --run {released}/run --out {tmp_path}"
    call(f"{run} --text", "a person turns left")
    motion = bvh_text.read_bvh(tmp_path / "a_person_turns_left.bvh")
    assert motion.values.shape[0] == 40
    with pytest.raises(ValueError, match="'emdm' exists; use another folder"):
        call(f"{line} --heads 4")


@pytest.mark.slow
def test_weights_of_another_task_are_refused(call, released, texts, actions):
    weights = f"import --weights {released}/t2m.pth --heads 4 --run"
    with pytest.raises(ValueError, match="'text_form' is 'unit', expected 'released'"):
        call(f"{weights} {texts}")
    with pytest.raises(
        ValueError, match="'settings.task' is 'action', expected 'text'"
    ):
        call(f"{weights} {actions}")
