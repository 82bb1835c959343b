"""The whole set of benchmarks on one card, in 20 minutes at most; --tiny on any CPU.

Needs no data: shipped models and random parameters. Every part is a benchmark of this
folder in a process of its own, with its report in a folder of its own; one that fails
or takes too long is named in the table, keeps the rows it had made, and the others go
on.

Examples:
  pip install -e ".[cuda]" && python benchmarks/gpu.py --out runs/gpu
  python benchmarks/gpu.py --tiny --out runs/gpu_tiny
"""

import dataclasses
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import suite

from jaxmotion import cli

# Part -> script, its options, and those that replace them with --tiny.
TINY = "--width 16 --runs 2 --limit 1"
PARTS: dict[str, tuple[str, str, str]] = {
    "steps": (
        "step_counts",
        "--steps 2 4 8 16 --batch 1 64 --chunk 0 --limit 5",
        f"--system camdm aamdm --steps 2 --batch 1 --frames-per-token 5 {TINY}",
    ),
    "emdm": (
        "step_counts",
        "--system emdm --steps 1 5 10 --batch 1 64 --chunk 0 --limit 5",
        f"--system emdm --steps 1 {TINY}",
    ),
    "precision": (
        "step_counts",
        "--system camdm smgdiff --steps 8 --batch 1 64 1024 --chunk 0 --limit 5 "
        "--precision float32 tf32 bfloat16",
        "--system camdm --steps 1 --frames-per-token 5 --precision float32 bfloat16 "
        f"{TINY}",
    ),
    "crowd": (
        "rollout_batch",
        "--characters 1 256 4096 16384 65536 --chunks 0 --width 128 "
        "--frames-per-token 5 --memory-gib 16 --limit 10",
        f"--characters 1 32 --seconds 0.2 --frames-per-token 5 {TINY}",
    ),
    "aamdm": (
        "rollout_batch",
        "--system aamdm --characters 1 64 4096 65536 --memory-gib 16 --limit 10",
        f"--system aamdm --characters 1 4 --seconds 0.1 {TINY}",
    ),
    "training": (
        "train_together",
        "--width 128 256 --models 2 --updates 50 --batch 512 --rounds 5 --limit 30",
        "--system aamdm --width 16 --models 2 --updates 2 --batch 4 --rounds 2",
    ),
    "diversity": (
        "diversity",
        "--run locomotion --seconds 0.5 --stream 1000000 --rollouts 8192 --pairs 512 "
        "--chunk 8192",
        "--run locomotion --seconds 0.2 --stream 8 --rollouts 4 --pairs 4",
    ),
}
# What we want of one card: metric of a part, whether more is better, the aim.
AIMS = {
    "16,384 characters, 8 steps, x real time": ("crowd", "realtime", 16384, True, 1.0),
    "AAMDM, one character, frames/s": ("aamdm", "frames_per_second", 1, True, 5000.0),
    "EMDM, one motion of 10 steps, ms": ("emdm", "p50_ms", 10, False, 3.0),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(suite.Settings):
    """Runs the parts one after another and joins their reports.

    Attributes:
      parts: Which to run; see PARTS in this file.
      tiny: At sizes that a CPU runs in minutes, whose figures mean nothing.
      limit: Seconds of a part, at most: seven parts take less than 20 minutes.
    """

    parts: tuple[str, ...] = tuple(PARTS)
    tiny: bool = False
    limit: float = 170.0


def run_part(args: Config, name: str) -> dict[str, Any]:
    """Runs one part: a row of the table, with the metrics and rows of its report."""
    script, full, tiny = PARTS[name]
    path, out = Path(__file__).with_name(f"{script}.py"), args.out / name
    words = [sys.executable, str(path), *(tiny if args.tiny else full).split()]
    started, begun, why = time.time(), time.perf_counter(), "ran"
    try:
        done = subprocess.run(
            [*words, "--out", str(out)],
            stderr=subprocess.PIPE,
            timeout=args.limit,
            text=True,
        )
        if done.returncode:
            last = done.stderr.strip().splitlines()[-1:]
            why = f"status {done.returncode}: {' '.join(last)}"
    except subprocess.TimeoutExpired:
        why = f"not done in --limit {args.limit:g} s"
    seconds = time.perf_counter() - begun
    reports = [x for x in out.glob(f"{script}*.json") if x.stat().st_mtime >= started]
    found = [json.loads(report.read_text()) for report in sorted(reports)]
    return {
        "part": name,
        "seconds": seconds,
        "end": why,
        "metrics": [metric for one in found for metric in one["metrics"]],
        "rows": [row for one in found for row in one["rows"] if isinstance(row, dict)],
    }


def aims(parts: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What was wanted of one card, and what was found; None for what was not run."""
    rows = {part["part"]: part["rows"] for part in parts}
    found = []
    for title, (part, field, size, more, aim) in AIMS.items():
        key = "steps" if part == "emdm" else "characters"
        values = [
            row[field]
            for row in rows.get(part, ())
            if row[key] == size and row.get("batch", 1) == 1
        ]
        value = values[0] if values else None
        met = None if value is None else (value >= aim if more else value <= aim)
        found.append({"what": title, "aim": aim, "found": value, "met": met})
    return found


def main() -> None:
    """Runs the parts and writes the table."""
    args = suite.parse(Config, __doc__)
    for name in args.parts:
        if name not in PARTS:
            raise ValueError(f"--parts {name}: expected some of {', '.join(PARTS)}")
    parts = []
    for name in args.parts:
        print(f"== {name}", flush=True)
        parts.append(run_part(args, name))
        print(f"{name}: {parts[-1]['end']}, {parts[-1]['seconds']:.0f} s", flush=True)
    wanted = aims(parts)
    titles = {"part": "part", "seconds": "s", "end": "end"}
    suite.print_table(parts, titles)
    suite.print_table(wanted, {key: key for key in ("what", "aim", "found", "met")})
    suite.write_table(args.out / "gpu", parts, titles)
    metrics = [
        suite.Metric(**metric | {"name": f"{part['part']}: {metric['name']}"})
        for part in parts
        for metric in part["metrics"]
    ]
    rows = [{key: part[key] for key in titles} for part in parts]
    suite.report("gpu", metrics, args, rows=rows, aims=wanted)
    if any(part["end"] != "ran" for part in parts):
        raise SystemExit(1)


if __name__ == "__main__":
    cli.start(main)
