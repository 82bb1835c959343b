"""How well characters are steered, and how they move meanwhile, beside recorded motion.

Characters of any steered model go straight on at several speeds and along courses, as
they are and with locked feet. Below the table the same is split by frame of the plan,
and by time since the last command.

Examples:
  python experiments/steering.py --data data/o3de.npz --held-out-clips WalkStopTurn1
  python experiments/steering.py --model locomotion_fast --data data/o3de60.npz
      --held-out-clips WalkStopTurn1 RunPivotTurn1 --out runs/steering_fast
"""

import dataclasses
from pathlib import Path

import tyro

import jaxmotion as jm
from jaxmotion import cli, reporting
from jaxmotion.control import steering
from jaxmotion.control.courses import Course
from jaxmotion.control.foot_lock import FootLock, lock_of
from jaxmotion.data import clips_io, selection
from jaxmotion.data.clips import Clips
from jaxmotion.evaluation import by_frame
from jaxmotion.learning import loop
from jaxmotion.systems import steering_table


@dataclasses.dataclass(frozen=True)
class Config:
    """Measure how a model is steered.

    Attributes:
      model: Name of a shipped model, run folder, or exported file.
      data: Clips of its skeleton and rate, for the rows of recorded motion.
      held_out_clips: Those of them that the model never saw, by name.
      out: Folder for metrics.json and table.md.
      label: Style or skill of all characters, and of the recorded windows if the clips
        know it; None for the model's first.
      speeds: What characters are commanded that go straight on, meters per second; 0
        to stand.
      courses: Courses that they follow besides.
      course_speeds: What they are commanded there, meters per second; each course at
        each.
      rollouts: Characters per speed and per course.
      seconds: Length of each rollout, seconds; 13 or more to measure who stands.
      foot_lock: Measure what is displayed with locked feet, too.
      toe_height: Height at which the skeleton's toes rest, for the lock, meters; None
        for that of the model, or of the shipped ones.
      visit: Steps of the schedule that a plan visits (CAMDM); none: the model's own.
      held: The frame before stands for drafts (AAMDM).
      chunk: Characters to run at a time, at most.
      seed: Seeds poses and noise.
    """

    data: Path
    held_out_clips: tuple[str, ...]
    model: str = "locomotion"
    out: Path = Path("runs/steering")
    label: str | None = None
    speeds: tuple[float, ...] = (0.0, 0.8, 1.4, 2.5, 3.5)
    courses: tuple[Course, ...] = (
        "figure_eight",
        "stop_and_go",
        "turn_on_the_spot",
        "turn_around",
    )
    course_speeds: tuple[float, ...] = (1.4,)
    rollouts: int = 16
    seconds: float = 20.0
    foot_lock: bool = True
    toe_height: cli.Optional[float] = None
    visit: tuple[int, ...] = ()
    held: bool = False
    chunk: int = 4
    seed: int = 0


def load_clips(args: Config, model: steering.Character) -> tuple[Clips, Clips]:
    """Training and held-out clips of the model's skeleton and rate, with its labels.

    Clips that know none of the labels (of skills with a ball, say) are all taken.
    """
    clips = clips_io.load_clips(args.data)
    for name, expected, found in (
        ("joints", model.skeleton.names, clips.skeleton.names),
        ("frames per second", model.fps, clips.fps),
    ):
        if found != expected:
            raise ValueError(
                f"{args.data}: {name} are {found}, expected {expected} of {args.model}"
            )
    field = selection.label_field(clips, model.labels)
    if field is not None:
        clips = selection.relabel(selection.select(clips, field, model.labels), field)
    return selection.split_by_name(clips, args.held_out_clips)


def main() -> None:
    """Writes the table; below it what is measured by frame of the plan and by time."""
    args = cli.check(tyro.cli(Config, description=__doc__))
    loop.check_writable(args.out)
    options = {"steps": args.visit} if args.visit else {}
    options |= {"held": True} if args.held else {}
    model = jm.load(args.model, foot_lock=False, **options)
    model = steering.steered(model, what=args.model)
    train, held_out = load_clips(args, model)
    lock = dataclasses.replace(lock_of(model), **cli.given(FootLock, args))
    cli.announce("compiling the rollouts", 40)
    found = steering_table.steering_table(
        model,
        held_out,
        train,
        label=args.label or (*model.labels, "")[0],
        speeds=args.speeds,
        names=args.courses,
        course_speeds=args.course_speeds,
        rollouts=args.rollouts,
        seconds=args.seconds,
        foot_lock=lock if args.foot_lock else None,
        chunk=args.chunk,
        seed=args.seed,
    )
    report = found.report | reporting.provenance(args)
    notes = [by_frame.to_markdown(found.by_plan, places="by frame of the plan")]
    if found.by_time:
        title = "by 0.2 s since a command"
        notes.append(by_frame.to_markdown(found.by_time, places=title))
    reporting.write_table(args.out, found.rows, report, tuple(notes))


if __name__ == "__main__":
    cli.start(main)
