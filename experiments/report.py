"""The tables of the four papers beside what was measured here; their claims decided.

Gathers what the `evaluate` commands (and step_sweep.py) left in run folders, and writes
report.md and report.json. What was not run is named with the command that would run it.

With --keep it stores what one evaluation left behind in experiments/results instead, and
with --write-docs it writes the tables, plots and figures of all pages from there.

Examples:
  python experiments/report.py
  python experiments/report.py --runs runs --out runs/report
  python experiments/report.py --seeds 3 --out runs/report
  python experiments/report.py --elsewhere aamdm=runs/a0,runs/a1,runs/a2 --out runs/report
  python experiments/report.py --keep runs/steering/metrics.json --name camdm/steering
  python experiments/report.py --write-docs
"""  # noqa: E501

import dataclasses
from pathlib import Path

import tyro
from reports import markdown, pages, results, stored, writing
from reports.claims import Source

from jaxmotion import cli, reporting
from jaxmotion.learning import loop


@dataclasses.dataclass(frozen=True)
class Config:
    """Report on the papers' tables.

    Attributes:
      runs: Folder of the run folders.
      out: Folder of the report.
      seeds: Trainings of each run, of seeds 0, 1, ...: aamdm, aamdm_seed1, ...; where
        there are several, claims are decided by paired differences over them.
      elsewhere: Run folders that do not lie in `runs` under the names that
        experiments/papers gives them, as in smgdiff=runs/other; several, with commas
        between, are several trainings.
      keep: Instead of a report: a metrics.json (or a sweep's table.json) to store.
      name: What it is stored as, system/table; of a further training, with _seed1 and
        so on at its end.
      title: What the stored table answers; "" for that of the file it replaces.
      add: Add the rows of `keep` to those that are stored under that name.
      write_docs: Instead of a report: write the pages' tables, plots and figures.
    """

    runs: Path = Path("runs")
    out: Path = Path("runs/report")
    seeds: int = 1
    elsewhere: tuple[str, ...] = ()
    keep: Path | None = None
    name: str = ""
    title: str = ""
    add: bool = False
    write_docs: bool = False


def folders_of(args: Config) -> dict[Source, tuple[Path, ...]]:
    """Run folders of each source's trainings; those not given need not exist.

    Raises:
      FileNotFoundError: names what does not exist.
      ValueError: names what is no run of the papers' tables.
    """
    if not args.runs.is_dir():
        raise FileNotFoundError(f"runs: no folder {args.runs}")
    names = dict.fromkeys(source.run for source in writing.SOURCES)
    ends = ("", *(f"_seed{i}" for i in range(1, args.seeds)))
    found = {name: tuple(args.runs / f"{name}{x}" for x in ends) for name in names}
    for given in args.elsewhere:
        name, _, folders = given.partition("=")
        if name not in names or not folders:
            raise ValueError(
                f"elsewhere: {given!r}, expected name=folder with a name of "
                f"{', '.join(names)}"
            )
        found[name] = tuple(map(Path, folders.split(",")))
        for folder in found[name]:
            if not folder.is_dir():
                raise FileNotFoundError(f"elsewhere: no folder {folder} for {name}")
    return {source: found[source.run] for source in writing.SOURCES}


def commands_of(source: Source, folder: Path, seed: int) -> tuple[str, ...]:
    """What leaves a source's file behind in a training's folder."""
    return tuple(
        command.format(run=folder)
        + (f" --seed {seed}" if seed and "--out {run} " in f"{command} " else "")
        for command in source.commands
    )


def report(args: Config) -> None:
    """Writes the report, and prints how the claims came out."""
    folders = folders_of(args)
    found = {
        source: results.read_trainings([folder / source.file for folder in own])
        for source, own in folders.items()
    }
    loop.check_writable(args.out)
    commands = {
        source: tuple(
            dict.fromkeys(
                line
                for seed, folder in enumerate(own)
                for line in commands_of(source, folder, seed)
            )
        )
        for source, own in folders.items()
    }
    for source, there in found.items():
        trained = there.trainings if there else ()
        for folder, one in zip(folders[source], trained, strict=False):
            if one is None:
                print(f"a training is missing: no {folder / source.file}")
    decided = writing.write(args.out, found, commands, reporting.provenance())
    for name, count in markdown.counts(decided).items():
        print(count)
        for table, claim, decision in decided:
            if decision.verdict == name:
                reason = f" ({decision.reason})" if decision.reason else ""
                print(f"  {table.name}: {claim.words}{reason}")
    print(f"{len(writing.ABSENT)} of the papers' results cannot be run here")
    for absent in writing.ABSENT:
        print(f"  {absent.paper}, {absent.what}: {absent.reason}")
    print(f"wrote report.md and report.json to {args.out}")


def keep_and_write(args: Config) -> None:
    """Stores a result, writes the pages, or both; says what was written."""
    if args.keep is not None:
        made = stored.keep(
            stored.FOLDER, args.keep, args.name, args.title, add=args.add
        )
        print(f"wrote {made}")
    if args.write_docs:
        for path in pages.write():
            print(f"wrote {path}")


def main() -> None:
    """Parses the command line and does what it says."""
    args = cli.check(tyro.cli(Config, description=__doc__))
    if args.add and args.keep is None:
        raise ValueError("add: expected --keep, whose rows should be added")
    if args.keep is not None or args.write_docs:
        keep_and_write(args)
    else:
        report(args)


if __name__ == "__main__":
    cli.start(main)
