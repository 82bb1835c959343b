"""Characters told to walk straight on at several speeds, beside data at those speeds.

A mean over a course hides which speed is at fault. Here each speed has a row of
rollouts, and rows of real windows whose own speed is near it.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.control import courses, steering
from jaxmotion.control.foot_lock import FootLock, lock_feet
from jaxmotion.data import windows
from jaxmotion.evaluation import by_frame, locomotion, table
from jaxmotion.evaluators.style import in_batches
from jaxmotion.motion import skeleton
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import scoring as camdm_scoring
from jaxmotion.systems.camdm.training import Run

# Ticks to leave out at the start: characters begin with other speeds.
SKIP = 90
# Real windows count for a told speed if their own is within 15 %, or 0.1 m/s.
_NEAR, _STILL = 0.15, 0.1


def _row(
    run: Run, found: windows.EvalWindows, *, height: float, rest: float
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Metrics of windows and their clip or rollout."""
    # Over half a second, so that the sway of the hips does not count.
    half = round(0.5 * run.model.config.fps)
    feet = jnp.array(run.model.skeleton.feet)

    @jax.jit
    def measure(x: windows.EvalWindows) -> dict[str, jax.Array]:
        positions = skeleton.joint_positions(run.model.skeleton, x.motion)
        path = positions[..., 0, ::2]
        way = jnp.linalg.norm(path[..., half:, :] - path[..., :-half, :], axis=-1)
        metrics = locomotion.locomotion_metrics(
            run.model.skeleton, x.motion, x.velocity, x.facing, contact_height=height
        )
        names = ("slide_speed", "slide_seconds", "skate_ratio", "jerk")
        return {name: metrics[name] for name in names} | {
            "speed": jnp.mean(way, axis=-1) * x.motion.fps / half,
            "sink": rest - jnp.min(positions[..., feet, 1], axis=(-2, -1)),
        }

    return in_batches(measure, found), np.asarray(found.group)


def _cells(values: dict[str, np.ndarray], groups: np.ndarray) -> dict[str, table.Cell]:
    columns = {
        "speed": ("speed", None, 1.0),
        "foot_slide": ("slide_speed", "slide_seconds", 1.0),
        "skate_ratio": ("skate_ratio", None, 1.0),
        "jerk": ("jerk", None, 1.0),
        "toe_sink": ("sink", None, 100.0),
    }
    if groups.size == 0:
        return {c: table.cell(jnp.zeros(0)) for c in columns} | {
            "windows": table.Cell(value=0.0, samples=0)
        }
    row = {}
    for column, (name, weights, scale) in columns.items():
        weight = None if weights is None else values[weights]
        means = table.group_means(values[name], groups, weight)
        row[column] = table.cell(means, scale=scale)
    return row | {"windows": table.Cell(value=float(groups.size), samples=groups.size)}


def speed_table(
    run: Run,
    speeds: Sequence[float],
    *,
    style: str,
    rollouts: int = 16,
    seconds: float = 20.0,
    control: camdm_controller.Control | None = None,
    foot_lock: FootLock | None = None,
    seed: int = 0,
) -> tuple[dict[str, dict[str, table.Cell]], dict[str, by_frame.ByFrame], dict]:
    """Rows by speed, the same rollouts by frame of the plan, and what belongs beside.

    Args:
      run: The run.
      speeds: What characters are told, m/s; 0 to stand.
      style: Their style.
      rollouts: Characters per speed.
      seconds: Of each rollout; the first three are left out.
      control: Constants of the run-time; None for the defaults.
      foot_lock: Settings of the lock; None for none.
      seed: Of start poses and noise.

    Returns:
      The table: for each speed rollouts, held-out and training windows; creep_cm is how
      far the root strays in ten seconds. Then jerk and slide by frame of the plan, of
      the fastest of `speeds` up to 1.5 m/s. Then a report.

    Raises:
      ValueError: if rollouts are too short to measure, or there is no such style.
    """
    model, fps = run.model, run.model.config.fps
    windows.check_ticks(round(seconds * fps), fps=fps, skip=SKIP)
    labels = steering.label_indices(model.labels, style, rollouts)
    real = {
        name: windows.eval_windows(
            clips, stride=windows.EVAL_WINDOW // 2, field=run.field
        )
        for name, clips in (("held-out", run.held_out), ("training", run.train))
    }
    height = camdm_scoring.contact_height(model.skeleton, real["held-out"])
    rest = height - 0.01
    measured = {
        name: (*_row(run, found, height=height, rest=rest), np.asarray(found.label))
        for name, found in real.items()
    }
    character = camdm_controller.character(run.params, model, control=control)
    if foot_lock is not None:
        character = lock_feet(character, foot_lock)
    states = character.start(clips=run.held_out, labels=labels, seed=seed)
    rows: dict[str, dict[str, table.Cell]] = {}
    plans: dict[str, by_frame.ByFrame] = {}
    for speed in speeds:
        commands = courses.course_batch(
            "straight", labels, np.full(len(labels), speed), seconds=seconds, fps=fps
        )
        frames = steering.steered_rollouts(
            character,
            jax.random.key(seed),
            states,
            commands,
            chunk=4,
        )
        made = windows.rollout_windows(frames, jnp.asarray(labels), skip=SKIP)
        row = _cells(*_row(run, made, height=height, rest=rest))
        if speed == 0:
            root = np.asarray(frames.root_position)[:, SKIP:, ::2]
            ten = np.linalg.norm(root - root[:, :1], axis=-1)[:, : round(10 * fps)]
            row["creep_cm"] = table.cell(jnp.asarray(ten.max(axis=1)), scale=100.0)
        rows[f"told {speed:g} m/s"] = row
        for name, (values, groups, style_of) in measured.items():
            off = np.abs(values["speed"] - speed)
            near = off < (_NEAR * speed if speed else _STILL)
            near &= style_of == labels[0]
            part = {k: v[near] for k, v in values.items()}
            rows[f"{name}, about {speed:g} m/s"] = _cells(part, groups[near])
        motion = frames[:, SKIP:].motion
        plans[f"told {speed:g} m/s"] = by_frame.by_frame(
            skeleton.joint_positions(model.skeleton, motion),
            model.skeleton.feet,
            by_frame.frames_since(frames.planned)[:, SKIP:],
            fps,
            num_places=(control or camdm_controller.Control()).apply,
            contact_height=height,
        )
    report: dict[str, Any] = {
        "source": model.source,
        "style": style,
        "rollouts": rollouts,
        "seconds": seconds,
        "contact_height_m": height,
        "by_frame_of_the_plan": by_frame.to_json(plans),
    }
    return rows, plans, report
