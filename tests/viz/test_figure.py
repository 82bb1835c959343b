import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from jaxmotion.viz import camera, figure, plots


def test_the_axes_of_a_view():
    # Right, up and toward the viewer are orthonormal, and right-handed.
    for azimuth, elevation in [(0.0, 0.0), (35.0, 20.0), (200.0, 70.0)]:
        axes = camera.view_axes(azimuth=azimuth, elevation=elevation)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) > 0
    # Straight ahead along -z; from above what is nearer is lower.
    flat = camera.view_axes(azimuth=0.0, elevation=0.0)
    np.testing.assert_allclose(flat, np.eye(3), atol=1e-12)
    above = camera.view_axes(azimuth=0.0, elevation=90.0)
    np.testing.assert_allclose(above @ [0, 0, 1], [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(above @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    # A camera turned by 90 degrees about +y stands on the +x axis.
    side = camera.view_axes(azimuth=90.0, elevation=0.0)
    np.testing.assert_allclose(side @ [1, 0, 0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(side @ [0, 0, 1], [-1, 0, 0], atol=1e-12)


def test_a_character_that_faces_the_viewer_has_its_left_on_the_right():
    left = np.array([0.3, 1.0, 0.0])  # facing +z, y up: left is +x
    assert (camera.view_axes(azimuth=0.0, elevation=10.0) @ left)[0] > 0


def test_a_file_below_a_file_cannot_be_written(tmp_path):
    (tmp_path / "plain").write_text("kept")
    with pytest.raises(OSError, match=r"plain/deep/a\.gif: cannot write here"):
        figure.check_writable(tmp_path / "plain" / "deep" / "a.gif")
    with pytest.raises(OSError, match=str(tmp_path)):
        figure.check_writable(tmp_path)
    assert (tmp_path / "plain").read_text() == "kept"


def test_checking_leaves_no_file_and_keeps_an_old_one(tmp_path):
    figure.check_writable(tmp_path / "new" / "a.gif")
    assert list((tmp_path / "new").iterdir()) == []
    old = tmp_path / "old.txt"
    old.write_text("kept")
    assert figure.check_writable(old) == old
    assert old.read_text() == "kept"


def test_plots_are_pictures_that_change_with_their_data(tmp_path):
    x = np.array([2.0, 4.0, 8.0])
    lines = {"p50": (x, x, 2 * x), "p95": (x, x**2, None)}
    found = []
    for log in (True, False):
        out = tmp_path / f"sweep{log}.png"
        plots.plot_sweep(out, lines, xlabel="steps", ylabel="ms", log=log)
        found.append(np.asarray(Image.open(out).convert("L")))
        assert found[-1].std() > 5
    assert np.mean(found[0] != found[1]) > 0.001


def test_plots_check_their_file_first(tmp_path):
    (tmp_path / "plain").write_text("")
    bad = tmp_path / "plain" / "a.png"
    with pytest.raises(OSError, match="plain"):
        plots.plot_sweep(bad, {}, xlabel="", ylabel="")


@pytest.mark.slow
def test_a_notebook_keeps_its_backend():
    code = (
        "import matplotlib; matplotlib.use('svg');"
        "import jaxmotion.viz.animation, jaxmotion.viz.figure, jaxmotion.viz.html;"
        "print(matplotlib.get_backend())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "svg"
