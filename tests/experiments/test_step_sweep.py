"""experiments/step_sweep.py: points, budgets, what is refused, and tiny sweeps."""

import csv
import dataclasses
import functools
import json
import re
import sys
import types
from pathlib import Path

import jax
import pytest
from PIL import Image

from jaxmotion.data import bvh_text, clips_io, procedural
from jaxmotion.data.ball_clips import save_ball_clips
from jaxmotion.evaluation import bench, table
from jaxmotion.evaluators import frozen
from jaxmotion.systems import registry
from tests import ball_walker, samples

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "experiments" / "step_sweep.py"
TINY = (
    "--replications 2 --change updates=2 batch=4 width=16 depth=1 warmup=1 "
    "held_out=0.4 seconds=4 evaluator_updates=2 chunk=2 rollout_seconds=0.5"
)
TIMES = ("p50", "p95")


def made_up(trained):
    """A system whose models are files with a number, and whose scores are noise."""

    def prepare(job):
        def row(value):
            noise = jax.random.normal(jax.random.key(job.seed), (job.replications,))
            one = table.Cell(value=1.0)
            return {"fid": table.cell(value + 0.1 * noise), "one": one}

        def score(point):
            if point.steps == 7:
                return {"one": table.Cell(value=float("nan"))}
            return row(float((job.models / point.folder).read_text()))

        return bench.Evaluation(
            real={bench.GROUND_TRUTH: row(1.0), bench.NOISE_FLOOR: row(0.5)},
            score=score,
            sampler=lambda point: jax.jit(jax.random.normal),
            describe={"source": "noise", "samples": "one number"},
        )

    def train(options):
        if not options["path"].exists():
            options["path"].write_text(str(options["updates"] / options["steps"]))
            trained.append(options["steps"])

    def draw(options):
        options["out"].mkdir(parents=True)
        (options["out"] / "seen.txt").write_text(options["name"])

    own = bench.Bench(
        data=(),
        amounts={
            "updates": bench.Amount(quick=8, full=80, meaning="of nothing"),
            "length": bench.Amount(
                quick=1.5, full=2.0, meaning="of nothing", training=False
            ),
        },
        points=bench.plain_points,
        train=lambda job, point: (
            "train",
            dict(
                path=job.models / point.folder,
                updates=job.budget["updates"],
                steps=point.steps,
            ),
        ),
        show=lambda job, point: ("draw", {"name": point.name}),
        prepare=prepare,
        quality="fid",
        sample="a number",
    )
    script = types.SimpleNamespace(Train=dict, train=train, Draw=dict, draw=draw)
    kind = type("Noise", (registry.System,), {"bench": own})
    return kind(name="noise", title="Noise", paper="none"), script


@pytest.fixture(scope="module")
def trained():
    """Step counts that were trained so far."""
    return []


@pytest.fixture(scope="module")
def call(invoke, trained):
    """Runs a command line; there is a fifth system, "noise", with a script."""
    system, script = made_up(trained)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry.SYSTEMS, "noise", system)
        patch.setitem(sys.modules, "noise", script)
        yield functools.partial(invoke, "step_sweep")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "clips.npz"
    clips_io.save_clips(path, samples.clips())
    return path


@pytest.fixture(scope="module")
def swept(call, tmp_path_factory):
    """A sweep of noise."""
    out = tmp_path_factory.mktemp("sweeps") / "a"
    call(f"--system noise --steps 4 2 --out {out}")
    return out


def report_of(folder):
    return json.loads((folder / "table.json").read_text())


def check_same(first, second):
    """The same rows but for times."""
    assert first.keys() == second.keys()
    for name, row in first.items():
        assert row.keys() == second[name].keys()
        for column in set(row) - set(TIMES):
            assert row[column] == second[name][column], (name, column)


# --- step counts and budgets --------------------------------------------------------


def test_step_counts_keep_their_order():
    points = bench.plain_points(("8", "2", "32"))
    assert [p.steps for p in points] == [8, 2, 32]
    assert [p.name for p in points] == ["8", "2", "32"]
    assert len({p.folder for p in points} | {p.row for p in points}) == 6


