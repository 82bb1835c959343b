"""The tables of the four papers beside what was measured here; their claims decided.

Gathers what the `evaluate` commands (and step_sweep.py) left in run folders, and writes
report.md, report.json and a picture of each table. What was not run is named with the
command that would run it.

Examples:
  python experiments/report.py
  python experiments/report.py --runs runs --out runs/report
  python experiments/report.py --elsewhere smgdiff=runs/other --out runs/report
"""

import dataclasses
from pathlib import Path

import tyro
from reports import results, verdicts, writing
from reports.claims import Source

from jaxmotion import cli, reporting
from jaxmotion.learning import loop


@dataclasses.dataclass(frozen=True)
class Config:
    """Report on the papers' tables.

    Attributes:
      runs: Folder of the run folders.
      out: Folder of the report.
      elsewhere: Run folders that do not lie in `runs` under the names that
        experiments/papers gives them, as in smgdiff=runs/other.
    """

    runs: Path = Path("runs")
    out: Path = Path("runs/report")
    elsewhere: tuple[str, ...] = ()


def folders_of(args: Config) -> dict[Source, Path]:
    """Run folder of each source; those that were not given need not exist.

    Raises:
      FileNotFoundError: names what does not exist.
      ValueError: names what is no run of the papers' tables.
    """
    if not args.runs.is_dir():
        raise FileNotFoundError(f"runs: no folder {args.runs}")
    names = dict.fromkeys(source.run for source in writing.SOURCES)
    found = {name: args.runs / name for name in names}
    for given in args.elsewhere:
        name, _, folder = given.partition("=")
        if name not in names or not folder:
            raise ValueError(
                f"elsewhere: {given!r}, expected name=folder with a name of "
                f"{', '.join(names)}"
            )
        if not Path(folder).is_dir():
            raise FileNotFoundError(f"elsewhere: no folder {folder} for {name}")
        found[name] = Path(folder)
    return {source: found[source.run] for source in writing.SOURCES}


def report(args: Config) -> None:
    """Writes the report, and prints how the claims came out."""
    folders = folders_of(args)
    found = {
        source: results.read(folder / source.file) for source, folder in folders.items()
    }
    loop.check_writable(args.out)
    commands = {
        source: tuple(x.format(run=folders[source]) for x in source.commands)
        for source in folders
    }
    decided = writing.write(args.out, found, commands, reporting.provenance())
    for name in verdicts.Verdict.__args__:
        own = [(t, c) for t, c, decision in decided if decision.verdict == name]
        print(f"{name}: {len(own)}")
        for table, claim in own:
            print(f"  {table.name}: {claim.words}")
    print(f"wrote report.md, report.json and pictures to {args.out}")


def main() -> None:
    """Parses the command line and writes the report."""
    report(cli.check(tyro.cli(Config, description=__doc__)))


if __name__ == "__main__":
    cli.start(main)
