"""Trains and evaluates what the papers' claims still need, a process per core.

Takes the runs of experiments/papers and their commands, with seeds 0, 1, ...: each run
until all claims of its tables are decided, or MAX trainings are made. What is there, or
stored in experiments/results, is not made again. Ctrl-C and `kill -9` lose nothing but
the updates since the last checkpoint: the same command goes on, and leaves alone what
still runs.

Examples:
  python experiments/train_queue.py --only emdm_ablation --minutes 240 --keep
  nohup python experiments/train_queue.py --cores 1 > queue.log &

Beside each run folder's files are queue.log (all output) and queue.json (the commands
and their minutes, which add up over restarts).
"""

import dataclasses
import fcntl
import itertools
import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import report
import tqdm
import tyro
from reports import results, stored, verdicts, writing
from reports.claims import Source

from jaxmotion import cli, files, reporting
from jaxmotion.learning import loop
from jaxmotion.learning import runs as learning_runs

POLL = 1.0  # seconds between looks at running trainings


@dataclasses.dataclass(frozen=True)
class Config:
    """Train what the papers' claims still need.

    Attributes:
      runs: Folder of the run folders.
      only: Names of runs (as experiments/papers has them); none: all.
      least: Trainings of each run, whatever its claims say.
      most: Trainings at most; claims that are open then stay so.
      cores: Trainings at a time, each on a core of its own; None for all cores.
      minutes: Start nothing after so many; None to go on until all is done.
      keep: Store what a training measured in experiments/results (then
        `report.py --write-docs`).
    """

    runs: Path = Path("runs")
    only: cli.Names = ()
    least: int = 3
    most: int = verdicts.MAX_TRAININGS
    cores: cli.Optional[int] = None
    minutes: cli.Optional[float] = None
    keep: bool = False


@dataclasses.dataclass(frozen=True)
class Job:
    """One training of a run, and its evaluations.

    Attributes:
      run: Name of the run, of all its seeds.
      folder: The run folder.
      commands: What makes it, in turn.
      files: What it leaves behind when it is done, by the name it is stored under.
    """

    run: str
    folder: Path
    commands: tuple[str, ...]
    files: dict[str, Path]

    def measured(self, name: str) -> Path:
        """Where a file is: in the run folder, or as it was stored."""
        path, kept = self.files[name], stored.FOLDER / f"{name}.json"
        there = results.is_whole(path) or not stored.is_measured(kept)
        return path if there else kept

    @property
    def done(self) -> bool:
        """Whether nothing is missing."""
        return all(results.is_whole(self.measured(name)) for name in self.files)


def sources_of(args: Config) -> dict[str, list[Source]]:
    """Files that each run leaves behind, by its name.

    Raises:
      ValueError: names what is no run of the papers' tables.
    """
    found: dict[str, list[Source]] = {}
    for source in writing.SOURCES:
        found.setdefault(source.run, []).append(source)
    for name in args.only:
        if name not in found:
            raise ValueError(
                f"--only: unknown run {name!r}, expected one of {', '.join(found)}"
            )
    return {name: found[name] for name in args.only or found}


def job_of(args: Config, sources: list[Source], seed: int) -> Job:
    """The training of a seed."""
    run = sources[0].run
    folder = learning_runs.of_seed(args.runs / run, seed)
    lines = [line for x in sources for line in report.commands_of(x, folder, seed)]
    end = f"_seed{seed}" if seed else ""
    found = {f"{x.name}{end}": folder / x.file for x in sources}
    return Job(run, folder, tuple(dict.fromkeys(lines)), found)


def paths_of(args: Config, source: Source) -> list[Path]:
    """A source's files of seeds 0, 1, ..., up to the first that is not there."""
    jobs = (job_of(args, [source], seed) for seed in range(args.most))
    there = itertools.takewhile(lambda job: job.done, jobs)
    return [job.measured(*job.files) for job in there]


def needed(args: Config, sources: list[Source]) -> int:
    """Trainings that a run needs, as far as those that are there tell.

    A claim that is not decided asks for one more, unless rows that it compares with,
    of other runs, have fewer.
    """
    there = min(len(paths_of(args, source)) for source in sources)
    if there < args.least:
        return min(args.least, args.most)
    for table in writing.TABLES:
        rows = dict.fromkeys(map(table.source_of, table.rows))
        if not rows.keys() & {*sources}:
            continue
        paths = {source: paths_of(args, source) for source in rows}
        found = {k: results.read_trainings(own) for k, own in paths.items() if own}
        for claim in table.claims:
            asked = {table.source_of(table.row(name)) for name in claim.rows}
            if not asked & {*sources} or min(len(paths[x]) for x in asked) < there:
                continue
            if verdicts.decide(table, claim, found).verdict == "not decided":
                return min(there + 1, args.most)
    return there


class Running(NamedTuple):
    """A training that this queue started.

    Attributes:
      job: Which.
      process: Its shell.
      minutes: What it had taken before.
      begun: When it started, on the monotonic clock.
    """

    job: Job
    process: subprocess.Popen
    minutes: float
    begun: float

    def note(self) -> None:
        """Writes down how long it has taken so far."""
        minutes = self.minutes + (time.monotonic() - self.begun) / 60
        value = {"minutes": round(minutes, 2), "commands": self.job.commands}
        path = self.job.folder / "queue.json"
        files.write_text(path, json.dumps(value, indent=1))


