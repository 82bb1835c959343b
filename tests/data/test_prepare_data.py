import importlib.util
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxmotion.data import ball_clips, clips_io, text_motion
from tests.data import test_builders, test_text_builders
from tests.data.builders import test_ballplay, test_soccer_x

SCRIPT = Path(__file__).parents[2] / "experiments" / "prepare_data.py"


@pytest.fixture(scope="module")
def script():
    """The script as a module."""
    spec = importlib.util.spec_from_file_location("prepare_data", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["prepare_data"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["prepare_data"]


@pytest.fixture
def raw(tmp_path):
    return test_builders.put(tmp_path / "raw", test_builders.bandai_files())


def test_published_clips_are_written_mirrored_and_resampled(
    script, raw, tmp_path, capsys
):
    out = tmp_path / "data" / "b.npz"
    options = {"source": "bandai_namco/2", "out": out, "manual_dir": raw}
    script.prepare(script.Config(**options, mirror=True, fps=60.0))
    found = clips_io.load_clips(out)
    assert (found.num_clips, found.fps, found.num_frames) == (4, 60.0, 4 * 7)
    assert found.clip_names[2:] == tuple(f"{n}_mirrored" for n in found.clip_names[:2])
    np.testing.assert_array_equal(found.labels["content"], [3, 0, 3, 0])
    printed = capsys.readouterr().out
    for word in ("clips    4", "frames   28 at 60 fps", "elderly 2", "CC BY-NC 4.0"):
        assert word in printed
    assert (tmp_path / "data" / "tfds").is_dir()
    with pytest.raises(FileExistsError, match="b.npz exists"):
        script.prepare(script.Config(**options))
    # A second reading sees that a clip is gone: nothing stale is reused.
    for path in raw.rglob("*run_active*"):
        path.unlink()
    script.prepare(script.Config(**options, overwrite=True))
    assert clips_io.load_clips(out).clip_names == ("dataset-2_walk_elderly_001",)


def test_sets_with_captions_are_written(script, tmp_path, capsys):
    test_text_builders.put(tmp_path, 251, inner=".")
    out = tmp_path / "data" / "k.npz"
    options = {"source": "kit_ml", "out": out, "manual_dir": tmp_path / "raw"}
    script.prepare(script.Config(**options, cut_fps=12.5))
    found = text_motion.load_text_motions(out)
    assert (found.num_clips, found.num_features, found.fps) == (6, 251, 12.5)
    printed = capsys.readouterr().out
    # One clip was cut by its caption, to frames 12..42.
    for word in ("clips    6", "train 4, val 1, test 1", "captions 7", "frames   509"):
        assert word in printed
    for change in ({"mirror": True}, {"fps": 20.0}):
        with pytest.raises(ValueError, match="--mirror and --fps do not apply"):
            script.prepare(script.Config(**options, overwrite=True, **change))


def test_humanact12_keeps_its_rate(script, tmp_path):
    skeleton = np.random.default_rng(9).normal(size=(24, 3)) * 0.2
    pose, joints = test_text_builders.smpl_clip(0, 4, skeleton)
    (tmp_path / "raw").mkdir()
    content = {"poses": [pose], "joints3D": [joints], "y": [2]}
    (tmp_path / "raw" / "humanact12poses.pkl").write_bytes(pickle.dumps(content))
    out = tmp_path / "a.npz"
    script.prepare(
        script.Config(source="humanact12", out=out, manual_dir=tmp_path / "raw")
    )
    found = clips_io.load_clips(out)
    assert (found.fps, found.num_frames) == (20.0, 4)
    assert found.clip_names == ("clip0000_run",)


def test_clips_with_a_ball_are_written(script, tmp_path, capsys):
    test_ballplay.write(tmp_path / "raw", test_ballplay.content())
    out = tmp_path / "data" / "b.npz"
    options = {"source": "ballplay", "out": out, "manual_dir": tmp_path / "raw"}
    script.prepare(script.Config(**options))
    found = ball_clips.load_ball_clips(out)
    assert (found.clips.num_clips, found.clips.fps, found.radius) == (3, 30.0, 0.112)
    printed = capsys.readouterr().out
    # 9 frames are 0.005 minutes; four touches apart, three of them with the left hand.
    for word in (
        "clips    3 (2 to 4 frames)",
        "catch 1, other 1, run 1",
        "radius 0.112 m",
        "in 44.4 % of frames; beginnings a minute: any joint 800.0, L_Wrist 600.0, R_",
        "minutes  of each skill: catch 0.00",
    ):
        assert word in printed
    for change in ({"mirror": True}, {"fps": 60.0}):
        with pytest.raises(ValueError, match="--mirror and --fps do not apply"):
            script.prepare(script.Config(**options, overwrite=True, **change))


def test_soccer_x_is_written(script, tmp_path):
    files = {"dribble_1.npz": test_soccer_x.sequence(33, 0)}
    test_soccer_x.write(tmp_path / "raw", files)
    out = tmp_path / "s.npz"
    script.prepare(
        script.Config(source="soccer_x", out=out, manual_dir=tmp_path / "raw")
    )
    found = ball_clips.load_ball_clips(out)
    assert (found.clips.num_frames, found.joints) == (5, (7, 8, 10, 11))


def test_bad_settings_stop_before_any_work(script, raw, tmp_path):
    base = {"source": "bandai_namco/2", "manual_dir": raw, "out": tmp_path / "o.npz"}
    (tmp_path / "file").write_text("")
    cases = [
        ({"manual_dir": tmp_path / "gone"}, FileNotFoundError, "no folder .*gone"),
        ({"manual_dir": None}, FileNotFoundError, "needs --manual-dir"),
        ({"out": tmp_path / "file" / "o.npz"}, OSError, "file"),
        ({"out": tmp_path}, IsADirectoryError, "is a folder"),
        ({"fps": 1e300}, ValueError, "--fps should be in 0.001..100000, found 1e.300"),
        ({"seed": -1}, ValueError, "--seed should be in 0..2"),
        ({"loops": 4.0, "actions": True}, ValueError, "not of stretches of --actions"),
        ({"loops": 1.0}, ValueError, "--loops should be in 2..3600 seconds, found 1.0"),
    ]
    for change, error, message in cases:
        with pytest.raises(error, match=message):
            script.prepare(script.Config(**{**base, **change}))
    assert sorted(os.listdir(tmp_path)) == ["file", "raw"]


# Larger files than allowed stand for a full disk.
FULL = """
import resource, runpy, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def run_full(*arguments) -> tuple[int, str]:
    """Exit status and last line of the script with almost no room to write."""
    line = [sys.executable, "-c", FULL, str(SCRIPT), *map(str, arguments)]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr
    return done.returncode, done.stderr[done.stderr.rindex("error: ") :].strip()


@pytest.mark.slow
def test_a_full_disk_under_a_builder_is_one_line_and_leaves_nothing(tmp_path):
    out = tmp_path / "made" / "w.npz"
    text = test_builders.lafan_text(0)
    head, rows = text.split("Frame Time", 1)
    rows = rows.split("\r\n", 1)
    text = head.replace("Frames: 5", "Frames: 1000") + "Frame Time" + rows[0] + "\r\n"
    raw = test_builders.put(
        tmp_path / "raw", {"walk1_subject1.bvh": text + 200 * rows[1]}
    )
    status, line = run_full("lafan1", "--manual-dir", raw, "--out", out)
    assert status == 1 and "\n" not in line
    assert line.startswith(f"error: cannot write {out.parent}/tfds/lafan1/1.0.0: ")
    assert not [path for path in out.parent.rglob("*") if path.is_file()]


def test_what_has_no_frames_is_made_at_the_rate_that_is_asked_for(
    script, tmp_path, monkeypatch
):
    """Generated walks and curves of FBX: in-between frames are computed, not mixed."""
    rates = []

    def made(**options):
        rates.append(options["fps"])
        raise ValueError("enough")

    monkeypatch.setattr("jaxmotion.data.procedural.make_clips", made)
    monkeypatch.setattr("jaxmotion.data.fbx.read_fbx", lambda *_, **x: made(**x))
    (tmp_path / "take.fbx").write_bytes(b"")
    for source in ("procedural", "fbx"):
        folder = tmp_path if source == "fbx" else None
        for fps in (60.0, None):
            config = script.Config(
                source=source, out=tmp_path / "x.npz", manual_dir=folder, fps=fps
            )
            with pytest.raises(ValueError, match="enough"):
                script.prepare(config)
    assert rates == [60.0, 30.0] * 2
