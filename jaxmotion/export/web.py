"""A folder of static files: the page on which characters walk in any browser.

    index.html, page.js, worker.js, ort.wasm.packed, models.json
    body.<digest>.bin.packed       skeleton and skinned mesh; models share it
    <model>/character.bin.packed   skeleton, starts, names of all arrays
    <model>/weights.bin.packed     constants that its graphs share, but for the lower
    <model>/fine.bin.packed        bytes of 16-bit floats, and those
    <model>/<graph>.onnx.packed, <graph>.crowd.onnx.packed    for one character, and for
                                   several at once, of whom a crowd is made

Any web server serves it: files are packed already, and the page unpacks them itself.
The page is bundled from the sources in `viz/web` by npm and esbuild. models.json lists
all files that an export wrote, so that the next one can take away what it does not
write again, and nothing else.
"""

import gzip
import hashlib
import json
import lzma
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion import files
from jaxmotion.export import graph, onnx, slim
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.retarget import transfer
from jaxmotion.typing import Exported
from jaxmotion.viz import packed

SOURCES = Path(packed.__file__).with_name("web")
WEIGHTS, FINE = "weights.bin", "fine.bin"
PACKED = ".packed"
LIST = "models.json"
# Characters of a crowd that one call moves, and for whom one call plans: a plan's time
# is of its products, so that more of them would only take longer.
TOGETHER, PLANS = 16, 4
# What a graph takes besides noise, state and command.
SETTINGS = {"scale": jnp.float32(1.0), "locks": jnp.bool_(True)}


def check() -> None:
    """Raises `ValueError` unless Node is there and the packages of the extra are."""
    onnx.check()
    missing = [name for name in ("node", "npm") if shutil.which(name) is None]
    if missing:
        raise ValueError(
            f"the page is bundled by Node 20 or newer: {' and '.join(missing)} not on "
            "the path (see nodejs.org)"
        )


def step_choices(character: Any, wanted: tuple[int, ...]) -> tuple[int, ...]:
    """Numbers of diffusion steps to offer: those wanted, and the model's own.

    Raises:
      ValueError: if one of those wanted is none that the model offers.
    """
    offered = character.tuning.num_steps
    for steps in wanted:
        if steps not in offered:
            raise ValueError(
                f"--steps has {steps}, expected some of {', '.join(map(str, offered))}"
            )
    return tuple(sorted({*wanted, character.tuning.own_steps}))


def functions(character: Any, steps: int) -> dict[str, Exported]:
    """What a tick calls, as functions of the guidance scale and the foot lock too.

    Args:
      character: A `control.steering.Character` with tuning.
      steps: Diffusion steps of a plan.
    """
    tuning, params = character.tuning, character.params

    def tuned(name: str, plain: Exported) -> Exported:
        def run(*arguments: Any) -> Any:
            *rest, scale, locks = arguments
            more = {"locks": locks} if tuning.lockable else {}
            controller = tuning.method(steps, scale, **more)(params)
            return character.exports(controller)[name].function(*rest)

        return Exported(run, (*plain.takes, *SETTINGS), plain.gives)

    plain = character.exports(character.method(params))
    return {name: tuned(name, one) for name, one in plain.items()}


