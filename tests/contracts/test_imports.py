"""The import contract: what each package may import, and one door a third party."""

import ast
import builtins
import functools
import symtable
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "jaxmotion"
SYSTEMS = ("aamdm", "camdm", "emdm", "smgdiff")

# Part -> what of jaxmotion it may import besides itself. Imports point down.
BASE = {"typing", "files"}
MAY_IMPORT = {
    "typing.py": set(),
    # Files as they come, for whatever reads or writes one.
    "files.py": set(),
    "diffusion": {"typing"},
    "motion": {"typing"},
    # files: published weights (networks/weight_files.py).
    "networks": BASE,
    "evaluation": {"typing", "motion"},
    "control": {"typing", "motion"},
    "learning": BASE | {"diffusion", "motion"},
    "data": BASE | {"motion"},
    "text": BASE | {"networks"},
    "evaluators": BASE
    | {"motion", "networks", "learning", "evaluation", "data", "text"},
    "systems": BASE
    | {
        "diffusion",
        "motion",
        "networks",
        "control",
        "learning",
        "evaluation",
        "evaluators",
        "data",
        "text",
    },
    # control: the live page (viewer.py). files: pictures are whole or not there.
    "viz": {"typing", "files", "motion", "control"},
    "retarget": {"typing", "files", "motion"},
    # Functions and shapes of whatever system; a graph's noise is an input.
    # motion, viz: the skinned body of a .glb.
    # retarget: motion onto other people's rigs.
    "export": {"typing", "files", "diffusion", "motion", "viz", "retarget"},
    # The face composes what stands below it.
    "face.py": BASE
    | {"motion", "control", "data", "learning", "systems", "viz", "export", "retarget"},
    # learning: versions, as run folders have them.
    "reporting.py": BASE | {"motion", "data", "evaluation", "viz", "learning"},
    # learning: what a training that diverges raises ends a script with one line.
    "cli.py": BASE | {"learning"},
}


# Third party -> where it may be imported (prefixes of paths below the root).
ANYWHERE = {"jax", "jaxtyping", "numpy"}
DOORS = {
    # A baseline is one file, with its own network.
    "flax": (
        "jaxmotion/networks/",
        "jaxmotion/evaluators/network.py",
        *(f"jaxmotion/systems/{name}/network.py" for name in SYSTEMS),
        "experiments/baselines/",
    ),
    "optax": ("jaxmotion/learning/training.py",),
    "orbax": ("jaxmotion/learning/checkpoint.py",),
    "tensorflow_datasets": ("jaxmotion/data/builders/",),
    "scipy": (
        "experiments/next_frame.py",
        "jaxmotion/data/",
        "jaxmotion/evaluation/sequential.py",
        "jaxmotion/evaluation/statistics.py",
    ),
    **dict.fromkeys(("mink", "mujoco"), ("jaxmotion/retarget/robot",)),
    "ufbx": ("jaxmotion/data/fbx.py",),
    "matplotlib": ("jaxmotion/viz/",),
    "PIL": ("jaxmotion/viz/",),
    "tqdm": ("jaxmotion/learning/loop.py", "experiments/", "benchmarks/"),
    "tyro": ("jaxmotion/cli.py", "experiments/", "benchmarks/"),
    "torch": ("benchmarks/",),
    **dict.fromkeys(("jax2onnx", "onnx", "onnxruntime"), ("jaxmotion/export/",)),
    "playwright": ("benchmarks/page.py",),
    "tokenizers": ("jaxmotion/text/",),
    "websockets": ("jaxmotion/viz/page.py",),
    "wordllama": ("jaxmotion/text/",),
}


