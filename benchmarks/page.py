"""What the page without a server weighs, and how it runs in a browser without a GPU.

Needs Playwright and Chromium (its own or the system's). A person is told to walk, and
what the page says of itself is read: milliseconds of its plans and ticks, of the main
thread without drawing, and ticks per second, which are real time where they are the
model's. Memory is of the browser's renderer.

Example:
  python experiments/export.py --format web --model locomotion dribble --out site
  python benchmarks/page.py --site site --characters 1 16
"""

import contextlib
import dataclasses
import functools
import http.server
import json
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import suite

from jaxmotion import cli

# Drawn without a GPU.
OPTIONS = (
    "--no-sandbox --disable-background-networking --use-gl=angle "
    "--use-angle=swiftshader --enable-unsafe-swiftshader"
).split()
# Each frame as it comes, and when the first one came that a model made.
WATCH = """
window.seen = [];
let last;
Object.defineProperty(window, "shown", {
  get: () => last,
  set: x => {
    last = x;
    if (x.tick > 0) seen.push([performance.now(), x.tick, x.ms, x.plans]);
  },
});
"""
COLUMNS = {
    "first": ("first frame", "s"),
    "plan": ("a tick with a plan", "ms"),
    "tick": ("a tick without", "ms"),
    "plans": ("plans", "per s"),
    "real_time": ("of real time", "%"),
    "own": ("main thread", "ms"),
    "own_99": ("99 % below", "ms"),
    "interval_99": ("pictures apart, 99 % below", "ms"),
    "memory": ("memory", "MB"),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(suite.Settings):
    """Sizes of a folder that export.py wrote, and the page in a browser.

    Attributes:
      site: The folder.
      characters: Numbers of characters.
      seconds: How long each walks.
    """

    site: Path
    characters: tuple[int, ...] = (1, 16)
    seconds: float = 20.0


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves and says nothing."""

    def log_message(self, *arguments: Any) -> None:
        """Of a request."""


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a server of the folder."""
    handler = functools.partial(Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def sizes(folder: Path, models: list[str]) -> dict[str, float]:
    """Megabytes as they are sent, of the page with its runtime and of each model."""

    def of(paths: Iterator[Path]) -> float:
        return sum(path.stat().st_size for path in paths if path.is_file()) / 1e6

    found = {"page and runtime": of(folder.iterdir())}
    found |= {model: of((folder / model).iterdir()) for model in models}
    return found | {"all": sum(found.values())}


def renderers() -> float:
    """Megabytes that renderers of browsers hold, by their proportional share."""
    total = 0.0
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, StopIteration, ValueError):
            if b"--type=renderer" in (process / "cmdline").read_bytes():
                lines = (process / "smaps_rollup").read_text().splitlines()
                line = next(line for line in lines if line.startswith("Pss:"))
                total += float(line.split()[1]) / 1e3
    return total


def walk(browser: Any, address: str, seconds: float) -> dict[str, float]:
    """What the page says while somebody walks there."""
    tab = browser.new_page(viewport={"width": 1280, "height": 720})
    errors: list[str] = []
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
    tab.add_init_script(WATCH)
    tab.goto(address)
    tab.wait_for_function("seen.length > 0", timeout=180_000)
    first = tab.evaluate("seen[0][0]") / 1e3
    tab.keyboard.down("w")
    tab.wait_for_timeout(3000)
    tab.evaluate("seen.length = 0; spent.length = 0")
    pictures = tab.evaluate(
        """seconds => new Promise(done => {
          const found = [], until = performance.now() + 1000 * seconds;
          const next = now => {
            found.push(now);
            if (now < until) requestAnimationFrame(next); else done(found);
          };
          requestAnimationFrame(next);
        })""",
        seconds,
    )
    seen = np.array(tab.evaluate("seen"))
    own = np.array(tab.evaluate("spent"))[:, 0]
    fps = tab.evaluate("shown.fps")
    memory = renderers()
    tab.close()
    if errors:
        raise ValueError(f"{address}: {errors[0]}")
    planned = seen[:, 3] > 0
    took = (seen[-1, 0] - seen[0, 0]) / 1e3
    return {
        "first": first,
        "plan": float(np.median(seen[planned, 2])) if planned.any() else np.nan,
        "tick": float(np.median(seen[~planned, 2])) if (~planned).any() else np.nan,
        "plans": float(seen[1:, 3].sum() / took),
        "real_time": float(100.0 * (seen[-1, 1] - seen[0, 1]) / took / fps),
        "own": float(np.median(own)),
        "own_99": float(np.percentile(own, 99)),
        "interval_99": float(np.percentile(np.diff(pictures), 99)),
        "memory": memory,
    }


def main() -> None:
    """Measures and writes the report."""
    args = suite.parse(Config, __doc__)
    suite.at_least(args, characters=1)
    try:
        from playwright import sync_api
    except ModuleNotFoundError:
        raise ModuleNotFoundError("needs playwright: pip install playwright") from None
    models = json.loads((args.site / "models.json").read_text())["models"]
    weighs = sizes(args.site, models)
    metrics = [suite.Metric(f"{name} size", x, "MB") for name, x in weighs.items()]
    rows = []
    with served(args.site) as address, sync_api.sync_playwright() as run:
        path = shutil.which("chromium") or run.chromium.executable_path
        for model in models:
            for number in args.characters:
                # Each in a browser of its own: nothing is kept, and memory is its own.
                browser = run.chromium.launch(executable_path=path, args=OPTIONS)
                asked = f"{address}#model={model}&characters={number}"
                began = time.perf_counter()
                found = walk(browser, asked, args.seconds)
                browser.close()
                name = f"{model}, {number} character" + "s" * (number > 1)
                rows.append({"row": name, **found})
                metrics += [
                    suite.Metric(f"{name} {key}", found[key], COLUMNS[key][1])
                    for key in COLUMNS
                    if np.isfinite(found[key])
                ]
                print(f"{name}: {time.perf_counter() - began:.0f} s", flush=True)
    suite.print_table(
        [{"name": name, "size": x} for name, x in weighs.items()],
        {"name": "", "size": "MB"},
    )
    titles = {"row": ""} | {key: f"{a} {b}" for key, (a, b) in COLUMNS.items()}
    suite.print_table(rows, titles)
    suite.report("page", metrics, args, rows=rows)


if __name__ == "__main__":
    cli.start(main)
