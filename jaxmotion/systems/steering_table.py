"""How well a character is steered, and how it moves meanwhile.

A mean over one course hides what is at fault. Here characters are told to go straight
on at several speeds, to stand, to turn, to stop and to go, as they are and with locked
feet, beside real windows whose own speed is about that.
The same rollouts are split by frame of the plan, and by time since the last command.

Characters run in parts of a batch, of which only measures are kept, not the frames.
"""

import datetime
import functools
import itertools
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.control import courses, steering
from jaxmotion.control.foot_lock import FootLock, lock_feet
from jaxmotion.control.frame import Frame
from jaxmotion.control.steering import Character
from jaxmotion.data import selection, windows
from jaxmotion.data.clips import Clips
from jaxmotion.evaluation import (
    alignment,
    ball,
    by_frame,
    columns,
    contact,
    health,
    locomotion,
    table,
)
from jaxmotion.evaluation.by_frame import ByFrame, Sums
from jaxmotion.evaluation.table import Cell, Row, Rows
from jaxmotion.evaluators.style import contact_height, in_batches
from jaxmotion.motion import trajectory
from jaxmotion.motion.ground import angle_from_to
from jaxmotion.motion.skeleton import Skeleton, joint_positions
from jaxmotion.motion.spring import Scalar
from jaxmotion.motion.trajectory import Command

# Seconds to leave out at the start: characters begin with other speeds.
SKIP = 3.0
# Real windows count for a told speed if their own is within 15 %, or 0.1 m/s.
_NEAR, _STILL = 0.15, 0.1
# Who is slower, m/s, makes no strides.
_GOES = 0.3
# Real windows turn if they end facing this far, degrees, from where they began.
_TURNING = 90.0
# A stop, a start and a turn are done below 0.1 m/s, at 90 % of the told speed, within
# 10 degrees; those that another command follows too soon are not measured.
_STOPPED, _STARTED, _TURNED = 0.1, 0.9, 10.0
_LEAST_SECONDS = 1.5
_CREEP_SECONDS = 10.0
# A ball that accelerates by more, m/s^2, is being touched: by a toe or an ankle within
# this distance of its center, meters, or by nothing (the values of SMGDiff's tables).
_PUSHED, _TOUCHING = 12.0, 0.18
# Time since a command, in steps of 0.2 s up to 3 s.
_STEP_SECONDS, _STEPS = 0.2, 15

KINDS = ("stop", "start", "turn")


class Change(NamedTuple):
    """A new command: which of `KINDS`, its first tick, and the first one without it.

    Besides, by how many degrees the facing is to change.
    """

    kind: str
    begin: int
    end: int
    degrees: float


def changes(commands: Command) -> list[Change]:
    """New commands of one character [ticks, ...], the first one left out.

    Where both speed and facing change it is a stop or a start. Changes of direction
    by less than 10 degrees are none.
    """
    velocity, facing = np.asarray(commands.velocity), np.asarray(commands.facing)
    speed = np.linalg.norm(velocity, axis=-1)
    both = np.concatenate([velocity, facing], axis=-1)
    begins = np.flatnonzero(np.abs(np.diff(both, axis=0)).max(axis=-1) > 1e-3) + 1
    found = []
    for begin, end in itertools.pairwise([*begins, len(speed)]):
        cosine = float(np.sum(facing[begin] * facing[begin - 1]))
        moves, moved = speed[begin] > 0, speed[begin - 1] > 0
        degrees = float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))))
        kind = "stop" if moved and not moves else "start" if moves > moved else "turn"
        if kind != "turn" or degrees > _TURNED:
            found.append(Change(kind, int(begin), int(end), degrees))
    return found


