import dataclasses

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from jaxmotion.viz import plots


def test_smoothing_against_a_loop():
    values = np.random.default_rng(0).normal(size=90)
    expected = []
    for i in range(90):
        reach = min(4, i)
        expected.append(values[i - reach : i + reach + 1].mean())
    np.testing.assert_allclose(plots.smoothed(values, part=0.1), expected, atol=1e-12)
    # Too few to smooth; and a line stays one, but where it is cut off.
    np.testing.assert_allclose(plots.smoothed(values[:5]), values[:5], atol=1e-12)
    line = np.arange(100.0)
    np.testing.assert_allclose(plots.smoothed(line)[:-2], line[:-2], atol=1e-12)


def panel(noisy, shift=0.0, **more):
    x = np.arange(1.0, 201.0)
    value = 1.0 + shift + 0.1 * np.sin(x)
    y = np.stack([value, np.full(200, np.nan), np.full(200, np.nan)], axis=1)
    texts = dict(title="a", xlabel="s", ylabel="loss")
    return plots.Curves(**texts, lines={"run": (x, y)}, noisy=noisy, **more)


def read(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def test_values_are_thin_behind_what_is_smoothed(tmp_path):
    plots.write_curves(tmp_path / "a.png", (panel(True),), title="t")
    pixels = read(tmp_path / "a.png")
    blue = pixels[..., 2] - pixels[..., 0]
    strong, weak = (blue > 140).sum(), ((blue > 20) & (blue < 100)).sum()
    assert strong > 200 and weak > 2 * strong


def test_panels_stand_in_rows_and_have_references(tmp_path):
    line = {"recorded": np.array([1.0, 0.9, 1.1])}
    panels = (*[panel(True)] * 3, panel(False, references=line))
    plots.write_curves(tmp_path / "a.png", panels[:1], title="t")
    plots.write_curves(tmp_path / "b.png", panels, title="t")
    one, four = read(tmp_path / "a.png"), read(tmp_path / "b.png")
    assert four.shape[0] > 1.8 * one.shape[0] and four.shape[1] > 2.5 * one.shape[1]
    green = four[..., 1] - np.maximum(four[..., 0], four[..., 2]) > 50
    assert green.any(axis=0).sum() > 100


def test_an_unwritable_file_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"a\.png"):
        plots.write_curves(tmp_path / "file" / "a.png", (panel(True),), title="")


@pytest.mark.parametrize(("number", "within"), [(3, True), (14, False)])
def test_many_names_stand_below_their_curves(tmp_path, monkeypatch, number, within):
    made = []
    keep = lambda *args, **options: made.append(Figure(*args, **options)) or made[-1]  # noqa: E731
    monkeypatch.setattr(plots, "Figure", keep)
    (line,) = panel(False).lines.values()
    lines = {f"a row with a name {i}": line for i in range(number)}
    full = dataclasses.replace(panel(False), lines=lines)
    plots.write_curves(tmp_path / "a.png", (full, panel(False)), title="t")
    axes = made[0].axes[0]
    names, box = axes.get_legend().get_window_extent(), axes.get_window_extent()
    assert bool(box.overlaps(names)) == within
    assert names.y0 > 0 and box.height > 150
