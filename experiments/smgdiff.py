"""SMGDiff, a soccer player with a ball: train, evaluate, roll out, export.

Examples:
  python experiments/dribble.py --data data/bandai1.npz data/bandai2.npz --out data/dribble.npz
  python experiments/smgdiff.py train --data data/dribble.npz --out runs/smgdiff
  python experiments/smgdiff.py train --data data/dribble.npz --out runs/smgdiff --stages motion_2 motion_32
  python experiments/smgdiff.py train --data data/dribble.npz --out runs/varied --stages paths_4 motion_8 --path-noise bridge
  python experiments/smgdiff.py evaluate --run runs/smgdiff
  python experiments/smgdiff.py rollout --run runs/smgdiff --seconds 60
"""  # noqa: E501

import dataclasses
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxmotion import cli, reporting
from jaxmotion.evaluation import by_frame
from jaxmotion.evaluation.table import Rows
from jaxmotion.evaluators import frozen
from jaxmotion.learning import checkpoint, loop, runs
from jaxmotion.motion.skeleton import joint_positions
from jaxmotion.systems.smgdiff import controller as smgdiff_controller
from jaxmotion.systems.smgdiff import evaluation as smgdiff_evaluation
from jaxmotion.systems.smgdiff import guidance as smgdiff_guidance
from jaxmotion.systems.smgdiff import model as smgdiff_model
from jaxmotion.systems.smgdiff import players as smgdiff_players
from jaxmotion.systems.smgdiff import training as smgdiff_training
from jaxmotion.systems.smgdiff.guidance import SCHEDULES, TUNED, Guidance
from jaxmotion.viz.stage import Ball