def test_polish_steps_have_draft_steps(load):
    points = bench.paired_points(("2", "0+3", "2+10"))
    assert [p.parts for p in points] == [(2, 3), (0, 3), (2, 10)]
    assert [p.steps for p in points] == [5, 3, 12]
    # The rows that experiments/aamdm.py knows.
    load("aamdm").rows.check(tuple(p.folder for p in points))


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (("2", "0"), "steps: '0' is no number of steps"),
        (("-1",), "steps: '-1'"),
        (("2.5",), "steps: '2.5'"),
        (("2+3",), r"steps: '2\+3'"),
        (("2", "4", "02"), "steps: T = 2 is given twice"),
        ((), "steps: there are none"),
    ],
)
def test_what_is_no_step_count_is_named(texts, message):
    with pytest.raises(ValueError, match=message):
        bench.plain_points(texts)


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (("0",), "steps: '0'"),
        (("0+0",), r"steps: '0\+0' has no step"),
        (("2+",), "steps: ''"),
        (("2", "2+3"), r"steps: 2 polish \+ 3 draft is given twice"),
    ],
)
def test_what_is_no_pair_is_named(texts, message):
    with pytest.raises(ValueError, match=message):
        bench.paired_points(texts)


def test_students_come_after_their_teacher(tmp_path):
    points = bench.taught_points(("8", "1", "1/8", "2/8"))
    assert [p.steps for p in points] == [8, 1, 1, 2]
    assert [p.teacher for p in points] == [None, None, "8", "8"]
    assert len({p.folder for p in points} | {p.row for p in points}) == 8
    own = registry.get("camdm").bench
    job = bench.Job(
        points=points,
        data=(tmp_path,),
        models=tmp_path,
        budget=bench.resolve(own.amounts, "quick"),
        replications=2,
        seed=0,
    )
    commands = [own.train(job, point) for point in points]
    assert [name for name, _ in commands] == ["train", "train", "distill", "distill"]
    assert [options.get("visit") for _, options in commands[2:]] == [(8,), (4, 8)]
    assert commands[2][1]["run"] == commands[0][1]["out"]


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (("1/8", "8"), "steps: '1/8', expected .* and '8', its teacher, before it"),
        (("8", "9/8"), "steps: '9/8', expected at most 8"),
        (("8", "0/8"), "steps: '0' is no number"),
        (("8", "1/"), "steps: '' is no number"),
        (("8", "1/8", "1/08"), "steps: 1 of T = 8, distilled is given twice"),
    ],
)
def test_what_is_no_student_is_named(texts, message):
    with pytest.raises(ValueError, match=message):
        bench.taught_points(texts)


def test_a_budget_is_changed_by_name():
    amounts = registry.get("camdm").bench.amounts
    quick = bench.resolve(amounts, "quick")
    changed = bench.resolve(amounts, "quick", ("updates=7", "seconds=5"))
    assert changed == quick | {"updates": 7, "seconds": 5.0}
    assert isinstance(changed["updates"], int)
    trained = bench.training_part(amounts, changed)
    assert "updates" in trained and "seconds" not in trained


def test_the_help_has_every_number_of_every_budget(help_of):
    text = help_of("step_sweep")
    for system in registry.SYSTEMS.values():
        for name, amount in system.bench.amounts.items():
            numbers = dict.fromkeys((f"{amount.quick:g}", f"{amount.full:g}"))
            wanted = rf" {name}: [^/]*?: [^:]*{system.name} {'/'.join(numbers)}"
            assert re.search(wanted, text), wanted


# --- what a sweep leaves behind ------------------------------------------------------


def test_a_sweep_has_real_motion_and_every_model(swept):
    report = report_of(swept)
    truth, floor, *models = report["rows"]
    assert "ground truth" in truth and "noise floor" in floor
    assert models == ["T = 4", "T = 2"]
    for name, value in zip(models, (2.0, 4.0), strict=True):
        row = report["rows"][name]
        assert row["fid"]["samples"] == 20
        assert row["fid"]["low"] < value < row["fid"]["high"]
        assert 0 < row["p50"]["low"] <= row["p50"]["value"]
        assert row["p50"]["value"] <= row["p50"]["high"]
        assert row["p50"]["value"] <= row["p95"]["value"]
    assert not set(TIMES) & set(report["rows"][truth])
    for name in ("jax", "jaxlib", "flax", "numpy", "cpu", "cores", "git_commit"):
        assert report[name], name
    assert report["seeds"] == {"training": 0, "evaluation": 0}
    assert report["budget"] == {"updates": 8, "length": 1.5}
    assert report["source"] == "noise" and report["replications"] == 20
    assert "--system noise --steps 4 2" in report["command"]


