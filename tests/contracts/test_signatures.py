"""How public functions look: annotations, argument order, keywords, loose ends.

Each test holds one rule and lists everything that breaks it.
"""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "jaxmotion").rglob("*.py"))
TREES = {path: ast.parse(path.read_text()) for path in FILES}

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
    "character",  # with its parameters
    "model",  # a character, in the face
    "run_chunk",
    "sample",
    "function",
    "generate",
    "self",
}


def relative(path):
    return path.relative_to(ROOT).as_posix()


def functions(path):
    """Public functions of a module and public methods of its public classes."""
    for node in TREES[path].body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield node, node.name
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            for item in node.body:
                if isinstance(item, ast.FunctionDef):
                    if not item.name.startswith("_") or item.name == "__call__":
                        yield item, f"{node.name}.{item.name}"


PUBLIC = [
    (f"{relative(path)}:{node.lineno} {name}", node)
    for path in FILES
    for node, name in functions(path)
]


def arguments(node):
    names = [a.arg for a in node.args.posonlyargs + node.args.args]
    return [name for name in names if name not in ("self", "cls")]


def test_annotations_are_complete():
    wrong = []
    for where, node in PUBLIC:
        for a in node.args.posonlyargs + node.args.args + node.args.kwonlyargs:
            if a.annotation is None and a.arg not in ("self", "cls", "scale"):
                wrong.append(f"{where}: {a.arg}")
        if node.returns is None and node.name != "setup":
            wrong.append(f"{where}: its result")
    assert not wrong, "\n".join(wrong)


def test_params_come_first_then_the_key():
    wrong = []
    for where, node in PUBLIC:
        names = arguments(node)
        if "params" in names and not set(names[: names.index("params")]) <= {"path"}:
            wrong.append(f"{where}: params is not the first argument")
        if "key" in names and not set(names[: names.index("key")]) <= BEFORE_KEY:
            wrong.append(f"{where}: {names[: names.index('key')]} before the key")
    assert not wrong, "\n".join(wrong)


def test_hyperparameters_are_keywords():
    """The only defaults of positional arguments are None and (): nothing given."""
    wrong = [
        f"{where}: {ast.unparse(default)} can be given by position"
        for where, node in PUBLIC
        for default in node.args.defaults
        if ast.unparse(default) not in ("None", "()")
    ]
    assert not wrong, "\n".join(wrong)


def test_modules_say_what_they_are_for():
    wrong = [
        relative(p) for p, t in TREES.items() if t.body and not ast.get_docstring(t)
    ]
    assert not wrong, "\n".join(wrong)


def test_no_old_style_keys_and_no_loose_ends():
    words = (
        "PRNGKey",
        "NotImplementedError",
        "TODO",
        "FIXME",
        "allow_pickle=True",
    )
    wrong = [
        f"{relative(path)} has {word}"
        for path in FILES
        for word in words
        if word in path.read_text()
    ]
    assert not wrong, "\n".join(wrong)
