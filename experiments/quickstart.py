"""From nothing to a steered character in half a minute, without data or training.

Steers the shipped model of a real person's locomotion along a course (stand, walk,
turn, jog, run, stop, crouch) and writes what it does as GIF, HTML and BVH.

With --train it shows the whole path instead: clips of a procedural walker in its eight
styles and in a ninth, "swagger", that the small model shipped for it has never seen;
the ninth is taught in a minute; a character changes from one style to the other, and is
measured beside the data.

Examples:
  python experiments/quickstart.py
  python experiments/quickstart.py --train
  python experiments/quickstart.py --train --from-scratch --out runs/scratch
"""

import dataclasses
import functools
import shutil
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from jaxmotion import cli, reporting
from jaxmotion.control import courses, steering
from jaxmotion.data import procedural, selection, windows
from jaxmotion.data.gaits import GAITS, Gait
from jaxmotion.learning import loop, training
from jaxmotion.motion import skeleton
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import loss as camdm_loss
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import scoring as camdm_scoring
from jaxmotion.systems.camdm import training as camdm_training

# Seconds, direction of travel and facing (degrees from +z toward +x), m/s, style.
COURSE = (
    (1.0, 0, 0, 0.0, "neutral"),
    (2.5, 0, 0, 1.4, "neutral"),
    (2.0, 90, 90, 1.4, "neutral"),
    (2.0, 45, 45, 2.5, "neutral"),
    (2.0, 0, 0, 3.5, "neutral"),
    (2.0, 0, 0, 0.0, "neutral"),
    (2.5, -90, -90, 0.9, "crouch"),
)
NEW_STYLE = "swagger"
SWAGGER = Gait(
    max_speed=1.2,
    cadence=1.0,
    width=0.24,
    lean=-0.15,
    sway=0.06,
    twist=0.3,
    arm_swing=0.5,
    arm_out=0.5,
    elbow=0.6,
)
# Optimizer steps of a row of losses.
CHUNK = 50
SIZE = camdm_training.PRESETS["small"] | dict(width=128, hidden=512)


@dataclasses.dataclass(frozen=True)
class Config:
    """Steer the shipped model; or train on the procedural walker, steer it, measure it.

    Attributes:
      out: Folder for rollout.bvh, rollout.gif, rollout.html and metrics.json; of a
        training also checkpoints.
      characters: Rollouts to measure.
      seed: Of everything random.
      train: Teach the procedural walker a style first; the options below are its own.
      from_scratch: Start from random parameters and train for 4000 steps (about 12
        minutes on two cores) instead of starting from the shipped model.
      steps: Optimizer steps, rounded down to fifties; None for 400, or 4000 from
        scratch.
      batch: Windows a step.
      minutes: Minutes of walking to generate.
      seconds: Length of the rollout, seconds.
      styles: Styles of the rollout, one after the other.
    """

    out: Path = Path("runs/quickstart")
    characters: int = 16
    seed: int = 0
    train: bool = False
    from_scratch: bool = False
    steps: int | None = None
    batch: int = 32
    minutes: float = 12.0
    seconds: float = 16.0
    styles: tuple[str, ...] = ("neutral", NEW_STYLE)


def first_motion(frames, fps) -> skeleton.Motion:
    """Motion of the first character."""
    return skeleton.Motion(
        root_position=frames.root_position[0],
        joint_rotation=frames.joint_rotation[0],
        fps=fps,
    )


def steer_shipped(args: Config):
    """Steers the shipped model along the course; writes files and metrics."""
    model, params, _ = camdm_model.load("locomotion")
    fps = model.config.fps
    print(f"locomotion: {model.source}; compiling, about 15 s", flush=True)
    course = courses.segment_commands(
        [(*part[:4], model.label(part[4])) for part in COURSE],
        seconds=sum(part[0] for part in COURSE),
        fps=fps,
    )
    many = args.characters
    commands = jax.tree.map(lambda x: jnp.repeat(x[None], many, axis=0), course)
    labels = np.zeros(many, int)
    frames = steering.steered_rollouts(
        camdm_controller.character(
            params, model, control=camdm_controller.Control(follow=1.0)
        ),
        jax.random.key(args.seed),
        camdm_controller.own_states(model, labels, seed=args.seed),
        commands,
        chunk=4,
    )
    made = windows.rollout_windows(frames, jnp.asarray(labels), skip=0)
    standing = jax.tree.map(lambda x: x[0], model.starts)
    toes = skeleton.joint_positions(model.skeleton, standing)[
        ..., model.skeleton.feet, 1
    ]
    row = camdm_scoring.metric_row(
        model.skeleton, made, None, height=float(toes.min()) + 0.01
    )
    reporting.write_rollout(
        args.out,
        model.skeleton,
        first_motion(frames, fps),
        frames.desired_velocity[0],
        title="stand, walk, turn, jog, run, stop, crouch",
        caption=f"locomotion, trained on {model.source}",
    )
    return {"rollouts": row}, {"source": model.source, "course": COURSE}


def start_model(args: Config, clips, key):
    """A new model for these clips, or the shipped one with a style to learn."""
    if args.from_scratch:
        model = camdm_training.make_model(clips, field="style", **SIZE)
        return model, camdm_model.init(key, model.config)
    model, params, _ = camdm_model.load("walker")
    config = dataclasses.replace(model.config, num_labels=model.config.num_labels + 1)
    table = params["embed_label"]["embedding"]
    table = jnp.concatenate([table, table.mean(axis=0, keepdims=True)])
    params = params | {"embed_label": {"embedding": table}}
    labels = (*model.labels, NEW_STYLE)
    return dataclasses.replace(model, config=config, labels=labels), params


