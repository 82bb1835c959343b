"""How public functions look: argument order, keywords, docstrings, lengths."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / "jaxmotion").rglob("*.py"))
MAX_FILE, MAX_FUNCTION = 300, 40
# The steps of a parser: documented in a line each, used in one place.
INTERNAL = {"Hierarchy"}

# What may stand before `key`: parameters and states, and what a function composes.
BEFORE_KEY = {
    "params",
    "other",  # the other player's, in adversarial training
    "generator",
    "discriminator",
    "state",
    "table",
    "schedule",
    "step",
    "controller",
    "run_chunk",
    "sample",
    "generate",
    "self",
}


def relative(path):
    return path.relative_to(ROOT).as_posix()


def functions(path):
    """Public functions of a module and public methods of its public classes."""
    tree = ast.parse(path.read_text())
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield node, node.name
        if isinstance(node, ast.ClassDef):
            for item in node.body:
                if isinstance(item, ast.FunctionDef) and not node.name.startswith("_"):
                    if not item.name.startswith("_") or item.name == "__call__":
                        yield item, f"{node.name}.{item.name}"


PUBLIC = [(path, node, name) for path in FILES for node, name in functions(path)]
each = pytest.mark.parametrize(
    ("path", "node", "name"),
    PUBLIC,
    ids=[f"{relative(path)}:{name}" for path, _, name in PUBLIC],
)


def arguments(node):
    names = [a.arg for a in node.args.posonlyargs + node.args.args]
    return [name for name in names if name not in ("self", "cls")]


def all_arguments(node):
    extra = [a for a in (node.args.vararg, node.args.kwarg) if a]
    return arguments(node) + [a.arg for a in node.args.kwonlyargs + extra]


def is_protocol(path, name):
    tree = ast.parse(path.read_text())
    owner = name.split(".")[0]
    return any(
        isinstance(node, ast.ClassDef)
        and node.name == owner
        and any(isinstance(b, ast.Name) and b.id == "Protocol" for b in node.bases)
        for node in tree.body
    )


@each
def test_docstrings_say_what_goes_in_and_out(path, node, name):
    where = f"{relative(path)}:{node.lineno} {name}"
    text = ast.get_docstring(node)
    assert text, f"{where} has no docstring"
    names = all_arguments(node)
    if is_protocol(path, name) or name.split(".")[0] in INTERNAL or not names:
        return
    assert "Args:" in text, where
    described = text.split("Args:")[1]
    for argument in names:
        found = re.search(rf"^ *\**{argument}: ", described, re.MULTILINE)
        assert found, f"{where} does not describe {argument}"
    returns = node.returns is not None and ast.unparse(node.returns) != "None"
    if returns and not ast.unparse(node.returns).startswith("Iterator"):
        assert "Returns:" in text, where


@each
def test_annotations_are_complete(path, node, name):
    where = f"{relative(path)}:{node.lineno} {name}"
    listed = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
    missing = [
        a.arg
        for a in listed
        if a.annotation is None and a.arg not in ("self", "cls", "scale")
    ]
    assert not missing, f"{where} does not annotate {missing}"
    assert node.returns is not None or node.name == "setup", where


@each
def test_params_come_first_then_the_key(path, node, name):
    where = f"{relative(path)}:{node.lineno} {name}"
    names = arguments(node)
    if "params" in names:
        before = set(names[: names.index("params")])
        assert before <= {"path"}, f"{where}: params is not the first argument"
    if "key" in names:
        before = set(names[: names.index("key")])
        assert before <= BEFORE_KEY, f"{where}: {before} before the key"


@each
def test_hyperparameters_are_keywords(path, node, name):
    """The only defaults of positional arguments are None and (): nothing given."""
    for default in node.args.defaults:
        found = ast.unparse(default)
        where = f"{relative(path)}:{node.lineno} {name}"
        assert found in ("None", "()"), f"{where}: {found} can be given by position"


@pytest.mark.parametrize("path", FILES, ids=relative)
def test_lengths(path):
    lines = path.read_text().splitlines()
    assert len(lines) <= MAX_FILE, f"{relative(path)} has {len(lines)} lines"
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.FunctionDef):
            continue
        first = node.body[0]
        if ast.get_docstring(node) is not None:
            first = node.body[1] if len(node.body) > 1 else None
        if first is None:
            continue
        length = node.end_lineno - first.lineno + 1
        where = f"{relative(path)}:{node.name}"
        assert length <= MAX_FUNCTION, f"{where} has {length} lines"


@pytest.mark.parametrize("path", FILES, ids=relative)
def test_modules_say_what_they_are_for(path):
    tree = ast.parse(path.read_text())
    assert not tree.body or ast.get_docstring(tree), relative(path)


@pytest.mark.parametrize("path", FILES, ids=relative)
def test_no_old_style_keys_and_no_loose_ends(path):
    text = path.read_text()
    for word in (
        "PRNGKey",
        "NotImplementedError",
        "TODO",
        "FIXME",
        "allow_pickle=True",
    ):
        assert word not in text, f"{relative(path)} has {word}"
