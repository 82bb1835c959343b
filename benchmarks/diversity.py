"""Diversity of many rollouts from one start state under the same commands.

Columns: world_m is the mean distance in meters of a joint in one rollout to the same
joint in another, over pairs, frames and joints; pose_m the same with joints relative to
the root and turned to face +z; diversity_m the metric of that name, the mean Euclidean
distance in meters of whole poses of the same time; variance_m2 is CAMDM's metric 4.

Examples:
  python benchmarks/diversity.py --rollouts 64 256 1024 4096
  python benchmarks/diversity.py --rollouts 64 --guidance 0 0.5 1 1.5 --memory-gib 0.5
  python benchmarks/diversity.py --run runs/camdm8 --step-runs runs/camdm2 runs/camdm4
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import memory
import suite
import tyro
import workload_diversity as workload

from jaxmotion import cli, files, reporting
from jaxmotion.control import courses
from jaxmotion.evaluation import table

WALKER = Path(__file__).parents[1] / "jaxmotion" / "assets" / "walker.npz"


@dataclasses.dataclass(frozen=True)
class Config:
    """Diversity against the number of rollouts, step count and guidance scale.

    Every rollout starts in the same state and gets the same commands; only its noise
    differs. A row is the mean over sets of rollouts with independent noise, with a 95 %
    interval (Student's t). All rollouts of a set are one compiled program, in which so
    many run at a time as the memory allows.

    Attributes:
      rollouts: Numbers of rollouts.
      sweep_rollouts: Rollouts of each row of the sweeps over steps and guidance; None
        for the largest number.
      run: Model of CAMDM: an exported file of the procedural walker, or a run folder
        of experiments/camdm.py (with the data it was trained on). None for the shipped
        walker.
      step_runs: Further models, trained for other numbers of diffusion steps.
      steps: Diffusion steps. A chain of another length needs parameters trained for it:
        numbers that no model has are rows that say so.
      guidance: Scales of classifier-free guidance on the past poses, in all plans; 1
        changes nothing. Less than 1 frees the motion from its past.
      style: Style; None for the model's first.
      course: Commands.
      speed: Meters per second; None for the style's median.
      seconds: Length of a rollout.
      every: Keep every so many frames, from the last one backwards.
      sets: Sets of rollouts, with seeds seed, seed + 1 and so on.
      seed: Of the first set's noise, and of the start pose.
      pairs: Random pairs of rollouts for each mean.
      memory_gib: Limit for each program: arguments, results and intermediate values.
      chunk: Rollouts at a time; None for as many as fit, but 16 on a CPU, whose cache
        more would not fit.
      out: Folder for diversity.json and diversity.md.
      gate: Report to compare with; exit status 1 if a program needs more memory.
    """

    rollouts: tuple[int, ...] = (64, 256, 1024)
    sweep_rollouts: int | None = None
    run: Path | None = None
    step_runs: tuple[Path, ...] = ()
    steps: tuple[int, ...] = (2, 4, 8, 16, 32)
    guidance: tuple[float, ...] = (0.0, 0.5, 0.7, 1.0)
    style: str | None = None
    course: str = "forward"
    speed: float | None = None
    seconds: float = 4.0
    every: int = 6
    sets: int = 20
    seed: int = 0
    pairs: int = 2000
    memory_gib: float = 4.0
    chunk: int | None = None
    out: Path = Path("runs/benchmarks")
    gate: Path | None = None


def check(args: Config) -> None:
    """Raises before any work if an argument makes no sense.

    Args:
      args: The settings.

    Raises:
      ValueError: names the option.
    """
    least = {
        "--rollouts": (min(args.rollouts, default=0), 2),
        "--steps": (min(args.steps, default=1), 1),
        "--every": (args.every, 1),
        "--sets": (args.sets, 2),
        "--pairs": (args.pairs, 1),
        "--chunk": (1 if args.chunk is None else args.chunk, 1),
    }
    if args.sweep_rollouts is not None:
        least["--sweep-rollouts"] = (args.sweep_rollouts, 2)
    for name, (found, expected) in least.items():
        if found < expected:
            raise ValueError(f"{name} {found}: expected {expected} or more")
    if args.course not in courses.COURSES:
        known = ", ".join(courses.COURSES)
        raise ValueError(f"--course {args.course}: there are {known}")
    if not args.memory_gib > 0:
        raise ValueError(f"--memory-gib {args.memory_gib}: expected more than 0")


def _cells(
    args: Config,
    program: workload.Program,
    numbers: tuple[int, ...],
    *,
    scale: float | None = None,
) -> dict[int, dict[str, table.Cell]]:
    """Columns for each number of rollouts, of the same sets."""
    found: dict[int, list[dict[str, Any]]] = {number: [] for number in numbers}
    for seed in range(args.seed, args.seed + args.sets):
        print(f"set with seed {seed}", end="\r", flush=True)
        key_roll, key_pairs = jax.random.split(jax.random.key(seed))
        motions = program.roll(key_roll, scale)
        for number in numbers:
            # Rollout i has the same noise whatever their number.
            part = jax.tree.map(lambda x: x[:number], motions)  # noqa: B023
            key = jax.random.fold_in(key_pairs, number)
            found[number].append(workload.measure(key, part, num_pairs=args.pairs))
    return {
        number: {
            column: table.cell(jnp.stack([row[column] for row in rows]))
            for column in rows[0]
        }
        for number, rows in found.items()
    }


def sweep(
    args: Config, load: workload.Load, others: list[workload.Load]
) -> tuple[dict[str, dict[str, table.Cell]], list[dict[str, Any]]]:
    """All rows.

    Args:
      args: The settings.
      load: The first model.
      others: Those for other step counts.

    Returns:
      The table, and what each program needs of the memory.
    """
    largest, needs = max(args.rollouts), []
    number = largest if args.sweep_rollouts is None else args.sweep_rollouts

    def program(load: workload.Load, number: int) -> workload.Program:
        made = workload.fit_program(
            load,
            number,
            every=args.every,
            limit=args.memory_gib * memory.GIB,
            chunk=args.chunk,
        )
        needs.append({"model": load.name, **made.memory})
        print(memory.describe(needs[-1]), flush=True)
        return made

    main = program(load, largest)
    by_number = _cells(args, main, tuple(sorted(set(args.rollouts))))
    if number != largest:
        main = program(load, number)
    own = by_number.get(number) or _cells(args, main, (number,))[number]
    by_steps = [(main.steps, load.name, own)]
    for other in others:
        made = program(other, number)
        cells = _cells(args, made, (number,))[number]
        by_steps.append((made.steps, other.name, cells))
    known = {steps for steps, *_ in by_steps}
    missing = set(args.steps) - known
    by_steps += [(n, "no parameters: give --step-runs", {}) for n in missing]
    rows = {f"{n} rollouts": cells for n, cells in by_number.items()}
    rows |= {
        f"{steps} steps ({name})": cells
        for steps, name, cells in sorted(by_steps, key=lambda x: x[0])
    }
    for scale in args.guidance:
        found = _cells(args, main, (number,), scale=scale)
        rows[f"guidance {scale:g}"] = found[number]
    return rows, needs


def main() -> None:
    """Measures, prints the table and writes the report."""
    args = tyro.cli(Config, description=__doc__)
    check(args)
    suite.prepare(args)
    options = dict(
        style=args.style,
        course=args.course,
        speed=args.speed,
        seconds=args.seconds,
        seed=args.seed,
    )
    load = workload.make_load(args.run or WALKER, **options)
    others = [workload.make_load(run, **options) for run in args.step_runs]
    for other in others:
        workload.check_same(load, other)
    rows, needs = sweep(args, load, others)
    text = table.to_markdown(rows)
    peak = memory.peak()
    print(text, f"{peak['what']}: {peak['bytes'] / memory.GIB:.2f} GiB", sep="\n")
    files.write_text(args.out / "diversity.md", text + "\n")
    metrics = [
        suite.Metric(f"memory {x['model']}", x["total"] / memory.GIB, "GiB")
        for x in needs
    ]
    suite.report(
        "diversity",
        metrics,
        args,
        rows=table.to_json(rows),
        memory=needs,
        peak_memory=peak,
        seeds=list(range(args.seed, args.seed + args.sets)),
        commit=reporting.git_commit(),
    )


if __name__ == "__main__":
    cli.start(main)
