"""How CAMDM is evaluated: steered rollouts against held-out motion.

Rows of the table: the held-out clips (ground truth), one half of the training clips
against the other (the noise floor of the Fréchet distance), and the rollouts. All go
through the same windows of 60 frames, and the Fréchet distances are taken of equal
numbers of windows against the same reference.

Source: Chen et al. 2024 (CAMDM), section 4.1 and table 1; what its release computes
instead is in the columns of `protocols.camdm_release`.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxmotion.control import presets, rollout
from jaxmotion.data import windows
from jaxmotion.data.clips import Clips
from jaxmotion.motion import features, trajectory
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm.model import Model
from jaxmotion.typing import Key, Params


def check_ticks(ticks: int, *, fps: float, skip: int) -> None:
    """Raises unless rollouts are long enough to be measured; for use before the work.

    Args:
      ticks: Length of the rollouts.
      fps: Ticks per second.
      skip: Ticks to leave out at the start.

    Raises:
      ValueError: names the length that is needed.
    """
    if ticks < skip + windows.EVAL_WINDOW:
        raise ValueError(
            f"rollouts of {ticks / fps:g} s are too short to measure: expected at "
            f"least {(skip + windows.EVAL_WINDOW) / fps:g} s ({skip} frames left out, "
            f"then windows of {windows.EVAL_WINDOW})"
        )


def rollout_windows(
    frames: camdm_controller.Frame,
    labels: Int[Array, " batch"],
    *,
    fps: float,
    skip: int,
) -> windows.EvalWindows:
    """Windows of rollouts, one behind the other.

    Args:
      frames: Displayed frames [characters, ticks, ...].
      labels: Style of each character.
      fps: Frames per second.
      skip: Ticks to leave out at the start, where the data's own pose still shows.

    Returns:
      The windows.

    Raises:
      ValueError: if the rollouts are shorter than what is left out and one window.
    """
    characters, ticks = frames.root_position.shape[:2]
    check_ticks(ticks, fps=fps, skip=skip)
    number = (ticks - skip) // windows.EVAL_WINDOW

    def cut(x: Array) -> Array:
        x = x[:, skip : skip + number * windows.EVAL_WINDOW]
        return x.reshape(characters * number, windows.EVAL_WINDOW, *x.shape[2:])

    return windows.EvalWindows(
        motion=Motion(
            root_position=cut(frames.root_position),
            joint_rotation=cut(frames.joint_rotation),
            fps=fps,
        ),
        velocity=cut(frames.desired_velocity),
        facing=cut(frames.desired_facing),
        label=jnp.repeat(labels, number),
        group=jnp.repeat(jnp.arange(characters), number),
    )


def check_labels(labels: np.ndarray | Array, model: Model) -> None:
    """Raises unless labels are styles of a model; compiled code cannot.

    Raises:
      ValueError: names the range and the labels found.
    """
    found, last = np.asarray(labels), len(model.labels) - 1
    if found.size and (found.min() < 0 or found.max() > last):
        raise ValueError(
            f"labels are in {found.min()}..{found.max()}, expected 0..{last} "
            f"({', '.join(model.labels)})"
        )


def start_states(
    clips: Clips, model: Model, labels: np.ndarray, *, field: str, seed: int
) -> camdm_controller.CharacterState:
    """States of characters that start with real poses of their style.

    Each is moved so that it stands at the origin and faces +z.

    Args:
      clips: Where the poses come from.
      model: The model.
      labels: Style of each character.
      field: Label field that is the style.
      seed: Of the choice of poses.

    Returns:
      States, batch axis first.

    Raises:
      ValueError: if a label is none of the model's, or a style has no clip that is long
        enough; names it.
    """
    past = model.config.past
    index = windows.window_index(clips, past, short="skip")
    owner = np.asarray(clips.labels[field])[np.asarray(index.clips)]
    generator = np.random.default_rng(seed)
    starts = []
    check_labels(labels, model)
    for label in labels:
        known = np.flatnonzero(owner == label)
        if known.size == 0:
            raise ValueError(f"no clip of style {model.labels[label]!r} to start from")
        starts.append(int(index.starts[generator.choice(known)]))
    cut = jax.vmap(lambda start: windows.cut(clips, start, past))
    return _states_at_origin(model, cut(jnp.asarray(starts)))


def own_states(
    model: Model, labels: np.ndarray, *, seed: int = 0
) -> camdm_controller.CharacterState:
    """States of characters that start with the model's own poses of their style.

    Args:
      model: A model with `starts`.
      labels: Style of each character.
      seed: Of the choice of poses.

    Returns:
      States, batch axis first.

    Raises:
      ValueError: if the model has no poses of its own, or no such style.
    """
    if model.starts is None:
        raise ValueError("the model has no poses to start from: give clips")
    check_labels(labels, model)
    labels = np.asarray(labels)
    number = model.starts.root_position.shape[1]
    which = np.random.default_rng(seed).integers(number, size=labels.shape)
    return _states_at_origin(
        model, jax.tree.map(lambda x: x[labels, which], model.starts)
    )


def at_origin(model: Model, motion: Motion) -> Motion:
    """A motion moved so that its last pose stands at the origin and faces +z."""
    path = trajectory.root_trajectory(model.skeleton, motion)
    frame = trajectory.PlanarFrame(origin=path.position[-1], facing=path.facing[-1])
    return features.to_frame(motion, frame)


def _states_at_origin(model: Model, motions: Motion) -> camdm_controller.CharacterState:
    def state(motion: Motion) -> camdm_controller.CharacterState:
        local = at_origin(model, motion)
        return camdm_controller.init_state(model.skeleton, local, config=model.config)

    return jax.jit(jax.vmap(state))(motions)


def preset_batch(
    name: str, labels: np.ndarray, speeds: np.ndarray, *, seconds: float, fps: float
) -> trajectory.Command:
    """One preset for each character, at its own speed.

    Args:
      name: Of `presets.PRESETS`.
      labels: Style of each character.
      speeds: Meters per second of each character.
      seconds: Length.
      fps: Ticks per second.

    Returns:
      Commands [characters, ticks, ...].
    """
    each = [
        presets.preset_commands(
            name, seconds=seconds, fps=fps, speed=float(speed), label=int(label)
        )
        for label, speed in zip(labels, speeds, strict=True)
    ]
    return jax.tree.map(lambda *x: jnp.stack(x), *each)


def straight_batch(
    speed: float, labels: np.ndarray, *, seconds: float, fps: float
) -> trajectory.Command:
    """Straight on along +z at one speed (m/s) for each character; 0 to stand."""
    each = [
        presets.segment_commands(
            [(seconds, 0.0, 0.0, speed, int(label))], seconds=seconds, fps=fps
        )
        for label in labels
    ]
    return jax.tree.map(lambda *x: jnp.stack(x), *each)


def steered_rollouts(
    params: Params,
    key: Key,
    states: camdm_controller.CharacterState,
    commands: trajectory.Command,
    *,
    model: Model,
    control: camdm_controller.Control | None = None,
    chunk: int | None = None,
) -> camdm_controller.Frame:
    """Frames of steered characters, as one compiled program.

    Args:
      params: The network's parameters.
      key: Consumed.
      states: From `start_states`.
      commands: From `preset_batch`.
      model: The model.
      control: Constants of the run-time; None for the defaults.
      chunk: Characters to run at a time, at most (the largest number that divides
        theirs); see `rollout.rollout`.

    Returns:
      Frames [characters, ticks, ...].

    Raises:
      ValueError: if the chunk is not positive, or a label is none of the model's.
    """
    check_labels(commands.label, model)
    number = commands.label.shape[0]
    if chunk is not None:
        if chunk < 1:
            raise ValueError(f"chunks of {chunk} characters, expected 1 or more")
        chunk = max(size for size in range(1, chunk + 1) if number % size == 0)
    return _rollouts(
        params,
        key,
        states,
        commands,
        model.skeleton,
        config=model.config,
        control=control,
        chunk=chunk,
    )


# One program per method and shape, also over calls: everything else is an argument.
@functools.partial(jax.jit, static_argnames=("config", "control", "chunk"))
def _rollouts(
    params: Params,
    key: Key,
    states: camdm_controller.CharacterState,
    commands: trajectory.Command,
    skeleton: Skeleton,
    *,
    config: camdm_model.Config,
    control: camdm_controller.Control | None,
    chunk: int | None,
) -> camdm_controller.Frame:
    driver = camdm_controller.controller(
        params, skeleton, config=config, control=control
    )
    return rollout.rollout(driver, key, states, commands, chunk=chunk)[1]
