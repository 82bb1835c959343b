"""How many small faults the tests find: comparisons, signs, numbers and conditions.

Faults are planted one at a time into a copy of the repository, evenly over a module's
code (not its annotations and texts), and the tests that touch
the module run until one fails. Those that nothing finds are listed: some change
nothing that anybody could see (a bound that is never met, a message).

python -m tests.planted_faults                 all modules, 40 faults each
python -m tests.planted_faults chain bvh       of some modules
python -m tests.planted_faults chain --count 9 fewer faults
"""

import argparse
import ast
import json
import multiprocessing
import os
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
# Module -> the tests that touch it.
MODULES = {
    "bvh": ("data/bvh.py", "data/test_bvh.py data/test_bvh_text.py fuzz/test_bvh.py"),
    "checkpoint": (
        "learning/checkpoint.py",
        "learning/test_checkpoint.py learning/test_loop.py learning/test_runs.py",
    ),
    "chain": ("diffusion/chain.py", "diffusion/test_chain.py diffusion"),
    "schedule": ("diffusion/schedule.py", "diffusion/test_schedule.py"),
    "foot_lock": ("control/foot_lock.py", "control/test_foot_lock.py"),
}
# A fault with which tests never end counts as found: after so many times the unfaulted
# run's time of the processor, which other processes hardly lengthen, or so long.
TIMES, SECONDS = 4, 1800
COMPARE = {
    ast.Lt: "<=",
    ast.LtE: "<",
    ast.Gt: ">=",
    ast.GtE: ">",
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.Is: "is not",
    ast.IsNot: "is",
    ast.In: "not in",
    ast.NotIn: "in",
}
ARITHMETIC = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.Pow: "*"}
BOOLEAN = {ast.And: "or", ast.Or: "and", ast.BitAnd: "|", ast.BitOr: "&"}


def _code(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes of code, without annotations and texts."""
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            is_text = isinstance(child, ast.JoinedStr) or (
                isinstance(child, ast.Constant) and isinstance(child.value, str)
            )
            if isinstance(child, ast.AST) and not is_text:
                yield from _code(child)


def _changed(node: ast.AST) -> str | None:
    """What stands in a node's place where it is at fault; None where nothing does."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        left, right = ast.unparse(node.left), ast.unparse(node.comparators[0])
        return f"(({left}) {COMPARE[type(node.ops[0])]} ({right}))"
    if isinstance(node, ast.BinOp):
        sign = (ARITHMETIC | BOOLEAN).get(type(node.op))
        left, right = ast.unparse(node.left), ast.unparse(node.right)
        return f"(({left}) {sign} ({right}))" if sign else None
    if isinstance(node, ast.BoolOp):
        sign = f" {BOOLEAN[type(node.op)]} "
        return f"({sign.join(f'({ast.unparse(x)})' for x in node.values)})"
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
        return f"({ast.unparse(node.operand)})"
    if isinstance(node, ast.IfExp):
        test, body, other = map(ast.unparse, (node.test, node.body, node.orelse))
        return f"(({other}) if ({test}) else ({body}))"
    if isinstance(node, ast.Constant) and isinstance(node.value, bool):
        return str(not node.value)
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        more = 1 if isinstance(node.value, int) else 0.1 * node.value + 0.01
        return f"({node.value + more!r})"
    return None


def faults(source: str) -> list[tuple[str, str]]:
    """What was changed, in a line, and the whole source with it, of every fault."""
    raw = source.encode().splitlines(keepends=True)
    starts = [0]
    for line in raw:
        starts.append(starts[-1] + len(line))
    text, found = source.encode(), []
    for node in _code(ast.parse(source)):
        new = _changed(node)
        if new is None:
            continue
        begin = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        old = text[begin:end].decode()
        planted = (text[:begin] + new.encode() + text[end:]).decode()
        try:
            ast.parse(planted)
        except SyntaxError:  # within a pattern, or a text
            continue
        said = f"line {node.lineno}: {' '.join(old.split())} -> {new}"
        found.append((begin, said, planted))
    return [(said, planted) for _, said, planted in sorted(found)]


def _spread(all_: list, count: int) -> list:
    """So many of them, evenly from the first to the last."""
    if len(all_) <= count:
        return all_
    return [all_[round(i * (len(all_) - 1) / (count - 1))] for i in range(count)]


def _run(folder: Path, tests: list[str], said: Path, most: int | None) -> None:
    import pytest

    if most:
        resource.setrlimit(resource.RLIMIT_CPU, (most, most))
    os.chdir(folder)
    output = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    sys.path[0] = str(folder)
    for name in [name for name in sys.modules if name.partition(".")[0] == "tests"]:
        del sys.modules[name]  # of this repository, not of the copy
    options = ["-x", "-q", "-n", "0", "-p", "no:cacheprovider", "-p", "no:randomly"]
    os._exit(int(pytest.main([*options, *tests])))


def passes(folder: Path, tests: list[str], said: Path, most: int | None = None) -> bool:
    """Whether tests of a copy pass within so many seconds of processor's time.

    They run in a process of their own; what they print goes to the file `said`.
    """
    process = multiprocessing.get_context("fork").Process(
        target=_run, args=(folder, tests, said, most)
    )
    process.start()
    process.join(SECONDS)
    if process.is_alive():
        process.kill()
        process.join()
    return process.exitcode == 0


def _spent() -> float:
    """Seconds of processor's time of all processes that ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("modules", nargs="*", choices=[*MODULES, []])
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    # As tests/conftest.py sets them; the forked processes have JAX already.
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.0")
    result = {}
    with tempfile.TemporaryDirectory() as place:
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", f"{place}/cache")
        import beartype  # noqa: F401
        import flax  # noqa: F401
        import hypothesis  # noqa: F401
        import jax  # noqa: F401
        import scipy.stats  # noqa: F401

        folder, said_by_tests = Path(place) / "copy", Path(place) / "output"
        shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(".git", "runs"))
        for name in args.modules or MODULES:
            path, tests = MODULES[name]
            tests = [f"tests/{one}" for one in tests.split()]
            module = folder / "jaxmotion" / path
            source = module.read_text()
            before = _spent()
            if not passes(folder, tests, said_by_tests):
                tail = said_by_tests.read_text()[-2000:]
                sys.exit(f"{name}: its tests fail without a fault\n{tail}")
            most = 10 + round(TIMES * (_spent() - before))
            left, began = [], time.perf_counter()
            planted = _spread(faults(source), args.count)
            for said, changed in planted:
                module.write_text(changed)
                if passes(folder, tests, said_by_tests, most):
                    left.append(said)
                    print(f"  not found: {name}.py {said}", flush=True)
            module.write_text(source)
            found, took = len(planted) - len(left), time.perf_counter() - began
            result[name] = {"found": found, "planted": len(planted), "left": left}
            print(f"{name}: {found} of {len(planted)} found, {took:.0f} s", flush=True)
    if args.out:
        args.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
