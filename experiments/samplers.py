"""Quality against milliseconds of one CAMDM model under several samplers.

The same parameters, the same commands, poses and noise: the model's own steps, more and
fewer of them, DDIM and DPM-Solver++, each with the time of a plan.

Examples:
  python experiments/samplers.py --data data/o3de.npz --held-out-clips WalkStopTurn1 RunPivotTurn1
"""  # noqa: E501

import dataclasses
from pathlib import Path

import tyro

from jaxmotion import cli, reporting
from jaxmotion.diffusion import chain, schedule
from jaxmotion.evaluators import frozen
from jaxmotion.learning import loop
from jaxmotion.systems.camdm import evaluation as camdm_evaluation
from jaxmotion.systems.camdm import training as camdm_training

SAMPLERS: dict[str, chain.StepFactory] = {
    "ancestral": chain.ancestral_step,
    "DDIM": chain.ddim_step,
    "DPM-Solver++": chain.dpm_solver_step,
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Steer one model by several samplers, and measure them.

    Attributes:
      data: Clips of its skeleton and styles.
      held_out_clips: Those of them that the model never saw, by name.
      model: Name of a shipped model, or exported file.
      out: Folder for metrics.json and table.md.
      visits: Numbers of network calls of a plan, spread evenly over the schedule; of as
        many as the model's own, ancestral steps are its own.
      rollouts: Characters, spread evenly over the styles.
      seconds: Length of each rollout, seconds; 4 at least.
      chunk: Characters to run at a time, at most.
      evaluator_steps: Updates of the evaluator of styles, if it is trained here.
      evaluator: File of a frozen evaluator of styles, from evaluator.py; None trains
        one here.
      seed: Seeds poses, noise, evaluator and subsets.
    """

    data: Path
    held_out_clips: tuple[str, ...]
    model: Path = Path("locomotion")
    out: Path = Path("runs/samplers")
    visits: tuple[int, ...] = (1, 2, 3, 4, 8)
    rollouts: int = 40
    seconds: float = 14.0
    chunk: int = 4
    evaluator_steps: int = 1500
    evaluator: Path | None = None
    seed: int = 0


def main() -> None:
    """Writes the table."""
    args = cli.check(tyro.cli(Config, description=__doc__))
    loop.check_writable(args.out)
    run = camdm_training.exported_run(args.model, args.data, args.held_out_clips)
    total = run.model.config.num_steps
    visits = {number: schedule.spread_steps(total, number) for number in args.visits}
    own = run.model.steps or schedule.spread_steps(total, total)
    chosen = {
        f"{name}, {number} calls": (step, steps)
        for name, step in SAMPLERS.items()
        for number, steps in visits.items()
        # One call is the network's prediction, whatever the step.
        if number > 1 or step is chain.ancestral_step
    }
    chosen[f"ancestral, {len(own)} calls"] = chain.ancestral_step, own
    cli.announce("compiling the rollouts of each sampler", 40)
    rows, report = camdm_evaluation.evaluate_samplers(
        run,
        chosen,
        rollouts=args.rollouts,
        seconds=args.seconds,
        chunk=args.chunk,
        evaluator_steps=args.evaluator_steps,
        seed=args.seed,
        evaluator=None if args.evaluator is None else frozen.load(args.evaluator),
    )
    report |= reporting.provenance(args)
    reporting.write_table(args.out, rows, report, (frozen.note(report["evaluator"]),))


if __name__ == "__main__":
    cli.start(main)
