"""Changes of style: how often they come, how soon, and what the motion is meanwhile.

Every ordered pair of styles is one change. A replication has one rollout of each, with
noise and start poses of its own; all rows have the same. An evaluator decides in
windows of two seconds whether the new style is there, and the change is dated to the
center of the first window that shows it: up to half of that window may be from before.

Source: Chen et al. 2024 (CAMDM), section 4.1, tables 2 and 4, where people judged.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxmotion.control import steering
from jaxmotion.control.frame import Frame
from jaxmotion.data import windows
from jaxmotion.evaluation import table
from jaxmotion.evaluation.transitions import transition
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.evaluators.style import StyleEvaluator, contact_height
from jaxmotion.motion import trajectory
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import evaluation as camdm_evaluation
from jaxmotion.systems.camdm import release as camdm_release
from jaxmotion.systems.camdm import scoring as camdm_scoring
from jaxmotion.systems.camdm.training import Run

# Frames between the windows in which the new style is looked for.
STRIDE = 3
HALF = windows.EVAL_WINDOW // 2
# Seconds after the command whose motion is measured; the paper's 120 frames.
MEASURED = 4.0
MOTION = ("foot_slide", "jerk")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Changes:
    """Rollouts to be made, and when and into what their style changes.

    Attributes:
      states: Where characters start, in poses of their first style.
      commands: [characters, ticks]; each style goes at its own speed.
      old: First style of each character.
      new: Style commanded from `tick` on.
      replication: That each character belongs to.
      tick: Tick of the change.
      limit: Seconds after it in which it must have come.
    """

    states: camdm_controller.CharacterState
    commands: trajectory.Command
    old: np.ndarray
    new: np.ndarray
    replication: np.ndarray
    tick: int
    limit: float


def make_changes(
    run: Run,
    *,
    course: str,
    before: float,
    limit: float = 4.0,
    replications: int,
    seed: int,
) -> Changes:
    """Every ordered pair of styles, in each replication.

    They spend `before` seconds, at least half a window, in the first style, and have
    `limit` seconds from the command on to change; rollouts last until the last window
    is whole. Replications are sets of all pairs, each with start poses of its own.
    `ValueError` for fewer than two styles or replications, no such course, or no time.
    """
    number, fps = len(run.model.labels), run.model.config.fps
    least = {"styles": (number, 2), "replications": (replications, 2)}
    for name, (found, expected) in least.items():
        if found < expected:
            raise ValueError(f"{name}: {found}, expected at least {expected}")
    for name, seconds, shortest in (
        ("before", before, HALF / fps),
        ("limit", limit, 0),
    ):
        if not (seconds >= shortest and seconds > 0):
            what = f"at least {shortest:g}" if shortest else "more than 0"
            raise ValueError(f"{name}: {seconds} s, expected {what}")
    pairs = np.array([(a, b) for a in range(number) for b in range(number) if a != b])
    old, new = np.tile(pairs, (replications, 1)).T
    tick = round(before * fps)
    ticks = tick + max(round(limit * fps) + HALF, round(MEASURED * fps))
    of_style = functools.partial(
        camdm_evaluation.course_of_run, run, course, seconds=ticks / fps, speed=None
    )
    commands = jax.tree.map(
        lambda a, b: jnp.concatenate([a[:, :tick], b[:, tick:]], axis=1),
        of_style(old)[1],
        of_style(new)[1],
    )
    return Changes(
        states=camdm_controller.start_states(
            run.held_out, run.model, old, field=run.field, seed=seed
        ),
        commands=commands,
        old=old,
        new=new,
        replication=np.repeat(np.arange(replications), len(pairs)),
        tick=tick,
        limit=limit,
    )


def without(changes: Changes) -> Changes:
    """The same characters, who keep label and speed, evaluated for the same new styles.

    What finds a change there is wrong.
    """
    first = changes.commands.label[:, :1]
    label = jnp.broadcast_to(first, changes.commands.label.shape)
    commands = dataclasses.replace(changes.commands, label=label)
    return dataclasses.replace(changes, commands=commands)


def find_changes(
    skeleton: Skeleton,
    frames: Frame,
    changes: Changes,
    evaluator: StyleEvaluator,
    *,
    fps: float,
) -> tuple[Bool[np.ndarray, "characters windows"], np.ndarray]:
    """Whether each window about or after the command shows the new style.

    Given are decisions, and windows' centers in seconds after the command, from 0 on.
    """
    centers = np.arange(0, round(changes.limit * fps) + 1, STRIDE)
    found = []
    for center in centers:
        first = changes.tick + int(center) - HALF
        last = first + windows.EVAL_WINDOW
        cut = jax.tree.map(lambda x: x[:, first:last], frames)  # noqa: B023
        label = jnp.asarray(changes.new)
        made = windows.rollout_windows(cut, label, skip=0)
        found.append(
            style_evaluator.features_and_hits(skeleton, made, evaluator)[1] > 0.5
        )
    return np.stack(found, axis=1), centers / fps


def transition_row(
    run: Run,
    frames: Frame,
    changes: Changes,
    evaluator: StyleEvaluator,
    *,
    height: float,
) -> dict[str, table.Cell]:
    """Success, duration and quality of motion, over replications.

    Success in per cent; duration in seconds and frames, failures counted as the limit;
    of the four seconds after the command what `metric_row` measures; and of the whole
    rollout slide and coherence of CAMDM's release. Below `height`, meters, a foot joint
    should not move.
    """
    skeleton, fps = run.model.skeleton, run.model.config.fps
    found, centers = find_changes(skeleton, frames, changes, evaluator, fps=fps)
    done = transition(
        jnp.asarray(found), jnp.asarray(centers, jnp.float32), limit=changes.limit
    )

    def cell(values: Array, **options) -> table.Cell:
        return table.cell(table.group_means(values, changes.replication), **options)

    row = {
        "success": cell(1.0 * done.succeeded, scale=100.0, bounds=(0.0, 1.0)),
        "transition_time": cell(done.seconds),
        "transition_frames": cell(fps * done.seconds),
    }
    after = slice(changes.tick, changes.tick + round(MEASURED * fps))
    cut = jax.tree.map(lambda x: x[:, after], frames)
    made = windows.rollout_windows(cut, jnp.asarray(changes.new), skip=0)
    owner = changes.replication[np.asarray(made.group)]
    grouped = dataclasses.replace(made, group=jnp.asarray(owner))
    motion = camdm_scoring.metric_row(skeleton, grouped, None, height=height)
    row |= {name: motion[name] for name in MOTION}
    # The release measures neither direction nor facing of its changes of style.
    whole = camdm_release.of_rollouts(frames, changes.commands)
    values = camdm_release.metrics(skeleton, dataclasses.replace(whole, command=None))
    return row | camdm_release.row(values, changes.replication)


def evaluate_transitions(
    run: Run,
    changes: Changes,
    controls: dict[str, camdm_controller.Control],
    evaluator: StyleEvaluator,
    *,
    chunk: int | None = None,
    seed: int = 0,
    report: Callable[[str], None] = print,
) -> dict[str, dict[str, table.Cell]]:
    """One row for each run-time, and one of characters who keep their style.

    The run-times' constants are by row; the last row's serve for those who keep their
    style. All rows have the same noise, and at most `chunk` characters at a time;
    `report` is called with each row's name.
    """
    real = windows.eval_windows(
        run.held_out, stride=windows.EVAL_WINDOW, field=run.field
    )
    height = contact_height(run.model.skeleton, real)

    def row(own: Changes, control: camdm_controller.Control) -> dict[str, table.Cell]:
        frames = steering.steered_rollouts(
            camdm_controller.character(run.params, run.model, control=control),
            jax.random.key(seed),
            own.states,
            own.commands,
            chunk=chunk,
        )
        return transition_row(run, frames, own, evaluator, height=height)

    rows = {}
    for name, control in controls.items():
        rows[name] = row(changes, control)
        report(name)
    rows["style kept (changes found by mistake)"] = row(without(changes), control)
    return rows


def clip_accuracy(run: Run, evaluator: StyleEvaluator) -> table.Cell:
    """Per cent of held-out clips that the evaluator recognizes: a bound on success."""
    real = windows.eval_windows(run.held_out, stride=STRIDE, field=run.field)
    _, hits = style_evaluator.features_and_hits(run.model.skeleton, real, evaluator)
    return table.cell(
        table.group_means(hits, real.group), scale=100.0, bounds=(0.0, 1.0)
    )
