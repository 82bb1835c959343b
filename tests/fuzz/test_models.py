"""Exported models, evaluators and run folders: other bytes, fields and JSON."""

import json
import shutil

import jax
import numpy as np
import optax
import pytest

from jaxmotion.data import clips_io
from jaxmotion.data.ball_clips import save_ball_clips
from jaxmotion.evaluators import frozen
from jaxmotion.learning import checkpoint, runs, training
from jaxmotion.systems.aamdm import training as aamdm_training
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.emdm import data as emdm_data
from jaxmotion.systems.emdm import training as emdm_training
from jaxmotion.systems.smgdiff import data as smgdiff_data
from jaxmotion.systems.smgdiff import model as smgdiff_model
from jaxmotion.systems.smgdiff import training as smgdiff_training
from tests import ball_walker, person, samples, tiny
from tests.fuzz import harness, mutations
from tests.fuzz.test_npz import fields_of
from tests.systems.smgdiff.test_training import PATHS, SIZES

# Orbax abandons its other reads when one fails.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
INPUTS = {
    "exports": 400,
    "models": 800,
    "evaluators": 200,
    "smgdiff": 250,
    "aamdm": 200,
    "emdm": 200,
    "checkpoints": 60,
}


def rounded(value):
    """JSON with numbers as float32 holds them, which is how skeletons are kept."""
    if isinstance(value, dict):
        return {name: rounded(x) for name, x in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(x) for x in value]
    return float(np.float32(value)) if isinstance(value, float) else value


def differences(found, given, path=""):
    """Places where a value says something else than its file does.

    The file may have more fields than the value, and the value more by default.
    """
    if isinstance(given, dict) and isinstance(found, dict):
        for name in given.keys() & found.keys():
            yield from differences(found[name], given[name], f"{path}.{name}")
    elif found != given:
        yield f"{path} is {found!r:.80} of {given!r:.80}"


def says(found, given):
    wrong = list(differences(rounded(json.loads(json.dumps(found))), rounded(given)))
    assert not wrong, wrong


def flat(params, path=()):
    for name, x in params.items():
        if isinstance(x, dict):
            yield from flat(x, (*path, name))
        else:
            yield "/".join((*path, name)), np.asarray(x)


def same_params(params, fields):
    found = dict(flat(params))
    assert found.keys() == fields.keys() - {"config", "checksum"}
    for name, array in found.items():
        np.testing.assert_array_equal(array, fields[name].astype(np.float32))
        assert np.isfinite(array).all()


@pytest.fixture
def camdm_value(config, skeleton):
    model = camdm_model.Model(
        config=config, skeleton=skeleton, labels=tiny.STYLES, source="tests"
    )
    return camdm_model.to_json(model)


def unsigned(data, random):
    """An export without its checksum, of which the JSON or an array is another."""
    fields = fields_of(data)
    fields.pop("checksum", None)
    if random.random() < 0.7:
        config = mutations.mutate_json(random, json.loads(str(fields["config"])))
        fields["config"] = np.array(json.dumps(config))
        return mutations.npz(fields)
    return mutations.mutate_npz(random, mutations.npz(fields))


def confirm_export(data, found):
    model, params = found
    fields = fields_of(data)
    says(camdm_model.to_json(model), json.loads(str(fields["config"])))
    same_params(params, fields)


def test_exported_models(tmp_path, capsys, camdm_value, config, params):
    path = tmp_path / "x.npz"
    checkpoint.export_params(path, params, camdm_value)
    data = path.read_bytes()
    target = harness.Target(
        "exported models",
        lambda _: camdm_model.load(path),
        confirm_export,
        names=("x.npz",),
    )
    for seed in range(INPUTS["exports"]):
        random = np.random.default_rng(seed)
        content = data
        if seed > 0:
            change = unsigned if seed % 3 else lambda x, r: mutations.mutate_npz(r, x)
            content = change(data, random)
        path.write_bytes(content)
        target.feed(f"seed {seed}", content)
    target.report(capsys.disabled, accepted=20, refused=100)


@pytest.mark.parametrize("system", ["camdm", "smgdiff"])
def test_models_as_json(capsys, camdm_value, system):
    module, value = camdm_model, camdm_value
    if system == "smgdiff":
        train, _ = smgdiff_data.split(ball_walker.clips(60), fraction=0.3)
        model = smgdiff_training.make_model(train, sizes=SIZES, paths=PATHS)
        module, value = smgdiff_model, smgdiff_model.to_json(model)

    def confirm(given, model):
        found = json.loads(json.dumps(module.to_json(model)))
        says(found, given)
        for leaf in jax.tree.leaves(found):
            assert not isinstance(leaf, float) or np.isfinite(leaf)

    target = harness.Target(
        f"{system}'s JSON",
        lambda given: module.from_json(given, where="x.json"),
        confirm,
        names=("x.json",),
    )
    for seed in range(INPUTS["models"]):
        random = np.random.default_rng(seed)
        given = value if seed == 0 else mutations.mutate_json(random, value)
        if not isinstance(given, dict):  # refused where files are read
            continue
        target.feed(f"seed {seed}", given)
    target.report(capsys.disabled, accepted=20, refused=100)


