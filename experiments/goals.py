"""How exactly steered characters go along paths, to places in time, and after somebody.

Each character of a batch has a goal of its own: an S-shaped path of 14 m at 1.4 m/s, in
a direction of its own; a place 1 to 5 m away, with a facing and a time of arrival that
suffices at 1.2 m/s; or a leader who walks a figure eight, to be followed at 1.5 m. Who
has a ball loses it, and fetches it. At last, characters on a circle change places, each
for the opposite one, and keep clear of each other; --gif draws them.

Example: python experiments/goals.py --model locomotion --characters 16 --out runs/goals
"""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import jaxmotion as jm
from jaxmotion import cli, reporting
from jaxmotion.control import goals, rollout
from jaxmotion.control.frame import Frame
from jaxmotion.control.steering import Character, steered
from jaxmotion.evaluation import table
from jaxmotion.evaluation.table import Rows
from jaxmotion.learning import loop
from jaxmotion.systems.smgdiff.controller import PlayerState, kicked
from jaxmotion.viz.stage import make_stage

SPEED, DISTANCE = 1.4, 1.5
SETTLE = 3.0  # seconds in which a follower comes up
NEAR = 0.1  # meters at which one has arrived
# Seconds after its time from which one should rest at a place, and m/s at which not.
REST, MOVES = 1.5, 0.15


@dataclasses.dataclass(frozen=True)
class Config:
    """Measure how exactly goals are met.

    Attributes:
      model: Names of shipped models, or run folders, or exported files.
      characters: How many at a time; one row each.
      crossing: Characters who change places; 0 for none.
      gif: Picture of those of the first model.
      out: Folder for metrics.json and table.md.
    """

    model: tuple[str, ...] = ("locomotion", "locomotion_fast", "dribble", "walker")
    characters: tuple[int, ...] = (1, 64)
    crossing: int = 64
    gif: cli.Optional[Path] = None
    out: Path = Path("runs/goals")
    seed: int = 0


def s_shapes(number: int, seed: int) -> goals.Path:
    """An S of two half circles, 14 m long, that begins straight on or a bit aside."""
    radius = 14.0 / (2 * np.pi)
    angle = np.linspace(0.0, np.pi, 41)
    half = radius * np.stack([1 - np.cos(angle), np.sin(angle)], axis=1)
    points = np.concatenate([half, half[-1] + half[1:] * [1, -1]])
    turn = np.random.default_rng(seed).uniform(-0.5, 0.5, number)
    cos, sin = np.cos(turn), np.sin(turn)
    matrix = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], -2)
    points = np.einsum("nij,pj->npi", matrix, points)
    return goals.Path(
        points=jnp.asarray(points, jnp.float32),
        speed=jnp.full(points.shape[:2], SPEED),
    )


def some_places(number: int, seed: int) -> goals.Place:
    """Places 1 to 5 m away, with facings, and times that suffice at 1.2 m/s."""
    generator = np.random.default_rng(seed)
    angle, facing = generator.uniform(-np.pi, np.pi, (2, number))
    distance = generator.uniform(1.0, 5.0, number)
    unit = lambda a: np.stack([np.sin(a), np.cos(a)], axis=1)  # noqa: E731
    return goals.Place(
        position=jnp.asarray(distance[:, None] * unit(angle), jnp.float32),
        facing=jnp.asarray(unit(facing), jnp.float32),
        seconds=jnp.asarray(2.0 + distance / 1.2, jnp.float32),
    )


def distances_to_path(path: np.ndarray, points: np.ndarray) -> np.ndarray:
    """From each place [ticks, 2] to the nearest point of a polyline, meters."""
    begin, step = points[:-1], np.diff(points, axis=0)
    gap = path[:, None] - begin[None]
    part = np.sum(gap * step, axis=-1) / np.sum(step**2, axis=-1)
    near = begin + np.clip(part, 0.0, 1.0)[..., None] * step
    return np.linalg.norm(path[:, None] - near, axis=-1).min(axis=1)


def _ground(frames: Frame) -> np.ndarray:
    return np.asarray(frames.root_position)[..., ::2]


