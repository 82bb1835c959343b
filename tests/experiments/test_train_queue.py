"""experiments/train_queue.py: more trainings until claims are decided; kill -9."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "experiments"

# A training that goes on where it was: counts to `steps`, a line each, and evaluates.
TRAIN = """
import json, pathlib, sys, time
out, steps, pause, gap = pathlib.Path(sys.argv[2]), *map(float, sys.argv[3:6])
out.mkdir(exist_ok=True)
seed = int(sys.argv[7]) if "--seed" in sys.argv else 0
log = out / "steps.txt"
done = len(log.read_text().split()) if log.exists() else 0
for step in range(done, int(steps)):
    time.sleep(pause)
    with log.open("a") as file:
        file.write(f"{seed * 1000 + step}\\n")
if out.name.startswith("fail"):
    sys.exit("no such thing")
total = sum(map(int, log.read_text().split()))
# The gap between rows wiggles a little from seed to seed.
rows = {"a": total, "b": total + gap * (1 + 0.05 * (-1) ** seed)}
cells = {k: {"fid": dict(value=v, low=None, high=None, samples=1)} for k, v in rows.items()}
about = {"seeds": {"training": [seed]}, "command": "train", "git_commit": ""}
(out / "metrics.json").write_text(json.dumps(about | {"rows": cells}))
"""  # noqa: E501

DRIVER = """
import dataclasses, sys
sys.path.insert(0, sys.argv[1])
import train_queue
from jaxmotion import cli
from pathlib import Path
from reports import claims, stored, writing
stored.FOLDER = Path(sys.argv[2]).parent / "results"
(stored.FOLDER / "x").mkdir(parents=True, exist_ok=True)
old = stored.FOLDER / "x/clear.json"
if not old.exists():
    old.write_text('{"title": "t", "transcribed": "", "rows": {}}')
def make(name, gap, pause):
    source = claims.Source(
        run=name, file="metrics.json", name=f"x/{name}", title=f"Of {name}",
        commands=(
            f"python {sys.argv[2]} --out {stored.FOLDER}/shared 1 0 0",
            f"python {sys.argv[2]} --out {{run}} 6 {pause} {gap}",
        ),
    )
    row = lambda x: claims.Row(name=x, here=x.lower(), paper=(1.0,))
    claim = claims.Claim(words=name, column="FID", pairs=(("A", "B"),), where="here")
    return source, claims.Table(
        paper="P", number=name, title="t", source=source, rows=(row("A"), row("B")),
        columns=(claims.Column(name="FID", here="fid", better="lower"),),
        claims=(claim,),
    )
made = [make(*x.split(",")) for x in sys.argv[4:]]
writing.SOURCES, writing.TABLES = map(list, zip(*made))
# A run "beside,.." has a row of its own in the table of the run before it.
for i in range(1, len(made)):
    if made[i][0].run == "beside":
        rows = (made[i - 1][1].rows[0], dataclasses.replace(
            made[i][1].rows[1], source=made[i][0]
        ))
        writing.TABLES[i - 1] = dataclasses.replace(made[i - 1][1], rows=rows)
        writing.TABLES[i] = dataclasses.replace(made[i][1], claims=())
