"""Characters of a run, steered along a course; and how they measure up."""

import dataclasses
import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmotion.control import courses, steering
from jaxmotion.control.frame import Frame
from jaxmotion.data import selection, windows
from jaxmotion.data.clips import Clips
from jaxmotion.data.windows import EvalWindows
from jaxmotion.evaluation import (
    diversity,
    frechet,
    frechet_bias,
    health,
    locomotion,
    table,
)
from jaxmotion.evaluators import frozen as evaluators
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.evaluators.frozen import Evaluator, clips_fingerprint
from jaxmotion.evaluators.style import Recognized, in_batches, recognized
from jaxmotion.motion import trajectory
from jaxmotion.motion.skeleton import Motion, Skeleton, joint_positions
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import release as camdm_release
from jaxmotion.systems.camdm.training import Run
from jaxmotion.typing import Key


def frechet_cell(
    feature: np.ndarray,
    reference: np.ndarray,
    *,
    count: int,
    seed: int,
    repeats: int = 5,
) -> table.Cell:
    """Fréchet distance to the reference, of random subsets of equal size.

    Args:
      feature: Features of the windows of a row.
      reference: Features of the reference windows.
      count: Windows of each subset, the same for all rows.
      seed: Of the subsets.
      repeats: Subsets.

    Returns:
      Mean, and interval over the subsets (not over clips); no interval where a subset
      is all there is.
    """
    if count == len(feature):
        repeats = 1
    generator = np.random.default_rng(seed)
    target = frechet.moments(jnp.asarray(reference))
    found = []
    for _ in range(repeats):
        chosen = generator.choice(len(feature), count, replace=False)
        own = frechet.moments(jnp.asarray(feature[chosen]))
        found.append(frechet.frechet_distance(own, target))
    return table.cell(jnp.stack(found))


def unbiased_cells(
    feature: np.ndarray, reference: np.ndarray, *, seed: int, sizes: int = 5
) -> dict[str, table.Cell]:
    """Fréchet distance to the reference, extrapolated to infinitely many windows.

    Args:
      feature: Features of all windows of a row.
      reference: Features of the reference windows.
      seed: Of the subsets.
      sizes: Of the subsets, from as many windows as there are features to all.

    Returns:
      "fid_unbiased", without an interval; nothing if there are too few windows for
      the extrapolation to hold.

    Source: `frechet_bias`.
    """
    count, least = feature.shape
    if count < least + sizes - 1:
        return {}
    found = frechet_bias.frechet_bias(
        jax.random.key(seed),
        jnp.asarray(feature),
        frechet.moments(jnp.asarray(reference)),
        sizes=frechet_bias.subset_sizes(count, number=sizes, least=least),
        repeats=3,
    )
    return {"fid_unbiased": table.Cell(value=float(found.extrapolated), samples=count)}


def frechet_cells(
    feature: np.ndarray,
    reference: np.ndarray,
    *,
    count: int,
    seed: int,
    repeats: int = 5,
) -> dict[str, table.Cell]:
    """Both distances to the reference.

    Args:
      feature: Features of the windows of a row.
      reference: Features of the reference windows.
      count: Windows of the subsets of `frechet_cell`.
      seed: Of all subsets.
      repeats: Subsets of `frechet_cell`.

    Returns:
      "fid", and "fid_unbiased" if there are enough windows.
    """
    fid = frechet_cell(feature, reference, count=count, seed=seed, repeats=repeats)
    return {"fid": fid} | unbiased_cells(feature, reference, seed=seed)


def random_half(clips: np.ndarray, labels: np.ndarray, seed: int) -> np.ndarray:
    """Which windows are of a random half of each style's clips.

    Args:
      clips: Clip of each window.
      labels: Style of each window.
      seed: Of the choice.

    Returns:
      True for the windows of that half.

    Raises:
      ValueError: if there is one clip only.
    """
    different, first = np.unique(clips, return_index=True)
    if len(different) < 2:
        raise ValueError("one clip, expected at least two to compare halves")
    shuffled = np.random.default_rng(seed).permutation(len(different))
    # Sorted by style, every second one: both halves hold every style alike.
    order = shuffled[np.argsort(labels[first][shuffled], kind="stable")]
    return np.isin(clips, different[order][::2])


TRUTH, ROLLOUTS = "held-out (ground truth)", "rollouts"
_DEGREES = 180.0 / np.pi
# Column: metric, metric that weights its windows, factor.
_COLUMNS = {
    "trajectory_error_deg": ("trajectory_error", "trajectory_used", _DEGREES),
    "orientation_error_deg": ("orientation_error", None, _DEGREES),
    "foot_slide_m/s": ("slide_speed", "slide_seconds", 1.0),
    "skate_ratio": ("skate_ratio", None, 1.0),
    "acceleration_m/s2": ("acceleration", None, 1.0),
    "jerk_m/s3": ("jerk", None, 1.0),
}