def path_errors(model: Character, number: int, seed: int) -> dict[str, np.ndarray]:
    """Distance from the path while it is walked, and from its end at last, cm."""
    goal, key = s_shapes(number, seed), jax.random.key(seed)
    frames = goals.goal_rollouts(
        model, key, model.start(number, seed=seed), goal, seconds=14.0
    )
    walked, points = _ground(frames), np.asarray(goal.points)
    errors = np.stack([distances_to_path(*x) for x in zip(walked, points, strict=True)])
    end = np.linalg.norm(walked[:, -1] - points[:, -1], axis=-1)
    return {
        "path_mean": 100 * errors.mean(axis=1),
        "path_largest": 100 * errors.max(axis=1),
        "path_end": 100 * end,
    }


def place_errors(model: Character, number: int, seed: int) -> dict[str, np.ndarray]:
    """Distance at the time, cm, how late the last decimeter began, s, and the facing.

    Who never comes so near counts with the whole time that was left. Also who does not
    rest: how much of the time from `REST` after his own on he goes at `MOVES` or more.
    """
    goal, key = some_places(number, seed), jax.random.key(seed)
    seconds = 9.0
    frames = goals.goal_rollouts(
        model, key, model.start(number, seed=seed), goal, seconds=seconds
    )
    due = np.asarray(goal.seconds)
    walked = _ground(frames)
    away = np.linalg.norm(walked - np.asarray(goal.position)[:, None], axis=-1)
    rows = np.arange(number)
    ticks = np.minimum(np.round(due * model.fps).astype(int), away.shape[1] - 1)
    near = away < NEAR
    came = np.where(near.any(axis=1), near.argmax(axis=1) / model.fps, seconds)
    facing = np.asarray(
        jm.motion.trajectory.root_trajectory(model.skeleton, frames.motion).facing
    )[:, -1]
    cosine = np.clip(np.sum(facing * np.asarray(goal.facing), axis=-1), -1.0, 1.0)
    over = round(0.2 * model.fps)
    speed = np.linalg.norm(walked[:, over:] - walked[:, :-over], axis=-1) / 0.2
    after = np.arange(speed.shape[1]) / model.fps > due[:, None] + REST
    return {
        "place_error": 100 * away[rows, ticks],
        "place_end": 100 * away[:, -1],
        "late": np.abs(came - due),
        "place_facing": np.rad2deg(np.arccos(cosine)),
        "place_moves": ((speed >= MOVES) & after).sum(axis=1) / after.sum(axis=1),
    }


def follow_errors(model: Character, number: int, seed: int) -> dict[str, np.ndarray]:
    """How far a follower is from his distance on a figure eight of a leader, cm."""
    if number < 2:
        return {}
    behind = np.full(number, DISTANCE)
    behind[0] = 0.0
    seconds = 15.0
    frames = goals.goal_rollouts(
        model,
        jax.random.key(seed),
        model.start(number, seed=seed),
        goals.Follow(
            leader=jnp.zeros(number, jnp.int32),
            distance=jnp.full(number, DISTANCE),
        ),
        seconds=seconds,
        places=jnp.asarray(np.stack([np.zeros(number), -behind], axis=1)),
        commands=jm.commands(
            "figure_eight", model, number, seconds=seconds, speed=SPEED
        ),
    )
    walked = _ground(frames)[:, round(SETTLE * model.fps) :]
    gap = np.linalg.norm(walked[1:] - walked[:1], axis=-1)
    return {"follow": 100 * np.abs(gap - DISTANCE).mean(axis=1)}


