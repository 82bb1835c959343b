"""experiments/quickstart.py: the shipped model walks out of the box."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxmotion.data import bvh, bvh_text
from jaxmotion.motion.skeleton import joint_positions

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_a_person_stands_walks_runs_and_crouches(tmp_path):
    """Seen in the BVH that is written: seconds, paths and heights of the hips."""
    done = subprocess.run(
        [sys.executable, ROOT / "experiments" / "quickstart.py", "--out", tmp_path],
        env={"PATH": "", "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert "Open 3D Engine" in found["source"]
    skeleton, motion = bvh.motion_from_bvh(bvh_text.read_bvh(tmp_path / "rollout.bvh"))
    hips = np.asarray(motion.root_position)
    frames = round(30 * sum(part[0] for part in found["course"]))
    assert hips.shape == (frames, 3)

    def along(start, end):
        """Speed between two moments, m/s."""
        way = hips[round(30 * end), ::2] - hips[round(30 * start), ::2]
        return np.linalg.norm(way) / (end - start)

    def height(start, end):
        return hips[round(30 * start) : round(30 * end), 1].mean()

    assert along(0.1, 0.9) < 0.2  # stands
    assert 1.1 < along(2.0, 3.4) < 1.7  # walks at 1.4 m/s
    assert along(8.0, 9.4) > 2.3  # runs
    assert along(10.8, 11.4) < 0.5  # has stopped
    assert height(12.8, 13.9) < height(2.0, 3.4) - 0.1  # crouches
    toes = np.asarray(joint_positions(skeleton, motion))[:, :, 1].min()
    assert -0.06 < toes < 0.06
    with Image.open(tmp_path / "rollout.gif") as image:
        assert image.n_frames > 100
