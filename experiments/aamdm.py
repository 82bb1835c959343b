"""AAMDM and what it is compared with: train, evaluate, roll out, export, levels.

Examples:
  python experiments/prepare_data.py lafan1 --manual-dir path/to/zips --out data/lafan1.npz
  python experiments/aamdm.py train --data data/lafan1.npz --out runs/aamdm
  python experiments/aamdm.py evaluate --run runs/aamdm
  python experiments/aamdm.py rollout --run runs/aamdm --seconds 20
"""  # noqa: E501

import dataclasses
import time
from pathlib import Path
from typing import Literal

import jax
from baselines import rows, tables

from jaxmotion import cli, reporting
from jaxmotion.control.courses import Course
from jaxmotion.learning import loop, runs
from jaxmotion.systems.aamdm import controller as aamdm_controller
from jaxmotion.systems.aamdm import evaluation as aamdm_evaluation
from jaxmotion.systems.aamdm import levels as aamdm_levels
from jaxmotion.systems.aamdm import space as aamdm_space
from jaxmotion.systems.aamdm import stored as aamdm_stored
from jaxmotion.systems.aamdm import training as aamdm_training


@dataclasses.dataclass(frozen=True)
class Train:
    """Train the rows of AAMDM's tables; what a folder has already is not trained again.

    Example: python experiments/aamdm.py train --data data/lafan1.npz --out runs/aamdm

    Attributes:
      data: Clips from prepare_data.py.
      rows: What to train; "all": both tables; "aamdm" alone is the system.
      field: Label field by which clips are chosen.
      labels: Labels of the clips to use; none: all clips.
      fps: Frames per second to which clips are resampled.
      held_out: Part of each clip, at its end, kept for evaluation.
      mirror: Add a mirrored copy of every clip.
      balance: How much more often rare speeds and turns are drawn: 0 as recorded, 1 all
        alike.
      autoencoder_steps: Updates of the pose autoencoder.
      polisher_steps: Updates of each diffusion model.
      generator_steps: Updates of each denoising-diffusion GAN.
      amdm_steps: Updates of each AMDM.
      window_steps: Updates of Motion VAE and of Learned Motion Matching, which cost
        more since they run through windows.
      full_pose_steps: Updates of the diffusion model of the full-pose row, which cost
        more: in about the same time.
      batch: Windows per update.
      width: Channels of the networks of AAMDM and AMDM (of AMDM a power of two no less
        than a frame's; Learned Motion Matching has 512, Motion VAE 256, as published).
      window: Frames that AAMDM's polishers predict in a row in training (paper: 10).
      polisher_batch: Windows per update of these.
      weight_pose: Weight of the errors of the poses that these frames mean (paper: 0).
      weight_foot: Weight of the errors of slow toes' velocities over the ground beside
        them (paper: 0).
      gan_window: Frames of the windows of the GANs (paper: 10).
      levels: Steps that each network learns: all, or its own.
      previous_noise: Largest deviation of the noise on given previous frames in
        training, in deviations of the data; rows as published and AMDM have none.
      constant_rate: Keep the polishers' rate; without it the rate falls to a twentieth
        of its peak. What is kept is a moving average of the parameters, always.
      init: Run folder or exported model to start the row "aamdm" from, in its learned
        space.
      distributed: One of several processes: "auto", or address, number, index.
      override: Go on with these settings where a stage began with others.
    """

    data: Path = Path("data/lafan1.npz")
    out: Path = Path("runs/aamdm")
    rows: tuple[str, ...] = ("all",)
    field: str = aamdm_evaluation.FIELD
    labels: tuple[str, ...] = aamdm_evaluation.LABELS
    fps: float = 60.0
    held_out: float = 0.1
    mirror: bool = True
    balance: float = 0.0
    autoencoder_steps: int = 20000
    polisher_steps: int = 5000
    generator_steps: int = 8000
    amdm_steps: int = 8000
    window_steps: int = 2500
    full_pose_steps: int = 1500
    batch: int = 64
    width: int = 256
    schedule: Literal["cosine", "vp"] = "cosine"
    window: int = 4
    polisher_batch: int = 128
    weight_pose: float = 1.0
    weight_foot: float = 5.0
    gan_window: int = 3
    levels: Literal["all", "own"] = "all"
    previous_noise: float = 0.5
    constant_rate: bool = False
    init: cli.Optional[Path] = None
    distributed: cli.Distributed = ()
    seed: int = 0
    override: bool = False


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Roll out every trained row, free and steered, and write the paper's tables.

    Example: python experiments/aamdm.py evaluate --run runs/aamdm

    Attributes:
      rows: Which rows; "all": those that were trained.
      data: Takes that characters start from and are compared with, chosen and split as
        those of training; None for those of training.
      out: Folder for metrics.json and table.md; None for <run>/evaluation.
      rollouts: Characters; a multiple of 4.
      seconds: Length of each rollout, seconds (the paper: 1000 frames).
      course: Commands of the steered rollouts.
      speed: Meters per second that are commanded.
      scale: Strength of AAMDM's guidance, epsilon of eq. 13.
      guided_steps: How many steps at the chain's end are guided; None for all (paper).
      amdm_scale: Strength of AMDM's, of which all steps are guided.
      noise_half_life: Seconds in which noise of AAMDM's posteriors is forgotten; 0 to
        draw it anew in every frame (paper).
      long_minutes: Length of the long rollouts of the row "aamdm"; 0 for none.
      long_rollouts: Their number.
      seed: Seeds poses, noise and pairs.
    """

    run: Path = Path("runs/aamdm")
    rows: tuple[str, ...] = ("all",)
    data: cli.Optional[Path] = None
    out: Path | None = None
    rollouts: int = 16
    seconds: float = 1000 / 60
    course: Course = aamdm_evaluation.COURSE
    speed: float = aamdm_evaluation.SPEED
    scale: float = aamdm_controller.SCALE
    guided_steps: int | None = aamdm_controller.GUIDED_STEPS
    amdm_scale: float = 1.0
    noise_half_life: float = 0.0
    long_minutes: float = 10.0
    long_rollouts: int = 16
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class Rollout:
    """Roll out one character; writes BVH, GIF and HTML.

    Example: python experiments/aamdm.py rollout --run runs/aamdm --seconds 20

    Attributes:
      speed: Meters per second that are commanded.
      scale: Strength of the guidance, epsilon of eq. 13.
      guided_steps: As of `evaluate`.
      noise_half_life: As of `evaluate`.
      out: Folder; None for <run>/rollout.
    """

    run: Path = Path("runs/aamdm")
    row: str = "aamdm"
    steered: bool = True
    seconds: float = 20.0
    course: Course = aamdm_evaluation.COURSE
    speed: float = aamdm_evaluation.SPEED
    scale: float = aamdm_controller.SCALE
    guided_steps: int | None = aamdm_controller.GUIDED_STEPS
    noise_half_life: float = 0.0
    out: Path | None = None
    seed: int = 0


def train(args: Train) -> None:
    """Trains, stage by stage."""
    cli.join_processes(args.distributed)
    names = cli.chosen_rows(args, rows.ALL)
    rows.check(names)
    if args.init and names != ("aamdm",):
        raise ValueError(f"init is {args.init}, but rows are {names}: expected 'aamdm'")
    loop.check_writable(args.out)
    run = aamdm_training.prepare(
        args.out,
        args.data,
        field=args.field,
        labels=args.labels,
        fps=args.fps,
        held_out=args.held_out,
        mirrored=args.mirror,
        balance=args.balance,
    )
    print(f"{run.train.num_frames} training frames, {run.held_out.num_frames} held out")
    sizes = rows.Sizes(
        width=args.width,
        schedule=args.schedule,
        window=args.window,
        weight_pose=args.weight_pose,
        weight_foot=args.weight_foot,
        gan_window=args.gan_window,
        levels=args.levels,
        previous_noise=args.previous_noise,
    )

    def budget(steps: int, batch: int = args.batch, **more) -> runs.Budget:
        return runs.Budget(
            steps=steps, batch=batch, seed=args.seed, override=args.override, **more
        )

    adversarial = budget(args.generator_steps, optimizer="radam", learning_rate=2e-4)
    spaces, networks = {}, None
    if args.init:
        spaces["embedded"], networks = aamdm_training.start_of(
            args.init, run, width=args.width
        )
    for name in names:
        where, begun = rows.space_of(name), time.perf_counter()
        if where not in spaces:
            autoencoder = None
            if where == "embedded":
                steps = budget(
                    args.autoencoder_steps, optimizer="adamw", learning_rate=1e-3
                )
                autoencoder = aamdm_training.train_autoencoder(run, steps)
            spaces[where] = aamdm_training.make_space(run, autoencoder)
        full = rows.is_chain(name) and where == "full_pose"
        steps = args.full_pose_steps if full else args.polisher_steps
        # Windows of these rows are longer: as many frames, about.
        windows = args.batch if rows.is_published(name) else args.polisher_batch
        rows.train_row(
            name,
            run,
            spaces[where],
            sizes,
            polisher=budget(steps, windows, constant=args.constant_rate or None),
            generator=adversarial,
            baseline=budget(
                args.amdm_steps if name.startswith("amdm") else args.window_steps,
                optimizer="adamw",
                learning_rate=1e-3,
            ),
            init=networks,
        )
        print(f"{name}: {time.perf_counter() - begun:.0f} s", flush=True)


def evaluate(args: Evaluate) -> None:
    """Writes the tables."""
    rows.check(cli.chosen_rows(args))
    out = cli.out_folder(args, "evaluation")
    run = aamdm_training.load_run(args.run)
    if args.data:
        run = aamdm_training.with_takes(run, args.data)
    cli.announce("compiling the rollouts of each row", 40)
    table, report = tables.evaluate(run, args, out)
    guided = "all" if args.guided_steps is None else f"the last {args.guided_steps}"
    note = (
        f"Steered: course {args.course!r} at {args.speed:g} m/s, guidance "
        f"{args.scale:g} in {guided} steps (rows as published: in all; AMDM: "
        f"{args.amdm_scale:g} in all), half-life of noise "
        f"{args.noise_half_life:g} s; div and fid are of joint positions in the "
        "character's axes: no evaluator."
    )
    reporting.write_table(out, table, report, (note,))


def rollout(args: Rollout) -> None:
    """Writes rollout.bvh, rollout.gif and rollout.html."""
    rows.check((args.row,))
    run = aamdm_training.load_run(args.run)
    out = cli.out_folder(args, "rollout")
    space = aamdm_training.load_space(run, rows.space_of(args.row))
    step = rows.load_row(
        args.row,
        run,
        space,
        scale=args.scale,
        guided_steps=args.guided_steps,
        half_life=args.noise_half_life,
    )
    states = aamdm_evaluation.start_states(run, space, step, 1, seed=args.seed)
    ticks = round(args.seconds * run.train.fps)
    given = aamdm_evaluation.commands(
        run, 1, ticks, course=args.course, speed=args.speed
    )
    cli.announce("compiling the rollout", 40)
    roll = aamdm_evaluation.roller(run, space, step, steered=args.steered)
    _, frames = roll(jax.random.key(args.seed), states, given)
    reporting.write_rollout(
        out,
        run.skeleton,
        frames[0].motion,
        frames.desired_velocity[0],
        title=f"{args.row}{'' if args.steered else ', not steered'}",
        caption=run.source,
    )


@dataclasses.dataclass(frozen=True)
class Export:
    """Write the character of the row "aamdm", as float16, as one small npz file.

    Example: python experiments/aamdm.py export --run runs/aamdm --out aamdm.npz

    Attributes:
      out: File to write, for `jaxmotion.load`.
      starts: Poses that the model itself stands in, with which characters start.
      noise_half_life: As of `evaluate`; the file's characters have it.
      encoder: Keep the encoder, from which one trains on or starts in other poses.
    """

    run: Path = Path("runs/aamdm")
    out: Path = Path("aamdm.npz")
    starts: int = 4
    noise_half_life: float = 0.0
    encoder: bool = True


def export(args: Export) -> None:
    """Writes the file."""
    cli.announce("compiling the rollout that starts are taken from", 40)
    _, model, networks = aamdm_controller.load_run(
        args.run, noise_half_life=args.noise_half_life
    )
    starts = aamdm_controller.own_starts(
        args.run, number=args.starts, noise_half_life=args.noise_half_life
    )
    model = dataclasses.replace(model, starts=starts)
    aamdm_stored.export(args.out, model, networks, encoder=args.encoder)
    print(f"wrote {args.out}, {args.out.stat().st_size / 1e6:.1f} MB: {model.source}")


@dataclasses.dataclass(frozen=True)
class Levels:
    """What a row's networks predict at each step of their chain; writes a table.

    Example: python experiments/aamdm.py levels --run runs/aamdm --row frame

    Attributes:
      row: A row that is AAMDM.
      out: Folder; None for <run>/levels.
      samples: Training frames, given to every step.
      latents: Latents of the generator for each.
      seed: Seeds frames, noise and latents.
    """

    run: Path = Path("runs/aamdm")
    row: str = "aamdm"
    out: Path | None = None
    samples: int = 2000
    latents: int = 16
    seed: int = 0


def levels(args: Levels) -> None:
    """Writes the table."""
    chain = rows.chain_of(args.row)
    out = cli.out_folder(args, "levels")
    run = aamdm_training.load_run(args.run)
    where = rows.space_of(args.row)
    space = aamdm_training.load_space(run, where)
    params, config = aamdm_training.load_networks(run, where, space, **chain)
    key_frames, key = jax.random.split(jax.random.key(args.seed))
    frames = aamdm_space.to_frames(space, run.train.poses, run.train.paths)
    windows, arrays = aamdm_training.frame_windows(
        frames, run.train, 2, batch=args.samples
    )
    pairs = windows(key_frames, arrays)
    table = aamdm_levels.level_table(
        params,
        key,
        pairs[:, 0],
        pairs[:, 1],
        config=config,
        change=aamdm_training.scale_of_changes(space, config),
        latents=args.latents,
    )
    report = {"source": run.source} | reporting.provenance(args)
    reporting.write_table(out, table, report, (run.source,))


COMMANDS = {
    "train": (Train, train),
    "evaluate": (Evaluate, evaluate),
    "rollout": (Rollout, rollout),
    "export": (Export, export),
    "levels": (Levels, levels),
}


def main() -> None:
    """Parses the command line and runs the command."""
    cli.run(COMMANDS, __doc__)


if __name__ == "__main__":
    cli.start(main)
