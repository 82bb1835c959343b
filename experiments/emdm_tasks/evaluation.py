"""The table of a run: rows beside real motions, with intervals over replications."""

import time
from pathlib import Path
from typing import Any

import jax
from jaxtyping import Array

from emdm_tasks import actions, texts
from emdm_tasks.scores import ORDER
from jaxmotion import reporting
from jaxmotion.evaluation import by_frame, columns
from jaxmotion.evaluation.table import Cell
from jaxmotion.evaluators import frozen
from jaxmotion.reporting import arguments_json
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import training as emdm_training

# Rows with so many network calls a motion are replicated less often.
_LONG = 500
_CHUNK = 32


def calls(config: emdm_model.Config, row: str) -> int:
    """Network calls of one motion.

    Args:
      config: Of the row.
      row: Its name.

    Returns:
      Steps of its sampler.
    """
    return (
        emdm_training.SAMPLERS[row][1]
        if row in emdm_training.SAMPLERS
        else config.num_steps
    )


def trained_rows(folder: Path) -> tuple[str, ...]:
    """Rows and samplers that a run folder can show.

    Args:
      folder: The run folder.

    Returns:
      Their names.
    """
    rows = [
        row for row in emdm_training.ROWS if (folder / row / "checkpoints").is_dir()
    ]
    more = [name for name, (row, _) in emdm_training.SAMPLERS.items() if row in rows]
    return (*rows, *more)


def _milliseconds(
    sample: emdm_model.Sample,
    condition: emdm_model.Condition,
    scale: Array | None,
    frames: int,
) -> Cell:
    """Time of one motion at batch 1, per frame, as the paper gives it."""
    run = jax.jit(lambda key: sample(key, condition, scale=scale))
    return columns.milliseconds(run, parts=frames, least=3)


def evaluate(args: Any, out: Path) -> None:
    """Scores every row and writes the table.

    Args:
      args: Of `emdm.py evaluate`.
      out: Folder for metrics.json and table.md.

    Raises:
      ValueError: if nothing was trained, or a row was not.
    """
    value = emdm_training.read_config(args.run)
    rows = args.rows or trained_rows(args.run)
    if not rows:
        raise ValueError(f"{args.run}: no row was trained")
    kind = texts if value["task"] == "text" else actions
    judge = kind.make_judge(args)
    found: dict[str, dict[str, Cell]] = dict(judge.real)
    places: dict[str, by_frame.ByFrame] = {}
    for row in rows:
        begun = time.perf_counter()
        params, config = emdm_training.load_row(args.run, row)
        sample = emdm_training.row_sampler(params, config, row)
        number = calls(config, row)
        count = args.long_replications if number >= _LONG else args.replications
        scale = judge.scale
        many = emdm_training.sample_many(sample, chunk=_CHUNK)
        keys = jax.random.split(jax.random.key(args.seed + 1), args.replications)
        results = [judge.score(key, many) for key in keys[:count]]
        found[row] = columns.row(results, order=ORDER) | {
            "ms a frame": _milliseconds(sample, judge.one, scale, config.frames),
            "network calls": Cell(value=float(number)),
        }
        if judge.by_frame is not None:
            places[row] = judge.by_frame(keys[0], many, config.frames_per_token)
        seconds = time.perf_counter() - begun
        print(f"{row}: {count} x {judge.samples}, {seconds:.0f} s", flush=True)
    report = {
        "arguments": arguments_json(args),
        "run": value,
        "evaluator": judge.describe,
    } | reporting.provenance()
    notes = (frozen.note(judge.describe), *judge.notes)
    if places:
        report["by_frame_of_the_token"] = by_frame.to_json(places)
        notes += (by_frame.to_markdown(places),)
    reporting.write_table(out, found, report, notes)
