"""Quality against time for several numbers of steps, for any system.

Trains a model for each number of steps with the same budget, seed and data (or loads
those that the folder has), evaluates all with the same noise, commands and samples, and
writes table.md, table.csv, table.json, pareto.png and a rollout of each.

Examples:
  python experiments/step_sweep.py --system camdm --steps 2 4 8 16 32 --budget quick
  python experiments/step_sweep.py --system camdm --steps 1 2 8 1/8 2/8
  python experiments/step_sweep.py --system aamdm --steps 0+3 1+3 2+3 10+3 2+10
  python experiments/step_sweep.py --system emdm --change updates=3000 width=192
"""

import dataclasses
import importlib
import json
import os
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import tyro

from jaxmotion import cli, files, reporting
from jaxmotion.evaluation import bench
from jaxmotion.evaluators import frozen
from jaxmotion.learning import loop
from jaxmotion.reporting import arguments_json
from jaxmotion.systems import registry


@dataclasses.dataclass(frozen=True)
class Config:
    """Sweep over numbers of steps.

    Attributes:
      system: camdm, aamdm, emdm or smgdiff.
      steps: Steps T of the model (emdm: GAN; aamdm: polish, or polish+draft). camdm:
        1/8 after 8 for a student of one step.
      budget: quick (five models in half an hour of two cores) or full.
      change: Numbers of the budget, as in updates=3000.
      data: Clips; none: the system's usual ones.
      out: Results; else runs/sweep_<system>.
      models: Models to use and keep; else <out>/models.
      replications: Sets of samples of each model, for intervals.
      evaluator: A frozen one (not aamdm); else it is trained.
      distributed: One of several processes, which train together: "auto", or address,
        number, index.
      seed: Seeds all that is random.
    """

    system: str
    steps: cli.Names = ("2", "4", "8", "16", "32")
    budget: str = "quick"
    change: cli.Names = ()
    data: tuple[Path, ...] = ()
    out: cli.Optional[Path] = None
    models: cli.Optional[Path] = None
    replications: int = 20
    evaluator: cli.Optional[Path] = None
    distributed: cli.Distributed = ()
    seed: int = 0


def make_job(args: Config) -> tuple[bench.Job, Path]:
    """The sweep that the arguments describe, and the folder of its results.

    Raises:
      ValueError: names the field that is wrong.
    """
    own = registry.get(args.system).bench
    out = args.out or Path(f"runs/sweep_{args.system}")
    job = bench.Job(
        points=own.points(args.steps),
        data=args.data or own.data,
        models=args.models or out / "models",
        budget=bench.resolve(own.amounts, args.budget, args.change),
        replications=args.replications,
        seed=args.seed,
        evaluator=None if args.evaluator is None else frozen.load(args.evaluator),
    )
    if job.evaluator is not None and own.evaluator is None:
        raise ValueError(f"evaluator: {args.system} is scored without one")
    if job.evaluator is not None and job.evaluator.kind != own.evaluator:
        raise ValueError(
            f"evaluator: {args.evaluator} is of kind {job.evaluator.kind!r}, "
            f"{args.system} needs {own.evaluator!r}"
        )
    return job, out


def check(args: Config, job: bench.Job, out: Path) -> None:
    """Raises before any work if files are missing or folders cannot be used.

    A folder of models is marked with what they are trained with.

    Raises:
      OSError: names the field.
      ValueError: names the field; if the folder holds models of another sweep, also
        what differs.
    """
    for file in job.data:
        if not file.is_file():
            raise FileNotFoundError(f"data: no clips file {file}: {files.CLIPS_MAKER}")
    if job.replications < 2:
        raise ValueError(
            f"replications: {job.replications}, expected at least 2 for intervals"
        )
    for field, folder in (("out", out), ("models", job.models)):
        try:
            loop.check_writable(folder)
        except OSError as error:
            raise OSError(f"{field}: {error}") from error
    amounts, path = registry.get(args.system).bench.amounts, job.models / "sweep.json"
    wanted = {
        "system": args.system,
        "data": [str(file) for file in job.data],
        "seed": job.seed,
    } | bench.training_part(amounts, job.budget)
    if not path.exists():
        files.write_text(path, json.dumps(wanted, indent=1))
        return
    found = files.read_object(path, what="expected what step_sweep.py writes")
    differ = [key for key in wanted | found if found.get(key) != wanted.get(key)]
    if differ:
        raise ValueError(
            f"models: {job.models} has models trained with other {', '.join(differ)}: "
            f"{[found.get(key) for key in differ]}, expected "
            f"{[wanted.get(key) for key in differ]}; choose another folder"
        )