@functools.cache
def imports(path):
    """Every imported module with the line, and whether it is loaded with the file."""
    found = []

    def visit(node, at_top):
        if isinstance(node, ast.Import):
            found.extend((alias.name, node.lineno, at_top) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            for alias in node.names:
                found.append((f"{node.module}.{alias.name}", node.lineno, at_top))
        at_top = at_top and not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for child in ast.iter_child_nodes(node):
            if not isinstance(child, ast.expr):
                visit(child, at_top)

    visit(ast.parse(path.read_text()), True)
    return found


def files(*folders):
    found = [path for folder in folders for path in sorted(folder.rglob("*.py"))]
    assert found
    return found


def relative(path):
    return path.relative_to(ROOT).as_posix()


LIBRARY = files(PACKAGE)
SCRIPTS = files(ROOT / "experiments", ROOT / "benchmarks")


def owner(path):
    """The entry of MAY_IMPORT that a file falls under; None for __init__.py."""
    parts = path.relative_to(PACKAGE).parts
    if parts == ("__init__.py",):
        return None
    assert parts[0] in MAY_IMPORT, f"{relative(path)} is in no known part"
    return parts[0]


def test_imports_point_down():
    wrong = []
    for path in LIBRARY:
        part = owner(path)
        for name, line, _ in imports(path) if part else ():
            head, *rest = name.split(".")
            allowed = head not in ("experiments", "benchmarks", "tests")
            if head == "jaxmotion":
                allowed = rest[0] in MAY_IMPORT[part] | {part}
                if part == rest[0] == "systems" and path.parent.name != "systems":
                    allowed = rest[1] == path.parent.name  # never another system
            if not allowed:
                wrong.append(f"{relative(path)}:{line} imports {name}")
    assert not wrong, "\n".join(wrong)


def test_third_parties_come_through_their_doors():
    wrong = []
    for path in LIBRARY + SCRIPTS:
        for name, line, _ in imports(path):
            head = name.split(".")[0]
            known = {*sys.stdlib_module_names, *ANYWHERE, "jaxmotion"}
            # Scripts import the modules beside them by their bare names.
            beside = path.with_stem(head).exists() or path.with_name(head).is_dir()
            beside = beside or path.parent.name == head  # a package's own modules
            if head in known or (path in SCRIPTS and beside):
                continue
            if not any(relative(path).startswith(d) for d in DOORS.get(head, ())):
                wrong.append(f"{relative(path)}:{line} imports {name}")
    assert not wrong, "\n".join(wrong)


def test_what_is_slow_to_load_is_loaded_when_used():
    """Only builders load tensorflow-datasets and only viz matplotlib: in functions."""
    inside = {"jaxmotion.data.builders": "builders", "jaxmotion.viz": "viz"}
    # What is drawn, which is NumPy alone.
    light = tuple(f"jaxmotion.viz.{x}" for x in ("mannequin", "packed", "stage"))
    wrong = [
        f"{relative(path)}:{line} imports {name}"
        for path in LIBRARY
        for name, line, at_top in imports(path)
        for module, folder in inside.items()
        if name.startswith(module) and folder not in path.parts and at_top
        if not name.startswith(light)
    ]
    assert not wrong, "\n".join(wrong)


def test_no_cycles():
    modules = {}
    for path in LIBRARY:
        name = relative(path).removesuffix(".py").removesuffix("/__init__")
        modules[name.replace("/", ".")] = path
    edges = {}
    for name, path in modules.items():
        found = set()
        for target, _, at_top in imports(path):
            while at_top and target not in modules and "." in target:
                target = target.rpartition(".")[0]
            if at_top and target in modules and modules[target].name != "__init__.py":
                found.add(target)
        edges[name] = found - {name}
    done, path = set(), []

    def visit(name):
        assert name not in path, " -> ".join([*path, name])
        if name in done:
            return
        path.append(name)
        for target in sorted(edges[name]):
            visit(target)
        path.pop()
        done.add(name)

    for name in modules:
        visit(name)


def unknown_names(table, known):
    """Names that a scope, or one within it, takes from the module, which lacks them."""
    for symbol in table.get_symbols():
        if symbol.is_global() and symbol.get_name() not in known:
            yield symbol.get_name()
    for child in table.get_children():
        yield from unknown_names(child, known)


def test_every_name_is_defined():
    """Lint cannot say so: it takes the words of jaxtyping's shapes for names."""
    paths = LIBRARY + SCRIPTS + files(ROOT / "tests")
    always = {*dir(builtins), "__file__", "__path__"}
    wrong = []
    for path in paths:
        table = symtable.symtable(path.read_text(), str(path), "exec")
        own = {s.get_name() for s in table.get_symbols() if s.is_assigned()}
        own |= {s.get_name() for s in table.get_symbols() if s.is_imported()}
        unknown = sorted(set(unknown_names(table, own | always)))
        wrong += [f"{relative(path)}: {name}" for name in unknown]
    assert not wrong, "\n".join(wrong)
