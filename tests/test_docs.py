"""The documentation site: strictly built, with pages, shapes, formulas and pictures."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_the_site_builds_strictly(tmp_path):
    for name in ("mkdocs", "material", "mkdocstrings", "mkdocs_jupyter"):
        pytest.importorskip(name, reason='pip install -e ".[docs]"')
    pytest.importorskip("latex2mathml", reason='pip install -e ".[docs]"')
    words = ["mkdocs", "build", "--strict", "-f", ".docs/mkdocs.yml", "-d", tmp_path]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        [sys.executable, "-m", *map(str, words)],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "WARNING" not in done.stderr

    def page(name):
        return (tmp_path / name / "index.html").read_text(encoding="utf-8")

    assert "locomotion.gif" in page("")
    for name in ("chain", "denoiser", "schedule", "controller"):
        assert f"{name}.svg" in page(f"concepts/{name}")
        assert (tmp_path / "concepts" / f"{name}.svg").stat().st_size > 5000
    assert page("concepts/chain").count("<math") > 5
    notebook = page("notebooks/01_one_chain")
    assert "<math" in notebook and "data:image/png" in notebook
    # Shapes stand in the API as they are written.
    assert "*shape" in page("api/diffusion") and "schedule.posterior" in page(
        "api/diffusion"
    )
    assert (tmp_path / "experiments/results/camdm/steering.json").exists()
