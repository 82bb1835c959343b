"""Characters of a run, steered along a course; and how they measure up.

One evaluation, for the table of a run and for a sweep over numbers of steps.
"""

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmotion.control import courses, steering
from jaxmotion.data import selection, windows
from jaxmotion.data.clips import Clips
from jaxmotion.diffusion import chain, schedule
from jaxmotion.evaluation import bench, table, timing
from jaxmotion.evaluation.bench import Amount
from jaxmotion.evaluation.table import Row, Rows
from jaxmotion.evaluators import frozen as evaluators
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.evaluators.frozen import Evaluator, clips_fingerprint
from jaxmotion.evaluators.style import StyleEvaluator
from jaxmotion.motion import trajectory
from jaxmotion.motion.skeleton import Motion
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import loss as camdm_loss
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import release as camdm_release
from jaxmotion.systems.camdm import scoring as camdm_scoring
from jaxmotion.systems.camdm.scoring import Reference
from jaxmotion.systems.camdm.training import Run, load_run
from jaxmotion.typing import Key

TRUTH, ROLLOUTS = "held-out (ground truth)", "rollouts"
FLOOR = "training half vs half (noise floor)"


# Ticks to leave out at the start, where the data's own pose still shows.
SKIP = 60


def course_of_run(
    run: Run, course: str, labels: np.ndarray, *, seconds: float, speed: float | None
) -> tuple[np.ndarray, trajectory.Command]:
    """Speeds [characters] and commands [characters, ticks, ...] of a `courses.COURSES`.

    The speed is in meters per second; None for each style's own median speed.
    """
    speeds = np.asarray(selection.label_speeds(run.train, field=run.field))[labels]
    speeds = speeds if speed is None else np.full(labels.shape, speed)
    return speeds, courses.course_batch(
        course, labels, speeds, seconds=seconds, fps=run.model.config.fps
    )


def steer_one(
    run: Run,
    style: str,
    *,
    course: str,
    seconds: float,
    to_style: str | None = None,
    speed: float | None = None,
    seed: int = 0,
) -> tuple[Motion, Float[Array, "frames 2"]]:
    """Steers one character from a pose of the training clips.

    From half time on its style is `to_style`, if given. The speed is in m/s; None for
    the first style's own median speed. With the motion comes the velocity asked for in
    each frame, m/s. A `ValueError` names the courses or styles that there are.
    """
    model = run.model
    label = steering.label_indices(model.labels, style)
    end = label if to_style is None else steering.label_indices(model.labels, to_style)
    _, commands = course_of_run(run, course, label, seconds=seconds, speed=speed)
    half = commands.label.shape[1] // 2
    changed = commands.label.at[:, half:].set(int(end[0]))
    commands = dataclasses.replace(commands, label=changed)
    states = camdm_controller.start_states(
        run.train, model, label, field=run.field, seed=seed
    )
    frames = steering.steered_rollouts(
        camdm_controller.character(run.params, model),
        jax.random.key(seed),
        states,
        commands,
    )
    return frames[0].motion, frames.desired_velocity[0]


def own_starts(run: Run, *, number: int, seed: int = 0) -> Motion:
    """Poses that the model itself stands in (`Model.starts`), none of them recorded.

    Characters of each style stand still for twelve seconds; of sixteen the calmest
    `number` are taken. `ValueError` if a style has no clip to begin with.
    """
    model, found = run.model, []
    character = camdm_controller.character(run.params, model)
    for label in range(len(model.labels)):
        labels = np.full(16, label)
        states = camdm_controller.start_states(
            run.train, model, labels, field=run.field, seed=seed
        )
        _, frames = steering.calmest(
            character,
            states,
            labels,
            number=number,
            past=model.config.past,
            seed=seed,
        )
        at_origin = functools.partial(camdm_controller.at_origin, model.skeleton)
        found.append(jax.vmap(at_origin)(frames.motion))
    return jax.tree.map(lambda *x: jnp.stack(x), *found)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trial:
    """What the characters of an evaluation are told.

    Attributes:
      labels: Style of each character; `repeats` neighbors have one style.
      repeats: Characters of a style.
      states: In held-out poses.
    """

    labels: np.ndarray
    repeats: int
    speeds: np.ndarray
    commands: trajectory.Command
    states: camdm_controller.CharacterState

    @property
    def windows(self) -> int:
        """Windows of each character's rollout."""
        return (self.commands.label.shape[1] - SKIP) // windows.EVAL_WINDOW


