"""The order of work of a sweep: train all, evaluate all, time all in turn, write."""

import json
import os
import time
from pathlib import Path
from typing import Any

from jaxmotion import files, reporting
from jaxmotion.evaluators import frozen
from jaxmotion.learning import loop
from sweeps import budgets, latency, report
from sweeps.system import Bench, Job, Rows, System


def check_models(name: str, system: System, job: Job) -> None:
    """Raises unless a folder's models were trained for this sweep; marks a new one.

    Args:
      name: Of the system.
      system: The system.
      job: The sweep.

    Raises:
      ValueError: if the folder holds models of another sweep; names what differs.
    """
    path = job.models / "sweep.json"
    wanted = {
        "system": name,
        "data": [str(file) for file in job.data],
        "seed": job.seed,
    } | budgets.training_part(system.amounts, job.budget)
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


def _check_folder(field: str, folder: Path) -> None:
    try:
        loop.check_writable(folder)
    except OSError as error:
        raise OSError(f"{field}: {error}") from error


def check(name: str, system: System, job: Job, out: Path) -> None:
    """Raises before any work if files are missing or folders cannot be used.

    Args:
      name: Of the system.
      system: The system.
      job: The sweep.
      out: Folder of the results.

    Raises:
      OSError: names the field.
      ValueError: names the field.
    """
    for file in job.data:
        if not file.is_file():
            raise FileNotFoundError(f"data: no clips file {file}")
    if job.replications < 2:
        raise ValueError(
            f"replications: {job.replications}, expected at least 2 for intervals"
        )
    _check_folder("out", out)
    _check_folder("models", job.models)
    check_models(name, system, job)


def sweep(name: str, system: System, job: Job, out: Path, arguments: Any) -> None:
    """Trains what is missing, and writes all results.

    Args:
      name: Of the system.
      system: The system.
      job: The sweep.
      out: Folder of the results.
      arguments: JSON of the command line.
    """
    check(name, system, job, out)
    seconds: dict[str, float] = {}
    begun = time.perf_counter()
    train = system.trainer(job)
    for point in job.points:
        started = time.perf_counter()
        train(point)
        seconds[f"training, {point.row}"] = time.perf_counter() - started
        print(f"{point.row}: {seconds[f'training, {point.row}']:.0f} s", flush=True)
    started = time.perf_counter()
    bench = system.bench(job)
    seconds["evaluator"] = time.perf_counter() - started
    rows = _measure(bench, job, seconds)
    load = round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None
    _rollouts(bench, job, out / "rollouts")
    seconds["all"] = time.perf_counter() - begun
    whole = reporting.provenance() | {
        "system": name,
        "arguments": arguments,
        "budget": job.budget,
        "seeds": {"training": job.seed, "evaluation": job.seed},
        "replications": job.replications,
        "load_average_1min": load,
        "seconds": {key: round(value, 1) for key, value in seconds.items()},
        **bench.describe,
    }
    whole["notes"] = _notes(system, job, whole)
    report.write(
        out,
        rows,
        job.points,
        whole,
        quality=system.quality,
        sample=system.sample,
        title=f"{name}: steps, {whole['arguments']['budget']} budget",
    )


def _measure(bench: Bench, job: Job, seconds: dict[str, float]) -> Rows:
    rows = dict(bench.real)
    for point in job.points:
        started = time.perf_counter()
        rows[point.row] = bench.score(point)
        seconds[f"scores, {point.row}"] = time.perf_counter() - started
        print(f"{point.row}: scored", flush=True)
    times = latency.milliseconds(
        {point.row: bench.sampler(point) for point in job.points}
    )
    for row, found in times.items():
        rows[row] = rows[row] | latency.cells(found, seed=job.seed)
    return rows


def _rollouts(bench: Bench, job: Job, folder: Path) -> None:
    for point in job.points:
        own = folder / point.folder
        own.mkdir(parents=True, exist_ok=True)
        bench.rollout(point, own)


def _notes(system: System, job: Job, whole: dict[str, Any]) -> list[str]:
    budget = ", ".join(f"{key} {value:g}" for key, value in job.budget.items())
    judge = [frozen.note(whole["evaluator"])] if "evaluator" in whole else []
    return [
        f"Data: {whole['source']}.",
        f"Trained with the same budget, data and seed {job.seed}: {budget} (--help "
        "says what each is). One training a row: what another training seed would "
        "change is in no interval.",
        f"Evaluated with the same noise, commands and samples, {job.replications} "
        f"replications: {whole['samples']}. Intervals are of 95 %.",
        *judge,
        f"p50 ms: {system.sample} at batch 1, all models in turn; its interval is the "
        f"bootstrap's of the median. Load average meanwhile: "
        f"{whole['load_average_1min']}.",
        f"{whole['cpu']}, {whole['cores']} cores, {', '.join(whole['devices'])}; "
        f"Python {whole['python']}, jax {whole['jax']}, flax {whole['flax']}, numpy "
        f"{whole['numpy']}; commit {whole['git_commit']}; "
        f"{whole['seconds']['all']:.0f} s in all.",
        f"`{whole['command']}`",
    ]
