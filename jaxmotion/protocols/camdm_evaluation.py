"""Characters of a run, steered along a preset; and how they measure up."""

import dataclasses
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmotion.evaluation import table
from jaxmotion.learning import recognition
from jaxmotion.motion import skeleton, trajectory
from jaxmotion.protocols import camdm as protocol
from jaxmotion.protocols import (
    camdm_release,
    camdm_rows,
    camdm_styles,
    evaluators,
    provenance,
)
from jaxmotion.protocols.camdm_runs import Run
from jaxmotion.typing import Key

# Ticks to leave out at the start, where the data's own pose still shows.
SKIP = 60


def preset_of_run(
    run: Run, preset: str, labels: np.ndarray, *, seconds: float, speed: float | None
) -> tuple[np.ndarray, trajectory.Command]:
    """Speed and commands of each character.

    Args:
      run: The run.
      preset: Of `presets.PRESETS`.
      labels: Style of each character.
      seconds: Length.
      speed: Metres a second; None for each style's own median speed.

    Returns:
      Speeds [characters], and commands [characters, ticks, ...].

    Raises:
      ValueError: if there is no such preset.
    """
    speeds = np.asarray(protocol.style_speeds(run.train, field=run.field))[labels]
    speeds = speeds if speed is None else np.full(labels.shape, speed)
    return speeds, protocol.preset_batch(
        preset, labels, speeds, seconds=seconds, fps=run.model.config.fps
    )


def steer_one(
    run: Run,
    style: str,
    *,
    preset: str,
    seconds: float,
    to_style: str | None = None,
    speed: float | None = None,
    seed: int = 0,
) -> tuple[skeleton.Motion, Float[Array, "frames 2"]]:
    """Steers one character from a pose of the training clips.

    Args:
      run: The run.
      style: Its style.
      preset: Of `presets.PRESETS`.
      seconds: Length.
      to_style: Its style from half time on; None for the same.
      speed: Metres a second; None for the first style's own median speed.
      seed: Of the start pose and the noise.

    Returns:
      The motion, and the velocity asked for in each frame, metres a second.

    Raises:
      ValueError: if there is no such preset or style; names those there are.
    """
    model = run.model
    label = np.array([model.label(style)])
    end = label[0] if to_style is None else model.label(to_style)
    _, commands = preset_of_run(run, preset, label, seconds=seconds, speed=speed)
    half = commands.label.shape[1] // 2
    changed = commands.label.at[:, half:].set(int(end))
    commands = dataclasses.replace(commands, label=changed)
    states = protocol.start_states(run.train, model, label, field=run.field, seed=seed)
    frames = protocol.steered_rollouts(
        run.params, jax.random.key(seed), states, commands, model=model
    )
    motion = skeleton.Motion(
        root_position=frames.root_position[0],
        joint_rotation=frames.joint_rotation[0],
        fps=model.config.fps,
    )
    return motion, frames.desired_velocity[0]


def own_starts(run: Run, *, number: int, seed: int = 0) -> skeleton.Motion:
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
        commands = protocol.straight_batch(
            0.0, labels, seconds=12.0, fps=model.config.fps
        )
        states = protocol.start_states(
            run.train, model, labels, field=run.field, seed=seed
        )
        frames = protocol.steered_rollouts(
            run.params, jax.random.key(seed), states, commands, model=model, chunk=4
        )
        past = skeleton.Motion(
            root_position=frames.root_position[:, -model.config.past :],
            joint_rotation=frames.joint_rotation[:, -model.config.past :],
            fps=model.config.fps,
        )
        positions = skeleton.joint_positions(model.bones, past)
        unrest = jnp.mean(jnp.abs(jnp.diff(positions, axis=1)), axis=(1, 2, 3))
        calmest = jnp.argsort(unrest)[:number]
        motions = jax.tree.map(lambda x, i=calmest: x[i], past)
        found.append(jax.vmap(lambda m: protocol.at_origin(model, m))(motions))
    return jax.tree.map(lambda *x: jnp.stack(x), *found)


