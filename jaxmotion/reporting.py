"""What an experiment leaves behind: a rollout to look at, and a table to cite."""

import contextlib
import dataclasses
import datetime
import itertools
import json
import math
import os
import platform
import subprocess
import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxmotion import files
from jaxmotion.data import bvh, bvh_text
from jaxmotion.evaluation import bench, columns, table
from jaxmotion.learning import checkpoint, loop, runs
from jaxmotion.motion import trajectory
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.viz.stage import Ball, make_stage


def write_rollout(
    folder: Path,
    skeleton: Skeleton,
    motion: Motion,
    desired_velocity: Float[Array, "frames 2"] | None,
    *,
    title: str,
    caption: str = "",
    name: str = "rollout",
    ball: Ball | None = None,
) -> None:
    """Writes a motion as BVH, GIF and HTML, and a ball as CSV.

    The motion is one character's, world. The desired velocity, m/s, is what was
    commanded; its integral is drawn as the commanded path; None if nothing was. The
    caption is the source of the data and its license; the name is that of the files,
    without their ends.
    """
    # matplotlib is slow to import, and only those who draw need it.
    from jaxmotion.viz import animation, html

    fps = motion.fps
    folder.mkdir(parents=True, exist_ok=True)
    bvh_text.write_bvh(folder / f"{name}.bvh", bvh.bvh_from_motion(skeleton, motion))
    wanted = None
    if desired_velocity is not None:
        path = trajectory.integrate_path(desired_velocity, fps)
        wanted = np.asarray(path) + np.asarray(motion.root_position)[0, ::2]
    if ball is not None:
        _write_ball(folder / f"{name}_ball.csv", ball, fps)
    stage = make_stage(skeleton, motion, wanted=wanted, ball=ball)
    texts: dict[str, Any] = dict(title=title, caption=caption)
    animation.save_gif(folder / f"{name}.gif", stage, **texts)
    html.save_html(folder / f"{name}.html", stage, **texts)
    print(f"wrote {name}.bvh, {name}.gif and {name}.html to {folder}")


def _write_ball(path: Path, ball: Ball, fps: float) -> None:
    """Time, position in meters, and whether something touches it, one frame a line."""
    lines = ["seconds,x,y,z,touch"]
    for frame, place in enumerate(ball.position):
        numbers = ",".join(f"{value:.4f}" for value in place)
        lines.append(f"{frame / fps:.4f},{numbers},{int(bool(ball.touching(frame)))}")
    files.write_text(path, "\n".join(lines) + "\n")


def _keep_earlier(path: Path, rows: Collection[str]) -> None:
    """Renames a table's file with rows that the new one lacks."""
    try:
        lost = json.loads(path.read_text(encoding="utf-8"))["rows"].keys() - rows
    except (FileNotFoundError, ValueError, KeyError, TypeError, AttributeError):
        return  # nothing there, or nothing of ours
    if lost:
        names = (path.with_name(f"metrics.{i}.json") for i in itertools.count(1))
        kept = next(name for name in names if not name.exists())
        path.rename(kept)
        print(f"rows of before ({', '.join(sorted(lost))}) are in {kept}")


def write_table(
    folder: Path,
    rows: dict[str, dict[str, table.Cell]],
    report: dict[str, Any],
    notes: tuple[str, ...] = (),
) -> None:
    """Writes metrics.json and table.md (folder made if missing), prints the table.

    The report is what belongs beside it: arguments, versions, hardware, bounds. Notes
    are lines below the table, which also say what is not trained to its end. An earlier
    table that has other rows stays, as metrics.1.json (or the next that is free).
    """
    _keep_earlier(folder / "metrics.json", rows)
    for stage, how in report.get("training", {}).items():
        if "of" in how:
            notes += (f"{stage} has {how['steps']} of {how['of']} updates.",)
    whole = report | {"rows": table.to_json(rows)}
    files.write_text(folder / "metrics.json", json.dumps(whole, indent=1))
    text = "\n\n".join([table.to_markdown(rows), *notes])
    files.write_text(folder / "table.md", text + "\n")
    print(text)


def write_sweep(
    folder: Path,
    rows: table.Rows,
    points: Sequence[bench.Point],
    report: dict[str, Any],
    *,
    quality: str,
    sample: str,
) -> None:
    """Writes table.md, table.csv, table.json and pareto.png, and prints the table.

    The folder must exist. Beside them stand the report's "title" (also the plot's) and
    "notes" (also below the Markdown table); `quality` is the plot's column, `sample`
    what the times are of.
    """
    title, notes = report["title"], [*report["notes"]]
    left_out = _draw(folder / "pareto.png", rows, points, quality, sample, title)
    if left_out:
        missing = f"for want of a finite {columns.header(quality)}"
        notes.append(f"not in the plot, {missing}: {left_out}")
    whole = report | {"notes": notes, "rows": table.to_json(rows)}
    files.write_text(folder / "table.json", json.dumps(whole, indent=1))
    text = table.to_markdown(rows)
    below = "\n".join(f"- {note}" for note in notes)
    files.write_text(folder / "table.md", f"# {title}\n\n{text}\n\n{below}\n")
    names = {point.row: point.name for point in points}
    files.write_text(folder / "table.csv", table.to_csv(rows, names))
    print(text)