sys.argv = ["train_queue.py", *sys.argv[3].split()]
cli.start(train_queue.main)
"""


@pytest.fixture
def queue(tmp_path):
    """Starts a queue over runs such as "name,gap,pause" in a process of its own."""
    script, driver = tmp_path / "train.py", tmp_path / "driver.py"
    script.write_text(TRAIN)
    driver.write_text(DRIVER)
    # Scripts are imported by path: only this repository's own packages are needed.
    path = os.pathsep.join([str(FOLDER.parent), os.environ.get("PYTHONPATH", "")])

    def start(options, *runs):
        line = [sys.executable, driver, FOLDER, script, options, *runs]
        return subprocess.Popen(
            list(map(str, line)),
            text=True,
            env=os.environ | {"PYTHONPATH": path},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )

    return start


def finish(process):
    out, errors = process.communicate(timeout=120)
    return process.returncode, out + errors


def numbers(folder):
    return {
        path.parent.name: json.loads(path.read_text())["rows"]
        for path in sorted(folder.glob("*/metrics.json"))
    }


@pytest.mark.slow
def test_trainings_are_added_until_a_claim_is_decided(queue, tmp_path):
    runs = tmp_path / "runs"
    code, shown = finish(
        queue(f"--runs {runs} --most 5", "clear,9,0", "none,0,0", "against,-9,0")
    )
    assert code == 0, shown
    made = sorted(numbers(runs))
    for name in ("clear", "against"):  # three trainings decide either way
        assert [x for x in made if x.startswith(name)] == [
            name, f"{name}_seed1", f"{name}_seed2"
        ]  # fmt: skip
    assert sum(x.startswith("none") for x in made) == 5
    note = json.loads((runs / "clear_seed1" / "queue.json").read_text())
    assert note["minutes"] >= 0 and "--seed 1" in note["commands"][-1]
    # All is there: nothing is made again.
    before = {path: path.stat().st_mtime for path in runs.glob("*/metrics.json")}
    assert finish(queue(f"--runs {runs} --most 5", "clear,9,0"))[0] == 0
    assert before == {path: path.stat().st_mtime for path in before}


@pytest.mark.slow
def test_runs_whose_rows_are_compared_wait_for_each_other(queue, tmp_path):
    """A claim of two runs' rows asks both for more; one alone gets one ahead."""
    runs, most = tmp_path / "runs", f"--runs {tmp_path}/runs --most 5"
    made = lambda: sorted(numbers(runs))  # noqa: E731
    for only, counts in (("own", (3, 0)), ("beside", (3, 4)), ("beside", (3, 4))):
        options = f"{most} --only {only}"
        code, shown = finish(queue(options, "own,0,0", "beside,0,0"))
        assert code == 0, shown
        assert tuple(sum(y in x for x in made()) for y in ("own", "beside")) == counts
    code, shown = finish(queue(most, "own,0,0", "beside,0,0"))
    assert code == 0, shown
    assert len(made()) == 5 + 5


