"""CAMDM's changes of style: how many succeed, how soon, with and without guidance.

Characters walk in one style, are told another, and an evaluator looks for it in what
follows: the paper's tables 2 and 4, where people judged. Rows are the default
guidance on the past (the paper's), that of its release, none, and characters who
were told nothing, in whom what is found is a mistake of the evaluator's.

Examples:
  python experiments/camdm_transitions.py --run runs/camdm
  python experiments/camdm_transitions.py --run runs/camdm --evaluator evaluators/styles.npz
"""  # noqa: E501

import dataclasses
from pathlib import Path

import jax
import tyro

from jaxmotion import cli, reporting
from jaxmotion.control.courses import Course
from jaxmotion.evaluators import frozen
from jaxmotion.systems.camdm import evaluation as camdm_evaluation
from jaxmotion.systems.camdm import training as camdm_training
from jaxmotion.systems.camdm import transitions as camdm_transitions
from jaxmotion.systems.camdm.controller import RELEASED, Control

CONTROLS = {
    "guided": Control(),
    "guided as released": Control(
        guidance_scale=RELEASED.guidance_scale, guided_plans=RELEASED.guided_plans
    ),
    "not guided": Control(guided_plans=0),
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Change the style of characters, and measure how it goes.

    Attributes:
      run: Run folder of camdm.py train.
      data: Clips; None for those that the run was trained on.
      out: Folder for metrics.json and table.md; None for <run>/transitions.
      replications: Sets of one rollout for each ordered pair of styles, with start
        poses and noise of their own; intervals run over these.
      before: Seconds in the first style, 1 at least.
      limit: Seconds after the command in which the change must have come.
      course: Commands; each style goes at its own median speed.
      contents: Contents of the clips to start from; none: all of the run's.
      chunk: Characters to run at a time, at most.
      evaluator_steps: Updates of the evaluator of styles, if it is trained here.
      evaluator: File of a frozen evaluator of styles, from evaluator.py; None trains
        one here.
      seed: Seeds poses, noise and evaluator.
    """

    run: Path = Path("runs/camdm")
    data: Path | None = None
    out: Path | None = None
    replications: int = 20
    before: float = 2.0
    limit: float = 4.0
    course: Course = "forward"
    contents: tuple[str, ...] = ("walk", "walk-turn-left", "walk-turn-right")
    chunk: int = 14
    evaluator_steps: int = 1500
    evaluator: Path | None = None
    seed: int = 0


def measure(args: Config) -> None:
    """Writes the table."""
    evaluator = None if args.evaluator is None else frozen.load(args.evaluator)
    run = camdm_training.load_run(args.run, args.data, args.contents)
    out = cli.out_folder(args, "transitions")
    cli.announce("compiling the rollouts of each row", 40)
    changes = camdm_transitions.make_changes(
        run,
        course=args.course,
        before=args.before,
        limit=args.limit,
        replications=args.replications,
        seed=args.seed,
    )
    key_fit, _ = jax.random.split(jax.random.key(args.seed))
    chosen = camdm_evaluation.load_evaluator(
        key_fit, run, evaluator, num_steps=args.evaluator_steps
    )
    rows = camdm_transitions.evaluate_transitions(
        run, changes, CONTROLS, chosen, chunk=args.chunk, seed=args.seed
    )
    report = {
        "source": run.model.source,
        "rollouts": int(changes.old.size),
        "recognized_in_clips_%": camdm_transitions.clip_accuracy(run, chosen).value,
        "evaluator": frozen.describe(
            chosen.params,
            evaluator,
            reference=frozen.clips_fingerprint(run.train, run.field),
        ),
        **reporting.provenance(args),
    }
    notes = (
        f"{changes.old.size} rollouts a row: every ordered pair of "
        f"{len(run.model.labels)} styles, {args.replications} times.",
        *(
            f"{name}: the first {control.guided_plans} after the change, scale "
            f"{control.guidance_scale:g}."
            for name, control in CONTROLS.items()
            if control.guided_plans
        ),
        # Without the clips of Fréchet distances: there are none.
        frozen.note({k: report["evaluator"][k] for k in ("fingerprint", "origin")}),
        f"It is right in {report['recognized_in_clips_%']:.1f} % of the windows of "
        "held-out clips.",
    )
    reporting.write_table(out, rows, report, notes)


def main() -> None:
    """Parses the command line and runs the command."""
    measure(cli.check(tyro.cli(Config, description=__doc__)))


if __name__ == "__main__":
    cli.start(main)