def evaluate_run(
    run: Run,
    *,
    preset: str,
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
      preset: Of `presets.PRESETS`.
      rollouts: Characters, spread evenly over the styles; at least one a style.
      seconds: Length of each rollout.
      speed: Metres a second; None for each style's own median speed.
      chunk: Characters to run at a time, at most.
      recognizer_steps: Updates of the style recogniser, if it is trained here.
      seed: Of poses, noise, recogniser and subsets.
      evaluator: A frozen style recogniser; None to train one.

    Returns:
      The table, and what belongs beside it: speeds, health, counts, versions.

    Raises:
      ValueError: before any training, if there is no such preset, rollouts are too
        short, a style has no held-out clip, or the evaluator does not fit the run.
    """
    model, field, fps = run.model, run.field, run.model.config.fps
    repeats = max(rollouts // len(model.labels), 1)
    labels = np.repeat(np.arange(len(model.labels)), repeats)
    speeds, commands = preset_of_run(run, preset, labels, seconds=seconds, speed=speed)
    protocol.check_ticks(commands.label.shape[1], fps=fps, skip=SKIP)
    states = protocol.start_states(run.held_out, model, labels, field=field, seed=seed)
    key_fit, key_roll = jax.random.split(jax.random.key(seed))
    judge = recognizer(key_fit, run, evaluator, num_steps=recognizer_steps)
    frames = _timed_rollouts(run, key_roll, states, commands, chunk)
    real = protocol.data_windows(run.held_out, stride=protocol.WINDOW, field=field)
    dense = protocol.data_windows(run.train, stride=10, field=field)
    made = protocol.rollout_windows(frames, jnp.asarray(labels), fps=fps, skip=SKIP)
    rows, report = camdm_rows.evaluation_table(
        model.bones, real, dense, made, frames, judge, repeats=repeats
    )
    styles = camdm_release.style_features(model.bones, run.train, judge, field=field)
    for name, whole in (
        (camdm_rows.TRUTH, camdm_release.of_clips(run.held_out, field=field)),
        (camdm_rows.ROLLOUTS, camdm_release.of_rollouts(frames, commands, fps=fps)),
    ):
        values = camdm_release.metrics(model.bones, whole)
        fid = camdm_release.distances(model.bones, whole, judge, styles)
        rows[name] |= camdm_release.row(values | {"fid": fid})
    return rows, report | {
        "source": model.source,
        "evaluator": evaluators.describe(
            judge.params,
            evaluator,
            reference=evaluators.clips_fingerprint(run.train, field),
        ),
        "speeds": dict(zip(model.labels, speeds[::repeats].tolist(), strict=True)),
        **provenance.provenance(),
    }


def recognizer(
    key: Key, run: Run, evaluator: evaluators.Evaluator | None, *, num_steps: int
) -> camdm_styles.Recognized:
    """The frozen recogniser if there is one, else one trained on the run's clips.

    Args:
      key: Consumed.
      run: The run.
      evaluator: A frozen style recogniser; None to train one.
      num_steps: Updates of a training.

    Returns:
      The recogniser.

    Raises:
      ValueError: if the evaluator does not fit the run; names the field.
    """
    model = run.model
    kind, labels, joints = "style", model.labels, model.bones.names
    classes: tuple[int, ...] = ()
    if evaluator is not None and evaluator.kind == "style_release":
        recognition.released_joints(model.bones)  # raises unless it has them
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
        frames=protocol.WINDOW,
    )
    if frozen is not None:
        return camdm_styles.Recognized(
            params=frozen, config=evaluator.config, classes=classes
        )
    print(f"training the style recogniser for {num_steps} steps", flush=True)
    return camdm_styles.fit_recognizer(
        key, run.train, field=run.field, num_steps=num_steps
    )


def _timed_rollouts(
    run: Run, key: Key, states: Any, commands: trajectory.Command, chunk: int | None
) -> Any:
    """Frames of the characters; says how many, and how long they took in all."""
    number, ticks = commands.label.shape
    print(f"{number} rollouts of {ticks} ticks, in one program", flush=True)
    begun = time.perf_counter()
    frames = protocol.steered_rollouts(
        run.params, key, states, commands, model=run.model, chunk=chunk
    )
    jax.block_until_ready(frames)
    taken = time.perf_counter() - begun
    print(f"rolled out in {taken:.0f} s, compilation included", flush=True)
    return frames
