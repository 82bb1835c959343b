"""Every code cell runs, in order, without a notebook server or a screen."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def code_cells(path):
    """Sources of the code cells of a notebook."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def run(name):
    """Runs a notebook's cells as one program; returns what they defined."""
    namespace = {"__name__": "__main__"}
    for number, source in enumerate(code_cells(ROOT / "notebooks" / name)):
        exec(compile(source, f"{name}, code cell {number}", "exec"), namespace)
    return namespace


@pytest.fixture
def no_screen(monkeypatch, tmp_path):
    """Draws into memory, and works in a folder of its own."""
    import matplotlib
    from matplotlib import pyplot

    matplotlib.use("Agg")
    # The backend without a screen warns that it shows nothing.
    monkeypatch.setattr(pyplot, "show", lambda: pyplot.gcf().canvas.draw())
    monkeypatch.chdir(tmp_path)
    yield
    pyplot.close("all")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_is_plain_and_holds_no_output(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    identities = [cell["id"] for cell in notebook["cells"]]
    assert len(set(identities)) == len(identities)
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [] and cell["execution_count"] is None
    for source in code_cells(path):
        assert not re.search(r"^\s*[%!]", source, re.MULTILINE), "magic"


def test_gaussian_oracle(no_screen, capsys):
    found = run("gaussian_oracle.ipynb")
    steps = list(found["STEPS"])
    expected, variance = found["expected"], found["VARIANCE"]
    # Of 50,000 normal samples: the standard error of a variance is 0.63 % of it.
    for name, wanted in (("plain", expected), ("drawn", [variance] * len(steps))):
        for t, got, want in zip(steps, found[name], wanted, strict=True):
            assert abs(got / want - 1.0) < 0.03, (name, t, got, want)
    assert 0.55 < expected[steps.index(8)] / variance < 0.58  # as the text says
    assert (expected[1:] > expected[:-1]).all()
    assert "recursion" in capsys.readouterr().out


def test_steer_a_character(no_screen, capsys):
    import numpy as np

    found = run("steer_a_character.ipynb")
    styles, repeats = found["STYLES"], found["REPEATS"]
    walked, same = found["walked"], found["same"]
    assert walked.shape == (2 * len(styles) * repeats, round(found["SECONDS"] * 30), 2)
    assert np.isfinite(found["positions"]).all()
    # The characters go where they are told.
    assert np.linalg.norm(walked[:, -1] - walked[:, 0], axis=-1).min() > 2.0
    assert np.linalg.norm(walked - found["wanted"], axis=-1).mean() < 1.0
    # Noise makes them differ, and their start poses more.
    local = np.asarray(found["local"])
    spread = [
        local[: 2 * repeats][rows].std(axis=0).mean()
        for rows in (same[: 2 * repeats], ~same[: 2 * repeats])
    ]
    assert 0.0 < spread[0] < spread[1]
    out = capsys.readouterr().out
    assert all(name in out for name in styles)
