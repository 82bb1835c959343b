"""A character leaves Python: its run-time as ONNX or StableHLO.

Writes to a folder: the graphs; character.json (names, shapes and meanings of all
arrays, the order of calls, the skeleton); start.npz (how a character starts, for each
label); for ONNX also player.py, which needs onnxruntime and NumPy alone and steers the
character for ten seconds. A run of EMDM gives the graph of its sampler.

The format web is a folder of static files for one or several models: a page on which
they walk in any browser, with nothing installed (needs Node, to bundle it).

Examples:
  python experiments/export.py --model locomotion --format onnx --out runs/onnx
  python experiments/export.py --format web --model locomotion dribble --out site
  python -m http.server -d site
"""

import dataclasses
import json
import shutil
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

import jaxmotion as jm
from jaxmotion import cli, face, files
from jaxmotion.control.foot_lock import lock_feet
from jaxmotion.control.steering import steered as steered_character
from jaxmotion.export import graph, onnx, stablehlo, web
from jaxmotion.learning import loop, model_json, runs
from jaxmotion.systems import registry

FORMATS = {"onnx": onnx, "stablehlo": stablehlo}
CONVENTIONS = (
    "meters, seconds, radians; y up, right-handed; vectors on the ground are (x, z), "
    "and a character that starts faces +z. Rotations are parent-local (the root's "
    "global), six numbers: the first two columns of the matrix, one after the other."
)
CALLS = {
    "step": ["state, frame = step(noise, state, command)"],
    "sample": ["motion = sample(noise, condition)"],
    "advance": [
        "level = plan_level(state, command)",
        "if level == 1: state = plan(noise, state, command)",
        "if level == n > 1: state = plan_n(noise, state, command)",
        "state, frame = advance(state, command)",
    ],
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Writes the graphs of a shipped model or a run.

    Attributes:
      model: Names of shipped models; several for the format web.
      run: Run folder of any system, or an exported file, in their place.
      out: Folder to write to.
      format: onnx, stablehlo or web.
      steps: Numbers of diffusion steps that the page offers besides the model's own.
      batch: one (arrays have no axis for characters), a number, or any.
      foot_lock: Planted feet stay; None as jm.load has it (on for shipped models). Not
        of whole motions, which are what the network makes.
      cache: Folder for the packages of npm that the page is made of.
      row: EMDM's row.
      scale: EMDM's guidance; None for the paper's.
    """

    model: cli.Names = ()
    run: Path | None = None
    out: Path = Path("runs/export")
    format: str = "onnx"
    steps: tuple[int, ...] = ()
    cache: Path = Path.home() / ".cache" / "jaxmotion" / "web"
    batch: str = "one"
    foot_lock: bool | None = None
    row: str = "emdm"
    scale: float | None = None


def refuse(args: Config, names: tuple[str, ...], what: str) -> None:
    """Raises `ValueError` for an option that would say nothing."""
    for name in names:
        if (value := getattr(args, name)) != getattr(Config(), name):
            option = name.replace("_", "-")
            raise ValueError(f"--{option} is {value}, but {what} has no such choice")


def batch_of(text: str) -> graph.Batch:
    """What --batch asks for."""
    if text in ("one", graph.ANY):
        return None if text == "one" else text
    if not text.isdecimal() or not 1 <= int(text) <= 10**6:
        raise ValueError(
            f"--batch is {text!r}, expected 'one', a number of characters, or 'any'"
        )
    return int(text)


def steered(character: Any) -> tuple[dict, dict, dict, dict]:
    """Functions, arguments, facts and starts of a steered character."""
    functions = character.exports(character.method(character.params))
    labels = character.labels or (None,)
    states = character.start(labels=list(range(len(labels))))
    command = jm.commands("stand", character, 1, seconds=1.0)
    first = lambda tree: jax.tree.map(lambda x: x[0], tree)  # noqa: E731
    arguments = {"state": first(states), "command": first(first(command))}
    names = [port.name for port in graph.ports({"state": states})]
    starts = dict(zip(names, map(np.asarray, jax.tree.leaves(states)), strict=True))
    facts = {
        "fps": character.fps,
        "source": character.source,
        "labels": list(character.labels),
        "skeleton": model_json.skeleton_to_json(character.skeleton),
    }
    return functions, arguments, facts, starts


def export_page(args: Config) -> None:
    """Writes the folder of the page, for shipped models or a run."""
    web.check()
    loop.check_writable(args.out)
    web.earlier(args.out)
    sources = {name: name for name in args.model}
    if args.run is not None:
        sources = {args.run.stem: args.run}
    say = lambda line: print(line, flush=True)  # noqa: E731
    loaded = {}
    for name, what in sources.items():  # before any work that takes long
        character = steered_character(jm.load(what, foot_lock=False), what=str(what))
        if args.foot_lock is not False and character.skeleton.feet:
            character = lock_feet(character)
        web.step_choices(character, args.steps)
        loaded[name] = character
    written = web.write_page(args.out, cache=args.cache, say=say)
    for name, character in loaded.items():
        tick = jax.tree.map(
            lambda x: x[0, 0], jm.commands("stand", character, 1, seconds=1.0)
        )
        written += web.write_character(
            args.out / name, name, character, tick, steps=args.steps, say=say
        )
    web.finish(args.out, list(loaded), written)
    print(f"python -m http.server -d {args.out}")


def earlier(folder: Path) -> set[Path]:
    """What the export before wrote there: graphs, starts and the player.

    `ValueError` if its list is none of an export.
    """
    path = folder / "character.json"
    if not path.exists():
        return set()
    graphs = files.read_object(path, what="a character").get("graphs")
    listed = [*graphs.values()] if isinstance(graphs, dict) else [None]
    names = [x.get("file") if isinstance(x, dict) else None for x in listed]
    if not all(isinstance(x, str) and Path(x).name == x for x in names):
        raise ValueError(f"{path} lists no graphs: expected a folder of its own")
    return {folder / str(name) for name in (*names, "start.npz", "player.py")}


def export(args: Config) -> None:
    """Loads, converts, and writes.

    Raises:
      OSError: if the model cannot be read or the folder not be written.
      ValueError: if an option is wrong, a package missing, or a function has no form
        in the format.
    """
    cli.check(args)
    batch = batch_of(args.batch)
    if args.format not in (*FORMATS, "web"):
        raise ValueError(
            f"--format is {args.format!r}, expected one of {', '.join(FORMATS)}, web"
        )
    if (not args.model) == (args.run is None):
        raise ValueError("expected either --model or --run")
    if args.format == "web":
        refuse(args, ("batch", "row", "scale"), "a page")
        return export_page(args)
    refuse(args, ("steps", "cache"), f"the format {args.format}")
    if len(args.model) > 1:
        raise ValueError(
            f"--model has {len(args.model)} names, expected one (but for --format web)"
        )
    source = args.model[0] if args.run is None else args.run
    path = files.SHIPPED.get(args.model[0]) if args.run is None else args.run
    system = None
    if path is not None:
        system = registry.get(str(face.system_of(path)))
    whole = None if system is None or system.steerable else system
    if whole is None:
        refuse(args, ("row", "scale"), "a model that is steered")
    else:
        refuse(args, ("foot_lock",), "a model of whole motions")
    writer = FORMATS[args.format]
    writer.check()
    loop.check_writable(args.out)
    if whole is not None:
        functions, condition, facts = whole.room("evaluation").exports(
            path, row=args.row, scale=args.scale
        )
        arguments, starts = {"condition": condition}, {}
    else:
        character = jm.load(source, foot_lock=args.foot_lock)
        functions, arguments, facts, starts = steered(character)
    # All of it into a folder of its own first: who stops keeps the export before.
    old, graphs, new = earlier(args.out), {}, args.out / ".new"
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir(parents=True)
    for name, function in functions.items():
        begun, path = time.perf_counter(), new / (name + writer.SUFFIX)
        made = graph.make(name, function, arguments)
        writer.write(path, made, batch=batch)
        graphs[name] = graph.to_json(made, path.name, batch=batch)
        size, seconds = path.stat().st_size / 1e6, time.perf_counter() - begun
        print(f"{args.out / path.name}: {size:.2f} MB, {seconds:.0f} s", flush=True)
    kind = next(name for name in CALLS if name in graphs)
    about = {
        "format": 1,
        "model": str(source),
        **facts,
        "conventions": CONVENTIONS,
        "batch": batch,
        "calls": CALLS[kind],
        "noise": "standard normal, drawn anew for each call",
        "graphs": graphs,
        "versions": runs.versions(),
    }
    if starts:
        files.write_arrays(new / "start.npz", starts)
    if starts and args.format == "onnx" and batch is None:
        player = Path(jm.__file__).with_name("export") / "player.py"
        shutil.copyfile(player, new / player.name)
    listed = args.out / "character.json"
    for path in {listed, *old}:
        path.unlink(missing_ok=True)
    for path in new.iterdir():
        path.replace(args.out / path.name)
    new.rmdir()
    files.write_text(listed, json.dumps(about, indent=1) + "\n")
    print(f"{args.out / 'character.json'}: {', '.join(graphs)}")


def main() -> None:
    """Parses the command line and exports."""
    export(tyro.cli(Config, description=__doc__))


if __name__ == "__main__":
    cli.start(main)