@dataclasses.dataclass(frozen=True)
class Train:
    """Train stages of SMGDiff; what a folder has already is not trained again.

    Example: python experiments/smgdiff.py train --data data/dribble.npz --out runs/smgdiff

    Attributes:
      data: Clips with a ball, from dribble.py or prepare_data.py.
      stages: motion_<T> is the motion model of T steps, paths_<T> the trajectory
        generator (the paper's: T = 1).
      preset: "small" for a CPU or a short run, "planted" for a second training of such
        a model in which feet weigh more, or "paper".
      width: Channels of the motion model's tokens; None for the preset's.
      depth: Its layers; None for the preset's.
      token_margin: Frames that its neighboring output tokens share; None for the
        preset's.
      attention: "full", or "prefix": computed once per plan; None for the preset's.
      path_noise: Noise of a trajectory generator: "bridge", as smooth as paths, for more
        steps than one, or "white" (paper); None for the preset's.
      path_soon: Frames to its second target; None for the preset's, 0 for none (paper).
      noise_levels: Noise levels that an update draws for each window; None for the preset's.
      own_levels: Probability of noise on own predictions at lower levels.
      cubic_wishes: Probability of wanted paths without sway.
      balance: How much more often rare speeds and turns are drawn: 0 as recorded, 1 all
        alike.
      seam_half_life: Half-life, frames, of the offset with which plans go on from the
        past; 0: none.
      weight_foot: Weight of planted feet; None for the preset's.
      init: Run folder or exported model to start from; without a draft then.
      held_out: Part of the recordings kept for evaluation.
      steps: Updates of a motion model.
      draft_steps: Updates before these in which displacements hardly count.
      path_steps: Updates of a trajectory generator.
      batch: Windows per update.
      learning_rate: Peak of Muon's rate; cosine to a twentieth.
      warmup: Updates of its linear rise; None for a tenth, 100 at most.
      ema: Decay per update of the average that is kept.
      distributed: One of several processes: "auto", or address, number, index.
      override: Go on with these settings where a stage began with others.
    """  # noqa: E501

    data: Path = Path("data/dribble.npz")
    out: Path = Path("runs/smgdiff")
    stages: tuple[str, ...] = ("paths_1", "motion_8")
    preset: Literal["small", "planted", "paper"] = "small"
    width: int | None = None
    depth: int | None = None
    token_margin: int | None = None
    attention: Literal["full", "prefix"] | None = None
    path_noise: Literal["white", "bridge"] | None = None
    path_soon: int | None = None
    noise_levels: int | None = None
    own_levels: float | None = None
    cubic_wishes: float | None = None
    balance: float = 0.0
    seam_half_life: float | None = None
    weight_foot: float | None = None
    init: cli.Optional[Path] = None
    held_out: float = 0.1
    steps: int = 3000
    draft_steps: int = 3500
    path_steps: int = 2000
    batch: int = 48
    learning_rate: float = 2e-3
    warmup: int | None = None
    ema: float = 0.999
    distributed: cli.Distributed = ()
    seed: int = 0
    override: bool = False


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Score plans and players beside real clips; writes a table in a folder of its own.

    Example: python experiments/smgdiff.py evaluate --run runs/smgdiff

    Attributes:
      tables: "schedules" (the paper's table 4), "steps" (table 3: every motion model
        that was trained), "paths" (table 2), "spread" (of paths, beside people's).
      out: Folder; None for <run>/evaluation.
      steps: Motion model of the tables "schedules" and "paths".
      schedules: Rows of table 4.
      windows: Held-out windows, at most.
      replications: Halves of them, of random pieces, each with noise of its own.
      starts: Starts of players of one replication (table "paths").
      repeats: Players of each start.
      rate: w_r of DSG.
      last_sigma: Length of the last step a channel; None for the released code's.
      min_acceleration: A ball that accelerates more is being touched, m/s^2 (paper 2).
      max_distance: From here on a joint is too far from the ball's center, meters
        (paper 0.1, less than a ball's radius).
      evaluator_steps: Updates of the evaluator of skills, if it is trained here.
      evaluator: File of a frozen evaluator of skills, from evaluator.py; None trains
        one here.
      chunk: Plans or players at a time.
      seed: Seeds windows, noise and evaluator.
    """

    run: Path = Path("runs/smgdiff")
    tables: tuple[Literal["schedules", "steps", "paths", "spread"], ...] = (
        "schedules",
        "steps",
        "paths",
    )
    out: Path | None = None
    steps: int = 8
    schedules: tuple[str, ...] = tuple(SCHEDULES)
    windows: int = 600
    replications: int = 20
    starts: int = 20
    repeats: int = 4
    rate: float = TUNED.rate
    last_sigma: float | None = TUNED.last_sigma
    min_acceleration: float = TUNED.min_acceleration
    max_distance: float = TUNED.max_distance
    evaluator_steps: int = 800
    evaluator: Path | None = None
    chunk: int = 4
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class Rollout:
    """Steer one player through all skills; writes BVH, ball CSV, GIF and HTML.

    Example: python experiments/smgdiff.py rollout --run runs/smgdiff --seconds 60

    Attributes:
      seconds: Length; every skill gets an equal part.
      skills: In this order; none: all of the model's.
      paths: Trajectory generator; "straight" for none.
      schedule: Schedule of contact guidance.
      rate: w_r of DSG; this and the next three as in `evaluate`.
      out: Folder; None for <run>/rollout.
    """

    run: Path = Path("runs/smgdiff")
    seconds: float = 60.0
    skills: tuple[str, ...] = ()
    paths: str = "paths_1"
    steps: int = 8
    schedule: str = "end 2"
    rate: float = TUNED.rate
    last_sigma: float | None = TUNED.last_sigma
    min_acceleration: float = TUNED.min_acceleration
    max_distance: float = TUNED.max_distance
    out: Path | None = None
    seed: int = 0


def sizes_of(args: Train) -> dict[str, Any]:
    """Sizes of the motion model that the arguments describe."""
    given = cli.given(smgdiff_model.Config, args)
    hidden = {} if args.width is None else {"hidden": 4 * args.width}
    return smgdiff_training.PRESETS[args.preset] | given | hidden


def paths_of(args: Train) -> dict[str, Any]:
    """Sizes and noise of the trajectory generator that the arguments describe."""
    given = {"noise": args.path_noise, "soon": args.path_soon}
    given = {name: value for name, value in given.items() if value is not None}
    return smgdiff_training.PATHS[args.preset] | given


def train(args: Train) -> None:
    """Trains stage by stage."""
    cli.join_processes(args.distributed)
    for stage in args.stages:
        smgdiff_training.check_stage_name(stage)
    loop.check_writable(args.out)
    run = smgdiff_training.prepare(
        args.out,
        args.data,
        held_out=args.held_out,
        sizes=sizes_of(args),
        paths=paths_of(args),
        init=args.init,
    )
    clips = run.train.clips
    print(
        f"{clips.num_clips} clips, {clips.num_frames / clips.fps / 60:.1f} minutes, of "
        f"{', '.join(run.model.labels)}: {run.model.source}"
    )
    for stage in args.stages:
        begun = time.perf_counter()
        number = args.steps if stage.startswith("motion") else args.path_steps
        budget = runs.Budget(**cli.given(runs.Budget, args) | {"steps": number})
        smgdiff_training.train_stage(
            run,
            stage,
            budget=budget,
            draft_steps=args.draft_steps,
            balance=args.balance,
            init=args.init,
        )
        print(f"{stage}: {time.perf_counter() - begun:.0f} s", flush=True)


def evaluate(args: Evaluate) -> None:
    """Writes the tables, each into a folder of its own."""
    guided = Guidance(**cli.given(Guidance, args))
    for schedule in args.schedules:
        smgdiff_guidance.on_schedule(guided, schedule)
    evaluator = None if args.evaluator is None else frozen.load(args.evaluator)
    run = smgdiff_training.load_run(args.run)
    out = cli.out_folder(args, "evaluation")
    if "spread" in args.tables:
        found = smgdiff_players.spread_table(run, windows=args.windows, seed=args.seed)
        report = {"source": run.model.source} | reporting.provenance(args)
        reporting.write_table(out / "spread", found, report)
    if args.tables == ("spread",):
        return
    cli.announce("compiling the evaluator and each row's plans", 40)
    setting = smgdiff_evaluation.make_setting(
        run.train,
        run.held_out,
        run.model,
        number=args.windows,
        replications=args.replications,
        evaluator_steps=args.evaluator_steps,
        seed=args.seed,
        evaluator=evaluator,
    )
    described = smgdiff_evaluation.describe_evaluator(run, setting, evaluator)

    def write(name: str, rows: Rows, more: dict[str, Any], *notes: str) -> None:
        report = {"source": run.model.source, "evaluator": described} | more
        report |= {"windows": int(setting.known.label.shape[0])}
        report |= reporting.provenance(args)
        notes = (frozen.note(described), *notes)
        reporting.write_table(out / name, rows, report, notes)

    def write_places(name: str, rows: Rows, places: smgdiff_evaluation.Places) -> None:
        more = {"by_frame_of_the_token": by_frame.to_json(places)}
        shown = (by_frame.to_markdown(places),) if places else ()
        write(name, rows, more if places else {}, *shown)

    if "schedules" in args.tables:
        rows, places = smgdiff_evaluation.schedule_table(
            run,
            setting,
            args.schedules,
            steps=args.steps,
            guided=guided,
            chunk=args.chunk,
        )
        write_places("schedules", rows, places)
    if "steps" in args.tables:
        rows, places = smgdiff_evaluation.step_table(run, setting, chunk=args.chunk)
        write_places("steps", rows, places)
    if "paths" in args.tables:
        rows = smgdiff_players.path_table(
            run,
            setting,
            steps=args.steps,
            guided=guided,
            starts=args.starts,
            repeats=args.repeats,
            chunk=args.chunk,
        )
        write("paths", rows, {})


def rollout(args: Rollout) -> None:
    """Writes the rollout, and prints what is worth knowing before one looks."""
    guided = Guidance(**cli.given(Guidance, args))
    run = smgdiff_training.load_run(args.run)
    out = cli.out_folder(args, "rollout")
    cli.announce("compiling the rollout", 40)
    features = run.model.representation
    skills = args.skills or run.model.labels
    commands = smgdiff_players.skill_commands(run.model, skills, seconds=args.seconds)
    scene = smgdiff_players.play_one(
        run,
        commands,
        steps=args.steps,
        paths=args.paths,
        guided=smgdiff_guidance.on_schedule(guided, args.schedule),
        seed=args.seed,
    )
    touch = np.asarray(scene.touch) > 0.5
    reporting.write_rollout(
        out,
        features.skeleton,
        scene.motion,
        commands.velocity,
        title=", ".join(skills),
        caption=run.model.source,
        ball=Ball(
            position=np.asarray(scene.ball),
            touch=touch,
            joints=features.joints,
            radius=features.radius,
        ),
    )
    places = joint_positions(features.skeleton, scene.motion)[:, list(features.joints)]
    nearest = np.linalg.norm(places - scene.ball[:, None], axis=-1).min()
    away = np.linalg.norm((scene.ball - scene.motion.root_position)[:, ::2], axis=-1)
    print(
        f"ball {np.median(away):.2f} m from the root (median), nearest foot "
        f"{nearest:.2f} m from its center, {np.any(touch, axis=1).sum()} frames with a "
        "touch"
    )


@dataclasses.dataclass(frozen=True)
class Export:
    """Write a run's player, averaged and as float16, as one small npz file.

    Example: python experiments/smgdiff.py export --run runs/smgdiff --out dribble.npz

    Attributes:
      run: Run folder of `train` with the stage motion_8 and one of paths.
      paths: Run folder whose trajectory generator to take; None for the run's own.
      out: File to write, for `jaxmotion.load`.
      starts: Starts per skill, in which the model itself stands.
    """

    run: Path = Path("runs/smgdiff")
    paths: cli.Optional[Path] = None
    out: Path = Path("dribble.npz")
    starts: int = 4


def export(args: Export) -> None:
    """Writes the file."""
    cli.announce("compiling the rollouts that starts are taken from", 60)
    _, model, params = smgdiff_controller.load_run(args.run)
    starts = smgdiff_controller.own_starts(args.run, number=args.starts)
    if args.paths is not None:
        own = smgdiff_training.load_run(args.paths)
        model, params = smgdiff_training.with_paths(params, model, own)
    model = dataclasses.replace(model, starts=starts)
    checkpoint.export_params(args.out, params, smgdiff_model.to_json(model))
    print(f"wrote {args.out}, {args.out.stat().st_size / 1e6:.1f} MB: {model.source}")


COMMANDS = {
    "train": (Train, train),
    "evaluate": (Evaluate, evaluate),
    "rollout": (Rollout, rollout),
    "export": (Export, export),
}


def main() -> None:
    """Parses the command line and runs the command."""
    cli.run(COMMANDS, __doc__)


if __name__ == "__main__":
    cli.start(main)
