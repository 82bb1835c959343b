"""Losses and a metric against training time, for one system: where it saturates.

Draws the losses of every stage that run folders have, over the seconds of its training;
and a metric of their evaluations over the seconds of the whole training. Runs of
different lengths show what longer training buys: the end of one run does not, since
most learning rates fall to its end, and losses flatten with them.

Examples:
  python experiments/curves.py --run runs/aamdm --out curves.png
  python experiments/curves.py --run runs/short runs/long --metric fid --rows aamdm --out curves.png
"""  # noqa: E501

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import tyro
from reports import results

from jaxmotion import cli, files
from jaxmotion.evaluation import columns
from jaxmotion.learning import loop
from jaxmotion.systems.emdm.training import SAMPLERS
from jaxmotion.viz import figure, plots

# Values of losses.jsonl that are drawn, where a stage has them.
_DRAWN = ("loss", "discriminator/loss")
# How rows of recorded motion begin.
_RECORDED = ("data", "real", "held-out", "ground truth", "noise floor", "training")


@dataclasses.dataclass(frozen=True)
class Config:
    """Draw losses and a metric against training time.

    Attributes:
      run: Run folders of one system.
      out: The picture.
      stages: Which stages; none: all.
      metric: Column of the evaluations.
      rows: Rows of the evaluations; "all": those there are.
      file: The evaluation, below the run folder.
    """

    run: tuple[Path, ...]
    out: Path = Path("curves.png")
    stages: cli.Names = ()
    metric: str = "fid"
    rows: cli.Names = ("all",)
    file: Path = Path("evaluation/metrics.json")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Stage:
    """What a stage left behind.

    Attributes:
      updates: Done at each row of losses, [rows].
      seconds: Seconds of training until then, without compiling at the start.
      values: Drawn values, each [rows].
    """

    updates: np.ndarray
    seconds: np.ndarray
    values: dict[str, np.ndarray]


def read_stage(path: Path) -> Stage:
    """Reads a losses.jsonl.

    Raises:
      OSError: if it cannot be read.
      ValueError: if it has no rows, or one lacks a positive rate or a value; names it.
    """
    rows = loop.read_losses(path)
    if not rows:
        raise ValueError(f"{path}: no rows: the training has just begun")
    names = [name for name in _DRAWN if name in rows[0]]
    for row in rows:
        for name in ("steps_per_second", "loss", *names):
            found = row.get(name)
            positive = name != "steps_per_second" or (found or 0) > 0
            if not isinstance(found, int | float) or not positive:
                raise ValueError(f"{path}: step {row['step']}: {name} is {found!r}")
    return Stage(
        updates=np.array([row["step"] for row in rows]),
        seconds=loop.seconds_of(rows),
        values={name: np.array([row[name] for row in rows], float) for name in names},
    )


def read_run(folder: Path, chosen: tuple[str, ...]) -> dict[str, Stage]:
    """Stages of a run folder by name, in the order of their training.

    Raises:
      OSError: if there is no such run, or a file cannot be read.
      ValueError: if it lacks a stage, or a file is damaged; names it.
    """
    paths = sorted(folder.glob("**/losses.jsonl"), key=lambda x: x.stat().st_mtime)
    there = {path.parent.relative_to(folder).as_posix(): path for path in paths}
    for name in chosen:
        if name not in there:
            raise ValueError(f"{folder}: no stage {name!r}, it has {', '.join(there)}")
    if not there:
        raise FileNotFoundError(f"{folder}: no losses.jsonl in any stage")
    names = chosen or tuple(there)
    return {name: read_stage(there[name]) for name in names}


def loss_panels(found: dict[str, dict[str, Stage]]) -> list[plots.Curves]:
    """One panel for each stage and value."""
    names = dict.fromkeys(
        (stage, value) for run in found.values() for stage in run
        for value in run[stage].values
    )  # fmt: skip
    panels = []
    for stage, value in names:
        lines = {}
        for run, stages in found.items():
            if stage in stages and value in (one := stages[stage]).values:
                ends = np.full((len(one.seconds), 2), math.nan)
                both = np.concatenate([one.values[value][:, None], ends], axis=1)
                lines[f"{run}, {one.updates[-1]:,} updates"] = (one.seconds, both)
        title = stage if value == "loss" else f"{stage}: {value}"
        text = dict(
            title=title, xlabel="seconds of the stage's training", ylabel="loss"
        )
        panels.append(plots.Curves(**text, lines=lines, noisy=True))
    return panels


def _data_of(measured: results.Measured) -> str:
    return json.dumps(measured.about.get("data"), sort_keys=True)