def since_changes(
    new: Sequence[Change], ticks: int, fps: float
) -> Int[np.ndarray, "kinds ticks"]:
    """Steps of 0.2 s since the last change, if it was of that of `KINDS`, else -1."""
    since, step = np.full((len(KINDS), ticks), -1), round(_STEP_SECONDS * fps)
    for kind, begin, end, _ in new:
        since[KINDS.index(kind), begin:end] = np.arange(end - begin) // step
    return since


def _reach(fps: float) -> int:
    return round(0.25 * fps)


class Ground(NamedTuple):
    """What heights say, in meters: where toes rest, and the root's when it stands."""

    rest: Scalar
    root: Scalar

    @property
    def contact(self) -> Scalar:
        """Below it a toe should not move."""
        return self.rest + 0.01


@jax.jit
def _window_metrics(
    skeleton: Skeleton, ground: Ground, x: windows.EvalWindows
) -> dict[str, Array]:
    positions = joint_positions(skeleton, x.motion)
    feet = positions[..., jnp.array(skeleton.feet), :]
    toes = feet[..., 1]
    reach, fps = _reach(x.motion.fps), x.motion.fps
    speed = alignment.steady_speed(positions[..., 0, ::2], fps, reach=reach)
    mean_speed = jnp.mean(speed[..., reach:-reach], axis=-1)
    metrics = locomotion.locomotion_metrics(
        skeleton, x.motion, x.velocity, x.facing, contact_height=ground.contact
    )
    swing = contact.swing_height(feet, speed, fps, ground=ground.rest)
    names = ("slide_speed", "slide_seconds", "skate_ratio", "jerk", "orientation_error")
    facing = trajectory.root_trajectory(skeleton, x.motion).facing
    raised = feet.at[..., 1].add(-ground.rest)
    turn = angle_from_to(facing[..., 0, :], facing[..., -1, :])
    return {name: metrics[name] for name in names} | {
        "turn": jnp.rad2deg(jnp.abs(turn)),
        "crossings": contact.leg_crossings(feet, facing, fps),
        "strides": contact.stride_rate(feet, facing, fps),
        "ffr_mann": contact.skating_frame_ratio(raised, fps),
        "speed": mean_speed,
        "goes": (mean_speed > _GOES).astype(jnp.float32),
        "sink": ground.rest - jnp.min(toes, axis=(-2, -1)),
        "swing": swing.median,
        "swing_low": swing.low,
        "swing_seconds": swing.seconds,
        "depth": jnp.mean(jnp.maximum(ground.rest - toes, 0.0), axis=(-2, -1)),
    }


def _ball_metrics(
    skeleton: Skeleton, frames: Frame, positions: Array, *, skip: int
) -> dict[str, Array]:
    """Touches, missed ones, and how far the ball is; nothing if there is no ball."""
    if "ball" not in frames.extra:
        return {}
    place, positions = frames.extra["ball"][:, skip:], positions[:, skip:]
    touching = sorted({*skeleton.feet, *(skeleton.parents[i] for i in skeleton.feet)})
    count = ball.touch_count(
        place,
        positions[..., jnp.array(touching), :],
        frames.fps,
        threshold=_PUSHED,
        max_distance=_TOUCHING,
    )
    away = jnp.linalg.norm((place - positions[..., 0, :])[..., ::2], axis=-1)
    return {
        "touches": count.touches / count.minutes,
        "missed": count.missed / count.minutes,
        "ball_away": jnp.mean(away, axis=-1),
    }