def make_trial(
    run: Run,
    course: str,
    *,
    repeats: int,
    seconds: float,
    speed: float | None,
    seed: int,
    styles: np.ndarray | None = None,
) -> Trial:
    """Commands and poses for some characters of the given styles; None for all.

    `ValueError` if there is no such course, rollouts are too short, or a style
    has no held-out clip.
    """
    styles = np.arange(len(run.model.labels)) if styles is None else styles
    labels = np.repeat(styles, repeats)
    speeds, commands = course_of_run(run, course, labels, seconds=seconds, speed=speed)
    fps, ticks = run.model.config.fps, commands.label.shape[1]
    windows.check_ticks(ticks, fps=fps, skip=SKIP)
    states = camdm_controller.start_states(
        run.held_out, run.model, labels, field=run.field, seed=seed
    )
    return Trial(
        labels=labels, repeats=repeats, speeds=speeds, commands=commands, states=states
    )


def reference_of_run(run: Run, evaluator: StyleEvaluator, *, seed: int) -> Reference:
    """The reference of a run's own clips."""
    real = windows.eval_windows(
        run.held_out, stride=windows.EVAL_WINDOW, field=run.field
    )
    dense = windows.eval_windows(run.train, stride=10, field=run.field)
    skeleton = run.model.skeleton
    found = camdm_scoring.make_reference(skeleton, real, dense, evaluator, seed=seed)
    styles = camdm_release.style_features(
        skeleton, run.train, evaluator, field=run.field
    )
    return dataclasses.replace(found, styles=styles)


def _release_cells(
    reference: Reference,
    whole: camdm_release.Recordings,
    group: np.ndarray | None = None,
) -> Row:
    """Columns of the released evaluation."""
    values = camdm_release.metrics(reference.skeleton, whole)
    fid = camdm_release.distances(
        reference.skeleton,
        whole,
        reference.evaluator,
        reference.styles,  # pyright: ignore[reportArgumentType]
    )
    return camdm_release.row(values | {"fid": fid}, group)


def truth_rows(
    run: Run,
    reference: Reference,
    *,
    count: int,
    seed: int,
    repeats: int = 5,
) -> tuple[Row, Row]:
    """`real_rows`, the first with the columns of the released evaluation."""
    truth, floor = camdm_scoring.real_rows(
        reference, count=count, seed=seed, repeats=repeats
    )
    whole = camdm_release.of_clips(run.held_out, field=run.field)
    return truth | _release_cells(reference, whole), floor


def score_run(
    run: Run,
    reference: Reference,
    trial: Trial,
    *,
    count: int,
    chunk: int | None,
    seed: int,
    replicated: bool = False,
    control: camdm_controller.Control | None = None,
    step: chain.StepFactory = chain.ancestral_step,
) -> tuple[Row, dict[str, int]]:
    """Steers the characters of a trial from held-out poses, and measures them.

    Fréchet distances are of `count` windows each; `replicated` is as in `made_row`.
    With the row comes how many rollouts diverged or froze.
    """
    model, fps = run.model, run.model.config.fps
    _, key = jax.random.split(jax.random.key(seed))
    frames = _timed_rollouts(
        run, key, trial.states, trial.commands, chunk, control, step
    )
    made = windows.rollout_windows(frames, jnp.asarray(trial.labels), skip=SKIP)
    row = camdm_scoring.made_row(
        reference,
        made,
        repeats=trial.repeats,
        count=count,
        seed=seed,
        replicated=replicated,
    )
    whole = camdm_release.of_rollouts(frames, trial.commands)
    group = np.arange(trial.labels.size) % trial.repeats if replicated else None
    row |= _release_cells(reference, whole, group)
    found = camdm_scoring.rollout_health(
        model.skeleton, frames, fps=fps, height=reference.root
    )
    return row, found