@pytest.mark.slow
def test_a_queue_that_is_killed_twice_ends_with_the_same_numbers(queue, tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert finish(queue(f"--runs {whole} --cores 1", "slow,9,0"))[0] == 0
    for _ in range(2):
        process = queue(f"--runs {killed} --cores 1", "slow,9,0.3")
        before = len(list(killed.glob("*/steps.txt")))
        end = time.monotonic() + 60
        while len(list(killed.glob("*/steps.txt"))) == before:
            assert process.poll() is None and time.monotonic() < end
            time.sleep(0.1)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        # What it started still runs: a new queue leaves that alone.
        other = queue(f"--runs {killed} --cores 1 --minutes 0.001", "slow,9,0.3")
        finish(other)
    while True:
        code, shown = finish(queue(f"--runs {killed} --cores 1", "slow,9,0"))
        if "left alone" not in shown:
            break
        time.sleep(0.5)
    assert code == 0, shown
    assert numbers(killed) == numbers(whole) and len(numbers(whole)) == 3


@pytest.mark.slow
def test_what_fails_is_named_and_the_rest_is_made(queue, tmp_path):
    code, shown = finish(queue(f"--runs {tmp_path}/runs", "fail,9,0", "good,9,0"))
    assert code == 1 and "fail: failed: no such thing" in shown
    assert shown.rstrip().splitlines()[-1].endswith("see their queue.log")
    assert len(numbers(tmp_path / "runs")) == 3


def test_an_unknown_run_is_named(load):
    module = load("train_queue")
    with pytest.raises(ValueError, match="--only: unknown run 'emd', expected one of"):
        module.sources_of(module.Config(only=("emd",)))


def test_nothing_is_trained_that_could_not_be_stored(load, monkeypatch, tmp_path):
    queue = load("train_queue")
    monkeypatch.setattr(queue.reporting, "git_commit", lambda: None)
    options = ["train_queue.py", "--keep", "--runs", str(tmp_path / "runs")]
    monkeypatch.setattr("sys.argv", options)
    with pytest.raises(ValueError, match="--keep: this is no git checkout, expected"):
        queue.main()
    assert not (tmp_path / "runs").exists()


def test_whatever_is_trained_first_has_a_title(load):
    module = load("train_queue")
    for sources in module.sources_of(module.Config()).values():
        for one in sources:
            place = module.stored.FOLDER / f"{one.name}.json"
            assert one.title or place.is_file(), one.name


def test_stored_trainings_go_together(load):
    module = load("train_queue")
    several = 0
    for source in (x for y in module.sources_of(module.Config()).values() for x in y):
        paths = module.stored.paths_of(module.stored.FOLDER, source.name)
        if len(paths) > 1:
            found = module.results.read_trainings(paths)
            assert None not in found.trainings and len(found.seeds) == 1
            several += 1
    assert several > 9


def test_a_job_has_the_commands_of_its_run_with_its_seed(load, tmp_path):
    module = load("train_queue")
    args = module.Config(runs=tmp_path, only=("smgdiff_long",))
    (sources,) = module.sources_of(args).values()
    job = module.job_of(args, sources, 11)
    folder = tmp_path / "smgdiff_long_seed11"
    assert (job.run, job.folder) == ("smgdiff_long", folder)
    # All seeds share one evaluator, which is made first, and once.
    evaluator, *own = job.commands
    assert "evaluator.py train --kind ball" in evaluator and "--seed" not in evaluator
    assert all(str(folder) in line for line in own)
    assert all(("--seed 11" in x) == (" train " in x) for x in own)
    assert len(set(job.commands)) == len(job.commands) == 4
    assert {x.parents[2] for x in job.files.values()} == {folder} and not job.done
    assert set(job.files) == {
        "smgdiff/smgdiff_schedules_seed11",
        "smgdiff/smgdiff_tuned_schedules_seed11",
        "smgdiff/smgdiff_paths_seed11",
        "smgdiff/smgdiff_tuned_paths_seed11",
    }
    assert dataclasses.replace(job, files={}).done


def test_a_training_that_was_looked_at_before_its_end_is_not_done(load, tmp_path):
    path = tmp_path / "metrics.json"
    job = load("train_queue").Job("x", tmp_path, (), {"x/x": path})
    for stage, done in (({"steps": 9}, True), ({"steps": 4, "of": 9}, False)):
        path.write_text(json.dumps({"training": {"motion": stage}, "rows": {}}))
        assert job.done == done


def test_what_runs_share_is_waited_for(load, tmp_path):
    queue, path = load("train_queue"), tmp_path / "evaluator.npz"
    own = tmp_path / "run"
    lines = f"python a.py train --out {path}", f"python b.py train --out {own}"
    job = queue.Job("run", own, lines, {})
    assert queue.shared(job) == {path}
    path.touch()
    assert not queue.shared(job)


@pytest.mark.slow
def test_what_is_stored_is_not_made_again_and_what_runs_share_is_made_once(
    queue, tmp_path
):
    results = tmp_path / "results"
    options = "--only clear --keep"
    code, shown = finish(queue(f"{options} --runs {tmp_path}/runs", "clear,9,0"))
    assert code == 0, shown
    # Three trainings are stored, the first in place of a text without numbers.
    kept = [results / f"x/clear{end}.json" for end in ("", "_seed1", "_seed2")]
    assert all(path.is_file() and f"wrote {path}" in shown for path in kept)
    assert len((results / "shared/steps.txt").read_text().split()) == 1
    before = kept[0].read_text()
    code, shown = finish(queue(f"{options} --runs {tmp_path}/others", "clear,9,0"))
    assert code == 0 and "started" not in shown, shown
    titles = [json.loads(path.read_text())["title"] for path in kept]
    assert titles == ["t"] * 3
    # A table that is new has its source's title.
    code, shown = finish(queue(f"--only new --keep --runs {tmp_path}/runs", "new,9,0"))
    assert code == 0, shown
    assert json.loads((results / "x/new_seed1.json").read_text())["title"] == "Of new"
    # One more is wanted: only that one is made.
    line = f"{options} --least 4 --runs {tmp_path}/others"
    code, shown = finish(queue(line, "clear,9,0"))
    assert code == 0 and shown.count("started") == 1, shown
    assert sorted(x.name for x in (tmp_path / "others").iterdir()) == ["clear_seed3"]
    assert kept[0].read_text() == before