@functools.partial(jax.jit, static_argnames=("skip", "places"))
def _measure(
    skeleton: Skeleton,
    ground: Ground,
    frames: Frame,
    facing: Float[Array, "ticks 2"],
    since: Int[Array, "kinds ticks"],
    *,
    skip: int,
    places: int,
) -> dict[str, Any]:
    """All that is kept of some rollouts of one course.

    The first `skip` ticks are left out; `places` frames of a plan are played.
    """
    fps, reach = frames.fps, _reach(frames.fps)
    number, ticks = frames.root_position.shape[:2]
    positions = joint_positions(skeleton, frames.motion)
    path = frames.root_position[..., ::2]
    wanted = alignment.commanded_path(frames.desired_velocity, fps)
    # A controller may take where a character came to a stop for where it should be.
    anchor = frames.extra.get("anchor", wanted)
    offset = 100.0 * alignment.path_offset(path, anchor, reach=reach)
    hips = trajectory.root_trajectory(skeleton, frames.motion).facing
    told = jnp.broadcast_to(facing, hips.shape)

    def still_to_turn(facing: Array) -> Array:
        return jnp.rad2deg(jnp.abs(angle_from_to(told, facing)))

    values = {
        "speed": alignment.steady_speed(path, fps, reach=reach),
        "wanted_speed": alignment.steady_speed(wanted, fps, reach=reach),
        "path_error": jnp.linalg.norm(offset, axis=-1),
        "path_lead": jnp.sum(offset * told, axis=-1),
        "facing_error": still_to_turn(hips),
        "wanted_facing_error": still_to_turn(frames.desired_facing),
    }
    rough = functools.partial(
        by_frame.rough_sums,
        positions[:, skip:],
        skeleton.feet,
        fps=fps,
        contact_height=ground.contact,
    )

    def by_time(place: Int[Array, " ticks"]) -> Sums:
        place = jnp.broadcast_to(place[skip:], (number, ticks - skip))
        return rough(place, num_places=_STEPS) | {
            name: by_frame.place_sums(values[name][:, skip:], place, num_places=_STEPS)
            for name in ("speed", "path_error", "path_lead", "facing_error")
        }

    labels = jnp.zeros(number, jnp.int32)
    cut = windows.rollout_windows(frames, labels, skip=skip)
    diverged = health.has_diverged(
        positions, fps=fps, min_root=0.5 * ground.root, max_root=1.5 * ground.root
    )
    return {
        "ball": _ball_metrics(skeleton, frames, positions, skip=skip),
        "windows": _window_metrics(skeleton, ground, cut),
        "by_plan": rough(
            by_frame.frames_since(frames.planned)[:, skip:], num_places=places
        ),
        "by_time": {kind: by_time(since[i]) for i, kind in enumerate(KINDS)},
        "path": path,
        "diverged": diverged,
        "frozen": health.is_frozen(positions, frames.desired_velocity, fps=fps),
    } | values


# Column: metric of a window, metric that weights it, factor.
_OF_WINDOWS = {
    "speed": ("speed", None, 1.0),
    "foot_slide": ("slide_speed", "slide_seconds", 1.0),
    "skate_ratio": ("skate_ratio", None, 1.0),
    "ffr_mann": ("ffr_mann", None, 1.0),
    "jerk": ("jerk", None, 1.0),
    "crossings": ("crossings", None, 1.0),
    "strides": ("strides", "goes", 1.0),
    "toe_sink": ("sink", None, 100.0),
    "toe_depth": ("depth", None, 100.0),
    "toe_swing": ("swing", "swing_seconds", 100.0),
    "toe_swing_low": ("swing_low", "swing_seconds", 100.0),
    "orientation_error": ("orientation_error", None, float(np.rad2deg(1.0))),
}
_OF_ROLLOUTS = ("speed_error", "path_error", "path_error_max", "creep")
_REACTIONS = ("stop_time", "start_time", "half_turn_time", "turn_time", "disobeyed")
_COUNTS = ("diverged", "frozen", "minutes")
_NONE = Cell(value=float("nan"), samples=0)


def _count(value: float | int | np.generic, samples: int) -> Cell:
    return Cell(value=float(value), samples=samples)


