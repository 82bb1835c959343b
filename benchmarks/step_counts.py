"""Latency, memory and work of one sample against the number of diffusion steps.

Writes step_counts.json, .csv, .md and .png; with --quality also a Pareto plot of each
system's quality against time, step_counts_<system>.png.

Examples:
  python benchmarks/step_counts.py --steps 2 4 8
  python benchmarks/step_counts.py --system camdm --sampler own ddim dpm_solver
  python benchmarks/step_counts.py --system camdm --steps 2 4 8 16 32 --batch 1 64
  python benchmarks/step_counts.py --system emdm --steps 1 5 10 20 50 --batch 1 32
  python benchmarks/step_counts.py --system smgdiff --guided
  python benchmarks/step_counts.py --quality runs/sweep_camdm
  python benchmarks/step_counts.py --precision float32 tf32 bfloat16 --batch 1 64
"""

import contextlib
import dataclasses
import itertools
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import suite
import workload

from jaxmotion import cli, files
from jaxmotion.evaluation import columns, timing
from jaxmotion.networks import work
from jaxmotion.systems import registry
from jaxmotion.viz import plots

COLUMNS = {
    "system": "system",
    "sampler": "sampler",
    "batch": "batch",
    "precision": "precision",
    "steps": "steps",
    "network_calls": "calls",
    "compile_s": "compile s",
    "p50_ms": "p50 ms",
    "p95_ms": "p95 ms",
    "runs": "runs",
    "frames_per_second": "frames/s",
    "real_time": "x real time",
    "memory_mib": "MiB",
    "gflop": "GFLOP",
    "matmul_percent": "% of matmul",
    "difference": "difference",
}
Precision = Literal["float32", "tf32", "bfloat16"]
# What matrix products multiply; all of them add in float32.
ALGORITHMS: dict[Precision, str] = {
    "float32": "F32_F32_F32",
    "tf32": "TF32_TF32_F32",
    "bfloat16": "BF16_BF16_F32",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(suite.Settings):
    """Compile time, p50, p95, memory and FLOPs of one sample for several step counts.

    A sample is a plan, or EMDM's whole motion, or AAMDM's frame. Parameters are random:
    they do not change the time. Each system, sampler, step count and batch is a program
    of its own, compiled on purpose.

    Attributes:
      system: What to measure: camdm, aamdm, emdm, smgdiff; none: all, or those of
        --quality.
      sampler: own (ancestral, or ddgan), ddim, or dpm_solver (not aamdm, emdm).
      steps: Diffusion steps; aamdm drafts all but two, and polishes two. None: 2 4 8
        16, or those of --quality.
      batch: Characters that are sampled together.
      precision: What matrix products multiply. "difference" is the largest one of a
        sample to float32's, in deviations of that sample. A CPU refuses tf32, and
        multiplies bfloat16 as float32.
      devices: Split each batch over so many.
      arguments: Pass the parameters as arguments; without it they are constants of
        the program, as in deployment.
      chunk: Run batches of 16 and more in chunks of so many characters; 0 for all at
        once.
      attention: "full" (the papers'), or "prefix" (camdm, smgdiff), which computes what
        does not change from step to step once a plan.
      frames_per_token: Frames of one token; 1 is the paper's network.
      width: Channels of a token or hidden layer; None for 256, or 128 (emdm, the size
        that experiments/emdm.py trains).
      guided: Measure SMGDiff's plans with contact guidance in the last two steps as
        well.
      paper: Measure EMDM's network of 12 layers and 1024 channels, one frame a token.
      quality: Folders of experiments/step_sweep.py (or their table.json), one a system:
        networks are of the size of its models, whose quality is added to the rows of
        their steps and own sampler.
      runs: Timed calls of each program.
      limit: Seconds of timed calls of each program, at most.
    """

    system: tuple[str, ...] = ()
    sampler: tuple[str, ...] = ("own",)
    steps: tuple[int, ...] = ()
    batch: tuple[int, ...] = (1,)
    precision: tuple[Precision, ...] = ("float32",)
    devices: int = 1
    arguments: bool = False
    chunk: int = 4
    attention: Literal["full", "prefix"] = "full"
    frames_per_token: int = 1
    width: int | None = None
    guided: bool = False
    paper: bool = False
    quality: tuple[Path, ...] = ()
    runs: int = 50
    limit: float = 25.0


@dataclasses.dataclass(frozen=True)
class Line:
    """What a line of the plot has in common."""

    system: str
    sampler: str
    batch: int
    guided: bool
    precision: Precision = "float32"

    def __str__(self) -> str:
        guided = " guided" if self.guided else ""
        name = "" if self.precision == "float32" else f" {self.precision}"
        return f"{self.system} {self.sampler}{guided}{name} batch={self.batch}"


# Options that do not change every system.
ONLY = {
    "guided": ("smgdiff",),
    "paper": ("emdm",),
    "frames_per_token": ("camdm", "smgdiff"),
    "attention": ("camdm", "smgdiff"),
}
# What a trained model's configuration says.
SIZES = ("width", "paper", "frames_per_token", "attention")


def without_effect(args: Config, sized: Collection[str]) -> list[str]:
    """Lines about options that change only some of the systems to measure.

    Args:
      args: The settings, systems filled in.
      sized: Systems whose sizes are those of trained models.

    Raises:
      ValueError: if an option changes none of them.
    """
    lines, paper = [], {"emdm"} if args.paper else set()
    for field in dataclasses.fields(args):
        name = field.name
        if name not in {*ONLY, *SIZES} or getattr(args, name) == field.default:
            continue
        changed = set(ONLY.get(name, args.system)) & set(args.system)
        if name in SIZES:
            changed -= set(sized)
        if name == "width":
            changed -= paper  # the published network has its own
        rest = [system for system in args.system if system not in changed]
        option = f"--{name.replace('_', '-')}"
        why = " (sizes are those of the models of --quality)" if sized else ""
        if not changed:
            raise ValueError(f"{option} changes nothing of {', '.join(rest)}{why}")
        if rest:
            lines.append(f"{option} changes nothing of {', '.join(rest)}{why}")
    return lines


def make_lines(args: Config) -> list[Line]:
    """What to measure, a number of steps each.

    Raises:
      ValueError: names the option, and what a system cannot take.
    """
    suite.at_least(args, steps=1, batch=1, chunk=0, runs=1, devices=1)
    if args.devices > len(jax.devices()):
        raise ValueError(f"--devices {args.devices}: {len(jax.devices())} are there")
    for batch in args.batch:
        if batch % args.devices:
            raise ValueError(
                f"--batch {batch}: expected a multiple of --devices {args.devices}"
            )
    if args.guided and min(args.steps) < 2:
        raise ValueError("--steps 1: expected 2 or more, --guided guides the last two")

    def found() -> Iterator[Line]:
        for system, name in itertools.product(args.system, args.sampler):
            sampler = workload.sampler_of(system, name)
            both = args.guided and system == "smgdiff"
            for batch, guided, precision in itertools.product(
                args.batch, (False, True), args.precision
            ):
                if both or not guided:
                    yield Line(system, sampler, batch, guided, precision)

    return list(dict.fromkeys(found()))


def matmul_of(precision: Precision) -> contextlib.AbstractContextManager:
    """Within it, matrix products of what is traced are of this precision."""
    if jax.default_backend() == "cpu" and precision == "float32":
        return contextlib.nullcontext()  # its own, and fastest
    return jax.default_matmul_precision(ALGORITHMS[precision])


def case(
    args: Config, line: Line, steps: int, rate: float, *, config: Any = None
) -> dict[str, Any]:
    """Measures one number of steps: a row of the report.

    Args:
      args: The settings.
      line: What to measure.
      steps: Diffusion steps.
      rate: FLOP per second of this machine's matmul.
      config: Configuration of a trained model, whose sizes the network has.
    """
    sizes = workload.Sizes(
        steps=steps,
        width=args.width,
        frames_per_token=args.frames_per_token,
        paper=args.paper,
        attention=args.attention,
        guided=line.guided,
        step=workload.STEPS[line.sampler],
        config=config,
    )
    samples = workload.of(line.system, "samples")(sizes)

    def program() -> tuple:
        return samples.program(
            line.batch, chunk=args.chunk, arguments=args.arguments, devices=args.devices
        )

    def sample(precision: Precision) -> np.ndarray:
        run, given = program()
        with matmul_of(precision):
            return np.asarray(run(*given))

    # Two programs: one that has been traced would not be traced again.
    run, given = program()
    asked = work.count(run, *given)
    run, given = program()
    with matmul_of(line.precision):
        found = timing.measure(run, *given, rounds=args.runs, limit_s=args.limit)
    difference = None
    if line.precision != "float32":
        exact = sample("float32")
        gap = np.abs(sample(line.precision) - exact).max()
        difference = float(gap / exact.std())
    frames = line.batch * samples.frames
    per_second = 1000 * frames / found.p50_ms
    return {
        **dataclasses.asdict(line),
        "steps": steps,
        # The trace has one device's share.
        "network_calls": args.devices * asked.network_calls // line.batch,
        **dataclasses.asdict(found),
        "frames_per_second": per_second,
        "ms_per_frame": found.p50_ms / frames,
        "real_time": per_second / samples.fps / line.batch,
        "gflop": args.devices * asked.flops / 1e9,
        "matmul_percent": 100 * asked.flops / (found.p50_ms / 1000) / rate,
        "difference": difference,
    }


Quality = dict[tuple[str, int], dict[str, Any]]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sweep:
    """A sweep's models: their sizes, and their quality by number of steps.

    Attributes:
      path: The table.
      system: Whose models they are.
      config: Configuration of one of them; they differ in steps alone.
      cells: Entries of rows: "quality", its ends, and "quality_column".
      left_out: Rows that have no time here: of students, or without a number.
    """

    path: Path
    system: str
    config: Any
    cells: dict[int, dict[str, Any]]
    left_out: list[str]


def read_sweep(path: Path) -> Sweep:
    """A sweep from its folder or its table.json.

    Raises:
      OSError: if it cannot be read.
      ValueError: if it is no sweep of this version; names the file.
    """
    what = "expected the folder of a sweep of experiments/step_sweep.py"
    path = path / "table.json" if path.is_dir() else path
    table = files.read_object(path, what=what)
    missing = {"system", "rows", "arguments", "config"} - set(table)
    if missing:
        raise ValueError(
            f"--quality {path}: has no {', '.join(sorted(missing))}, {what}; one of an "
            "older version is made anew from its models by the same command"
        )
    try:
        system, rows, told = table["system"], table["rows"], table["arguments"]["steps"]
        bench = registry.get(system).bench
        points = bench.points(tuple(told))
        found = [rows[point.row].get(bench.quality) or {} for point in points]
        config = workload.config_of(system, table["config"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"--quality {path}: {error}: {what}") from error
    cells: dict[int, dict[str, Any]] = {}
    for point, cell in zip(points, found, strict=True):
        named = workload.point_of(system, point.steps)
        timed = point.teacher is None and bench.points((named,))[0].row == point.row
        if not timed or cell.get("value") is None:
            continue
        ends = (cell.get(key) for key in ("low", "high"))
        low, high = (cell["value"] if end is None else end for end in ends)
        cells[point.steps] = {
            "quality": cell["value"],
            "quality_low": low,
            "quality_high": high,
            "quality_column": columns.header(bench.quality),
        }
    known = {bench.points((workload.point_of(system, x),))[0].row for x in cells}
    return Sweep(
        path=path,
        system=system,
        config=config,
        cells=cells,
        left_out=[point.row for point in points if point.row not in known],
    )


def fill(args: Config, sweeps: list[Sweep]) -> Config:
    """The settings with the systems and steps that were left to the sweeps.

    Raises:
      ValueError: if sweeps are of one system or of others than asked for, or have
        nothing of the steps.
    """
    names = [sweep.system for sweep in sweeps]
    system = args.system or tuple(names) or tuple(registry.SYSTEMS)
    every = sorted({steps for sweep in sweeps for steps in sweep.cells})
    steps = args.steps or tuple(every) or (2, 4, 8, 16)
    for sweep in sweeps:
        if names.count(sweep.system) > 1:
            raise ValueError(
                f"--quality {sweep.path}: a second table of {sweep.system}"
            )
        if sweep.system not in system:
            raise ValueError(
                f"--quality {sweep.path}: a table of system {sweep.system!r}, expected "
                f"one of --system {', '.join(system)}"
            )
        if not set(steps) & set(sweep.cells):
            raise ValueError(
                f"--quality {sweep.path}: nothing of --steps "
                f"{', '.join(map(str, steps))}, expected some of "
                f"{', '.join(map(str, sweep.cells)) or 'a sweep that has any'}"
            )
    if args.guided and "smgdiff" in names:
        raise ValueError(
            "--guided: a sweep has no skeleton of its models: measure guided plans "
            "without --quality"
        )
    return dataclasses.replace(args, system=system, steps=steps)


def join(row: dict[str, Any], quality: Quality) -> dict[str, Any]:
    """The row with its quality: None where it has none, as of other samplers."""
    own = row["sampler"] == workload.sampler_of(row["system"], "own")
    plain = own and not row["guided"] and row["precision"] == "float32"
    empty = {"quality": None, "quality_column": None}
    return row | (plain and quality.get((row["system"], row["steps"])) or empty)


def draw_quality(args: Config, rows: list[dict[str, Any]]) -> None:
    """Draws quality against time of each system that has any, at the smallest batch."""
    for system in args.system:
        own = [
            row
            for row in rows
            if (row["system"], row["batch"]) == (system, min(args.batch))
            and row["quality"] is not None
        ]
        if not own:
            continue
        ends = ("quality", "quality_low", "quality_high")
        plots.write_pareto(
            args.out / f"step_counts_{system}.png",
            tuple(str(row["steps"]) for row in own),
            np.array([[row["p50_ms"]] * 3 for row in own]),
            np.array([[row[name] for name in ends] for row in own]),
            references={},
            xlabel=f"a batch of {min(args.batch)}: p50, ms",
            ylabel=f"{own[0]['quality_column']} (lower is better)",
            title=f"{system}: quality of the sweep's models, time of this benchmark",
        )


def metrics_of(name: str, row: dict[str, Any]) -> list[suite.Metric]:
    """Metrics of a row: its times, and its memory."""
    memory = suite.Metric(f"{name} memory", row["memory_mib"], "MiB", tolerance=0.1)
    return [*suite.time_metrics(name, row), memory]


def main() -> None:
    """Measures, writes the report, the table and the plot."""
    args = suite.parse(Config, __doc__)
    sweeps = [read_sweep(path) for path in args.quality]
    args = fill(args, sweeps)
    configs = {sweep.system: sweep.config for sweep in sweeps}
    quality = {(x.system, n): cell for x in sweeps for n, cell in x.cells.items()}
    lines = make_lines(args)
    for said in without_effect(args, configs):
        print(said, flush=True)
    for sweep in sweeps:
        if sweep.left_out:
            print(f"{sweep.path}: not timed here: {', '.join(sweep.left_out)}")
    rate = timing.matmul_rate()
    print(f"matmul, float32: {rate / 1e9:.4g} GFLOP/s", flush=True)
    rows, metrics, drawn = [], [], {}
    for line in lines:
        own = []
        for steps in args.steps:
            row = case(args, line, steps, rate, config=configs.get(line.system))
            own.append(join(row, quality))
            about = f"{line} steps={steps}"
            print(f"{about}: {own[-1]['p50_ms']:.4g} ms", flush=True)
            metrics += metrics_of(about, own[-1])
            suite.save("step_counts", metrics, args, rows=rows + own)
        drawn[str(line)] = tuple(
            np.array([row[name] for row in own])
            for name in ("steps", "p50_ms", "p95_ms")
        )
        rows += own
    titles = COLUMNS
    if quality:
        titles = titles | {"quality": "quality", "quality_column": "measured as"}
        draw_quality(args, rows)
    suite.print_table(rows, titles)
    suite.write_table(args.out / "step_counts", rows, titles)
    plots.plot_sweep(
        args.out / "step_counts.png",
        drawn,
        xlabel="diffusion steps",
        ylabel="a batch of samples, ms (p50, whisker to p95)",
    )
    suite.report("step_counts", metrics, args, rows=rows, matmul_gflops=rate / 1e9)


if __name__ == "__main__":
    cli.start(main)
