"""experiments/robot.py, on a robot that the test writes."""

import numpy as np
import pytest
from PIL import Image

from tests.retarget import robots


@pytest.mark.slow
def test_a_robot_walks(invoke, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    path, out = tmp_path / "ours.xml", tmp_path / "out"
    path.write_text(robots.mjcf())
    invoke("robot", f"--robot {path} --out {out} --course straight --seconds 2")
    words = capsys.readouterr().out
    assert "frames at 50 per second" in words and "no limit in the file" in words
    found = np.load(out / "motion.npz")
    assert 95 <= len(found["joint_pos"]) <= 100
    assert found["body_pos_w"][-1, 0, 0] > 1.0, "it walks ahead"
    with Image.open(out / "motion.gif") as picture:
        assert picture.n_frames > 30
