"""Every code cell runs, in order, without a notebook server or a screen."""

import json
import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

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


@pytest.fixture
def little_optimized():
    """For a notebook that compiles for longer than it computes."""
    import jax

    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_is_plain_and_holds_its_output(path):
    assert path.stat().st_size < 1_000_000
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    identities = [cell["id"] for cell in notebook["cells"]]
    assert len(set(identities)) == len(identities)
    codes = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    # In order, from a fresh kernel, without an error.
    assert [cell["execution_count"] for cell in codes] == list(range(1, len(codes) + 1))
    outputs = [output for cell in codes for output in cell["outputs"]]
    assert all(output["output_type"] != "error" for output in outputs)
    assert any("image/png" in output.get("data", {}) for output in outputs)
    for source in code_cells(path):
        assert not re.search(r"^\s*[%!]", source, re.MULTILINE), "magic"


def test_one_chain(no_screen, little_optimized, capsys):
    found = run("01_one_chain.ipynb")
    steps = list(found["STEPS"])
    expected, variance = found["expected"], found["VARIANCE"]
    # For 20,000 normal samples the standard error of a variance is 1 % of it.
    for name, wanted in (("plain", expected), ("drawn", [variance] * len(steps))):
        for t, got, want in zip(steps, found[name], wanted, strict=True):
            assert abs(got / want - 1.0) < 0.03, (name, t, got, want)
    assert 0.55 < expected[steps.index(8)] / variance < 0.58  # as the text says
    assert (expected[1:] > expected[:-1]).all()
    # What is learned keeps more than what is known, of the same number of steps.
    learned = found["gan_variance"] / variance
    assert 0.8 < learned < 1.25 and expected[steps.index(4)] / variance < 0.5
    assert "recursion" in capsys.readouterr().out


def test_steer_a_character(no_screen, little_optimized):
    import numpy as np

    found = run("02_steer_a_character.ipynb")
    walked, wanted = found["walked"], found["wanted"]
    assert walked.shape == (9, round(found["SECONDS"] * 30), 2)
    assert np.isfinite(found["positions"]).all()
    # The characters go where they are told.
    assert np.linalg.norm(walked[:, -1] - walked[:, 0], axis=-1).min() > 1.0
    assert np.linalg.norm(walked - wanted, axis=-1).mean() < 0.3
    # The ninth lifts its knees as it does not before the change.
    assert found["after"] > found["before"] + 0.05
    assert found["view"]._repr_html_().startswith("<iframe srcdoc=")
    assert not list(Path().iterdir())  # nothing is left on disk


def test_diversity_by_vmap(no_screen, little_optimized):
    import numpy as np

    found = run("03_diversity_by_vmap.ipynb")
    positions, lead = found["positions"], found["lead"]
    assert positions.shape[:2] == (len(found["STATES"]), found["ROLLOUTS"])
    # One state: what differs comes with time, from the noise alone.
    spread = positions.std(axis=1).mean(axis=(-1, -2))
    assert spread[:, 0].max() < 0.01 and (spread[:, -1] > 2 * spread[:, 0]).all()
    # Those that stood set out with either foot.
    share = found["first_step"].mean(axis=1)
    assert 0.05 < share[0] < 0.95 and share[1] in (0.0, 1.0)
    assert lead[0].std(axis=0).max() > 3 * lead[1].std(axis=0).max()
    # The estimate gets sharper with N and does not drift; the widest gap grows.
    deviation, widest = np.array(found["deviation"]), np.array(found["widest"])
    assert deviation[1].std() > 2 * deviation[-2].std()
    assert abs((deviation[2] ** 2).mean() / (deviation[-1] ** 2).mean() - 1) < 0.3
    assert np.median(widest[-1]) > 1.3 * np.median(widest[0])
    assert np.isfinite(found["spread"]).all() and (found["spread"] > 0).all()


def test_step_counts(no_screen, little_optimized):
    import numpy as np

    found = run("04_step_counts.ipynb")
    steps, score = found["STEPS"], found["score"]
    middle = [score["trained for T", t][0] for t in steps]
    # One step is the mean of the data; from there quality rises.
    assert middle[0] > 4 * middle[2] > 8 * middle[-1]
    assert np.abs(found["points"]["trained for T", 1]).max() < 0.5
    assert np.isfinite(found["latency"]).all()
    assert all(len(found["points"][way, steps[-1]]) == 4 for way in found["WAYS"])


def test_guidance_gradients(no_screen, little_optimized, capsys):
    import numpy as np

    found = run("05_guidance_gradients.ipynb")
    # Steps have the length that DSG promises; the last has that of the one before.
    slope, radius = np.asarray(found["slope"]), found["radius"]
    expected = np.broadcast_to(np.append(radius[:-1], radius[-2]), slope.shape)
    length = np.asarray(found["measured"]["DSG"])
    np.testing.assert_allclose(length[slope > 0], expected[slope > 0], rtol=1e-4)
    assert (slope[:, 1:] > 0).any(axis=0).all()
    assert np.asarray(found["measured"]["ancestral"])[:, -1].max() < 1e-5
    # Through one prediction and through the chain are the same at the last step.
    np.testing.assert_allclose(found["one"][:, -1], found["whole"][:, -1], atol=1e-4)
    gaps = {name: np.median(gap) for name, gap in found["gaps"].items()}
    assert gaps["end 2"] < 0.6 * gaps["none"]
    assert gaps["all 8"] < gaps["none"]
    assert "guided steps" in capsys.readouterr().out