def _window_cells(values: dict[str, np.ndarray], groups: np.ndarray) -> Row:
    row = dict.fromkeys((*_OF_WINDOWS, *_OF_ROLLOUTS, *_REACTIONS, *_COUNTS), _NONE)
    if groups.size:
        for column, (name, weights, scale) in _OF_WINDOWS.items():
            weight = None if weights is None else values[weights]
            means = table.group_means(values[name], groups, weight)
            bounds = columns.COLUMNS[column].bounds
            row[column] = table.cell(means, scale=scale, bounds=bounds)
    return row | {"windows": _count(groups.size, groups.size)}


def _reaction_cells(
    values: dict[str, Any], told: list[Change], commands: Command, fps: float
) -> Row:
    """Times until new commands are obeyed: cells over characters.

    Values are "speed" and "facing_error" [characters, ticks].
    """
    least = round(_LEAST_SECONDS * fps)
    wanted = np.linalg.norm(np.asarray(commands.velocity), axis=-1)
    reached = {
        "stop": values["speed"] < _STOPPED,
        "start": values["speed"] >= _STARTED * wanted,
        "turn": values["facing_error"] <= _TURNED,
        "half_turn": np.zeros_like(values["facing_error"], bool),
    }
    for _, begin, end, degrees in told:
        half = values["facing_error"][..., begin:end] <= degrees / 2.0
        reached["half_turn"][..., begin:end] = half
    row, failed = {}, []
    for name, is_reached in reached.items():
        kind = name.removeprefix("half_")
        some = [c for c in told if c.kind == kind and c.end - c.begin >= least]
        if some:
            spans = [c.begin for c in some], [c.end for c in some]
            found = alignment.reaction(is_reached, *spans, fps)
            row[f"{name}_time"] = table.cell(jnp.asarray(found.seconds.mean(axis=-1)))
            if name in KINDS:
                failed.append(~found.obeyed)
    if failed:
        share = np.concatenate(failed, axis=-1).mean(axis=-1)
        row["disobeyed"] = table.cell(jnp.asarray(share), bounds=(0.0, 1.0))
    return row


def _rollout_row(
    kept: dict[str, Any],
    told: list[Change],
    commands: Command,
    *,
    fps: float,
    skip: int,
) -> Row:
    """The row of all rollouts of one course."""
    number, ticks = kept["speed"].shape
    per = kept["windows"]["jerk"].size // number
    row = _window_cells(kept["windows"], np.repeat(np.arange(number), per))
    error = kept["path_error"][:, skip:]
    row["path_error"] = table.cell(jnp.asarray(error.mean(axis=-1)))
    row["path_error_max"] = table.cell(jnp.asarray(error.max(axis=-1)))
    wanted = kept["wanted_speed"][:, skip:].mean(axis=-1)
    if np.any(np.asarray(commands.velocity)):
        off = kept["speed"][:, skip:].mean(axis=-1) / wanted - 1.0
        row["speed_error"] = table.cell(jnp.asarray(np.abs(off)), scale=100.0)
    length = round(_CREEP_SECONDS * fps)
    if not (told or np.any(np.asarray(commands.velocity))) and ticks - skip >= length:
        away = alignment.creep(jnp.asarray(kept["path"][:, skip:]), length=length)
        row["creep"] = table.cell(away, scale=100.0)
    row |= {name: table.cell(jnp.asarray(x)) for name, x in kept["ball"].items()}
    row |= _reaction_cells(kept, told, commands, fps)
    row["diverged"] = _count(kept["diverged"].sum(), number)
    row["frozen"] = _count(kept["frozen"].sum(), number)
    row["minutes"] = _count(number * ticks / fps / 60.0, number)
    return row


_SUMS = ("by_plan", "by_time")