def output_of(words: list[str]) -> Path:
    """What a command that serves several runs leaves behind, as an evaluator's file."""
    return Path(words[words.index("--out") + 1])


def start(job: Job, core: int) -> Running | None:
    """Starts a training on a core; None if it is running already.

    The lock is the training's own: it outlives a queue that is killed.
    """
    job.folder.mkdir(parents=True, exist_ok=True)
    lock = (job.folder / "queue.lock").open("w")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        return None
    minutes, path = 0.0, job.folder / "queue.json"
    if path.is_file():
        minutes = float(json.loads(path.read_text())["minutes"])
    lines = [
        shlex.join([sys.executable, *words[1:]])
        for words in map(shlex.split, job.commands)
        if str(job.folder) in words or not output_of(words).exists()
    ]
    known = hasattr(os, "sched_setaffinity")
    with (job.folder / "queue.log").open("a") as log, lock:
        process = subprocess.Popen(
            ["sh", "-c", " && ".join(lines)],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            pass_fds=[lock.fileno()],
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            # In the shell, before it starts anything that would keep all cores.
            preexec_fn=(lambda: os.sched_setaffinity(0, {core})) if known else None,
        )
    return Running(job, process, minutes, time.monotonic())


def keep(job: Job, sources: list[Source]) -> list[Path]:
    """Stores what a training measured; the first of a table has its source's title."""
    kept = []
    for source, (name, path) in zip(sources, job.files.items(), strict=True):
        is_new = not (stored.FOLDER / f"{source.name}.json").is_file()
        title = source.title if is_new else ""
        kept.append(stored.keep(stored.FOLDER, path, name, title))
    return kept


def shared(job: Job) -> set[Path]:
    """What a training waits for that others wait for as well, and is not there."""
    lines = map(shlex.split, job.commands)
    found = {output_of(words) for words in lines if str(job.folder) not in words}
    return {path for path in found if not path.exists()}


def last_line(path: Path) -> str:
    """The last line of a log that says something."""
    lines = [x for x in path.read_text(errors="replace").splitlines() if x.strip()]
    return lines[-1].strip() if lines else "no output"


def work(args: Config, show: Callable[[str], None] = print) -> list[Job]:
    """Runs the queue to its end.

    Args:
      args: What, where and how much.
      show: Takes lines for the user.

    Returns:
      Trainings that failed.
    """
    sources = sources_of(args)
    cores = sorted(os.sched_getaffinity(0))[: args.cores]
    wanted = {name: needed(args, own) for name, own in sources.items()}
    running: dict[int, Running] = {}
    left: dict[Path, Job] = {}  # failed, or at work elsewhere
    failed, begun = [], time.monotonic()

    def jobs() -> list[Job]:
        """All that is wanted, the first seeds of all runs first."""
        found = [
            (seed, job_of(args, own, seed))
            for name, own in sources.items()
            for seed in range(wanted[name])
        ]
        return [job for _, job in sorted(found, key=lambda x: x[0])]

    def following() -> Job | None:
        """The next to be started, if any."""
        if args.minutes is not None and time.monotonic() - begun > 60 * args.minutes:
            return None
        busy = {x.job.folder for x in running.values()} | left.keys()
        made = set().union(*(shared(x.job) for x in running.values()))
        waiting = (x for x in jobs() if not x.done and x.folder not in busy)
        return next((x for x in waiting if not made & shared(x)), None)

    with tqdm.tqdm(unit="training", disable=None) as bar:
        while True:
            bar.total, bar.n = len(jobs()), sum(job.done for job in jobs())
            bar.refresh()
            idle = [core for core in cores if core not in running]
            while idle and (job := following()):
                if made := start(job, idle[0]):
                    running[idle.pop(0)] = made
                    show(f"{job.folder}: started")
                else:
                    left[job.folder] = job
                    show(f"{job.folder}: another queue trains it, left alone")
            if not running:
                return failed
            time.sleep(POLL)
            for core, own in list(running.items()):
                own.note()
                if (code := own.process.poll()) is None:
                    continue
                job = running.pop(core).job
                if code == 0 and job.done:
                    show(f"{job.folder}: done")
                    if args.keep:
                        for path in keep(job, sources[job.run]):
                            show(f"wrote {path}")
                    # Other runs may have waited for this one's rows.
                    wanted |= {k: needed(args, own) for k, own in sources.items()}
                else:
                    left[job.folder] = job
                    failed.append(job)
                    log = job.folder / "queue.log"
                    show(f"{job.folder}: failed: {last_line(log)} ({log})")


def main() -> None:
    """Parses the command line and works the queue off."""
    args = cli.check(tyro.cli(Config, description=__doc__))
    if args.keep and reporting.git_commit() is None:
        raise ValueError(
            "--keep: this is no git checkout, expected one: what is stored names the "
            "commit that made it"
        )
    loop.check_writable(args.runs)
    if failed := work(args, show=tqdm.tqdm.write):
        raise ValueError(f"{len(failed)} trainings failed, see their queue.log")


if __name__ == "__main__":
    cli.start(main)