def test_the_tables_agree(swept):
    rows = report_of(swept)["rows"]
    with open(swept / "table.csv", newline="") as file:
        cells = list(csv.DictReader(file))
    assert len(cells) == sum(len(row) for row in rows.values())
    for cell in cells:
        own = rows[cell["row"]][cell["column"]]
        assert float(cell["value"]) == own["value"]
        assert (cell["low"] == "") == (own["low"] is None)
        assert int(cell["samples"]) == own["samples"]
    assert {cell["steps"] for cell in cells} == {"", "2", "4"}
    text = (swept / "table.md").read_text()
    for name in rows:
        assert f"| {name} |" in text
    for note in report_of(swept)["notes"]:
        assert f"- {note}" in text
    assert "one number" in text and "commit" in text


def test_a_plot_and_rollouts_are_written(swept):
    with Image.open(swept / "pareto.png") as image:
        assert min(image.size) > 400
    for name in ("2", "4"):
        assert (swept / "rollouts" / f"T{name}" / "seen.txt").read_text() == name


def test_what_is_trained_is_loaded(call, swept, trained, tmp_path):
    assert trained[:2] == [4, 2]
    before = len(trained)
    call(
        f"--system noise --steps 2 16 --models {swept}/models --out {tmp_path} "
        "--change length=9"
    )
    assert trained[before:] == [16]
    rows, first = report_of(tmp_path)["rows"], report_of(swept)["rows"]
    assert rows["T = 2"]["fid"] == first["T = 2"]["fid"]


@pytest.mark.parametrize(
    ("more", "what"),
    [
        ("--change updates=9", "updates"),
        ("--seed 1", "seed"),
        ("--data {file}", "data"),
    ],
)
def test_models_of_another_sweep_are_refused(call, swept, tmp_path, more, what):
    (tmp_path / "file").write_text("")
    more = more.format(file=tmp_path / "file")
    with pytest.raises(ValueError, match=f"models: .* trained with other {what}:"):
        call(f"--system noise --models {swept}/models --out {tmp_path} {more}")


def test_a_model_without_a_number_is_in_the_table_alone(call, tmp_path):
    call(f"--system noise --steps 2 7 --out {tmp_path}")
    report = report_of(tmp_path)
    assert report["rows"]["T = 7"]["one"]["value"] is None
    assert "not in the plot" in report["notes"][-1] and "T = 7" in report["notes"][-1]
    assert (tmp_path / "pareto.png").exists()


def test_distances_of_rollouts_that_diverge_stand_for_nothing():
    fails = bench.has_failed
    count = lambda n: table.Cell(value=float(n), samples=40)  # noqa: E731
    assert fails({"diverged": count(21)}) and fails({"frozen": count(40)})
    assert not fails({"diverged": count(20), "frozen": count(0)})
    assert not fails({"fid": table.Cell(value=3.0, samples=2)})


def test_the_same_seed_gives_the_same_table(call, swept, tmp_path):
    call(f"--system noise --steps 4 2 --out {tmp_path / 'same'}")
    call(f"--system noise --steps 4 2 --out {tmp_path / 'other'} --seed 1")
    first, same, other = (
        report_of(x)["rows"] for x in (swept, tmp_path / "same", tmp_path / "other")
    )
    check_same(first, same)
    assert first["T = 2"]["fid"] != other["T = 2"]["fid"]


# --- systems ------------------------------------------------------------------------

