"""Quality against time for several numbers of steps, for any of the four systems.

Trains a model for each number of steps with the same budget, seed and data (or loads
those that the folder has), evaluates all with the same noise, commands and samples, and
writes table.md, table.csv, table.json, pareto.png and a rollout of each.

Examples:
  python experiments/step_sweep.py --system camdm --steps 2 4 8 16 32 --budget quick
  python experiments/step_sweep.py --system smgdiff --steps 2 4 8 16 32
  python experiments/step_sweep.py --system emdm --steps 1 2 5 10 20
  python experiments/step_sweep.py --system aamdm --steps 0+3 1+3 2+3 10+3 2+10
  python experiments/step_sweep.py --system camdm --change updates=3000 width=192
  python experiments/step_sweep.py --system camdm --evaluator evaluators/styles.npz
"""

import dataclasses
from pathlib import Path

import tyro
from sweeps import aamdm, budgets, camdm, emdm, run, smgdiff
from sweeps.system import Job

from jaxmotion import cli
from jaxmotion.evaluators import frozen
from jaxmotion.reporting import arguments_json

SYSTEMS = {
    "camdm": camdm.SYSTEM,
    "aamdm": aamdm.SYSTEM,
    "emdm": emdm.SYSTEM,
    "smgdiff": smgdiff.SYSTEM,
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Sweep over numbers of steps.

    Attributes:
      system: camdm, aamdm, emdm or smgdiff.
      steps: Numbers of steps T: of the motion model (camdm, smgdiff), of the GAN
        (emdm), polish steps (aamdm; or polish and draft steps as in 2+3).
      drafts: Draft steps of aamdm, where polish steps alone are given.
      budget: quick (half an hour of two cores for five numbers of steps, training
        included) or full; the numbers are listed above.
      change: Numbers of the budget to change, as in updates=3000.
      data: Clips from prepare_data.py or dribble.py; none: data/bandai2.npz (camdm),
        data/lafan1.npz (aamdm), data/bandai1.npz and bandai2.npz (emdm),
        data/dribble.npz (smgdiff).
      out: Folder of the results; None for runs/sweep_<system>.
      models: Folder of the models; None for <out>/models. A model that is there is
        not trained again; one of another budget, seed or data is refused.
      replications: Sets of samples of each model, each with noise of its own;
        intervals run over these.
      evaluator: File of a frozen recognizer, from evaluator.py; None trains one, with
        the budget's updates. aamdm has none.
      seed: Of parameters, batches, poses, noise and evaluators.
    """

    system: str
    steps: tuple[str, ...] = ("2", "4", "8", "16", "32")
    drafts: int = 3
    budget: str = "quick"
    change: tuple[str, ...] = ()
    data: tuple[Path, ...] = ()
    out: Path | None = None
    models: Path | None = None
    replications: int = 20
    evaluator: Path | None = None
    seed: int = 0


def load_evaluator(args: Config, kind: frozen.Kind | None) -> frozen.Evaluator | None:
    """The frozen recognizer that the arguments name.

    Args:
      args: Of the command line.
      kind: That the system needs; None for none.

    Returns:
      The recognizer; None if it is to be trained.

    Raises:
      ValueError: if there is no such file, or it is of another kind.
    """
    if args.evaluator is None:
        return None
    if kind is None:
        raise ValueError(f"evaluator: {args.system} is judged without a recognizer")
    found = frozen.load(args.evaluator)
    if found.kind != kind:
        raise ValueError(
            f"evaluator: {args.evaluator} is of kind {found.kind!r}, {args.system} "
            f"needs {kind!r}"
        )
    return found


def make_job(args: Config) -> tuple[Job, Path]:
    """The sweep that the arguments describe, and the folder of its results.

    Args:
      args: Of the command line.

    Returns:
      Both.

    Raises:
      ValueError: names the field that is wrong.
    """
    if args.system not in SYSTEMS:
        raise ValueError(
            f"system: unknown system {args.system!r}, expected one of "
            f"{', '.join(SYSTEMS)}"
        )
    system = SYSTEMS[args.system]
    out = args.out or Path(f"runs/sweep_{args.system}")
    job = Job(
        points=system.points(args.steps, drafts=args.drafts),
        data=args.data or system.data,
        models=args.models or out / "models",
        budget=budgets.resolve(system.amounts, args.budget, args.change),
        replications=args.replications,
        seed=args.seed,
        evaluator=load_evaluator(args, system.judge),
    )
    return job, out


def main() -> None:
    """Parses the command line and runs the sweep."""
    numbers = [budgets.describe(name, x.amounts) for name, x in SYSTEMS.items()]
    args = cli.check(tyro.cli(Config, description="\n\n".join([__doc__, *numbers])))
    job, out = make_job(args)
    shown = arguments_json(args) | {
        "data": [str(file) for file in job.data],
        "out": str(out),
        "models": str(job.models),
    }
    run.sweep(args.system, SYSTEMS[args.system], job, out, shown)


if __name__ == "__main__":
    cli.start(main)