def metric_panels(
    args: Config, found: dict[str, dict[str, Stage]], names: dict[Path, str]
) -> list[plots.Curves]:
    """The metric of each row over the seconds of training of each run; or none.

    A line joins runs of one seed of training on the same data. The seconds of a row are
    those of the stage that has its name (or that it samples, as ddim_10 does), if one
    does, else of all stages that are drawn. Recorded motion is a line across, of the
    last run.

    Raises:
      OSError: if an evaluation cannot be read.
      ValueError: if one is damaged, or no one has the metric; names it.
    """
    points: dict[str, list[tuple[float, ...]]] = {}
    there, evaluators = set(), set()
    evaluations = {
        folder: one
        for folder in names
        if (one := results.read(folder / args.file)) is not None
    }
    for folder in names:
        if folder not in evaluations:
            print(f"not evaluated, so without a dot: no {folder / args.file}")
    several = len({one.seeds for one in evaluations.values()}) > 1
    # Data go by the name of the first run that was trained on them.
    data: dict[str, str] = {}
    for folder, measured in evaluations.items():
        data.setdefault(_data_of(measured), names[folder])
    for folder, measured in evaluations.items():
        evaluators.add(measured.evaluator)
        seed = f", seed {', '.join(map(str, measured.seeds)) or '?'}" if several else ""
        if len(data) > 1:
            seed += f", data of {data[_data_of(measured)]}"
        for row, cells in measured.rows.items():
            there |= cells.keys()
            cell = cells.get(args.metric)
            if cell is None or cli.chosen_rows(args) and row not in args.rows:
                continue
            stages = found[names[folder]]
            stage = SAMPLERS.get(row, (row,))[0]
            own = [x for k, x in stages.items() if k.split("/")[-1] == stage]
            spent = sum(x.seconds[-1] for x in own or stages.values())
            ends = (math.nan if x is None else x for x in (cell.low, cell.high))
            label = row if row.startswith(_RECORDED) else f"{row}{seed}"
            points.setdefault(label, []).append((spent, cell.value, *ends))
    if there and not points:
        raise ValueError(
            f"metric: no row {', '.join(args.rows)} with {args.metric!r}; there are "
            f"the columns {', '.join(sorted(there))}"
        )
    arrays = {row: np.array(sorted(own)) for row, own in points.items()}
    known = {row for row in arrays if row.startswith(_RECORDED)}
    lines = {row: (x[:, 0], x[:, 1:]) for row, x in arrays.items() if row not in known}
    if not lines:
        return []
    declared = columns.COLUMNS.get(args.metric)
    if declared is not None and declared.evaluated and len(evaluators) > 1:
        print(f"the runs have several evaluators: their {args.metric} does not compare")
    label = columns.header(args.metric)
    made = plots.Curves(
        title=f"{label} of {args.file}",
        xlabel="seconds of all stages that a row needs",
        ylabel=label,
        lines=lines,
        references={row: arrays[row][-1, 1:] for row in sorted(known)},
        noisy=False,
    )
    return [made]


def say(run: str, stage: str, one: Stage) -> None:
    """Prints the smoothed loss at parts of a stage's training."""
    curve, parts = plots.smoothed(one.values["loss"]), (0.25, 0.5, 0.75, 1.0)
    at = [float(np.interp(x * one.seconds[-1], one.seconds, curve)) for x in parts]
    shown = ", ".join(f"{x:.0%} {y:.4g}" for x, y in zip(parts, at, strict=True))
    spent = f"{one.updates[-1]} updates in {one.seconds[-1]:.3g} s"
    print(f"{run}, {stage}: {spent}; loss at {shown}")


def draw(args: Config) -> None:
    """Writes the picture."""
    figure.check_writable(args.out)
    systems = {
        folder: files.read_object(folder / "config.json", what="expected a run folder")
        for folder in args.run
    }
    kinds = {str(value.get("system")) for value in systems.values()}
    if len(kinds) > 1:
        raise ValueError(f"run: of several systems: {', '.join(sorted(kinds))}")
    if len(set(args.run)) < len(args.run):
        raise ValueError("run: a folder is given twice")
    short = len({x.name for x in args.run}) == len(args.run)
    names = {folder: folder.name if short else str(folder) for folder in args.run}
    found = {names[x]: read_run(x, args.stages) for x in args.run}
    for run, stages in found.items():
        for stage, one in stages.items():
            say(run, stage, one)
    title = f"{kinds.pop()}: losses and evaluations against training time"
    panels = (*loss_panels(found), *metric_panels(args, found, names))
    plots.write_curves(args.out, panels, title=title)
    print(f"wrote {args.out}")


def main() -> None:
    """Parses the command line and draws."""
    draw(cli.check(tyro.cli(Config, description=__doc__)))


if __name__ == "__main__":
    cli.start(main)