def test_evaluators(tmp_path, capsys):
    path = tmp_path / "x.npz"
    contents = []
    for kind in ("style", "action", "ball"):
        frozen.save(path, samples.evaluator(kind))
        contents.append(path.read_bytes())

    def confirm(data, found):
        fields = fields_of(data)
        value = json.loads(str(fields["config"]))
        says(frozen.to_json(found), value)
        same_params(found.params, fields)

    target = harness.Target(
        "evaluators", lambda _: frozen.load(path), confirm, names=("x.npz",)
    )
    for seed in range(INPUTS["evaluators"]):
        random = np.random.default_rng(seed)
        data = contents[seed % 3]
        if seed > 2:
            change = unsigned if seed % 4 else lambda x, r: mutations.mutate_npz(r, x)
            data = change(data, random)
        path.write_bytes(data)
        target.feed(f"seed {seed}", data)
    target.report(capsys.disabled, accepted=10, refused=100)


def spoil(folder, random, names):
    """One of a folder's files made wrong; its name and its content before."""
    name = names[random.integers(len(names))]
    path = folder / name
    before = path.read_bytes()
    if name.endswith(".npz"):
        path.write_bytes(mutations.mutate_npz(random, before))
    else:
        value = json.loads(before)
        path.write_bytes(mutations.mutate_json_text(random, value))
    return path, before


def fuzz_folder(tmp_path, capsys, name, load, confirm, *, accepted):
    """Feeds a run folder of which one file is spoiled at a time."""
    folder = tmp_path / "run"
    target = harness.Target(
        f"runs of {name}", lambda _: load(folder), confirm, names=("run",)
    )
    target.feed("untouched", None)
    names = ["config.json"] * 3 + [
        f"data/{x.name}" for x in (folder / "data").iterdir()
    ]
    for seed in range(1, INPUTS[name]):
        random = np.random.default_rng(seed)
        path, before = spoil(folder, random, names)
        target.feed(f"seed {seed}", None)
        path.write_bytes(before)
    target.report(capsys.disabled, accepted=accepted, refused=60)


def stored(run):
    """What the config of a run that was loaded says now."""
    value = json.loads(run.record.config.read_text())
    assert run.record.model == value["model"] and run.record.source == value["source"]
    return value


def test_runs_of_smgdiff(tmp_path, capsys):
    save_ball_clips(tmp_path / "clips.npz", ball_walker.clips(60))
    smgdiff_training.prepare(
        tmp_path / "run",
        tmp_path / "clips.npz",
        held_out=0.3,
        sizes=SIZES,
        paths=PATHS,
    )

    def confirm(_, run):
        says(smgdiff_model.to_json(run.model), stored(run)["model"])
        for leaf in jax.tree.leaves((run.train, run.held_out)):
            assert np.isfinite(np.asarray(leaf)).all()

    load = smgdiff_training.load_run
    fuzz_folder(tmp_path, capsys, "smgdiff", load, confirm, accepted=10)


def test_runs_of_aamdm(tmp_path, capsys):
    clips_io.save_clips(tmp_path / "clips.npz", person.clips((160, 90, 160, 30)))
    aamdm_training.prepare(
        tmp_path / "run",
        tmp_path / "clips.npz",
        field="theme",
        labels=("walk",),
        fps=60.0,
        held_out=0.2,
        mirrored=False,
    )

    def confirm(_, run):
        assert run.skeleton.names == tuple(stored(run)["model"]["skeleton"]["names"])
        for leaf in jax.tree.leaves((run.train, run.held_out, run.skeleton)):
            assert np.isfinite(np.asarray(leaf)).all()
        assert 0 < run.train.fps < np.inf

    load = aamdm_training.load_run
    fuzz_folder(tmp_path, capsys, "aamdm", load, confirm, accepted=10)


def test_runs_of_emdm(tmp_path, capsys):
    clips_io.save_clips(tmp_path / "clips.npz", tiny.clips())
    emdm_data.prepare(
        tmp_path / "run",
        (tmp_path / "clips.npz",),
        task="action",
        field="style",
        merge={},
        least=1,
        fps=tiny.clips().fps,
        frames=20,
        held_out=0.3,
    )

    def load(folder):
        run = runs.load(folder, system="emdm")
        emdm_training.check_task(run, ("action", "none"))
        return run

    def confirm(_, run):
        value = json.loads(run.config.read_text())
        assert run.settings == value["settings"] and run.split == value["split"]
        assert 2 <= run.settings["frames"] <= 10**5

    fuzz_folder(tmp_path, capsys, "emdm", load, confirm, accepted=10)


def test_runs_of_camdm(tmp_path, capsys, camdm_value, params):
    folder = tmp_path / "run"
    state = training.init_train_state(params, optax.adam(1e-3))
    run = runs.begin(
        folder,
        system="camdm",
        data=[],
        settings={},
        make=lambda: runs.Content(model=camdm_value, source="", split={}, files={}),
    )
    runs.store(run, camdm_model.STAGE, state, model=camdm_value["config"])
    expected = dict(flat(state.ema_params))
    whole = tmp_path / "whole"
    shutil.copytree(folder, whole)
    paths = sorted(x.relative_to(whole) for x in whole.rglob("*") if x.is_file())

    def confirm(_, found):
        model, loaded = found
        says(camdm_model.to_json(model), json.loads(json.dumps(camdm_value)))
        for name, array in flat(loaded):
            np.testing.assert_array_equal(array, expected[name])

    target = harness.Target(
        "checkpoints", lambda _: camdm_model.load(folder), confirm, names=("run",)
    )
    for seed in range(INPUTS["checkpoints"]):
        random = np.random.default_rng(seed)
        shutil.rmtree(folder)
        shutil.copytree(whole, folder)
        path = folder / paths[random.integers(len(paths))]
        data = path.read_bytes()
        if seed % 10 == 9:
            path.unlink()
        elif data:
            path.write_bytes(mutations.mutate_bytes(random, data))
        target.feed(f"seed {seed} ({path.name})", None)
    target.report(capsys.disabled, accepted=3, refused=10)