def steps_of(args: Config) -> int:
    """Optimizer steps; whole chunks."""
    default = 4000 if args.from_scratch else 400
    steps = default if args.steps is None else args.steps
    if steps < CHUNK:
        raise ValueError(f"--steps is {steps}, expected at least {CHUNK}")
    return steps // CHUNK * CHUNK


def train(args: Config, clips, model, params, key):
    """Trains on the clips; returns the averaged parameters and the losses."""
    steps = steps_of(args)
    optimizer = training.make_optimizer(
        "muon",
        learning_rate=1e-3 if args.from_scratch else 3e-4,
        num_steps=steps,
        warmup_steps=min(steps // 4, 500),
        max_norm=1.0,
    )
    # Half of each batch is the new style; from scratch all styles are alike.
    new = clips if args.from_scratch else selection.select(clips, "style", [NEW_STYLE])
    length = model.config.window
    data = [(x, windows.window_index(x, length)) for x in (clips, new)]

    def sample_batch(key, data):
        halves = []
        for half_key, (clips, index) in zip(jax.random.split(key), data, strict=True):
            motion, clip = windows.sample_windows(
                half_key, clips, index, batch=args.batch // 2
            )
            halves.append((motion, clips.labels["style"][clip]))
        return jax.tree.map(lambda *x: jnp.concatenate(x), *halves)

    objective = functools.partial(
        camdm_loss.loss, skeleton=model.skeleton, config=model.config
    )
    update = training.make_update(objective, optimizer, ema_decay=0.995)
    state = loop.train(
        training.train_chunk(update, sample_batch, num_steps=CHUNK),
        training.init_train_state(params, optimizer),
        key,
        data,
        loop=loop.Loop(
            num_steps=steps,
            chunk=CHUNK,
            save_every=max(steps // CHUNK // 2, 1) * CHUNK,
            folder=args.out,
            config=camdm_model.to_json(model) | {"experiment": {"label": "style"}},
            show=("loss", "data", "foot"),
        ),
    )
    rows = loop.read_losses(args.out / "losses.jsonl")
    return state.ema_params, [row["loss"] for row in rows]


def steer(args: Config, clips, model, params, key):
    """Rolls out the characters; returns frames and the style of each character."""
    styles = [model.label(name) for name in args.styles]
    labels = np.resize(styles, args.characters)
    speeds = np.asarray(selection.label_speeds(clips, field="style"))[labels]
    commands = courses.course_batch(
        "forward", labels, speeds, seconds=args.seconds, fps=model.config.fps
    )
    # The first character goes through all the styles, one after the other.
    ticks = commands.label.shape[1]
    order = jnp.asarray(styles)[jnp.arange(ticks) * len(styles) // ticks]
    label = commands.label.at[0].set(order)
    commands = dataclasses.replace(commands, label=label)
    states = camdm_controller.start_states(
        clips, model, labels, field="style", seed=args.seed
    )
    control = camdm_controller.Control(follow=1.0)
    frames = steering.steered_rollouts(
        camdm_controller.character(params, model, control=control),
        key,
        states,
        commands,
        chunk=4,
    )
    return jax.block_until_ready(frames), labels


def train_walker(args: Config):
    """Teaches the walker a style; returns the table's rows and what belongs beside."""
    if (args.out / "losses.jsonl").exists():  # an earlier quickstart's
        shutil.rmtree(args.out / "checkpoints", ignore_errors=True)
        (args.out / "losses.jsonl").unlink()
    key_init, key_train, key_roll = jax.random.split(jax.random.key(args.seed), 3)
    gaits = {**GAITS, NEW_STYLE: SWAGGER}
    clips = procedural.make_clips(seed=args.seed + 1, minutes=args.minutes, gaits=gaits)
    print(f"{clips.num_clips} clips of the procedural walker: {clips.names('style')}")
    model, params = start_model(args, clips, key_init)
    params, losses = train(args, clips, model, params, key_train)
    print(f"loss {losses[0]:.4f} -> {losses[-1]:.4f}")
    cli.announce("compiling the rollouts", 40)
    frames, labels = steer(args, clips, model, params, key_roll)

    fps = model.config.fps
    made = windows.rollout_windows(frames, jnp.asarray(labels), skip=30)
    real = windows.eval_windows(clips, stride=windows.EVAL_WINDOW, field="style")
    height = procedural.TOE_HEIGHT + 0.01
    rows = {
        "data": camdm_scoring.metric_row(model.skeleton, real, None, height=height),
        "rollouts": camdm_scoring.metric_row(model.skeleton, made, None, height=height),
    }
    reporting.write_rollout(
        args.out,
        model.skeleton,
        first_motion(frames, fps),
        frames.desired_velocity[0],
        title=f"procedural walker: {', '.join(args.styles)}",
        caption=procedural.SOURCE,
    )
    return rows, {"losses": losses}


def main() -> None:
    """Runs the quickstart."""
    args = cli.check(tyro.cli(Config, description=__doc__))
    steps_of(args)
    loop.check_writable(args.out)
    begun = time.perf_counter()
    rows, report = train_walker(args) if args.train else steer_shipped(args)
    seconds = time.perf_counter() - begun
    report |= {"seconds": seconds, "jax": jax.__version__}
    reporting.write_table(args.out, rows, report)
    print(f"done in {seconds:.0f} s: see {args.out}")


if __name__ == "__main__":
    cli.start(main)
