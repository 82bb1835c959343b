"""The tables of the four papers beside what was measured here; their claims decided.

Gathers what the `evaluate` commands (and step_sweep.py) left in run folders, and writes
report.md, report.json and a picture of each table. What was not run is named with the
command that would run it.

Examples:
  python experiments/report.py
  python experiments/report.py --runs runs --out runs/report
  python experiments/report.py --smgdiff runs/other --out runs/report
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
      camdm: Run of camdm.py; None, here and below, for the folder of that name in
        `runs`, which need not exist.
      camdm_single_token: Run of camdm.py train --network single_token.
      camdm_mlp: Run of camdm.py train --network mlp.
      sweep_camdm: Results of step_sweep.py --system camdm.
      aamdm: Run of aamdm.py.
      emdm_action: Run of emdm.py train --task action.
      emdm_text: Run of emdm.py train --task text.
      emdm_none: Run of emdm.py train --task none.
      emdm_ablation: Run of emdm.py with the rows recon_0 to recon_100.
      sweep_emdm: Results of step_sweep.py --system emdm.
      smgdiff: Run of smgdiff.py.
    """

    runs: Path = Path("runs")
    out: Path = Path("runs/report")
    camdm: Path | None = None
    camdm_single_token: Path | None = None
    camdm_mlp: Path | None = None
    sweep_camdm: Path | None = None
    aamdm: Path | None = None
    emdm_action: Path | None = None
    emdm_text: Path | None = None
    emdm_none: Path | None = None
    emdm_ablation: Path | None = None
    sweep_emdm: Path | None = None
    smgdiff: Path | None = None


def folders_of(args: Config) -> dict[Source, Path]:
    """Run folder of each source.

    Args:
      args: Of the command line.

    Returns:
      The folders; those that were not given need not exist.

    Raises:
      FileNotFoundError: names an option whose folder does not exist.
    """
    if not args.runs.is_dir():
        raise FileNotFoundError(f"runs: no folder {args.runs}")
    found = {}
    for source in writing.SOURCES:
        given = getattr(args, source.run)
        if given is not None and not given.is_dir():
            raise FileNotFoundError(f"{source.run}: no folder {given}")
        found[source] = args.runs / source.run if given is None else given
    return found


def report(args: Config) -> None:
    """Writes the report, and prints how the claims came out.

    Args:
      args: Of the command line.
    """
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