def _join(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """What was kept of all parts of a batch."""
    arrays = [{k: v for k, v in x.items() if k not in _SUMS} for x in parts]
    sums = [{k: x[k] for k in _SUMS} for x in parts]
    return jax.tree.map(lambda *x: np.concatenate(x), *arrays) | jax.tree.map(
        lambda *x: np.sum(x, axis=0, dtype=np.float64), *sums
    )


class _Real:
    """Windows of real clips, and where the ground is by the first clips.

    Those with the label, if their clips know it.
    """

    def __init__(self, clips: dict[str, Clips], *, label: str):
        first = next(iter(clips))
        field = selection.label_field(clips[first], [label])
        any_field = field or clips[first].label_names[0][0]
        found = {
            name: windows.eval_windows(
                some, stride=windows.EVAL_WINDOW // 2, field=any_field
            )
            for name, some in clips.items()
        }
        skeleton = clips[first].skeleton
        height = contact_height(skeleton, found[first])
        root = np.asarray(found[first].motion.root_position)[..., 1]
        self.ground = Ground(rest=height - 0.01, root=float(np.median(root)))
        measure = functools.partial(_window_metrics, skeleton, self.ground)
        self.values = {}
        for name, some in found.items():
            values, groups = in_batches(measure, some), np.asarray(some.group)
            is_own = np.ones(groups.size, bool)
            if field is not None:
                wanted = clips[name].names(field).index(label)
                is_own = np.asarray(some.label) == wanted
            groups = groups[is_own]
            self.values[name] = {k: v[is_own] for k, v in values.items()}, groups

    def rows(self, speed: float) -> Rows:
        """A row for each clips' windows whose own speed is about that, m/s."""
        width = _NEAR * speed if speed else _STILL
        return self._some(
            f"about {speed:g} m/s", lambda x: np.abs(x["speed"] - speed) < width
        )

    def turning(self) -> Rows:
        """A row for each clips' windows in which it turns, at whatever speed."""
        return self._some("turning", lambda x: x["turn"] > _TURNING)

    def _some(
        self, what: str, which: Callable[[dict[str, np.ndarray]], np.ndarray]
    ) -> Rows:
        rows = {}
        for name, (values, groups) in self.values.items():
            chosen = which(values)
            part = {k: v[chosen] for k, v in values.items()}
            rows[f"{name}, {what}"] = _window_cells(part, groups[chosen])
        return rows


class _Progress:
    """Prints every ten seconds how much is done, and how long the rest takes."""

    def __init__(self, parts: int, minutes: float):
        self.parts, self.minutes, self.done = parts, minutes, 0
        self.begun = self.said = time.perf_counter()

    def step(self) -> None:
        self.done += 1
        now = time.perf_counter()
        if self.done == 1:  # it was compiled meanwhile
            self.begun = now
        elif now - self.said > 10.0:
            self.said = now
            rest = (self.parts - self.done) / (self.done - 1)
            left = datetime.timedelta(seconds=round((now - self.begun) * rest))
            made = self.minutes * self.done / self.parts
            text = f"{made:.1f} of {self.minutes:.1f} character-minutes, {left} left"
            print(text, file=sys.stderr, flush=True)


def _title(name: str, speed: float) -> str:
    """What a row is called; whoever turns on the spot has no speed."""
    stands = name in ("stand", "turn_on_the_spot")
    title = name.replace("_", " ")
    return title if stands else f"{title} at {speed:g} m/s"


class Steered(NamedTuple):
    """The table, the same by frame of the plan and by 0.2 s since a command; report."""

    rows: Rows
    by_plan: dict[str, ByFrame]
    by_time: dict[str, ByFrame]
    report: dict[str, Any]


def steering_table(
    character: Character,
    held_out: Clips,
    train: Clips,
    *,
    label: str,
    speeds: Sequence[float],
    names: Sequence[str] = (),
    course_speeds: Sequence[float] = (1.4,),
    places: int = 15,
    rollouts: int = 16,
    seconds: float = 20.0,
    foot_lock: FootLock | None = None,
    chunk: int = 4,
    seed: int = 0,
) -> Steered:
    """Steers characters straight on and along courses, and measures them.

    Held-out clips, which it never saw, and training clips give rows of real motion, the
    ground, and poses to start from if it starts from clips. All characters have the
    label, as have the real windows if the clips know it. They go straight on at
    `speeds`, m/s (0 to stand), and follow the courses `names` at each of
    `course_speeds`; so many rollouts per speed and course, which all begin with the
    same poses and noise, and whose first three seconds are left out. `places` frames of
    a plan are played; at most `chunk` characters run at a time. With settings of the
    lock there are second rows. Where there are courses, real windows that turn by more
    than 90 degrees have rows, too.

    `ValueError` if rollouts are too short to measure, there is no such label or course,
    or the skeleton has no feet to lock.
    """
    fps = character.fps
    index = character.label(label) if character.labels else 0
    skip, ticks = round(SKIP * fps), round(seconds * fps)
    windows.check_ticks(ticks, fps=fps, skip=skip)
    pairs = [("straight", speed) for speed in speeds]
    pairs += itertools.product(names, course_speeds)
    courses_ = {_title(name, speed): (name, speed) for name, speed in pairs}
    told = {
        title: courses.course_commands(
            name, seconds=seconds, fps=fps, speed=speed, label=index
        )
        for title, (name, speed) in courses_.items()
    }
    characters = {"": character}
    if foot_lock is not None:
        characters[", locked feet"] = lock_feet(character, foot_lock)
    real = _Real({"held-out": held_out, "training": train}, label=label)
    starts = {
        feet: one.start(
            rollouts,
            labels=index,
            clips=None if one.clip_starts is None else held_out,
            seed=seed,
        )
        for feet, one in characters.items()
    }
    chunk = max(size for size in range(1, chunk + 1) if rollouts % size == 0)
    minutes = len(told) * rollouts * seconds / 60.0
    progress = _Progress(len(told) * rollouts // chunk, minutes)
    measure = functools.partial(
        _measure, character.skeleton, real.ground, skip=skip, places=places
    )

    def kept(commands: Command, since: np.ndarray) -> dict[str, dict[str, Any]]:
        every = jax.tree.map(lambda x: jnp.stack([x] * chunk), commands)
        parts: dict[str, list[dict[str, Any]]] = {}
        for first in range(0, rollouts, chunk):
            for feet, one in characters.items():
                part = jax.tree.map(lambda x, i=first: x[i : i + chunk], starts[feet])
                frames = steering.steered_rollouts(
                    one, jax.random.key(seed), part, every, first=first
                )
                found = measure(frames, commands.facing, since)
                parts.setdefault(feet, []).append(jax.device_get(found))
            progress.step()
        return {feet: _join(some) for feet, some in parts.items()}

    rows: Rows = {}
    by_plan: dict[str, ByFrame] = {}
    by_time: dict[str, ByFrame] = {}
    for title, commands in told.items():
        (course, speed), new = courses_[title], changes(commands)
        for feet, one in kept(commands, since_changes(new, ticks, fps)).items():
            rows[title + feet] = _rollout_row(one, new, commands, fps=fps, skip=skip)
            by_plan[title + feet] = by_frame.means(one["by_plan"])
            for kind, sums in one["by_time"].items():
                if sums["speed"][1].any():
                    by_time[f"{title}{feet}, {kind}"] = by_frame.means(sums)
        if course == "straight":
            rows |= real.rows(speed)
        springs = {name: one[f"wanted_{name}"] for name in ("speed", "facing_error")}
        if row := _reaction_cells(springs, new, commands, fps):
            rows[f"{title}, the springs themselves"] = row
    rows |= real.turning() if names else {}
    report = {
        "source": character.source,
        "label": label,
        "rollouts": rollouts,
        "seconds": seconds,
        "character_minutes": minutes,
        "contact_height_m": real.ground.contact,
        "by_frame_of_the_plan": by_frame.to_json(by_plan),
        "by_time_since_a_command": by_frame.to_json(by_time),
    }
    return Steered(rows=rows, by_plan=by_plan, by_time=by_time, report=report)