def call(script: ModuleType, command: str, options: dict[str, Any]) -> None:
    """Runs a command of a script with options of its own."""
    getattr(script, command)(getattr(script, command.capitalize())(**options))


def sweep(args: Config, job: bench.Job, out: Path) -> None:
    """Trains what is missing, scores all, times all in turn, and writes the results."""
    own = registry.get(args.system).bench
    script = importlib.import_module(args.system)
    seconds: dict[str, float] = {}
    begun = time.perf_counter()
    for point in job.points:
        started = time.perf_counter()
        call(script, *own.train(job, point))
        seconds[f"training, {point.row}"] = time.perf_counter() - started
        print(f"{point.row}: {seconds[f'training, {point.row}']:.0f} s", flush=True)
    if not cli.part_processes():
        return
    job, out = make_job(args)
    started = time.perf_counter()
    evaluation = own.prepare(job)
    seconds["evaluator"] = time.perf_counter() - started
    rows, more = bench.measure(evaluation, job)
    load = round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None
    for point in job.points:
        command, options = own.show(job, point)
        call(script, command, options | {"out": out / "rollouts" / point.folder})
    seconds |= more | {"all": time.perf_counter() - begun}
    report = {"title": f"{args.system}: steps, {args.budget} budget"}
    report |= reporting.provenance() | {
        "system": args.system,
        "arguments": arguments_json(args)
        | {
            "data": [str(file) for file in job.data],
            "out": str(out),
            "models": str(job.models),
        },
        "budget": job.budget,
        "seeds": {"training": job.seed, "evaluation": job.seed},
        "replications": job.replications,
        "load_average_1min": load,
        "seconds": {key: round(value, 1) for key, value in seconds.items()},
        **evaluation.describe,
    }
    report["notes"] = notes(own, job, report)
    quality = dict(quality=own.quality, sample=own.sample)
    reporting.write_sweep(out, rows, job.points, report, **quality)


def notes(own: bench.Bench, job: bench.Job, report: dict[str, Any]) -> list[str]:
    """Lines below the table."""
    budget = ", ".join(f"{key} {value:g}" for key, value in job.budget.items())
    who = [frozen.note(report["evaluator"])] if "evaluator" in report else []
    taught = ", ".join(point.row for point in job.points if point.teacher)
    taught = (
        [f"{taught}: as many updates again, after the teacher's."] if taught else []
    )
    return [
        f"Data: {report['source']}.",
        f"Trained with the same budget, data and seed {job.seed}: {budget} (--help "
        "says what each is). One training a row: what another training seed would "
        "change is in no interval.",
        *taught,
        f"Evaluated with the same noise, commands and samples, {job.replications} "
        f"replications: {report['samples']}. Intervals are of 95 %.",
        *who,
        f"p50 ms: {own.sample} at batch 1, all models in turn; its interval is the "
        f"bootstrap's of the median. Load average meanwhile: "
        f"{report['load_average_1min']}.",
        f"{report['cpu']}, {report['cores']} cores, {', '.join(report['devices'])}; "
        f"Python {report['python']}, jax {report['jax']}, flax {report['flax']}, numpy "
        f"{report['numpy']}; commit {report['git_commit']}; "
        f"{report['seconds']['all']:.0f} s in all.",
        f"`{report['command']}`",
    ]


def budgets() -> str:
    """The numbers of all budgets, for the help: a line a number."""
    found: dict[str, list[str]] = {}
    for name, system in registry.SYSTEMS.items():
        for key, amount in (system.bench.amounts if system.swept else {}).items():
            line = found.setdefault(key, [amount.meaning])
            quick, full = f"{amount.quick:g}", f"{amount.full:g}"
            line.append(f"{name} {quick}" + f"/{full}" * (quick != full))
    lines = [f"  {key}: {what}: {', '.join(x)}" for key, (what, *x) in found.items()]
    return "\n".join(["Budgets, quick/full:", *lines])


def main() -> None:
    """Parses the command line and runs the sweep."""
    args = cli.check(tyro.cli(Config, description=f"{__doc__}\n\n{budgets()}"))
    cli.join_processes(args.distributed)
    job, out = make_job(args)
    check(args, job, out)
    sweep(args, job, out)


if __name__ == "__main__":
    cli.start(main)
