"""The README says what is so: its programs run, its commands parse, its links lead."""

import importlib.util
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import tyro

from jaxmotion import cli

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = {
    path: path.read_text(encoding="utf-8")
    for pattern in ("*/README.md", "jaxmotion/*/*.md", "experiments/*/*.md", "*.md")
    for path in sorted(ROOT.glob(pattern))
}


def blocks(language, text):
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def commands():
    """Commands of all pages' shell blocks, each as its words."""
    whole = [block for text in PAGES.values() for block in blocks("bash", text)]
    lines = [line for block in whole for line in block.splitlines()]
    parts = [part for line in lines for part in line.split("&&") if part.strip()]
    return [shlex.split(part) for part in parts]


SCRIPTS = sorted(
    {tuple(w) for w in commands() if w[0] == "python" and w[1].endswith(".py")}
)


def test_the_readme_is_short():
    assert len(README.splitlines()) <= 200


@pytest.mark.slow
def test_programs_run_as_they_stand(tmp_path):
    """In a process and a folder of their own, one after the other."""
    programs = blocks("python", README)
    assert len(programs) == 4
    # Whether they run is the question: unoptimized programs compile in a third.
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    }
    done = subprocess.run(
        [sys.executable, "-W", "error::FutureWarning", "-c", "\n".join(programs)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["walk.gif"]


@pytest.mark.parametrize("words", SCRIPTS, ids=lambda words: " ".join(words[1:3]))
def test_commands_parse(words, monkeypatch):
    """The script exists and knows the arguments."""
    _, script, *arguments = words
    if "--" in arguments:  # another script's command
        at = arguments.index("--")
        name, *theirs = arguments[at + 1 :]
        test_commands_parse(("python", f"experiments/{name}.py", *theirs), monkeypatch)
        arguments = arguments[:at]
    path = ROOT / script
    monkeypatch.syspath_prepend(str(path.parent))
    spec = importlib.util.spec_from_file_location(f"readme_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    # A dataclass looks itself up in its module.
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
        several = getattr(module, "COMMANDS", None)
        kind = cli.kind_of(several) if several else module.Config
        parsed = tyro.cli(kind, args=arguments)
    finally:
        del sys.modules[spec.name]
    values = [a for a in arguments if not a.startswith("--")]
    assert all(v in f"{vars(parsed)}{type(parsed).__name__.lower()}" for v in values)


def test_start_commands():
    installs = [words for words in commands() if words[0] == "pip"]
    assert {" ".join(words[:3]) for words in installs} == {"pip install -e"}
    # .ci/run looks for this line.
    assert '\npip install -e ".[test]" && pytest\n' in README
    assert ("python", "experiments/quickstart.py") in SCRIPTS


def test_links_lead_somewhere():
    def wrong(path, link):
        name, _, anchor = link.partition("#")
        page = (path.parent / name).resolve() if name else path
        if not page.exists():
            return True
        return bool(anchor) and anchor not in anchors(page.read_text(encoding="utf-8"))

    found = {
        (str(path.relative_to(ROOT)), link)
        for path, text in PAGES.items()
        for link in re.findall(r"\]\((?!https?:)([^)]+)\)", text)
        if wrong(path, link)
    }
    assert not found


def anchors(text):
    """What a site makes of a page's headings."""
    heads = re.findall(
        r"^#+ (.+)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.M
    )
    return {re.sub(r"[^\w -]", "", head).lower().replace(" ", "-") for head in heads}


def test_scripts_and_options_that_the_text_names():
    for text in PAGES.values():
        for name in re.findall(r"`(?:python )?(?:[\w/]+/)?(\w+\.py)`", text):
            assert list(ROOT.glob(f"**/{name}")), name
    from jaxmotion.systems.camdm import controller as camdm_controller
    from jaxmotion.systems.camdm import model as camdm_model

    # The table's defaults and the released constants.
    default, released = camdm_controller.Control(), camdm_controller.RELEASED
    assert camdm_model.Config(num_joints=22, num_labels=8).num_steps == 8
    assert (default.guidance_scale, released.guidance_scale) == (0.7, 0.5)
    assert (default.guided_plans, released.guided_plans) == (1, 2)
    assert (default.guide_start, released.guide_start) == (False, True)
    assert (default.reuse, released.reuse) == (15, 23)
    assert (default.replan_on_change, released.replan_on_change) == (True, False)
    assert (default.bias_position, released.bias_position) == (0.7, 0.4)
    assert (default.apply, released.apply, default.follow) == (15, 15, 0.0)


def test_our_own_options_are_off_by_default():
    from jaxmotion.systems import camdm
    from jaxmotion.systems.camdm import model as camdm_model
    from jaxmotion.systems.camdm import training as camdm_training

    about = camdm.__doc__
    config = camdm_model.Config(num_joints=22, num_labels=8)
    assert camdm_training.PRESETS["paper"] == {}
    small = camdm_training.PRESETS["small"]
    for name, off in (
        ("frames_per_token", 1),
        ("token_margin", 0),
        ("heading", "random"),
        ("rotation_scale", 1.0),
        ("norm", "post"),
    ):
        assert getattr(config, name) == off
        assert f"`{name}={small[name]}`" in about or (
            f'`{name}="{small[name]}"`' in about
        )
    assert small["dropout"] == 0.0


def test_version_is_the_same_everywhere():
    import jaxmotion

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert project["version"] == jaxmotion.__version__
    assert f"\nversion: {jaxmotion.__version__}\n" in citation
    assert jaxmotion.__version__ in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert citation.count("  - type: ") == 4


def test_imports_load_no_more_than_they_need():
    """One process: the package, then the registry, then what reads data sets."""
    heavy = ["tensorflow_datasets", "tensorflow", "matplotlib", "orbax", "torch"]
    code = f"""
import sys, jaxmotion
print([m for m in {heavy} if m in sys.modules])
import jaxmotion.systems.registry
print([m for m in sys.modules if m.startswith("jaxmotion.systems.")])
from jaxmotion.data.builders import (
    bandai_namco, base, humanact12, humanml3d, lafan1, style100
)
print("tensorflow" in sys.modules)
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.splitlines() == ["[]", "['jaxmotion.systems.registry']", "False"]