def evaluate_run(
    run: Run,
    *,
    course: str,
    rollouts: int,
    seconds: float,
    speed: float | None = None,
    chunk: int | None = None,
    evaluator_steps: int = 1500,
    seed: int = 0,
    evaluator: evaluators.Evaluator | None = None,
    control: camdm_controller.Control | None = None,
) -> tuple[Rows, dict[str, Any]]:
    """Steers characters in every style, and measures them beside held-out clips.

    Rollouts are spread evenly over the styles, at least one a style, at most `chunk` at
    a time; the speed is in m/s, None for each style's own median. Without a frozen
    evaluator one is trained in `evaluator_steps` updates; `control` None is the
    model's. Beside the table come speeds, health, counts and versions.

    `ValueError`, before any training, if there is no such course, rollouts are too
    short, a style has no held-out clip, or the evaluator does not fit the run.
    """
    model = run.model
    repeats = max(rollouts // len(model.labels), 1)
    trial = make_trial(
        run, course, repeats=repeats, seconds=seconds, speed=speed, seed=seed
    )
    key_fit, _ = jax.random.split(jax.random.key(seed))
    chosen = load_evaluator(key_fit, run, evaluator, num_steps=evaluator_steps)
    reference = reference_of_run(run, chosen, seed=seed)
    windows_made = trial.windows * trial.labels.size
    count = reference.count(windows_made)
    row, found = score_run(
        run, reference, trial, count=count, chunk=chunk, seed=seed, control=control
    )
    truth, floor = truth_rows(run, reference, count=count, seed=seed)
    return {TRUTH: truth, FLOOR: floor, ROLLOUTS: row}, {
        "contact_height_m": reference.height,
        "windows": {"held_out": len(reference.hits), "rollouts": windows_made},
        "fid_windows": count,
        "fid_reference_windows": len(reference.features),
        "health": found,
        "source": model.source,
        "evaluator": describe_evaluator(run, chosen, evaluator),
        "speeds": dict(
            zip(model.labels, trial.speeds[::repeats].tolist(), strict=True)
        ),
    }


def evaluate_samplers(
    run: Run,
    samplers: dict[str, tuple[chain.StepFactory, tuple[int, ...]]],
    *,
    rollouts: int,
    seconds: float,
    chunk: int | None = None,
    evaluator_steps: int = 1500,
    seed: int = 0,
    evaluator: evaluators.Evaluator | None = None,
) -> tuple[Rows, dict[str, Any]]:
    """One model steered by several samplers, each with milliseconds of a plan.

    Arguments are as for `evaluate_run`; replications have a character of each style
    with held-out clips.

    Args:
      samplers: By name, what makes the steps, and those of the schedule to visit.
    """
    styles = np.unique(run.held_out.labels[run.field])
    repeats = max(rollouts // len(styles), 2)
    trial = make_trial(
        run,
        _COURSE,
        repeats=repeats,
        seconds=seconds,
        speed=None,
        seed=seed,
        styles=styles,
    )
    key_fit, _ = jax.random.split(jax.random.key(seed))
    chosen = load_evaluator(key_fit, run, evaluator, num_steps=evaluator_steps)
    reference = reference_of_run(run, chosen, seed=seed)
    count = reference.count(len(styles) * trial.windows)
    truth, floor = truth_rows(run, reference, count=count, seed=seed, repeats=repeats)
    rows, health, calls = {TRUTH: truth, FLOOR: floor}, {}, {}
    condition = _condition(run, seed=seed)
    for name, (step, steps) in samplers.items():
        model = dataclasses.replace(run.model, steps=steps)
        own = dataclasses.replace(run, model=model)
        rows[name], health[name] = score_run(
            own,
            reference,
            trial,
            count=count,
            chunk=chunk,
            seed=seed,
            replicated=True,
            step=step,
        )
        plan = camdm_model.sampler(
            own.params, config=model.config, step=step, steps=steps
        )
        calls[name] = jax.jit(lambda key, plan=plan: plan(key, condition))
    times = timing.time_in_turn(
        calls, arguments=lambda i: (jax.random.key(i),), rounds=100, least=10
    )
    for name, found in times.items():
        cell = bench.time_cells(found[:, 0], seed=seed)["p50"]
        visited = len(samplers[name][1])
        more = {"plan_time": cell, "network_calls": table.Cell(value=float(visited))}
        rows[name] = rows[name] | more
    return rows, {
        "fid_windows": count,
        "fid_reference_windows": len(reference.features),
        "health": health,
        "source": run.model.source,
        "evaluator": describe_evaluator(run, chosen, evaluator),
    }


def describe_evaluator(
    run: Run, chosen: StyleEvaluator, evaluator: Evaluator | None
) -> dict[str, Any]:
    """Who scored a table, for what stands beside it."""
    reference = clips_fingerprint(run.train, run.field)
    return evaluators.describe(chosen.params, evaluator, reference=reference)


def load_evaluator(
    key: Key, run: Run, evaluator: evaluators.Evaluator | None, *, num_steps: int
) -> style_evaluator.StyleEvaluator:
    """The frozen evaluator, if it fits the run (`ValueError`), or one trained here."""
    model = run.model
    kind, labels, joints = "style", model.labels, model.skeleton.names
    classes: tuple[int, ...] = ()
    if evaluator is not None and evaluator.kind == "style_release":
        style_evaluator.released_joints(model.skeleton)  # raises unless it has them
        kind, joints = evaluator.kind, evaluator.joints
        if set(labels) <= set(evaluator.labels):  # a run may have fewer styles
            classes = tuple(evaluator.labels.index(name) for name in labels)
            labels = evaluator.labels
    frozen = evaluators.params_for(
        evaluator,
        kind=kind,
        labels=labels,
        joints=joints,
        fps=model.config.fps,
        frames=windows.EVAL_WINDOW,
    )
    if frozen is not None:
        return style_evaluator.StyleEvaluator(
            params=frozen,
            config=evaluator.config,  # pyright: ignore
            classes=classes,
        )
    print(f"training the evaluator of styles for {num_steps} steps", flush=True)
    return style_evaluator.fit(key, run.train, field=run.field, num_steps=num_steps)


def _timed_rollouts(
    run: Run,
    key: Key,
    states: Any,
    commands: trajectory.Command,
    chunk: int | None,
    control: camdm_controller.Control | None = None,
    step: chain.StepFactory = chain.ancestral_step,
) -> Any:
    """Frames of the characters; says how many, and how long they took in all."""
    number, ticks = commands.label.shape
    print(f"{number} rollouts of {ticks} ticks, in one program", flush=True)
    begun = time.perf_counter()
    frames = steering.steered_rollouts(
        camdm_controller.character(run.params, run.model, control=control, step=step),
        key,
        states,
        commands,
        chunk=chunk,
    )
    jax.block_until_ready(frames)
    taken = time.perf_counter() - begun
    print(f"rolled out in {taken:.0f} s, compilation included", flush=True)
    return frames


def train_style(
    train: Clips, held_out: Clips, *, field: str, num_steps: int, seed: int
) -> Evaluator:
    """CAMDM's evaluator, of windows of 60 frames.

    Held-out clips give its accuracy; it recognizes labels of the field. `ValueError` if
    a part has no clip as long as a window, or there is no such field.
    """
    key_fit, _ = jax.random.split(jax.random.key(seed))
    found = style_evaluator.fit(key_fit, train, field=field, num_steps=num_steps)
    unseen = windows.eval_windows(held_out, stride=windows.EVAL_WINDOW, field=field)
    _, hits = style_evaluator.features_and_hits(train.skeleton, unseen, found)
    return Evaluator(
        kind="style",
        params=found.params,
        field=field,
        labels=train.names(field),
        joints=train.skeleton.names,
        fps=train.fps,
        frames=windows.EVAL_WINDOW,
        source=train.source,
        clips=clips_fingerprint(train, field),
        seed=seed,
        updates=num_steps,
        accuracy=float(np.mean(hits)),
    )


# Contents of the clips that rollouts are compared with.
CONTENTS = ("walk", "walk-turn-left", "walk-turn-right")
_COURSE = "forward"
_AMOUNTS = {
    "updates": Amount(quick=900, full=11000, meaning="of each model"),
    "batch": Amount(quick=48, full=48, meaning="windows per update"),
    "width": Amount(quick=128, full=192, meaning="channels of a token"),
    "depth": Amount(quick=4, full=4, meaning="layers"),
    "warmup": Amount(quick=100, full=300, meaning="updates of linear rise of the rate"),
    "held_out": Amount(quick=0.1, full=0.1, meaning="part for evaluation"),
    "seconds": Amount(
        quick=14.0,
        full=30.0,
        meaning="of a rollout",
        training=False,
    ),
    "evaluator_updates": Amount(
        quick=400, full=1500, meaning="of the evaluator", training=False
    ),
    "chunk": Amount(
        quick=10, full=10, meaning="characters to run at a time", training=False
    ),
    "rollout_seconds": Amount(
        quick=8.0,
        full=20.0,
        meaning="to look at",
        training=False,
    ),
}


def _train(job: bench.Job, point: bench.Point) -> tuple[str, dict[str, Any]]:
    budget, chunk = job.budget, math.gcd(job.budget["updates"], 50)
    options = dict(
        out=job.models / point.folder,
        steps=budget["updates"],
        batch=budget["batch"],
        warmup=budget["warmup"],
        chunk=chunk,
        save_every=10 * chunk,
        seed=job.seed,
    )
    if point.teacher is not None:
        (teacher,) = bench.plain_points([point.teacher])
        return "distill", options | dict(
            run=job.models / teacher.folder,
            visit=schedule.spread_steps(teacher.steps, point.steps),
        )
    return "train", options | dict(
        data=job.data[0],
        held_out=budget["held_out"],
        width=budget["width"],
        depth=budget["depth"],
        diffusion_steps=point.steps,
    )


def _show(job: bench.Job, point: bench.Point) -> tuple[str, dict[str, Any]]:
    folder = job.models / point.folder
    model, _ = camdm_model.load(folder)
    seconds = job.budget["rollout_seconds"]
    options = dict(run=folder, style=model.labels[0], seconds=seconds, seed=job.seed)
    return "rollout", options


def _condition(run: Run, *, seed: int) -> camdm_model.Condition:
    """One condition of a plan, from a held-out window."""
    config = run.model.config
    index = windows.window_index(run.held_out, config.window, short="skip")
    key_window, key_example = jax.random.split(jax.random.key(seed))
    motion, clip = windows.sample_windows(key_window, run.held_out, index, batch=1)
    label = run.held_out.labels[run.field][clip]
    first = functools.partial(jax.tree.map, lambda x: x[0])
    make = jax.jit(functools.partial(camdm_loss.example, config=config))
    return make(key_example, run.model.skeleton, first(motion), label[0])[0]


def _prepare(job: bench.Job) -> bench.Evaluation:
    """`evaluate_run` of several models, in replications."""
    first = job.models / job.points[0].folder
    run = load_run(first, None, CONTENTS)
    trial = make_trial(
        run,
        _COURSE,
        repeats=job.replications,
        seconds=job.budget["seconds"],
        speed=None,
        seed=job.seed,
    )
    key_fit, _ = jax.random.split(jax.random.key(job.seed))
    chosen = load_evaluator(
        key_fit, run, job.evaluator, num_steps=job.budget["evaluator_updates"]
    )
    reference = reference_of_run(run, chosen, seed=job.seed)
    # A replication has one character of each style.
    count = reference.count(len(run.model.labels) * trial.windows)
    truth, floor = truth_rows(
        run, reference, count=count, seed=job.seed, repeats=job.replications
    )

    def run_of(point: bench.Point) -> Run:
        model, params = camdm_model.load(job.models / point.folder)
        return dataclasses.replace(run, model=model, params=params)

    def score(point: bench.Point) -> Row:
        row, found = score_run(
            run_of(point),
            reference,
            trial,
            count=count,
            chunk=job.budget["chunk"],
            seed=job.seed,
            replicated=True,
        )
        return row | {
            name: table.Cell(value=float(found[name]), samples=found["rollouts"])
            for name in ("diverged", "frozen")
        }

    def sampler(point: bench.Point) -> Callable[[Key], Array]:
        own = run_of(point)
        condition = _condition(own, seed=job.seed)
        model = own.model
        plan = camdm_model.sampler(own.params, config=model.config, steps=model.steps)
        return jax.jit(lambda key: plan(key, condition))

    return bench.Evaluation(
        real={bench.GROUND_TRUTH: truth, bench.NOISE_FLOOR: floor},
        score=score,
        sampler=sampler,
        describe={
            "config": dataclasses.asdict(run.model.config),
            "source": run.model.source,
            "samples": f"one rollout of {job.budget['seconds']:g} s for each of "
            f"{len(run.model.labels)} styles, course {_COURSE!r}; Fréchet distances of "
            f"{count} windows to {len(reference.features)}; the clips' distances are "
            "of as many random subsets, their other intervals over clips; fid_unbiased "
            "is extrapolated to infinitely many windows from a row's subsets of at "
            "least as many windows as features",
            "fid_windows": count,
            "fid_reference_windows": len(reference.features),
            "rollouts": int(trial.labels.size),
            "evaluator": describe_evaluator(run, chosen, job.evaluator),
        },
    )


BENCH = bench.Bench(
    data=(Path("data/bandai2.npz"),),
    amounts=_AMOUNTS,
    points=bench.taught_points,
    train=_train,
    show=_show,
    prepare=_prepare,
    quality="fid",
    sample="one plan of 45 frames",
    evaluator="style",
)
