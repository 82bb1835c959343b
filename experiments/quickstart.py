"""From nothing to a steered character in a minute, without data or training.

Steers the shipped model of a real person's locomotion along a course (stand, walk,
turn, jog, run, stop, crouch) and writes what it does as GIF, HTML and BVH.

With --train it teaches the shipped model of a procedural walker a ninth style,
"swagger", in about a minute; a character changes style, and is measured beside the
data.

Example: python experiments/quickstart.py --train
"""

import dataclasses
import functools
import shutil
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import tyro

import jaxmotion as jm
from jaxmotion import cli, reporting
from jaxmotion.data import procedural, selection, windows
from jaxmotion.data.gaits import GAITS, Gait
from jaxmotion.learning import loop, training
from jaxmotion.motion.skeleton import joint_positions
from jaxmotion.systems.camdm import loss as camdm_loss
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import scoring as camdm_scoring
from jaxmotion.systems.camdm.controller import Control, character

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
    **dict(max_speed=1.2, cadence=1.0, width=0.24, lean=-0.15, sway=0.06, twist=0.3),
    **dict(arm_swing=0.5, arm_out=0.5, elbow=0.6),
)
CHUNK = 50  # optimizer steps of a row of losses


@dataclasses.dataclass(frozen=True)
class Config:
    """Steer the shipped model; or train on the procedural walker, steer it, measure it.

    Attributes:
      out: Folder for the rollout and metrics.json; of a training also checkpoints.
      characters: Rollouts to measure.
      train: Teach the walker a style first; the options below are its own.
      steps: Optimizer steps, rounded down to a multiple of 50.
      batch: Windows per step.
      minutes: Minutes of walking to generate.
      seconds: Length of the rollout, seconds.
      styles: Styles of the rollout, one after the other.
    """

    out: Path = Path("runs/quickstart")
    characters: int = 16
    seed: int = 0
    train: bool = False
    steps: int = 400
    batch: int = 32
    minutes: float = 12.0
    seconds: float = 16.0
    styles: tuple[str, ...] = ("neutral", NEW_STYLE)


def write(args: Config, model, frames, made, real=None, *, height, title):
    """Writes the first character's rollout; returns the table's rows."""
    shown = (model.skeleton, frames[0].motion, frames.desired_velocity[0])
    reporting.write_rollout(args.out, *shown, title=title, caption=model.source)
    found = {"rollouts": made} if real is None else {"data": real, "rollouts": made}
    row = functools.partial(camdm_scoring.metric_row, model.skeleton, height=height)
    return {name: row(part, None) for name, part in found.items()}


def steer_shipped(args: Config):
    """Steers the shipped model along the course; writes files and metrics."""
    model = jm.load("locomotion")
    print(f"locomotion: {model.source}; compiling, about 15 s", flush=True)
    commands = jm.commands(COURSE, model, args.characters)
    states = model.start(args.characters, seed=args.seed)
    frames = jm.rollout(model, jax.random.key(args.seed), states, commands)
    made = windows.rollout_windows(frames, commands.label[:, 0], skip=0)
    toes = joint_positions(model.skeleton, frames.motion)[..., model.skeleton.feet, 1]
    height = float(toes[:, 0].min()) + 0.01  # they stand
    title = "locomotion, steered along one course"
    rows = write(args, model, frames, made, height=height, title=title)
    return rows, {"source": model.source, "course": COURSE}


def start_model():
    """The shipped walker with a style to learn, which begins as the others' mean."""
    model, params = camdm_model.load("walker")
    config = dataclasses.replace(model.config, num_labels=model.config.num_labels + 1)
    table = params["embed_label"]["embedding"]
    table = jnp.concatenate([table, table.mean(axis=0, keepdims=True)])
    params = params | {"embed_label": {"embedding": table}}
    labels = (*model.labels, NEW_STYLE)
    return dataclasses.replace(model, config=config, labels=labels), params


def train(args: Config, clips, model, params, key):
    """Trains on the clips; returns the averaged parameters and the losses."""
    steps = args.steps // CHUNK * CHUNK
    rates = dict(learning_rate=3e-4, warmup_steps=min(steps // 4, 500), max_norm=1.0)
    optimizer = training.make_optimizer("muon", num_steps=steps, **rates)
    # Half of each batch is the new style.
    parts = (clips, selection.select(clips, "style", [NEW_STYLE]))
    data = [(part, windows.window_index(part, model.config.window)) for part in parts]

    def sample_batch(key, data):
        halves = []
        for half, (clips, index) in zip(jax.random.split(key), data, strict=True):
            number = args.batch // 2
            motion, clip = windows.sample_windows(half, clips, index, batch=number)
            halves.append((motion, clips.labels["style"][clip]))
        return jax.tree.map(lambda *x: jnp.concatenate(x), *halves)

    about = dict(skeleton=model.skeleton, config=model.config)
    loss = functools.partial(camdm_loss.loss, **about)
    update = training.make_update(loss, optimizer, ema_decay=0.995)
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


def train_walker(args: Config):
    """Teaches the walker a style; returns the table's rows and what belongs beside."""
    if (args.out / "losses.jsonl").exists():  # an earlier quickstart's
        shutil.rmtree(args.out / "checkpoints", ignore_errors=True)
        (args.out / "losses.jsonl").unlink()
    key_train, key_roll = jax.random.split(jax.random.key(args.seed))
    options = dict(minutes=args.minutes, gaits={**GAITS, NEW_STYLE: SWAGGER})
    clips = procedural.make_clips(seed=args.seed + 1, **options)
    print(f"{clips.num_clips} clips of the procedural walker: {clips.names('style')}")
    trained, params = start_model()
    params, losses = train(args, clips, trained, params, key_train)
    print(f"loss {losses[0]:.4f} -> {losses[-1]:.4f}")
    cli.announce("compiling the rollouts", 40)
    model = character(params, trained, control=Control(follow=1.0))
    many, styles = args.characters, [model.label(name) for name in args.styles]
    speed = min(selection.label_speeds(clips, field="style")[i] for i in styles)
    commands = jm.commands("forward", model, many, seconds=args.seconds, speed=speed)
    # Through all the styles, one after the other.
    ticks = commands.label.shape[1]
    label = jnp.asarray(styles)[jnp.arange(ticks) * len(styles) // ticks]
    label = jnp.broadcast_to(label, commands.label.shape)
    commands = dataclasses.replace(commands, label=label)
    states = model.start(many, labels=styles[0], clips=clips, seed=args.seed)
    frames = jm.rollout(model, key_roll, states, commands)
    made = windows.rollout_windows(frames, label[:, 0], skip=30)
    real = windows.eval_windows(clips, stride=windows.EVAL_WINDOW, field="style")
    height, title = procedural.TOE_HEIGHT + 0.01, f"walker: {', '.join(args.styles)}"
    rows = write(args, model, frames, made, real, height=height, title=title)
    return rows, {"losses": losses}


def main() -> None:
    """Runs the quickstart."""
    args = cli.check(tyro.cli(Config, description=__doc__))
    if args.steps < CHUNK:
        raise ValueError(f"--steps is {args.steps}, expected at least {CHUNK}")
    loop.check_writable(args.out)
    begun = time.perf_counter()
    rows, report = train_walker(args) if args.train else steer_shipped(args)
    report |= {"seconds": time.perf_counter() - begun, "jax": jax.__version__}
    reporting.write_table(args.out, rows, report)
    print(f"done in {report['seconds']:.0f} s: see {args.out}")


if __name__ == "__main__":
    cli.start(main)