def fetch_errors(model: Character, number: int, seed: int) -> dict[str, np.ndarray]:
    """How long one fetches a ball that was kicked away, s, and where it is at last, cm.

    He dribbles on for three seconds before; it lies, or rolls, 2 to 4 m from where it
    was. It is back within 60 cm; who never has it counts with all the time.
    """
    states = model.start(number, seed=seed)
    if not isinstance(getattr(states, "inner", None), PlayerState):
        return {}
    run = jax.jit(functools.partial(rollout.rollout, model.method(model.params)))
    told = jm.commands("straight", model, number, seconds=12.0, speed=SPEED)
    kicks = round(3.0 * model.fps)
    cut = lambda part: jax.tree.map(lambda x: x[:, part], told)  # noqa: E731
    first, second = jax.random.split(jax.random.key(seed))
    states, frames = run(first, states, cut(slice(kicks)))

    generator = np.random.default_rng(seed)
    angle = generator.uniform(-np.pi, np.pi, number)
    away, speed = generator.uniform([[2.0], [0.0]], [[4.0], [3.0]], (2, number))
    unit = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    inner = jax.vmap(kicked)(
        states.inner,
        frames.extra["ball"][:, -1, ::2] + jnp.asarray(away[:, None] * unit),
        jnp.asarray(speed[:, None] * unit),
    )
    states = dataclasses.replace(states, inner=inner)
    _, frames = run(second, states, cut(slice(kicks, None)))
    gap = np.linalg.norm(
        np.asarray(frames.extra["ball"])[..., ::2] - _ground(frames), axis=-1
    )
    near = gap < 0.6
    took = np.where(near.any(axis=1), near.argmax(axis=1), gap.shape[1]) / model.fps
    return {"fetch": took, "ball_end": 100 * gap[:, -1]}


def cross(model: Character, number: int, seed: int) -> tuple[Frame, np.ndarray]:
    """Frames of characters who change places across a circle, and where they want to.

    The circle has 1.2 m for each.
    """
    angle = np.arange(number) * 2 * np.pi / number
    radius = max(1.2 * number / (2 * np.pi), 2.0)
    start = radius * np.stack([np.sin(angle), np.cos(angle)], axis=1)
    goal = goals.Place(
        position=jnp.asarray(-start, jnp.float32),
        facing=jnp.asarray(-start / radius, jnp.float32),
        seconds=jnp.full(number, 2.0 + 2 * radius / 1.2, jnp.float32),
    )
    frames = goals.goal_rollouts(
        model,
        jax.random.key(seed),
        model.start(number, seed=seed),
        goal,
        seconds=10.0 + 2 * radius / 1.2,
        places=jnp.asarray(start, jnp.float32),
        avoiding=True,
    )
    return frames, -start


def crossing_row(model: Character, frames: Frame, wanted: np.ndarray) -> table.Row:
    """Smallest distance of two roots, cm, and how many came within 30 cm of theirs."""
    walked = _ground(frames)
    number = len(walked)
    nearest = np.full(number, np.inf)
    for tick in range(walked.shape[1]):
        gaps = np.linalg.norm(walked[:, None, tick] - walked[None, :, tick], axis=-1)
        nearest = np.minimum(nearest, (gaps + 1e6 * np.eye(number)).min(axis=1))
    away = np.linalg.norm(walked[:, -1] - wanted, axis=-1)
    count = lambda value: table.Cell(value=float(value), samples=number)  # noqa: E731
    return {
        "gap": count(100 * nearest.min()),
        "touching": count((nearest < 0.4).mean()),
        "arrived": count((away < 0.3).mean()),
    }


def main() -> None:
    """Writes the table, and the picture."""
    args = cli.check(tyro.cli(Config, description=__doc__))
    loop.check_writable(args.out)
    models = {x: steered(jm.load(x), what=x) for x in args.model}
    cli.announce("compiling the rollouts of each model and number", 60)
    rows: Rows = {}
    for name, model in models.items():
        for number in args.characters:
            found = {}
            for measure in (path_errors, place_errors, follow_errors, fetch_errors):
                found |= measure(model, number, args.seed)
            row = {k: table.cell(jnp.asarray(x)) for k, x in found.items()}
            rows[f"{name}, {number}"] = row
            print(name, number, {k: round(v.value, 2) for k, v in row.items()})
        if args.crossing:
            frames, wanted = cross(model, args.crossing, args.seed)
            row = crossing_row(model, frames, wanted)
            rows[f"{name}, {args.crossing} who change places"] = row
            if args.gif is not None and model is next(iter(models.values())):
                from jaxmotion.viz import animation

                stage = make_stage(model.skeleton, frames.motion, apart=0.0)
                animation.save_gif(args.gif, stage)
                print(f"wrote {args.gif}")
        # Of all models up to here: the others may take long.
        reporting.write_table(args.out, rows, reporting.provenance(args))


if __name__ == "__main__":
    cli.start(main)
