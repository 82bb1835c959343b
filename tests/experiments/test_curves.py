"""experiments/curves.py: time of training, what is drawn over it, what is damaged."""

import functools
import json

import numpy as np
import pytest
from PIL import Image

from jaxmotion.learning import loop

RATES = [2.0, 10.0, 20.0, 10.0, 5.0]


@pytest.fixture(scope="module")
def call(invoke):
    """Runs a command line."""
    return functools.partial(invoke, "curves")


def put(folder, stages, rows=None, system="emdm", rates=RATES, **about):
    """A run folder with stages and an evaluation."""
    folder.mkdir(exist_ok=True)
    (folder / "config.json").write_text(json.dumps({"system": system}))
    for stage in stages:
        (folder / stage).mkdir(parents=True)
        lines = [
            {"step": 50 * i, "loss": 1.0 / i, "steps_per_second": rate}
            for i, rate in enumerate(rates, start=1)
        ]
        (folder / stage / "losses.jsonl").write_text("\n".join(map(json.dumps, lines)))
    if rows:
        (folder / "evaluation").mkdir()
        cells = {
            row: {"fid": dict(value=x, low=x - 1, high=x + 1, samples=9)}
            for row, x in rows.items()
        }
        written = json.dumps({"rows": cells} | about)
        (folder / "evaluation" / "metrics.json").write_text(written)
    return folder


def test_seconds_add_up_without_the_compiling():
    rows = [dict(step=50 * i, steps_per_second=r) for i, r in enumerate(RATES, 1)]
    # 50 updates each at 10 (the median of the others), 10, 20, 10 and 5 per second.
    expected = np.cumsum([5.0, 5.0, 2.5, 5.0, 10.0])
    seconds_of = loop.seconds_of
    np.testing.assert_allclose(seconds_of(rows), expected)
    np.testing.assert_allclose(seconds_of(rows[:1]), [25.0])
    # A fast first row stays as it is.
    rows[0]["steps_per_second"] = 100.0
    np.testing.assert_allclose(seconds_of(rows), expected - 4.5)


def test_a_metric_stands_over_the_time_of_its_rows_stages(load, tmp_path):
    curves = load("curves")
    rows = {"real": 0.5, "gan": 4.0, "both": 3.0}
    short = put(tmp_path / "a", ("gan", "ddpm_1000"), rows | {"ddim_10": 6.0})
    long = put(
        tmp_path / "b", ("gan",), rows | dict(gan=2.0, both=1.0), rates=RATES * 2
    )
    args = curves.Config(run=(short, long))
    found = {x.name: curves.read_run(x, ()) for x in (short, long)}
    assert list(found["a"]) == ["gan", "ddpm_1000"]
    (panel,) = curves.metric_panels(args, found, {short: "a", long: "b"})
    assert list(panel.references) == ["real"]
    # The second run goes on for 50 updates at 2 per second, and as the first.
    spent = 27.5 + 25 + 22.5
    np.testing.assert_allclose(panel.lines["gan"][0], [27.5, spent])
    np.testing.assert_allclose(panel.lines["gan"][1], [[4, 3, 5], [2, 1, 3]])
    # A sampler needs the stage that it samples, and no other.
    np.testing.assert_allclose(panel.lines["ddim_10"][0], [27.5])
    # No stage is named so: all of them.
    np.testing.assert_allclose(panel.lines["both"][0], [55.0, spent])
    args = curves.Config(run=(short, long), rows=("gan",))
    (panel,) = curves.metric_panels(args, found, {short: "a", long: "b"})
    assert list(panel.lines) == ["gan"] and not panel.references


def test_lines_join_runs_of_one_seed_and_data_only(load, tmp_path):
    curves = load("curves")
    runs = {}
    for name, seed, count, data in (
        ("a", 0, 1, "x"), ("b", 0, 2, "x"), ("c", 1, 1, "x"), ("d", 1, 2, "y"),
    ):  # fmt: skip
        about = dict(seeds={"training": [seed]}, data={"train.npz": data})
        rows = {"real": 0.5, "gan": 4.0}
        folder = put(tmp_path / name, ("gan",), rows, rates=RATES * count, **about)
        runs[folder] = name

    def sizes(names):
        chosen = {folder: name for folder, name in runs.items() if name in names}
        found = {name: curves.read_run(x, ()) for x, name in chosen.items()}
        args = curves.Config(run=tuple(chosen))
        (panel,) = curves.metric_panels(args, found, chosen)
        assert list(panel.references) == ["real"]
        return {label: len(x) for label, (x, _) in panel.lines.items()}

    assert sizes("abc") == {"gan, seed 0": 2, "gan, seed 1": 1}
    assert sizes("cd") == {"gan, data of c": 1, "gan, data of d": 1}


def test_a_picture_and_the_losses_in_words(call, tmp_path, capsys):
    put(tmp_path / "a", ("gan", "deep/ddpm"), {"gan": 4.0})
    put(tmp_path / "b", ("gan",))
    out = tmp_path / "out" / "c.png"
    call(f"--run {tmp_path}/a {tmp_path}/b --out {out}")
    shown = capsys.readouterr().out
    assert "a, deep/ddpm: 250 updates in 27.5 s; loss at 25% 0.8125" in shown
    assert f"no {tmp_path}/b/evaluation/metrics.json" in shown
    with Image.open(out) as image:
        assert image.size[0] > 1000
    call(f"--run {tmp_path}/a --stages deep/ddpm --out {out}")
    assert "gan:" not in capsys.readouterr().out


def test_bad_input_is_named(call, tmp_path):
    run, out = put(tmp_path / "a", ("gan",), {"gan": 4.0}), tmp_path / "c.png"
    other = put(tmp_path / "b", ("gan",), system="aamdm")
    (empty := tmp_path / "c").mkdir()
    (empty / "config.json").write_text('{"system": "emdm"}')
    for line, message in (
        (f"{run} {other}", "run: of several systems: aamdm, emdm"),
        (f"{run} {run}", "run: a folder is given twice"),
        (f"{empty}", "c: no losses.jsonl in any stage"),
        (f"{run} --stages ddpm", "a: no stage 'ddpm', it has gan"),
        (f"{run} --metric fad", "no row all with 'fad'; there are the columns fid"),
    ):
        with pytest.raises((OSError, ValueError), match=message):
            call(f"--run {line} --out {out}")
    path = run / "gan" / "losses.jsonl"
    for text, message in (
        ('{"step": 50, "loss": 1.0}', "step 50: steps_per_second is None"),
        ('{"step": 50, "steps_per_second": 0}', "step 50: steps_per_second is 0"),
        ('{"step": 50, "steps_per_second": 1}', "step 50: loss is None"),
        ("", "no rows: the training has just begun"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=f"losses.jsonl: {message}"):
            call(f"--run {run} --out {out}")
    assert not out.exists()
