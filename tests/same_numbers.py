"""What each system computes at fixed seeds, to hold changes of the house against.

Losses of 20 updates, a rollout, rows of an evaluation and of a sweep, by the scripts as
users call them, with tiny models; and the metrics of the quickstart.

python -m tests.same_numbers write          makes what is computed now the record
python -m tests.same_numbers check          says what differs from the record
python -m tests.same_numbers check camdm    of one system
"""

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from tests.experiments import test_kills, test_step_sweep

ROOT = Path(__file__).parents[1]
RECORD = Path(__file__).with_suffix(".json")
# Cells that are times, and what says when, where and by what it was made.
TIMES = (
    "ms a frame",
    "steps_per_second",
    "p50",
    "p95",
    "ms",
    "first_ms",
    "seconds",
    "latency_ms",
    "frame_time",
    "fps",
)
TRAIN = {
    "camdm": "--held-out 0.5 --contents --width 16 --depth 1 --batch 2 --warmup 1 "
    "--diffusion-steps 2 --chunk 10 --save-every 10 --steps 20",
    "aamdm": "--field style --labels --rows aamdm --autoencoder-steps 20 "
    "--polisher-steps 20 --generator-steps 20 --batch 4 --width 32",
    "emdm": "--task action --field style --least 2 --held-out 0.3 --frames 20 --merge "
    "--rows emdm ddpm_50 --steps 20 --ddpm-steps 20 --batch 2 --width 8 --depth 1 "
    "--hidden 8 --discriminator-width 64",
    "smgdiff": "--width 8 --depth 1 --steps 20 --draft-steps 10 --path-steps 20 "
    "--batch 2 --held-out 0.3",
}
EVALUATE = {
    "camdm": "--rollouts 2 --seconds 4 --evaluator-steps 20 --contents",
    "aamdm": "--rows aamdm --rollouts 4 --seconds 1 --long-minutes 0",
    "emdm": "--samples 16 --replications 2 --long-replications 2 --evaluator-steps 20",
    "smgdiff": "--tables steps --windows 8 --replications 2 --evaluator-steps 20",
}
ROLLOUT = {
    "camdm": "rollout --seconds 2 --style calm",
    "aamdm": "rollout --seconds 1",
    "smgdiff": "rollout --seconds 2",
}
PROGRAMS = (*TRAIN, "quickstart")


def _run(*words: object) -> None:
    done = subprocess.run(
        [sys.executable, *map(str, words)],
        cwd=ROOT,
        env=os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise RuntimeError(f"{words}: {done.stderr[-3000:]}")


def _cells(rows: dict) -> dict:
    """Values of a table's cells, without those of time."""
    return {
        row: {
            name: cell["value"] if isinstance(cell, dict) else cell
            for name, cell in cells.items()
            if name not in TIMES
        }
        for row, cells in rows.items()
    }


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _losses(folder: Path) -> dict:
    """Last row of each stage's losses."""
    return _cells(
        {
            path.parent.relative_to(folder).as_posix(): json.loads(
                path.read_text().splitlines()[-1]
            )
            for path in sorted(folder.rglob("losses.jsonl"))
        }
    )


def compute(program: str, folder: Path) -> dict:
    """Numbers of a system, or of the quickstart."""
    if program == "quickstart":
        _run("experiments/quickstart.py", "--out", folder)
        found = json.loads((folder / "metrics.json").read_text())
        return {"rows": _cells(found["rows"]), "bvh": _digest(folder / "rollout.bvh")}
    script, run, out = f"experiments/{program}.py", folder / "run", folder / "out"
    test_kills.prepare(folder)
    data = folder / f"{program}.npz"
    _run(script, "train", "--data", data, "--out", run, *TRAIN[program].split())
    line = EVALUATE[program].split()
    _run(script, "evaluate", "--run", run, "--out", out, *line)
    found = {
        "losses": _losses(run),
        "evaluation": {
            path.name: _digest(path) if path.suffix == ".md" else _rows(path)
            for path in sorted(out.glob("*.json"))
        },
    }
    if program in ROLLOUT:
        line = ROLLOUT[program].split()
        _run(script, *line, "--run", run, "--out", folder / "rollout")
        found["bvh"] = _digest(folder / "rollout" / "rollout.bvh")
    steps, kind, more = test_step_sweep.SYSTEMS[program]
    test_step_sweep.clips_for(kind, folder / "clips.npz")
    line = f"--system {program} --steps {steps} {more}".split()
    places = ("--data", folder / "clips.npz", "--out", folder / "sweep")
    _run("experiments/step_sweep.py", *line, *places)
    table = json.loads((folder / "sweep" / "table.json").read_text())
    found["sweep"] = _cells(table["rows"])
    found["sweep_losses"] = _losses(folder / "sweep" / "models")
    return found


def _rows(path: Path) -> dict:
    value = json.loads(path.read_text())
    tables = value.get("tables", {"rows": value.get("rows", {})})
    return {
        name: _cells(table.get("rows", table))
        for name, table in tables.items()
        if isinstance(table, dict)
    }


def flat(value: object, name: str = "") -> dict[str, object]:
    """Leaves of nested JSON by their paths."""
    if isinstance(value, dict):
        leaves = [flat(inner, f"{name}/{key}") for key, inner in value.items()]
        return {path: leaf for found in leaves for path, leaf in found.items()}
    return {name: value}


def differences(program: str, folder: Path) -> list[str]:
    """Lines of what differs from the record."""
    record = flat(json.loads(RECORD.read_text())[program])
    found = flat(json.loads(json.dumps(compute(program, folder))))
    return [
        f"{program}{path}: {record.get(path)} in the record, now {found.get(path)}"
        for path in sorted(record.keys() | found.keys())
        if json.dumps(record.get(path)) != json.dumps(found.get(path))
    ]


@pytest.mark.slow
@pytest.mark.parametrize("program", PROGRAMS)
def test_the_numbers_are_those_of_the_record(program):
    """In a process of its own: flags of the suite's compiler change the numbers."""
    suite = ("XLA_FLAGS", "JAX_DISABLE_MOST_OPTIMIZATIONS")
    done = subprocess.run(
        [sys.executable, "-m", "tests.same_numbers", "check", program],
        cwd=ROOT,
        env={name: value for name, value in os.environ.items() if name not in suite},
        capture_output=True,
        text=True,
    )
    assert not done.returncode, done.stderr[-3000:]
    assert done.stdout == f"{program}: 0 differences\n", done.stdout


def main() -> None:
    task, *programs = sys.argv[1:]
    for program in programs or PROGRAMS:
        with tempfile.TemporaryDirectory() as folder:
            if task == "check":
                lines = differences(program, Path(folder))
                print(f"{program}: {len(lines)} differences", *lines, sep="\n")
            else:
                record = json.loads(RECORD.read_text()) if RECORD.exists() else {}
                record[program] = compute(program, Path(folder))
                RECORD.write_text(json.dumps(record, indent=1) + "\n")
                print(f"{program}: {len(flat(record[program]))} numbers")


if __name__ == "__main__":
    main()
