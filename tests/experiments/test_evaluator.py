"""experiments/evaluator.py: frozen evaluators, and their use by the three systems."""

import dataclasses
import functools
import json
import re

import jax
import numpy as np
import pytest

from jaxmotion.data import clips_io, windows
from jaxmotion.data.ball_clips import save_ball_clips
from jaxmotion.evaluation.columns import COLUMNS
from jaxmotion.evaluators import frozen as evaluators
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.learning.fingerprint import fingerprint
from jaxmotion.systems.camdm import evaluation as camdm_evaluation
from tests import ball_walker, samples, tiny

FIELDS = ("fingerprint", "kind", "labels", "joints", "fps", "frames", "accuracy")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Files of clips: of two styles, and of a ball at hand or far away."""
    folder = tmp_path_factory.mktemp("data")
    clips_io.save_clips(folder / "clips.npz", tiny.clips(130))
    save_ball_clips(folder / "ball.npz", ball_walker.clips(60))
    return folder


# What `train` needs for the tiny clips of each kind.
TRAIN = {
    "style": "--data {data}/clips.npz --held-out 0.5",
    "action": "--data {data}/clips.npz --held-out 0.5 --label style --merge --least 1 "
    "--frames 8 --fps 30",
    "ball": "--data {data}/ball.npz --held-out 0.3 --frames 12",
}


@pytest.fixture
def frozen(invoke, data, tmp_path):
    """Trains an evaluator of a kind by two updates; returns its file."""

    def train(kind):
        path = tmp_path / "new" / f"{kind}.npz"
        options = TRAIN[kind].format(data=data)
        invoke("evaluator", f"train --kind {kind} {options} --updates 2 --out {path}")
        return path

    return train


def shown(text):
    """Fields that `show` printed."""
    return dict(re.findall(r"^([\w ]+): (.*)$", text, re.MULTILINE))


@pytest.mark.slow
@pytest.mark.parametrize("kind", TRAIN)
def test_training_writes_a_file_and_prints_its_fingerprint(
    invoke, frozen, capsys, kind
):
    path = frozen(kind)
    trained = shown(capsys.readouterr().out)
    assert set(FIELDS) <= set(trained)
    assert trained["fingerprint"] == fingerprint(evaluators.load(path).params)
    assert re.fullmatch(r"[\d.]+ % of held-out .*", trained["accuracy"])
    labels = {"ball": "dribble, off_ball"}.get(kind, "calm, brisk")
    assert trained["labels"] == labels and trained["joints"].startswith("Hips, ")
    assert (trained["kind"], trained["updates"]) == (kind, "2")
    invoke("evaluator", f"show {path}")
    assert shown(capsys.readouterr().out) == trained


@pytest.mark.slow
@pytest.mark.parametrize("kind", TRAIN)
def test_faults_are_measured_beside_recordings(invoke, frozen, data, tmp_path, kind):
    path, out = frozen(kind), tmp_path / "doubt"
    clips = data / ("ball.npz" if kind == "ball" else "clips.npz")
    options = f"--data {clips} --out {out} --windows 8 --replications 2"
    invoke("evaluator", f"doubt {path} {options}")
    rows = json.loads((out / "metrics.json").read_text())["rows"]
    assert ("ball of another window" in rows) == (kind == "ball")
    fid = {name: row["fid"]["value"] for name, row in rows.items()}
    assert rows["as recorded"]["fid_added"]["value"] == 0.0
    for name, row in rows.items():
        added = fid[name] - fid["as recorded"]
        assert row["fid_added"]["value"] == pytest.approx(added, abs=1e-4)
    assert fid["limbs stand still"] != fid["as recorded"]
    # Actions are recognized by the path, too; styles and skills are not.
    seen = fid["paths 1.3 times as long: feet slide"] - fid["as recorded"]
    assert (abs(seen) > 1e-3) == (kind == "action")


BAD = {
    "train --data {gone} --out {new}": "gone.npz",
    "train --data {clips} --out {new} --label mood": "field 'mood'",
    "train --data {clips} {clips} --out {new}": "data has 2 files, expected one",
    "train --data {clips} --out {new} --frames 30": "--frames is not for kind 'style'",
    "train --data {clips} --out {clips}": "clips.npz exists; --overwrite",
    "train --data {clips} --out {clips}/below/e.npz": "below",
    "train --kind action --data {clips} --out {new}": "content",
    "train --kind action --data {clips} --out {new} --label style --merge calm": (
        "expected old=new"
    ),
    "train --kind action --data {clips} --out {new} --contents walk": "--contents",
    "train --kind ball --data {clips} --out {new}": "ball",
    "train --kind ball --data {ball} --out {new} --label style": "expected 'skill'",
    "show {gone}": "gone.npz",
    "show {clips}": "clips.npz: field .config. is missing",
}


@pytest.mark.parametrize("line", BAD)
def test_bad_input_is_one_clear_error(invoke, data, tmp_path, line):
    places = dict(
        clips=data / "clips.npz",
        ball=data / "ball.npz",
        gone=tmp_path / "gone.npz",
        new=tmp_path / "new.npz",
    )
    with pytest.raises((OSError, ValueError), match=BAD[line]):
        invoke("evaluator", line.format(**places))
    assert not (tmp_path / "new.npz").exists()


# --- use ---------------------------------------------------------------------------


def stored_evaluator(path, kind, clips, field, frames):
    """An evaluator that was not trained, for a run of these clips."""
    made = samples.evaluator(
        kind,
        field=field,
        labels=clips.names(field),
        joints=clips.skeleton.names,
        fps=clips.fps,
        frames=frames,
        updates=0,
    )
    evaluators.save(path, made)
    return made


def check_same(folders, made, path):
    """Both evaluations used it, say so, and have the same numbers but for times."""
    reports = [json.loads((x / "metrics.json").read_text()) for x in folders]
    name = fingerprint(made.params)
    for folder, report in zip(folders, reports, strict=True):
        assert report["evaluator"]["fingerprint"] == name
        assert report["evaluator"]["origin"] == path.name
        assert report["arguments"]["evaluator"] == str(path)
        notes = (folder / "table.md").read_text().splitlines()
        assert any(x.startswith(f"Evaluator {name} ({path.name})") for x in notes)
    first, second = (report["rows"] for report in reports)
    for row in first:
        for column, cell in first[row].items():
            if column not in COLUMNS or COLUMNS[column].kind != "time":
                assert second[row][column] == cell, (row, column)


@pytest.mark.slow
def test_camdm_is_scored_alike_twice(invoke, tmp_path):
    clips = tiny.clips(130)
    clips_io.save_clips(tmp_path / "clips.npz", clips)
    run, path = tmp_path / "run", tmp_path / "style.npz"
    invoke(
        "camdm",
        f"train --data {tmp_path}/clips.npz --out {run} --width 16 --depth 1 "
        "--batch 4 --diffusion-steps 2 --held-out 0.5 --warmup 1 --chunk 1 --steps 2",
    )
    made = stored_evaluator(path, "style", clips, "style", 60)
    line = f"evaluate --run {run} --rollouts 2 --seconds 4 --chunk 2"
    for name in ("a", "b"):
        invoke("camdm", f"{line} --evaluator {path} --out {tmp_path / name}")
    check_same([tmp_path / "a", tmp_path / "b"], made, path)
    invoke("camdm", f"{line} --evaluator-steps 2 --out {tmp_path / 'here'}")
    assert "(trained here)" in (tmp_path / "here" / "table.md").read_text()


@pytest.mark.slow
def test_smgdiff_is_scored_alike_twice(invoke, data, tmp_path):
    run, path = tmp_path / "run", tmp_path / "ball.npz"
    invoke(
        "smgdiff",
        f"train --data {data}/ball.npz --out {run} --width 16 --depth 1 --steps 10 "
        "--draft-steps 10 --batch 4 --held-out 0.3 --stages motion_2",
    )
    made = stored_evaluator(path, "ball", ball_walker.clips(60).clips, "skill", 45)
    line = f"evaluate --run {run} --tables steps --steps 2 --windows 8 --replications 2"
    for name in ("a", "b"):
        invoke("smgdiff", f"{line} --evaluator {path} --out {tmp_path / name}")
    check_same([tmp_path / name / "steps" for name in "ab"], made, path)
    wrong = tmp_path / "wrong.npz"
    stored_evaluator(wrong, "ball", ball_walker.clips(60).clips, "skill", 12)
    with pytest.raises(ValueError, match="wrong.npz.*field 'frames' is 12, expected"):
        invoke("smgdiff", f"{line} --evaluator {wrong}")


@pytest.mark.slow
def test_emdm_is_scored_alike_twice(invoke, data, tmp_path):
    run, path = tmp_path / "run", tmp_path / "action.npz"
    invoke(
        "emdm",
        f"train --data {data}/clips.npz --out {run} --field style --least 1 --fps 30 "
        "--frames 20 --held-out 0.5 --steps 10 --batch 8 --width 16 --hidden 16 "
        "--depth 1 --discriminator-width 64 --merge",
    )
    made = stored_evaluator(path, "action", tiny.clips(130), "style", 20)
    line = f"evaluate --run {run} --samples 20 --replications 2"
    for name in ("a", "b"):
        invoke("emdm", f"{line} --evaluator {path} --out {tmp_path / name}")
    check_same([tmp_path / "a", tmp_path / "b"], made, path)
    assert not (run / "evaluator").exists()
    report = json.loads((tmp_path / "a" / "metrics.json").read_text())
    assert "trained on tests, 0 updates" in report["evaluator"]["network"]
    assert np.isfinite(report["rows"]["emdm"]["fid"]["value"])


@pytest.mark.slow
def test_the_released_style_classifier_scores(invoke, capsys, tmp_path):
    """Four styles known, two of them the run's; against PyTorch on the same input."""
    torch = pytest.importorskip("torch")
    from tests.reference import published_torch as peers

    weights, out = tmp_path / "classifier.pth", tmp_path / "released.npz"
    peer = peers.randomize(peers.StyleClassifier(classes=4), 2)
    names = ["angry", "neutral", "old", "zombie"]
    torch.save({"state_dict": peer.state_dict(), "class_names": names}, weights)
    invoke("evaluator", f"import --weights {weights} --out {out}")
    fields = shown(capsys.readouterr().out)
    assert fields["kind"] == "style_release" and fields["accuracy"] == "not known"
    with pytest.raises(FileExistsError, match="--overwrite replaces it"):
        invoke("evaluator", f"import --weights {weights} --out {out}")

    run, evaluator = samples.run(), evaluators.load(out)
    get = functools.partial(camdm_evaluation.load_evaluator, jax.random.key(0))
    chosen = get(run, evaluator, num_steps=1)
    found = windows.eval_windows(run.train, stride=60, field="style")
    skeleton = run.model.skeleton
    features, hits = style_evaluator.features_and_hits(skeleton, found, chosen)
    x = np.array(style_evaluator.released_input(skeleton, found.motion))
    with torch.inference_mode():
        wanted, logits = peer(torch.from_numpy(x.swapaxes(1, 2)))
    assert wanted.std() > 0.1
    np.testing.assert_allclose(features, wanted.numpy(), atol=1e-5 * wanted.abs().max())
    classes = np.array([1, 3])[np.asarray(found.label)]
    np.testing.assert_array_equal(hits, logits.argmax(-1).numpy() == classes)

    other = dataclasses.replace(evaluator, labels=("a", "neutral", "b", "c"))
    with pytest.raises(ValueError, match="field 'labels' is .* expected"):
        get(run, other, num_steps=1)
    lame = dataclasses.replace(skeleton, names=("Hip", *skeleton.names[1:]))
    model = dataclasses.replace(run.model, skeleton=lame)
    with pytest.raises(ValueError, match="released classifier needs the joints hips"):
        get(dataclasses.replace(run, model=model), evaluator, num_steps=1)