def _ends(cell: table.Cell) -> tuple[float, float, float]:
    low = cell.value if cell.low is None else cell.low
    high = cell.value if cell.high is None else cell.high
    return cell.value, low, high


def _draw(
    path: Path,
    rows: table.Rows,
    points: Sequence[bench.Point],
    quality: str,
    sample: str,
    title: str,
) -> str:
    """Draws quality against time; returns the points that cannot be in the plot."""
    from jaxmotion.viz import plots

    def is_finite(row: str) -> bool:
        found = rows.get(row, {}).get(quality)
        return found is not None and math.isfinite(found.value)

    shown = [point for point in points if is_finite(point.row)]
    if shown:
        plots.write_pareto(
            path,
            tuple(point.name for point in shown),
            *(
                np.array([_ends(rows[point.row][column]) for point in shown])
                for column in ("p50", quality)
            ),
            references={
                name: np.array(_ends(rows[name][quality]))
                for name in (bench.GROUND_TRUTH, bench.NOISE_FLOOR, bench.REFERENCE)
                if is_finite(name)
            },
            xlabel=f"{sample}, batch 1: p50, ms",
            ylabel=f"{columns.header(quality)} (lower is better)",
            title=title,
            broken=tuple(
                point.name for point in shown if bench.has_failed(rows[point.row])
            ),
        )
    return ", ".join(point.row for point in points if point not in shown)


def processor() -> str:
    """Name of the processor, as Linux or Python name it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(x.split(":")[1].strip() for x in lines if "model name" in x)
    except (OSError, StopIteration):
        return platform.processor()


def git_commit() -> str | None:
    """Hash of this code's commit, with "+" after it if files differ from it.

    None outside a repository.
    """

    def git(*words: str) -> str:
        found = subprocess.run(
            ["git", *words],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
        )
        return found.stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def provenance(arguments: Any = None) -> dict[str, Any]:
    """What a table was made with, as a JSON object.

    Versions, hardware, commit, command and date, and the "arguments" of a command
    line's dataclass, if there is one; where these name a run folder, also its "seeds",
    its "data", and of its stages the "training", the "models", which have the sizes of
    networks, and the "minutes", without compiling.
    """
    given = {} if arguments is None else {"arguments": arguments_json(arguments)}
    if (run := getattr(arguments, "run", None)) is not None and run.is_dir():
        given |= _training(run)
    return given | {
        **runs.versions(),
        "machine": platform.machine(),
        "cpu": processor(),
        "cores": os.cpu_count(),
        "devices": [str(device) for device in jax.devices()],
        "git_commit": git_commit(),
        "command": " ".join(["python", *sys.argv]),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def _training(folder: Path) -> dict[str, Any]:
    """Seeds and other settings of a run's stages, and fingerprints of its data.

    A stage that is not trained to its end has the "steps" that it made "of" how many.
    """
    seeds, settings, models = set(), {}, {}
    for place in sorted(folder.glob("**/checkpoints")):
        with contextlib.suppress(checkpoint.CheckpointError):
            config = checkpoint.load_config(place)
            how = config.get("training", {})
            if "seed" in how:
                stage = place.parent.relative_to(folder).as_posix()
                seeds.add(how.pop("seed"))
                done, steps = checkpoint.latest_step(place) or 0, how.get("steps", 0)
                if done < steps:
                    how |= {"steps": done, "of": steps}
                settings[stage], models[stage] = how, config.get("model")
    config = files.read_object(folder / "config.json", what="expected a run folder")
    return {
        "seeds": {"training": sorted(seeds)},
        "data": config.get("files"),
        "training": settings,
        "models": models,
        "minutes": _minutes(folder),
    }


def _minutes(folder: Path) -> dict[str, float]:
    """Minutes of training of a run's stages; without those whose losses are damaged."""
    found = {}
    for path in sorted(folder.glob("**/losses.jsonl")):
        with contextlib.suppress(ValueError, KeyError, TypeError, IndexError):
            seconds = loop.seconds_of(loop.read_losses(path))
            stage = path.parent.relative_to(folder).as_posix()
            found[stage] = round(float(seconds[-1]) / 60, 1)
    return found


def arguments_json(arguments: Any) -> dict[str, Any]:
    """Arguments of an experiment, plain values and paths, as JSON."""
    return {
        name: str(value) if isinstance(value, Path) else value
        for name, value in dataclasses.asdict(arguments).items()
    }