# Step counts, data and numbers of a sweep that takes a minute or two.
SYSTEMS = {
    "camdm": ("1 2 1/2", "clips", TINY),
    "smgdiff": (
        "1 2",
        "ball",
        "--replications 2 --change updates=10 draft_updates=10 batch=4 width=16 "
        "depth=1 held_out=0.3 windows=8 evaluator_updates=20 rollout_seconds=0.5",
    ),
    "emdm": (
        "1 2",
        "actions",
        "--replications 2 --change updates=10 batch=4 width=16 depth=1 hidden=16 "
        "discriminator_width=64 frames=20 least=2 held_out=0.3 samples=8 "
        "evaluator_updates=20",
    ),
    "aamdm": (
        "1+1 0+2",
        "walker",
        "--replications 2 --change autoencoder_updates=10 polisher_updates=10 "
        "generator_updates=10 batch=8 width=32 characters=2 seconds=0.5 "
        "rollout_seconds=0.5",
    ),
}


def clips_for(kind, path):
    """Writes clips of the walker that a system can use."""
    if kind == "ball":
        save_ball_clips(path, ball_walker.clips(80))
        return
    clips = samples.clips() if kind == "clips" else procedural.make_clips(minutes=2.0)
    if kind == "actions":
        labels = {"content": clips.labels["style"] % 2}
        names = (("content", ("run", "walk")),)
        clips = dataclasses.replace(clips, labels=labels, label_names=names)
    clips_io.save_clips(path, clips)


@pytest.mark.slow
@pytest.mark.parametrize("system", SYSTEMS)
def test_a_tiny_sweep_twice_gives_the_same_table(call, tmp_path, system):
    steps, kind, more = SYSTEMS[system]
    clips_for(kind, tmp_path / "clips.npz")
    line = f"--system {system} --steps {steps} --data {tmp_path}/clips.npz {more}"
    for name in "ab":
        call(f"{line} --out {tmp_path / name}")
    first, second = (report_of(tmp_path / name)["rows"] for name in "ab")
    check_same(first, second)
    truth, floor, *models = first
    assert len(models) == len(steps.split())
    quality = registry.get(system).bench.quality
    for name in (truth, floor, *models):
        assert first[name][quality]["samples"] == 2
    source = "made in the tests" if kind == "ball" else "rocedural"
    assert source in report_of(tmp_path / "a")["source"]
    for folder in (tmp_path / "a" / "rollouts").iterdir():
        (path,) = folder.glob("*.bvh")
        assert len(bvh_text.read_bvh(path).values) > 1
        assert path.with_suffix(".gif").exists()


# --- errors -------------------------------------------------------------------------

BAD = {
    "--system camd --steps 2": "system: unknown system 'camd', expected one of camdm",
    "--system camdm --budget huge": "budget: unknown budget 'huge'",
    "--system camdm --change speed=3": "change: 'speed=3'",
    "--system camdm --change updates=many": "change: 'updates=many'",
    "--system camdm --change updates=0": "change: 'updates=0'",
    "--system emdm --data {gone} --out {new}": "data: no clips file .*gone.npz",
    "--system camdm --data {data} --out {file}/below": "out: .*plain/below",
    "--system camdm --data {data} --out {new} --models {file}/below": "models: .*plain",
    "--system camdm --data {data} --out {new} --replications 1": "replications: 1",
    "--system aamdm --evaluator {evaluator}": "evaluator: aamdm is scored without",
    "--system camdm --evaluator {evaluator}": "is of kind 'ball', camdm needs",
    "--system camdm --evaluator {gone}": "gone.npz",
}


@pytest.fixture(scope="module")
def of_balls(tmp_path_factory):
    """The file of an evaluator that no model but SMGDiff is scored by."""
    path = tmp_path_factory.mktemp("evaluator") / "evaluator.npz"
    frozen.save(path, samples.evaluator("ball"))
    return path


@pytest.mark.parametrize("line", BAD)
def test_what_is_wrong_is_named_before_any_work(call, data, of_balls, tmp_path, line):
    (tmp_path / "plain").write_text("")
    places = dict(
        data=data,
        gone=tmp_path / "gone.npz",
        file=tmp_path / "plain",
        evaluator=of_balls,
        new=tmp_path / "new",
    )
    with pytest.raises((OSError, ValueError), match=BAD[line]):
        call(line.format(**places))
    assert not list(tmp_path.glob("new/models/T*"))