@jax.jit
def _metrics(skeleton: Skeleton, height: Array, x: EvalWindows) -> dict[str, Array]:
    return locomotion.locomotion_metrics(
        skeleton, x.motion, x.velocity, x.facing, contact_height=height
    )


def metric_row(
    skeleton: Skeleton,
    found: EvalWindows,
    hits: np.ndarray | None,
    *,
    height: float,
) -> dict[str, table.Cell]:
    """All columns but the Fréchet distances, with intervals over clips or rollouts.

    Args:
      skeleton: The skeleton.
      found: EvalWindows.
      hits: From `recognized`; None to leave style accuracy out.
      height: Below it a foot joint should not move, meters.

    Returns:
      Columns; angles in degrees.
    """
    run = functools.partial(_metrics, skeleton, jnp.float32(height))
    values = in_batches(run, found)
    row = {}
    if hits is not None:
        means = table.group_means(hits, found.group)
        row["style_accuracy_%"] = table.cell(means, scale=100.0, bounds=(0.0, 1.0))
    for column, (name, weights, scale) in _COLUMNS.items():
        weight = None if weights is None else values[weights]
        means = table.group_means(values[name], found.group, weight)
        bounds = (0.0, 1.0) if name == "skate_ratio" else (-np.inf, np.inf)
        row[column] = table.cell(means, scale=scale, bounds=bounds)
    return row


def rollout_health(
    skeleton: Skeleton,
    frames: Frame,
    *,
    fps: float,
    height: float,
) -> dict[str, int]:
    """How many rollouts diverged or froze; bounds as in `evaluation.health`.

    Args:
      skeleton: The skeleton.
      frames: Displayed frames [characters, ticks, ...].
      fps: Frames per second.
      height: Root height of the standing character, meters; half of it and 1.5
        times of it are the bounds.

    Returns:
      Counts by name, and the number of rollouts.
    """

    @jax.jit
    def run(x: Frame) -> tuple[Array, Array]:
        positions = joint_positions(skeleton, x.motion)
        diverged = health.has_diverged(
            positions, fps=fps, min_root=0.5 * height, max_root=1.5 * height
        )
        return diverged, health.is_frozen(positions, x.desired_velocity, fps=fps)

    diverged, frozen = in_batches(run, frames, size=10)
    return {
        "diverged": int(diverged.sum()),
        "frozen": int(frozen.sum()),
        "rollouts": int(frozen.size),
    }