def write_character(
    folder: Path,
    name: str,
    character: Any,
    command: Any,
    *,
    steps: tuple[int, ...] = (),
    say: Callable[[str], None] = lambda line: None,
) -> list[Path]:
    """Writes a character's files; returns their paths.

    Args:
      folder: Its own; its body's file comes beside it, unless it is there.
      name: What the page calls it.
      character: A `control.steering.Character` with tuning.
      command: Of one tick; only its shapes matter.
      steps: Numbers of diffusion steps to offer besides the model's own.
      say: Called with a line for each file.

    Raises:
      OSError: if a file cannot be written.
      ValueError: if a function has no ONNX form that runs, or a number of steps is none
        that the model offers.
    """
    labels = character.labels or (None,)
    states = character.start(labels=list(range(len(labels))))
    arguments = {
        "state": jax.tree.map(lambda x: x[0], states),
        "command": command,
        **SETTINGS,
    }
    names = [port.name for port in graph.ports({"state": states})]
    starts = dict(zip(names, map(np.asarray, jax.tree.leaves(states)), strict=True))
    weights, graphs, runs, written = slim.Weights(WEIGHTS), {}, {}, []
    for number in step_choices(character, steps):
        runs[number] = []
        for which, function in functions(character, number).items():
            # Only these know how many steps a plan takes.
            key = f"{which}@{number}" if which[:4] in ("plan", "step") else which
            key = which if which == "plan_level" else key
            runs[number].append(key)
            if key in graphs:
                continue
            made = graph.make(which, function, arguments)
            places = PLANS if key != "plan_level" and key[:4] == "plan" else TOGETHER
            file, crowd = (
                key.replace("@", ".") + more + onnx.SUFFIX for more in ("", ".crowd")
            )
            for one, where in ((made, file), (graph.together(made, places), crowd)):
                content = slim.slim(onnx.content(one), weights)
                written.append(_write(folder / where, content, say))
            graphs[key] = {
                "file": file,
                "crowd": {"file": crowd, "number": places},
                "inputs": _ports(made.inputs),
                "outputs": _ports(made.outputs),
            }
    about = {
        "format": 1,
        "model": name,
        "fps": character.fps,
        "ahead": character.ahead,
        "source": character.source,
        "labels": list(character.labels),
        "skeleton": packed.skeleton_json(character.skeleton),
        "graphs": graphs,
        "runs": runs,
        "steps": list(runs),
        "num_steps": character.tuning.own_steps,
        "scale": character.tuning.scale,
        "scales": list(character.tuning.scales),
        "lockable": character.tuning.lockable,
        "patience": character.tuning.patience,
        "plan": _arrays(names, ".plan.", cursor=True),
        "past": _arrays(names, ".past."),
        "weights": {"files": [WEIGHTS, FINE], "parts": weights.parts},
    }
    poses = None
    if about["past"]:
        poses = starts[about["past"]["rotation"]]
        poses = poses.reshape(-1, *poses.shape[-2:])
    body = {"skeleton": about["skeleton"], "wear": _wear(character.skeleton, poses)}
    content = packed.pack(body, packed.body_arrays(character.skeleton, poses))
    about["body"] = f"body.{hashlib.sha256(content).hexdigest()[:8]}.bin"
    path = folder.parent / (about["body"] + PACKED)
    written.append(path)
    if not path.exists():
        _write(folder.parent / about["body"], content, say)
    for file, content in zip((WEIGHTS, FINE), weights.packed(), strict=True):
        written.append(_write(folder / file, content, say))
    content = packed.pack(about, starts)
    return [*written, _write(folder / "character.bin", content, say)]


def _wear(skeleton: Skeleton, poses: np.ndarray | None) -> dict[str, Any] | None:
    """What dropped rigs are worn by; None for a skeleton that is no person's."""
    turns = None if poses is None else packed.world_turns(skeleton, poses)
    try:
        return transfer.page_json(transfer.rest(skeleton, rotations=turns))
    except ValueError:
        return None


def _ports(ports: tuple[graph.Port, ...]) -> list[dict[str, Any]]:
    return [{"name": x.name, "dtype": x.dtype, "shape": x.shape} for x in ports]


def _arrays(names: list[str], part: str, **more: bool) -> dict[str, str] | None:
    """Where the state has poses; None for characters without such a part."""
    ends = {"root": "root_position", "rotation": "joint_rotation"}
    found = {
        key: next((x for x in names if part in x and x.endswith(end)), "")
        for key, end in ends.items()
    }
    for key in more:
        found[key] = next((x for x in names if x.endswith(f".{key}")), "")
    return found if all(found.values()) else None


def pack(content: bytes) -> bytes:
    """As gzip, or as LZMA where that is a little smaller: it takes longer to unpack."""
    # No time of day in it: the same content is the same file.
    plain = gzip.compress(content, 9, mtime=0)
    chain = [{"id": lzma.FILTER_LZMA1, "preset": 9 | lzma.PRESET_EXTREME}]
    small = lzma.compress(content, format=lzma.FORMAT_ALONE, filters=chain)
    # The page wants the size, which Python leaves open.
    small = small[:5] + len(content).to_bytes(8, "little") + small[13:]
    return small if len(small) < 0.98 * len(plain) else plain


