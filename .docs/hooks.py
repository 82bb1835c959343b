"""Adds to the site what lies elsewhere in the repository, and renders mathematics.

Pages, pictures and stored results keep their places, so that links between them hold on
a code host and here. Each package gets a page of its modules' docstrings; figures of
the concepts are drawn from the library by figures.py.
"""

import html
import re
import subprocess
import sys
from pathlib import Path

import latex2mathml.converter
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(Path(__file__).parent))

import figures  # noqa: E402

PAGES = (
    *("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "CITATION.cff", "LICENSE"),
    *("experiments/*.md", "experiments/results/*.md", "experiments/guides/*.md"),
    *("experiments/results/*.svg", "experiments/results/*/*.json"),
    "experiments/results/*/*.svg",
    *("experiments/*.gif", "experiments/*.jpg", "benchmarks/*.md"),
    *("jaxmotion/assets/*.md", "jaxmotion/data/*.md", "notebooks/*.ipynb"),
)
PACKAGES = (
    *("diffusion", "motion", "control", "networks", "learning", "evaluation"),
    *("evaluators", "systems", "data", "text", "export", "retarget", "viz"),
)
_MATH = re.compile(r"\$\$(.+?)\$\$|(?<![\\$`])\$(?!\s)([^$\n]+?)\$", re.DOTALL)

_NUMBER = r"-?[\d,]*\.?\d+"
_INTERVAL = re.compile(rf"(?<= )\[{_NUMBER}, {_NUMBER}\](?=<)")

_VERBATIM = re.compile(r"(<(pre|code|script|style|svg|textarea)\b.*?</\2>)", re.DOTALL)


def modules(package: str) -> list[str]:
    """Public modules of a package, dotted, without those that are only imports."""
    folder = ROOT / "jaxmotion" / package
    found = [
        path.relative_to(ROOT).with_suffix("")
        for path in sorted(folder.rglob("*.py"))
        if not path.stem.startswith("_") or path.stem == "__init__"
    ]
    names = [".".join(x.parts).removesuffix(".__init__") for x in found]
    return [x for x in names if "._" not in x]


def api_page(package: str) -> str:
    """A package's page: one section per module."""
    whole = f"jaxmotion.{package.replace('/', '.')}"
    blocks = [
        f"::: {name}\n    options: {{members: {'false' if i == 0 else 'null'}}}\n"
        if name == whole
        else f"::: {name}\n"
        for i, name in enumerate(modules(package))
    ]
    return "\n".join([f"# {whole}\n", *blocks])


def on_config(config):
    """The API's pages in the navigation: the face, then a page per package."""
    nav = [{"The face": "api/face.md"}]
    nav += [{name: f"api/{name}.md"} for name in PACKAGES if name != "systems"]
    nav += [{name: f"api/systems_{name}.md"} for name in systems()]
    config["nav"].append({"API": nav})
    return config


def systems() -> list[str]:
    """Names of the systems' packages."""
    folder = ROOT / "jaxmotion" / "systems"
    return sorted(path.parent.name for path in folder.glob("*/__init__.py"))


@event_priority(100)  # before the plugin that takes notebooks
def on_files(files, config):
    """Adds pages and files of the repository, the API's pages, and figures."""

    def add(place: str, content: str) -> None:
        files.append(File.generated(config, place, content=content))

    tracked = subprocess.run(
        ["git", "ls-files", *PAGES], cwd=ROOT, capture_output=True, text=True
    )
    names = tracked.stdout.split() if tracked.returncode == 0 else []
    found = [ROOT / x for x in names] or [x for p in PAGES for x in ROOT.glob(p)]
    for path in sorted(found):
        place = path.relative_to(ROOT).as_posix()
        files.append(File(place, str(ROOT), config.site_dir, config.use_directory_urls))
    text = "# The face\n\n`import jaxmotion as jm`\n\n::: jaxmotion.face\n"
    add("api/face.md", text)
    for name in PACKAGES:
        if name != "systems":
            add(f"api/{name}.md", api_page(name))
    for name in systems():
        add(f"api/systems_{name}.md", api_page(f"systems/{name}"))
    for name, draw in figures.FIGURES.items():
        add(f"concepts/{name}.svg", draw())
    return files


def mathml(match: re.Match[str]) -> str:
    """A formula in dollars as MathML, which browsers draw by themselves."""
    block, inline = (html.unescape(x or "").strip() for x in match.groups())
    display = "block" if block else "inline"
    return latex2mathml.converter.convert(block or inline, display=display)


def on_page_markdown(markdown, page, config, files):
    """Formulas out of Markdown's way; links to folders, which a site lacks, as text."""
    place = page.file.src_uri
    page.formulas = []

    def formula(match: re.Match[str]) -> str:
        page.formulas.append(mathml(match))
        return f"@@formula{len(page.formulas) - 1}@@"

    if place.startswith(("concepts/", "how-to/", "tour")):
        markdown = _MATH.sub(formula, markdown)
    folder = (ROOT / place).parent

    def link(match: re.Match[str]) -> str:
        return match[1] if (folder / match[2]).is_dir() else match[0]

    return re.sub(r"\[([^\]]+)\]\(([^)#:\s]+)\)", link, markdown)


def on_page_content(content, page, config, files):
    """Formulas as MathML; intervals of tables in one line."""
    content = re.sub(r"@@formula(\d+)@@", lambda x: page.formulas[int(x[1])], content)
    if page.file.src_uri.endswith(".ipynb"):
        # Text alone: not code, nor what programs of the page hold.
        parts = _VERBATIM.split(content)
        parts[::3] = [_MATH.sub(mathml, x) for x in parts[::3]]
        content = "".join(x for i, x in enumerate(parts) if i % 3 != 2)
    return _INTERVAL.sub(lambda x: x[0].replace(" ", "\N{NO-BREAK SPACE}"), content)
