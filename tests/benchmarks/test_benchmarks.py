"""The scripts at sizes that take seconds, and the arithmetic of their reports."""

import collections
import csv
import dataclasses
import json
import math
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import timing
from jaxmotion.networks import work
from jaxmotion.systems import registry
from jaxmotion.systems.camdm import model as camdm_model
from tests import tiny
from tests.benchmarks.conftest import FOLDER
from tests.retarget import rigs

SMALL = ["--width", "16", "--runs", "2", "--limit", "1"]
# Script -> arguments, and what its rows are told apart by.
SCRIPTS = {
    "step_counts": (
        [*SMALL, "--system", "camdm", "--steps", "2", "--batch", "1", "16"]
        + ["--frames-per-token", "5"],
        [(1, 2), (16, 2)],
        ("batch", "steps"),
    ),
    "rollout_batch": (
        [*SMALL, "--characters", "16", "--chunks", "8", "--seconds", "0.4"],
        [(16, 8)],
        ("characters", "chunk"),
    ),
}


def run_script(name, *arguments):
    """Runs a script in a process of its own and returns what it printed.

    Not in this one, because `lower` rebuilds dataclasses with things that are not
    arrays, which the type checks of the tests refuse.
    """
    return subprocess.run(
        [sys.executable, FOLDER / f"{name}.py", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=True,
        # Their times do not matter here: unoptimized programs compile in a third.
        env=os.environ
        | {"JAX_PLATFORMS": "cpu", "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"},
    ).stdout


@pytest.mark.slow
def test_a_rollout_stands_beside_python_loops():
    """Compiled alike; frames, steps, or the networks alone, are jitted in them."""
    small = ["--width", "16", "--runs", "2", "--limit", "1", "--seconds", "0.1"]
    text = run_script("rollout_batch", "--system", "aamdm", "--characters", "1", *small)
    rates = re.findall(r"Python loop, ([a-z ]+) jitted: ([0-9.,]+) frames/s", text)
    assert [name for name, _ in rates] == ["networks", "whole steps", "whole frames"]
    assert all(float(rate.replace(",", "")) > 0 for _, rate in rates)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_write_what_they_measure(name, tmp_path):
    arguments, cases, keys = SCRIPTS[name]
    printed = run_script(name, *arguments, "--out", tmp_path)
    value = json.loads((tmp_path / f"{name}.json").read_text())
    rows = value["rows"]
    assert [tuple(row[key] for key in keys) for row in rows] == cases
    for row in rows:
        assert 0 < row["p50_ms"] <= row["p95_ms"]
        assert row["compile_s"] > 0
        assert row.get("traces", 1) == 1
    one = rows[0]
    frames = 45 if name == "step_counts" else 16 * 12
    assert one["frames_per_second"] == pytest.approx(1000 * frames / one["p50_ms"])
    environment = value["environment"]
    for key in ("cpu", "cores", "jax", "jaxlib", "flax", "numpy", "python", "date"):
        assert environment[key], key
    assert name in environment["command"]
    assert "frames/s" in printed
    assert len({metric["name"] for metric in value["metrics"]}) == len(value["metrics"])
    if name == "step_counts":
        assert (tmp_path / "step_counts.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
@pytest.mark.parametrize("system", ["camdm", "aamdm", "emdm", "smgdiff"])
def test_a_step_is_a_network_call(load, system):
    workload = load("workload")
    for name in workload.of(system, "samplers"):
        sizes = workload.Sizes(steps=3, width=16, step=workload.STEPS[name])
        run, given = workload.of(system, "samples")(sizes).program(2)
        found = work.count(run, *given)
        assert found.network_calls == 2 * 3, name
        assert found.flops > 0


@pytest.mark.slow
@pytest.mark.parametrize("system", ["camdm", "smgdiff"])
def test_prefix_attention_is_less_work_from_the_second_step_on(load, system):
    workload = load("workload")

    def flops(attention, steps):
        config = dataclasses.replace(sizes(load, system), attention=attention, depth=3)
        given = workload.Sizes(steps=steps, config=config)
        run, given = workload.of(system, "samples")(given).program(1)
        return work.count(run, *given).flops

    full, prefix = ([flops(x, 1), flops(x, 5)] for x in ("full", "prefix"))
    assert prefix[1] < 0.6 * full[1]
    assert prefix[1] - prefix[0] < 0.5 * (full[1] - full[0])


def test_step_counts_refuses_before_the_work(load):
    module = load("step_counts")
    refused = {
        "--sampler dpm_solver: not for aamdm": dict(sampler=("ddim", "dpm_solver")),
        "--steps 1: expected 2": dict(system=("smgdiff",), guided=True, steps=(1, 2)),
        "--batch 0": dict(batch=(0,)),
        "--devices 9: . are there": dict(devices=9),
        "unknown system 'nn'": dict(system=("nn",)),
    }
    for message, options in refused.items():
        with pytest.raises(ValueError, match=message):
            module.make_lines(module.fill(module.Config(**options), []))
    options = dict(system=("smgdiff", "emdm"), sampler=("own", "ddim", "ancestral"))
    with pytest.raises(ValueError, match="ancestral: not for emdm"):
        module.make_lines(module.fill(module.Config(**options), []))
    args = module.Config(
        system=("smgdiff",), guided=True, sampler=options["sampler"], steps=(8,)
    )
    assert [str(line) for line in module.make_lines(args)] == [
        "smgdiff ancestral batch=1",
        "smgdiff ancestral guided batch=1",
        "smgdiff ddim batch=1",
        "smgdiff ddim guided batch=1",
    ]


def row_of(line, steps, **more):
    """A row of step_counts.py that took a millisecond per step."""
    return dataclasses.asdict(line) | dict(
        steps=steps, network_calls=steps, compile_s=1.0,
        p50_ms=float(steps), p95_ms=2.0 * steps, runs=5, memory_mib=3.0,
        frames_per_second=45e3 / steps, real_time=1.5e3 / steps, gflop=0.25 * steps,
        matmul_percent=10.0, difference=None,
    ) | more  # fmt: skip


def run_step_counts(load, monkeypatch, out, *options, **more):
    """Runs step_counts.py with `row_of` for what would be measured."""
    module = load("step_counts")
    case = lambda args, line, steps, rate, config: row_of(line, steps, **more)  # noqa: E731
    monkeypatch.setattr(module, "case", case)
    monkeypatch.setattr(timing, "matmul_rate", lambda: 1e11)
    arguments = [*map(str, options), "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["step_counts.py", *arguments])
    module.main()


def test_step_counts_writes_its_tables(load, monkeypatch, tmp_path):
    options = "--system", "emdm", "camdm", "--steps", 2, 4, "--sampler", "own", "ddim"
    run_step_counts(load, monkeypatch, tmp_path, *options)
    rows = list(csv.DictReader((tmp_path / "step_counts.csv").open()))
    assert [(row["system"], row["sampler"], row["steps"]) for row in rows] == [
        (system, sampler, steps)
        for system, own in (("emdm", "ddgan"), ("camdm", "ancestral"))
        for sampler in (own, "ddim")
        for steps in "24"
    ]
    head, rule, first, *_ = (tmp_path / "step_counts.md").read_text().splitlines()
    cells = lambda line: [x.strip() for x in line.strip("|").split("|")]  # noqa: E731
    found = dict(zip(cells(head), cells(first), strict=True))
    assert set(cells(rule)) == {"---"}
    assert found["sampler"] == "ddgan" and found["frames/s"] == "22,500"
    assert (tmp_path / "step_counts.png").read_bytes().startswith(b"\x89PNG")
    value = json.loads((tmp_path / "step_counts.json").read_text())
    assert value["matmul_gflops"] == 100
    metrics = {metric["name"]: metric["value"] for metric in value["metrics"]}
    assert metrics["emdm ddim batch=1 steps=4 p50"] == 4


def write_sweep(folder, system, steps, config):
    """A sweep's folder, with the same number in each row."""
    own = registry.get(system).bench
    cells = {"value": 0.5, "low": 0.4, "high": None, "samples": 20}
    names = [point.row for point in own.points(steps)]
    table = {
        "system": system,
        "arguments": {"steps": list(steps)},
        "config": dataclasses.asdict(config),
        "rows": {row: {own.quality: cells} for row in names},
    }
    folder.mkdir()
    (folder / "table.json").write_text(json.dumps(table))
    return folder


CAMDM = dict(num_joints=21, num_labels=7, width=32, heads=2, hidden=64, depth=2)


def sizes(load, system):
    """A configuration of each system that is not the benchmark's own."""
    workload = load("workload")
    return {
        "camdm": workload.camdm_model.Config(**CAMDM),
        "aamdm": workload.aamdm_model.Config(features=20, width=32, depth=2),
        "emdm": workload.emdm_model.Config(
            features=30, frames=20, condition_size=5, width=32, heads=2, depth=3
        ),
        "smgdiff": workload.smgdiff_model.Config(
            num_features=60, num_labels=3, width=32, heads=2, depth=3
        ),
    }[system]


@pytest.mark.parametrize("as_file", [False, True])
def test_quality_joins_a_sweep(load, monkeypatch, tmp_path, as_file, capsys):
    sweep = write_sweep(
        tmp_path / "a", "aamdm", ("2+3", "0+3", "2+6"), sizes(load, "aamdm")
    )
    options = ["--steps", 5, 6, "--sampler", "own", "ddim"]
    path = sweep / "table.json" if as_file else sweep
    run_step_counts(load, monkeypatch, tmp_path, *options, "--quality", path)
    value = json.loads((tmp_path / "step_counts.json").read_text())
    assert {row["system"] for row in value["rows"]} == {"aamdm"}
    assert [row["quality"] for row in value["rows"]] == [0.5, None, None, None]
    assert value["rows"][0]["quality_high"] == 0.5
    assert (tmp_path / "step_counts_aamdm.png").read_bytes().startswith(b"\x89PNG")
    last = (tmp_path / "step_counts.md").read_text().splitlines()[-1]
    assert last.endswith("| – | – |")
    assert "not timed here: 0 polish + 3 draft" in capsys.readouterr().out


def test_a_sweep_says_what_to_measure(load, monkeypatch, tmp_path, capsys):
    sweep = write_sweep(
        tmp_path / "a", "camdm", ("8", "2", "1/8"), sizes(load, "camdm")
    )
    run_step_counts(load, monkeypatch, tmp_path, "--quality", sweep)
    value = json.loads((tmp_path / "step_counts.json").read_text())
    assert [row["steps"] for row in value["rows"]] == [2, 8]
    assert [row["quality"] for row in value["rows"]] == [0.5, 0.5]
    assert "not timed here: 1 of T = 8, distilled" in capsys.readouterr().out


@pytest.mark.parametrize("system", ["camdm", "aamdm", "emdm", "smgdiff"])
def test_networks_are_of_the_size_of_the_sweeps_models(load, tmp_path, system):
    module, workload = load("step_counts"), load("workload")
    own = sizes(load, system)
    points = {"aamdm": ("2+3",)}.get(system, ("8",))
    sweep = module.read_sweep(write_sweep(tmp_path / "a", system, points, own))
    assert sweep.config == own
    given = workload.Sizes(steps=3, config=sweep.config)
    found = workload.of(system, "samples")(given)
    for name in ("width", "features", "num_features", "num_labels", "frames", "depth"):
        assert getattr(found.config, name, None) == getattr(own, name, None)
    assert found.config.num_steps == 3
    run, arguments = found.program(1)
    assert jax.eval_shape(run, *arguments).shape[-1] in (20, 30, 60, 22 * 6)


def test_quality_refuses_what_is_no_sweep_of_these(load, tmp_path):
    module, config = load("step_counts"), sizes(load, "camdm")
    folder = write_sweep(tmp_path / "a", "camdm", ("8",), config)
    sweep = module.read_sweep(folder)

    def fill(*sweeps, **options):
        return module.fill(module.Config(**options), list(sweeps))

    with pytest.raises(ValueError, match="nothing of --steps 2, 4, expected .* of 8"):
        fill(sweep, steps=(2, 4))
    with pytest.raises(ValueError, match="second table of camdm"):
        fill(sweep, sweep)
    with pytest.raises(ValueError, match="system 'camdm', expected .*--system emdm"):
        fill(sweep, system=("emdm",))
    other = write_sweep(tmp_path / "b", "smgdiff", ("8",), sizes(load, "smgdiff"))
    with pytest.raises(ValueError, match="--guided: a sweep has no skeleton"):
        fill(module.read_sweep(other), guided=True)
    with pytest.raises(FileNotFoundError, match="gone: no such file: .*step_sweep"):
        module.read_sweep(tmp_path / "gone")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match="empty/table.json: .*step_sweep"):
        module.read_sweep(tmp_path / "empty")
    path = folder / "table.json"
    whole = json.loads(path.read_text())
    for field, value in (
        ("config", {"width": 3}),
        ("config", None),
        ("system", "nn"),
        ("rows", []),
        ("rows", {"T = 8": []}),
        ("arguments", {"steps": ["0"]}),
        ("arguments", {}),
    ):
        path.write_text(json.dumps(whole | {field: value}))
        with pytest.raises(ValueError, match=r"--quality .*table\.json: .*step_sweep"):
            module.read_sweep(folder)
    path.write_text(json.dumps({k: x for k, x in whole.items() if k != "config"}))
    with pytest.raises(ValueError, match="has no config, .*made anew"):
        module.read_sweep(folder)
    path.write_text("[]")
    with pytest.raises(ValueError, match=r"table\.json.*step_sweep"):
        module.read_sweep(folder)


def test_options_that_change_nothing_are_refused_or_named(load):
    module = load("step_counts")

    def lines(*sized, **options):
        return module.without_effect(module.Config(**options), sized)

    every = ("camdm", "aamdm", "emdm", "smgdiff")
    assert lines(system=every) == []
    assert lines(system=every, width=64) == []
    for message, system, options in (
        ("--paper changes nothing of camdm, aamdm$", ("camdm", "aamdm"), "paper"),
        ("--guided changes nothing of camdm$", ("camdm",), "guided"),
        ("--frames-per-token .* of emdm$", ("emdm",), "frames_per_token"),
        ("--attention changes nothing of aamdm$", ("aamdm",), "attention"),
    ):
        value = {"frames_per_token": 5, "attention": "prefix"}.get(options, True)
        with pytest.raises(ValueError, match=message):
            lines(system=system, **{options: value})
        (said,) = lines(system=every, **{options: value})
        assert "changes nothing of" in said
    with pytest.raises(ValueError, match="--width changes nothing of emdm$"):
        lines(system=("emdm",), width=64, paper=True)
    with pytest.raises(ValueError, match="--width .* of camdm .sizes are those of"):
        lines("camdm", system=("camdm",), width=64)
    (said,) = lines("camdm", system=("camdm", "emdm"), width=64)
    assert said.startswith("--width changes nothing of camdm (sizes are")


def test_history_has_a_line_per_metric_and_a_picture(load, monkeypatch, tmp_path):
    suite, history = load("suite"), tmp_path / "history.jsonl"
    metrics = [suite.Metric("a p50", 2.0, "ms"), suite.Metric("a compile", 1.0, "s")]
    monkeypatch.setattr(sys, "argv", ["x.py"])
    for _ in range(2):
        suite.report("x", metrics, Config(tmp_path, None, history), rows=[])
    entries = suite.read_history(history)
    assert [entry["name"] for entry in entries] == 2 * ["a p50", "a compile"]
    assert all(entry["date"] and "commit" in entry for entry in entries)
    assert (tmp_path / "history.png").read_bytes().startswith(b"\x89PNG")
    history.write_text(history.read_text() + "{}\n")
    with pytest.raises(ValueError, match=r"history\.jsonl: line 5.*--history"):
        suite.prepare(Config(tmp_path, None, history))


def test_phases_add_up(load):
    program = jax.jit(lambda x: jnp.sin(x) @ x)
    row = load("compile_times").phases("sines", program, (jnp.ones((8, 8)),))
    parts = row["trace"], row["lower"], row["compile"]
    assert min(parts) > 0
    assert row["total"] == pytest.approx(sum(parts))


def test_settings_are_json(load):
    @dataclasses.dataclass(frozen=True)
    class Config:
        out: Path = Path("a")
        runs: tuple[Path, ...] = (Path("b"), Path("c"))
        steps: tuple[int, ...] = (2, 4)
        gate: Path | None = None

    found = json.loads(json.dumps(load("suite").settings(Config())))
    assert found == {"out": "a", "runs": ["b", "c"], "steps": [2, 4], "gate": None}


@pytest.mark.slow
def test_compile_times(tmp_path):
    small = ["--width", 16, "--steps", 2, "--updates", 2, "--batch", 2]
    small += ["--characters", 1, "--seconds", 0.1]
    run_script("compile_times", *small, "--out", tmp_path)
    rows = json.loads((tmp_path / "compile_times.json").read_text())["rows"]
    kinds = [row["program"].split(",")[0] for row in rows]
    assert kinds == ["schedule", "sampler", "sampler", "training", "rollout"]
    assert all(row["compile"] > 0 for row in rows)


@pytest.mark.slow
def test_unrolled_sampler_is_the_scanned_one(load):
    """What compile_times compares computes the same."""
    compile_times, workload = load("compile_times"), load("workload")
    config = tiny.config(num_steps=2)
    params = tiny.random_params(camdm_model.init, config)
    condition = jax.tree.map(lambda x: x[0], workload.camdm_conditions(config, 1))
    scan = jax.jit(camdm_model.sampler(params, config=config))
    loop = jax.jit(lambda k, c: compile_times.unrolled(config, params, k, c))
    found, expected = (f(jax.random.key(0), condition) for f in (loop, scan))
    np.testing.assert_allclose(found, expected, atol=1e-5)


SCRIPT_NAMES = ["step_counts", "rollout_batch", "compile_times", "train_together"]
SCRIPT_NAMES += ["peers", "page"]


@pytest.mark.parametrize("name", SCRIPT_NAMES)
def test_help_has_defaults_units_and_an_example(name, load, monkeypatch, capsys):
    if name == "peers":
        pytest.importorskip("torch")
    monkeypatch.setattr(sys, "argv", [f"{name}.py", "--help"])
    with pytest.raises(SystemExit) as stop:
        load(name).main()
    assert stop.value.code == 0
    printed = " ".join(capsys.readouterr().out.replace("\u2502", " ").split())
    assert f"python benchmarks/{name}.py" in printed
    assert "default: runs/benchmarks" in printed
    assert "seconds" in printed.lower()


Config = dataclasses.make_dataclass("Config", ["out", "gate", ("history", Path, None)])


def test_gate(load, tmp_path, monkeypatch):
    suite = load("suite")
    monkeypatch.setattr(sys, "argv", ["x.py"])
    time, rate = (
        suite.Metric("time", 10.0, "ms", tolerance=0.2),
        suite.Metric("rate", 100.0, "frames/s", "higher", tolerance=0.2),
    )
    suite.report("x", [time, rate], Config(tmp_path, None), rows=[])
    baseline = tmp_path / "x.json"
    value = lambda metric, x: dataclasses.replace(metric, value=x)  # noqa: E731
    new = suite.Metric("new", 1e9, "ms")
    assert suite.compare([value(time, 11.9), value(rate, 84.0), new], baseline) == []
    assert suite.compare([value(time, 1.0), value(rate, 1e4)], baseline) == []
    with pytest.raises(ValueError, match=r"x\.json: has none of the metrics"):
        suite.compare([new], baseline)
    (slow,) = suite.compare([value(time, 12.1), rate], baseline)
    assert "time: 12.1 ms, baseline 10" in slow
    (few,) = suite.compare([time, value(rate, 80.0)], baseline)
    assert "rate" in few
    (unknown,) = suite.compare([value(time, math.nan), rate], baseline)
    assert "time: nan ms" in unknown
    suite.report("zero", [value(time, 0.0), rate], Config(tmp_path, None), rows=[])
    zero = tmp_path / "zero.json"
    assert suite.compare([value(time, 0.0), rate], zero) == []
    (late,) = suite.compare([value(time, 1e-3), rate], zero)
    assert "(inf times worse" in late
    with pytest.raises(SystemExit) as stop:
        suite.report("y", [value(time, 20.0)], Config(tmp_path, baseline), rows=[])
    assert stop.value.code == 1
    assert (tmp_path / "y.json").exists()


def test_bad_input_stops_before_the_work(load, tmp_path):
    suite = load("suite")
    file = tmp_path / "file"
    file.write_text("{}")
    with pytest.raises(OSError, match="file"):
        suite.prepare(Config(file / "below", None))
    with pytest.raises(ValueError, match="metrics"):
        suite.prepare(Config(tmp_path, file))
    with pytest.raises(OSError, match="none.json"):
        suite.prepare(Config(tmp_path, tmp_path / "none.json"))
    chunks_of = load("rollout_batch").chunks_of
    assert chunks_of(16, (4, 0, 4)) == [4, None]
    with pytest.raises(ValueError, match="--chunks 5.*divisor of 16"):
        chunks_of(16, (4, 5))


def test_time_calls_warms_up_and_stops():
    calls = []
    work = lambda: calls.append(1) or jnp.zeros(())  # noqa: E731
    assert len(timing.time_calls(work, rounds=7, warmup=2)) == 7
    assert len(calls) == 9
    # No time at all: one call to warm up, and the least number.
    calls.clear()
    assert len(timing.time_calls(work, rounds=7, warmup=2, limit_s=0.0, least=3)) == 3
    assert len(calls) == 4


def test_time_in_turn_calls_each_once_a_round_after_different_others():
    order = []
    calls = {name: (lambda name=name: order.append(name)) for name in "abc"}
    times = timing.time_in_turn(calls, rounds=29, warmup=1, limit_s=60.0)
    rounds = np.reshape(order, (30, 3))
    assert (np.sort(rounds, axis=1) == [*"abc"]).all()
    pairs = collections.Counter(zip(order, order[1:], strict=False))
    assert len({*pairs} - {(x, x) for x in "abc"}) == 6 and max(pairs.values()) < 25
    assert all(values.shape == (29, 2) for values in times.values())


@pytest.mark.slow
def test_peers_compute_the_same(tmp_path):
    """Frames of AAMDM, one and three; onnxruntime is there or is said to be missing."""
    pytest.importorskip("torch")
    options = ["--system", "aamdm", "--batch", "1", "3", "--width", "32"]
    options += ["--rounds", "2", "--compile-limit", "0", "--target", "0"]
    printed = run_script("peers", *options, "--out", tmp_path)
    report = json.loads((tmp_path / "peers.json").read_text())
    found = {(row["batch"], row["name"]) for row in report["rows"]}
    names = {"ours, constants", "torch eager", "torch eager, products by oneDNN"}
    different = report["systems"]["aamdm"]["largest_differences"]
    if "onnxruntime" in different:
        names.add("onnxruntime")
    else:
        assert printed.count("onnxruntime: left out") == 1
    every = {(batch, name) for batch in (1, 3) for name in names}
    assert found == {(1, "ours, arguments"), *every}
    cells = {metric["name"] for metric in report["metrics"]}
    assert "AAMDM, a frame, batch 3 eager" in cells and len(cells) == len(every)
    # Of whole chains, which enlarge what their networks differ by: that is at most 1e-5
    # (tests/networks/test_parity.py), and noise in another order would give 1.
    assert max(different.values()) < 1e-3
    assert (tmp_path / "peers.md").exists()


def test_what_is_far_slower_sits_out(load):
    """Ours and another in all rounds, one that takes longer in the first ones alone."""
    pytest.importorskip("torch")
    peers, calls = load("peers"), collections.Counter()

    def call(name, seconds):
        def run():
            calls[name] += 1
            end = time.process_time() + seconds
            while time.process_time() < end:
                pass

        return run

    made = {peers.OURS: call("ours", 0.01), peers.EAGER: call("eager", 0.01)}
    made |= {peers.ONNX: call("onnx", 0.04)}
    args = peers.Config(rounds=9, sit_out=2.0)
    times = peers.time_rows(made, args, warmup=0)
    assert {k: len(v) for k, v in times.items()} == {
        peers.OURS: 9,
        peers.EAGER: 9,
        peers.ONNX: 7,
    }
    # And once, to see how long they take.
    assert calls == {"ours": 10, "eager": 10, "onnx": 8}
    every = peers.time_rows(made, peers.Config(rounds=8, sit_out=0.0), warmup=0)
    assert {len(v) for v in every.values()} == {8}
    # Quick calls are repeated, and their mean is what counts.
    calls.clear()
    quick = {name: call(name, 0.004) for name in (peers.OURS, peers.EAGER)}
    found = peers.time_rows(quick, peers.Config(rounds=2), warmup=0)
    assert 1 + 2 * 2 <= calls[peers.OURS] <= 1 + 2 * 3
    assert found[peers.OURS].min() >= 4.0 and found[peers.OURS].shape == (2, 2)


def test_ratios_are_of_the_same_round(load):
    pytest.importorskip("torch")
    peers = load("peers")
    eager = np.array([[10.0, 8.0], [100.0, 80.0], [20.0, 16.0]])
    rows = peers.rows_of({peers.OURS: eager * [0.5, 0.75], peers.EAGER: eager})
    ours = rows[0]
    assert peers.faster(rows) == []
    slow, other = ours | {"p50_ms": 30.0}, {"name": peers.PREFIX, "p50_ms": 1.0}
    assert peers.faster([slow, other, rows[1]]) == [peers.EAGER]
    assert ours["ratio"] == pytest.approx(0.5)
    assert ours["cpu_ratio"] == pytest.approx(0.75)
    assert ours["p50_ms"] == pytest.approx(10.0)

    def status(**given):
        try:
            peers.check_target(ours, 0.65, **given)
        except SystemExit as stop:
            return stop.code
        return 0

    assert status(threads=2, load=0.0) == 0
    assert status(threads=2, load=1.0) == 2
    assert status(threads=1, load=1.0) == 1


@pytest.mark.slow
def test_retarget(tmp_path):
    arguments = ["--seconds", "1", "--characters", "1", "--repeats", "2"]
    run_script("retarget", *arguments, "--out", tmp_path)
    rows = json.loads((tmp_path / "retarget.json").read_text())["rows"]
    assert len(rows) == 25
    assert {row.rpartition(", ")[0] for row in rows} >= {"child", "giant"}
    for row in rows.values():
        assert row["slide"] < 1.1 * row["source_slide"] + 1e-4
        assert row["penetration"] < 1.0 and row["round"] < 10.0
    costs = json.loads((tmp_path / "retarget_cost.json").read_text())["rows"]
    assert costs["1 character"]["with_rig"] > 0.0
    walker = tmp_path / "walker.glb"
    walker.write_bytes(rigs.glb(rigs.person("long arms", "Unreal")))
    run_script(
        "retarget",
        *("--rig", walker, "--seconds", "1", "--characters", "--out", tmp_path),
    )
    rows = json.loads((tmp_path / "rigs.json").read_text())["rows"]
    assert len(rows) == 5 and "walker.glb, crouch" in rows


def test_shipped_models_are_rolled_out_straight_on(load):
    workload = load("workload")
    made = workload.shipped_rollouts("locomotion_fast", 0.1, True)
    states, commands = made.start(3)
    assert commands.label.shape == (3, round(0.1 * made.fps))
    assert jax.tree.leaves(states)[0].shape[0] == 3
    speed = np.linalg.norm(commands.velocity, axis=-1)
    np.testing.assert_allclose(speed, 1.0, atol=1e-5)
    with pytest.raises(ValueError, match="actions makes whole motions"):
        workload.shipped_rollouts("actions", 0.1, False)