def repeat_diversity(
    skeleton: Skeleton, found: EvalWindows, *, repeats: int
) -> table.Cell:
    """Intra-style variance over characters of one style under one control.

    Windows of the same time are compared in the frame of the root.

    Args:
      skeleton: The skeleton.
      found: EvalWindows of rollouts in which every `repeats` neighboring characters
        share style and commands.
      repeats: Characters a style.

    Returns:
      Square meters, with an interval over styles.
    """
    local = in_batches(
        jax.jit(functools.partial(style_evaluator.recognizer_input, skeleton)),
        found.motion,
    )
    characters = int(found.group.max()) + 1
    shape = (characters // repeats, repeats, -1, skeleton.num_joints, 3)
    local = jnp.asarray(local).reshape(shape)
    return table.cell(jax.vmap(diversity.intra_style_variance)(local))


def contact_height(skeleton: Skeleton, real: EvalWindows) -> float:
    """Height below which toes should not move.

    Args:
      skeleton: The skeleton.
      real: Windows of real clips.

    Returns:
      Where toes rest (their first percentile), and one centimeter more, as the paper's
      "below, e.g., 1 cm"; meters.
    """
    feet = jnp.array(skeleton.feet)
    toes = in_batches(
        jax.jit(lambda m: joint_positions(skeleton, m)[..., feet, :]), real.motion
    )
    return float(np.percentile(toes[..., 1], 1)) + 0.01


def evaluation_table(
    skeleton: Skeleton,
    real: EvalWindows,
    dense: EvalWindows,
    made: EvalWindows,
    frames: Frame,
    recognizer: Recognized,
    *,
    repeats: int,
    seed: int = 0,
) -> tuple[dict[str, dict[str, table.Cell]], dict[str, Any]]:
    """The table, and what belongs beside it.

    Args:
      skeleton: The skeleton.
      real: Windows of held-out clips, one behind the other.
      dense: Windows of training clips with a short stride: the reference.
      made: Windows of the rollouts.
      frames: The rollouts themselves.
      recognizer: From `fit_recognizer`.
      repeats: Neighboring characters that share style and commands; with one there
        is no column of diversity.
      seed: Of the subsets for Fréchet distances.

    Returns:
      Rows "held-out (ground truth)", "training half vs half (noise floor)" and
      "rollouts"; and the contact height, window counts and health of the rollouts.
    """
    height = contact_height(skeleton, real)
    real_feature, real_hits = recognized(skeleton, real, recognizer)
    made_feature, made_hits = recognized(skeleton, made, recognizer)
    reference, _ = recognized(skeleton, dense, recognizer)
    own = random_half(np.asarray(dense.group), np.asarray(dense.label), seed)
    count = min(len(real_feature), len(made_feature), int(own.sum()), int((~own).sum()))
    distances = functools.partial(frechet_cells, count=count, seed=seed)
    rows = {
        TRUTH: metric_row(skeleton, real, real_hits, height=height)
        | distances(real_feature, reference),
        "training half vs half (noise floor)": distances(
            reference[own], reference[~own]
        ),
        ROLLOUTS: metric_row(skeleton, made, made_hits, height=height)
        | distances(made_feature, reference),
    }
    if repeats > 1:
        found = repeat_diversity(skeleton, made, repeats=repeats)
        rows[ROLLOUTS]["diversity_m2"] = found
    root = float(np.median(np.asarray(real.motion.root_position)[..., 1]))
    return rows, {
        "contact_height_m": height,
        "windows": {"held_out": len(real_hits), "rollouts": len(made_hits)},
        "fid_windows": count,
        "fid_reference_windows": len(reference),
        "health": rollout_health(skeleton, frames, fps=made.motion.fps, height=root),
    }


# Ticks to leave out at the start, where the data's own pose still shows.
SKIP = 60


def course_of_run(
    run: Run, course: str, labels: np.ndarray, *, seconds: float, speed: float | None
) -> tuple[np.ndarray, trajectory.Command]:
    """Speed and commands of each character.

    Args:
      run: The run.
      course: Of `courses.COURSES`.
      labels: Style of each character.
      seconds: Length.
      speed: Meters per second; None for each style's own median speed.

    Returns:
      Speeds [characters], and commands [characters, ticks, ...].

    Raises:
      ValueError: if there is no such course.
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

    Args:
      run: The run.
      style: Its style.
      course: Of `courses.COURSES`.
      seconds: Length.
      to_style: Its style from half time on; None for the same.
      speed: Meters per second; None for the first style's own median speed.
      seed: Of the start pose and the noise.

    Returns:
      The motion, and the velocity asked for in each frame, meters per second.

    Raises:
      ValueError: if there is no such course or style; names those there are.
    """
    model = run.model
    label = np.array([model.label(style)])
    end = label[0] if to_style is None else model.label(to_style)
    _, commands = course_of_run(run, course, label, seconds=seconds, speed=speed)
    half = commands.label.shape[1] // 2
    changed = commands.label.at[:, half:].set(int(end))
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
    """Poses that the model itself stands in: a start without any recorded frame.

    Characters of each style stand still for twelve seconds; of sixteen the calmest are
    taken.

    Args:
      run: The run.
      number: Starts per style, 1 to 16.
      seed: Of the recorded poses that the rollouts begin with, and the noise.

    Returns:
      `Model.starts`.

    Raises:
      ValueError: if a style has no clip to begin with.
    """
    model, many = run.model, 16
    if not 1 <= number <= many:
        raise ValueError(f"starts is {number}, expected 1 to {many}")
    found = []
    for label in range(len(model.labels)):
        labels = np.full(many, label)
        commands = courses.course_batch(
            "straight",
            labels,
            np.full(len(labels), 0.0),
            seconds=12.0,
            fps=model.config.fps,
        )
        states = camdm_controller.start_states(
            run.train, model, labels, field=run.field, seed=seed
        )
        frames = steering.steered_rollouts(
            camdm_controller.character(run.params, model),
            jax.random.key(seed),
            states,
            commands,
            chunk=4,
        )
        past = frames[:, -model.config.past :].motion
        positions = joint_positions(model.skeleton, past)
        unrest = jnp.mean(jnp.abs(jnp.diff(positions, axis=1)), axis=(1, 2, 3))
        calmest = jnp.argsort(unrest)[:number]
        motions = jax.tree.map(lambda x, i=calmest: x[i], past)
        found.append(
            jax.vmap(lambda m: camdm_controller.at_origin(model.skeleton, m))(motions)
        )
    return jax.tree.map(lambda *x: jnp.stack(x), *found)


def evaluate_run(
    run: Run,
    *,
    course: str,
    rollouts: int,
    seconds: float,
    speed: float | None = None,
    chunk: int | None = None,
    recognizer_steps: int = 1500,
    seed: int = 0,
    evaluator: evaluators.Evaluator | None = None,
) -> tuple[dict[str, dict[str, table.Cell]], dict[str, Any]]:
    """Steers characters in every style, and measures them beside held-out clips.

    Args:
      run: The run.
      course: Of `courses.COURSES`.
      rollouts: Characters, spread evenly over the styles; at least one a style.
      seconds: Length of each rollout.
      speed: Meters per second; None for each style's own median speed.
      chunk: Characters to run at a time, at most.
      recognizer_steps: Updates of the style recognizer, if it is trained here.
      seed: Of poses, noise, recognizer and subsets.
      evaluator: A frozen style recognizer; None to train one.

    Returns:
      The table, and what belongs beside it: speeds, health, counts, versions.

    Raises:
      ValueError: before any training, if there is no such course, rollouts are too
        short, a style has no held-out clip, or the evaluator does not fit the run.
    """
    model, field, fps = run.model, run.field, run.model.config.fps
    repeats = max(rollouts // len(model.labels), 1)
    labels = np.repeat(np.arange(len(model.labels)), repeats)
    speeds, commands = course_of_run(run, course, labels, seconds=seconds, speed=speed)
    windows.check_ticks(commands.label.shape[1], fps=fps, skip=SKIP)
    states = camdm_controller.start_states(
        run.held_out, model, labels, field=field, seed=seed
    )
    key_fit, key_roll = jax.random.split(jax.random.key(seed))
    judge = recognizer(key_fit, run, evaluator, num_steps=recognizer_steps)
    frames = _timed_rollouts(run, key_roll, states, commands, chunk)
    real = windows.eval_windows(run.held_out, stride=windows.EVAL_WINDOW, field=field)
    dense = windows.eval_windows(run.train, stride=10, field=field)
    made = windows.rollout_windows(frames, jnp.asarray(labels), skip=SKIP)
    rows, report = evaluation_table(
        model.skeleton, real, dense, made, frames, judge, repeats=repeats
    )
    styles = camdm_release.style_features(model.skeleton, run.train, judge, field=field)
    for name, whole in (
        (TRUTH, camdm_release.of_clips(run.held_out, field=field)),
        (ROLLOUTS, camdm_release.of_rollouts(frames, commands)),
    ):
        values = camdm_release.metrics(model.skeleton, whole)
        fid = camdm_release.distances(model.skeleton, whole, judge, styles)
        rows[name] |= camdm_release.row(values | {"fid": fid})
    return rows, report | {
        "source": model.source,
        "evaluator": evaluators.describe(
            judge.params,
            evaluator,
            reference=evaluators.clips_fingerprint(run.train, field),
        ),
        "speeds": dict(zip(model.labels, speeds[::repeats].tolist(), strict=True)),
    }


def recognizer(
    key: Key, run: Run, evaluator: evaluators.Evaluator | None, *, num_steps: int
) -> style_evaluator.Recognized:
    """The frozen recognizer if there is one, else one trained on the run's clips.

    Args:
      key: Consumed.
      run: The run.
      evaluator: A frozen style recognizer; None to train one.
      num_steps: Updates of a training.

    Returns:
      The recognizer.

    Raises:
      ValueError: if the evaluator does not fit the run; names the field.
    """
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
        return style_evaluator.Recognized(
            params=frozen, config=evaluator.config, classes=classes
        )
    print(f"training the style recognizer for {num_steps} steps", flush=True)
    return style_evaluator.fit_recognizer(
        key, run.train, field=run.field, num_steps=num_steps
    )


def _timed_rollouts(
    run: Run, key: Key, states: Any, commands: trajectory.Command, chunk: int | None
) -> Any:
    """Frames of the characters; says how many, and how long they took in all."""
    number, ticks = commands.label.shape
    print(f"{number} rollouts of {ticks} ticks, in one program", flush=True)
    begun = time.perf_counter()
    frames = steering.steered_rollouts(
        camdm_controller.character(run.params, run.model),
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
    """CAMDM's recognizer, of windows of 60 frames.

    Args:
      train: Training clips.
      held_out: Clips for its accuracy.
      field: Label field that it recognizes.
      num_steps: Updates.
      seed: Of parameters and batches.

    Returns:
      The evaluator.

    Raises:
      ValueError: if a part has no clip as long as a window, or there is no such field.
    """
    key_fit, _ = jax.random.split(jax.random.key(seed))
    found = style_evaluator.fit_recognizer(
        key_fit, train, field=field, num_steps=num_steps
    )
    unseen = windows.eval_windows(held_out, stride=windows.EVAL_WINDOW, field=field)
    _, hits = style_evaluator.recognized(train.skeleton, unseen, found)
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
