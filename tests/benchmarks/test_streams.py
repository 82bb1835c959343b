"""Streams that are stopped, and what a crowd's cost is fitted by."""

import json
import os

import numpy as np
import pytest


def make(number, stop=None):
    if number == stop:
        raise KeyboardInterrupt
    x = np.random.default_rng(number).normal(size=(6, 2, 3)).astype(np.float32)
    return {"columns": x.var(axis=0).reshape(1, -1)[:, :4], "pose": x}


def test_a_stopped_stream_ends_with_the_same_moments_to_the_bit(load, tmp_path):
    streams = load("streams")
    path, more = tmp_path / "stopped.npz", dict(size=6, total=9, about={"a": 1})
    whole = streams.run(make, path=tmp_path / "whole.npz", **more)
    with pytest.raises(KeyboardInterrupt, match="stopped at 30 of 54; .*stopped.npz"):
        streams.run(lambda i: make(i, stop=5), path=path, **more)
    # A kill leaves what was last written: here at 4 sets.
    at_four = streams.run(make, path=tmp_path / "4.npz", **more | {"total": 4})
    for file, begun in ((path, 5), (tmp_path / "4.npz", 4)):
        text = json.dumps(more["about"])
        assert streams.read(file, text).sets == begun
        found = streams.run(make, path=file, **more)
        assert found.sets == 9 and found.spreads["pose"].count == 54
        for name, one in whole.spreads.items():
            for a, b in zip(found.spreads[name], one, strict=True):
                np.testing.assert_array_equal(a, b)
    assert [row[0] for row in at_four.history] == [6, 12, 24]
    streams.draw(tmp_path / "x.png", whole, ("a", "b", "c", "d"))
    assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")
    assert "GiB at 54" in streams.memory(whole)


def test_a_stream_of_other_samples_is_refused(load, tmp_path):
    streams, path = load("streams"), tmp_path / "stream.npz"
    streams.run(make, size=6, total=1, path=path, about={"seed": 0})
    with pytest.raises(ValueError, match=r"stream\.npz: field 'about' is .*other sam"):
        streams.run(make, size=6, total=2, path=path, about={"seed": 1})
    path.write_bytes(b"no")
    with pytest.raises(ValueError, match=r"stream\.npz"):
        streams.read(path, "")


def test_slope_of_a_crowd(load):
    rows = [dict(characters=n, p50_ms=3.0 * n**0.8) for n in (1, 16, 65536)]
    assert load("rollout_batch").slope(rows) == pytest.approx(0.8)
    assert load("rollout_batch").slope(rows[:1]) is None


def test_gpu_names_what_failed_and_goes_on(load, monkeypatch, tmp_path, capsys):
    gpu = load("gpu")
    rows = [dict(steps=10, batch=1, p50_ms=2.0)]
    emdm = dict(part="emdm", seconds=1.0, end="ran", metrics=[], rows=rows)
    late = dict(part="aamdm", seconds=9.0, end="late", metrics=[], rows=[])
    monkeypatch.setattr(gpu, "run_part", lambda args, name: late)
    assert [one["met"] for one in gpu.aims([emdm, late])] == [None, None, True]
    options = ["gpu.py", "--parts", "aamdm", "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", options)
    with pytest.raises(SystemExit) as stop:
        gpu.main()
    assert stop.value.code == 1 and "late" in capsys.readouterr().out
    assert json.loads((tmp_path / "gpu.json").read_text())["rows"][0]["end"] == "late"


@pytest.mark.slow
def test_a_part_that_takes_too_long_keeps_the_rows_it_made(load, monkeypatch, tmp_path):
    gpu = load("gpu")
    report = {"metrics": [{"name": "m"}], "rows": [{"characters": 1}]}
    (tmp_path / "slow.py").write_text(
        "import json, pathlib, sys, time\n"
        "out = pathlib.Path(sys.argv[-1])\n"
        "out.mkdir(parents=True, exist_ok=True)\n"
        f"(out / 'slow.json').write_text({json.dumps(json.dumps(report))})\n"
        "time.sleep(60)\n"
    )
    monkeypatch.setattr(gpu, "__file__", str(tmp_path / "gpu.py"))
    monkeypatch.setattr(gpu, "PARTS", {"crowd": ("slow", "", "")})
    stale = tmp_path / "out" / "crowd" / "slow_before.json"
    stale.parent.mkdir(parents=True)
    stale.write_text("{}")
    os.utime(stale, (0, 0))
    made = gpu.run_part(gpu.Config(out=tmp_path / "out", limit=2.0), "crowd")
    assert made["end"] == "not done in --limit 2 s"
    assert made["rows"] == report["rows"] and made["metrics"] == report["metrics"]
