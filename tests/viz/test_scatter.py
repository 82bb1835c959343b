import numpy as np
import pytest
from PIL import Image

from jaxmotion.viz import plots

MARKS = np.array([[-1.0, -1.0], [1.0, 1.0]])


def test_a_panel_a_cloud(tmp_path):
    path = tmp_path / "a.png"
    cloud = np.random.default_rng(0).normal(size=(50, 2))
    plots.write_scatter(path, {"data": cloud}, marks=MARKS, title="one")
    one = Image.open(path).size
    clouds = {"data": cloud, "far": cloud + 100}
    plots.write_scatter(path, clouds, marks=MARKS, title="two")
    two = Image.open(path).size
    assert two[0] == pytest.approx(2 * one[0], abs=2) and two[1] == one[1]
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    blue = (pixels[..., 2] > pixels[..., 0] + 20).sum(axis=0)
    half = blue.size // 2
    assert blue[:half].sum() > 50  # drawn
    assert blue[half:].sum() == 0  # all outside


def test_an_unwritable_file_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"a\.png"):
        plots.write_scatter(
            tmp_path / "file" / "a.png", {"x": MARKS}, marks=MARKS, title=""
        )