def _write(path: Path, content: bytes, say: Callable[[str], None]) -> Path:
    """Writes a packed file; its path."""
    path = path.with_name(path.name + PACKED)
    small = pack(content)
    with files.replacing(path) as file:
        file.write(small)
    say(f"{path}: {len(small) / 1e6:.2f} MB ({len(content) / 1e6:.2f} unpacked)")
    return path


def packages(cache: Path) -> Path:
    """The page's packages of npm in `cache`, one for each lock file; made if need be.

    Raises:
      ValueError: if Node is missing, or npm fails.
    """
    check()
    lock = (SOURCES / "package-lock.json").read_bytes()
    place = cache / hashlib.sha256(lock).hexdigest()[:16]
    if not (place / "node_modules" / ".package-lock.json").exists():
        place.mkdir(parents=True, exist_ok=True)
        for name in ("package.json", "package-lock.json"):
            shutil.copyfile(SOURCES / name, place / name)
        _run(["npm", "ci", "--no-audit", "--no-fund"], place)
    return place


def write_page(
    folder: Path,
    *,
    cache: Path,
    say: Callable[[str], None] = lambda line: None,
) -> list[Path]:
    """Bundles the page's sources and writes them and the runtime; returns their paths.

    Args:
      cache: Folder for the packages of npm; those there are used again.

    Raises:
      OSError: if a file cannot be written.
      ValueError: if Node is missing, or npm or esbuild fails.
    """
    place = packages(cache)
    folder.mkdir(parents=True, exist_ok=True)
    runtime = place / "node_modules/onnxruntime-web/dist/ort-wasm-simd-threaded.wasm"
    with tempfile.TemporaryDirectory(dir=place) as build:
        for path in SOURCES.iterdir():
            if path.suffix in (".js", ".html"):
                shutil.copyfile(path, Path(build) / path.name)
        shutil.copyfile(runtime.with_suffix(".mjs"), Path(build) / "loader.mjs")
        for source, made in (("local.js", "page.js"), ("worker.js", "worker.js")):
            options = ["--bundle", "--minify", "--format=esm", "--target=es2022"]
            # Of Node, if the runtime finds itself there.
            options += ["--external:module", "--external:worker_threads"]
            bundler = str(place / "node_modules" / ".bin" / "esbuild")
            out = [f"--outfile={made}.out", "--log-level=error"]
            _run([bundler, source, *options, *out], Path(build))
            shutil.copyfile(Path(build) / f"{made}.out", folder / made)
        shutil.copyfile(Path(build) / "index.html", folder / "index.html")
    written = [folder / made for made in ("index.html", "page.js", "worker.js")]
    for path in written:
        say(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
    return [*written, _write(folder / "ort.wasm", runtime.read_bytes(), say)]


def earlier(folder: Path) -> list[Path]:
    """The files that an earlier export wrote to a folder.

    Raises:
      ValueError: if the folder has an export that does not say what it wrote.
    """
    path = folder / LIST
    if not path.exists():
        return []
    try:
        found = [folder / name for name in json.loads(path.read_bytes())["files"]]
    except (ValueError, KeyError, TypeError):
        raise ValueError(
            f"{path} does not list the files of the export that wrote it, so they "
            "cannot be replaced: take another folder, or delete that one"
        ) from None
    inside = folder.resolve()
    return [x for x in found if x.is_file() and inside in x.resolve().parents]


def finish(folder: Path, models: list[str], written: list[Path]) -> None:
    """Lists models and files, and deletes what only the export before wrote.

    Args:
      models: Names, each of a character's folder there; the first is shown first.
      written: Paths of all files of this export.

    Raises:
      OSError: if the list cannot be written or a file not be deleted.
      ValueError: as `earlier` does.
    """
    old = {path for path in earlier(folder) if path not in written}
    for path in old:
        path.unlink()
        if path.parent != folder and not any(path.parent.iterdir()):
            path.parent.rmdir()
    names = sorted({path.relative_to(folder).as_posix() for path in written})
    listed = {"models": models, "files": names}
    files.write_text(folder / LIST, json.dumps(listed, indent=1) + "\n")


def _run(command: list[str], folder: Path) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        said = [x for x in (done.stderr or done.stdout).splitlines() if x.strip()]
        reason = said[0].strip() if said else f"exit status {done.returncode}"
        raise ValueError(f"{Path(command[0]).name} failed: {reason}")
