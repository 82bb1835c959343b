"""Many rollouts of one character as one program, whose chunks fit a limit of memory."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import memory
import numpy as np
import workload
from jaxtyping import Array, Float

from jaxmotion.control import courses, rollout
from jaxmotion.data import selection
from jaxmotion.evaluation import diversity
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.motion import trajectory
from jaxmotion.motion.skeleton import Motion, joint_positions
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import training as camdm_training
from jaxmotion.typing import Key, Params

# More rollouts at a time leave a processor's cache, and are slower.
CPU_CHUNK = 16
COLUMNS = ("world_m", "pose_m", "diversity_m", "variance_m2")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Load:
    """What all rollouts have in common.

    Attributes:
      name: File or folder of the model.
      model: The model.
      params: Its parameters.
      state: Where they start, one character.
      commands: What they are told, one a tick.
    """

    name: str
    model: camdm_model.Model
    params: Params
    state: camdm_controller.CharacterState
    commands: trajectory.Command


class Motions(NamedTuple):
    """Kept frames: joints in the world, and relative to the root, facing +z; meters."""

    world: Float[Array, "rollouts frames joints 3"]
    pose: Float[Array, "rollouts frames joints 3"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Program:
    """Rollouts of one model, compiled.

    Attributes:
      roll: `roll(key, scale) -> Motions`; every plan is guided with the scale, none if
        it is None.
      steps: Diffusion steps of a plan.
      memory: What it needs, in bytes, and the rollouts at a time.
    """

    roll: Callable[[Key, float | None], Motions]
    steps: int
    memory: dict[str, int]


def make_load(
    run: Path,
    *,
    style: str | None,
    course: str,
    speed: float | None,
    seconds: float,
    seed: int,
) -> Load:
    """Model, start state and commands.

    Args:
      run: Exported file of the procedural walker, or a run folder.
      style: Its style; None for the first.
      course: Of `courses.COURSES`.
      speed: Meters per second; None for the style's median.
      seconds: Length of the rollouts.
      seed: Of the start pose.

    Returns:
      The load.

    Raises:
      OSError: if the run or its clips cannot be read.
      ValueError: if the run is none, or has no such style or course.
    """
    if not run.exists():
        raise ValueError(f"{run}: no such file or folder")
    if run.is_file():
        clips, field = workload.make_clips(), "style"
        model, params = workload.walker_model(clips, run)
    else:
        found = camdm_training.load_run(run)
        model, params, clips, field = (
            found.model,
            found.params,
            found.train,
            found.field,
        )
    label = np.array([0 if style is None else model.label(style)])
    speeds = np.asarray(selection.label_speeds(clips, field=field))[label]
    speeds = speeds if speed is None else np.array([speed])
    commands = courses.course_batch(
        course, label, speeds, seconds=seconds, fps=model.config.fps
    )
    states = camdm_controller.start_states(clips, model, label, field=field, seed=seed)
    state, command = jax.tree.map(lambda x: x[0], (states, commands))
    return Load(
        name=run.name, model=model, params=params, state=state, commands=command
    )


def check_same(a: Load, b: Load) -> None:
    """Raises unless two models start alike and are told the same.

    Args:
      a: One.
      b: The other.

    Raises:
      ValueError: says what differs.
    """
    pairs = {
        "joints": (a.model.skeleton.names, b.model.skeleton.names),
        "styles": (a.model.labels, b.model.labels),
        "past frames": (a.model.config.past, b.model.config.past),
    }
    for what, (expected, found) in pairs.items():
        if expected != found:
            raise ValueError(f"{b.name}: {what} {found}, {a.name} has {expected}")
    for x, y in zip(
        jax.tree.leaves((a.state.past, a.commands)),
        jax.tree.leaves((b.state.past, b.commands)),
        strict=True,
    ):
        if not np.allclose(x, y, atol=1e-4):
            raise ValueError(
                f"{b.name}: starts in another pose or is told to go at another speed "
                f"than {a.name}; were they trained on the same data?"
            )


def one_rollout(
    params: Params,
    key: Key,
    load: Load,
    *,
    control: camdm_controller.Control,
    guided: Array | int,
    every: int,
) -> Motions:
    """One rollout, to be mapped over keys and nothing else.

    Then when to plan depends on nothing that is mapped, and stays a condition, where
    otherwise every planner would run in every tick.

    Args:
      params: The network's parameters.
      key: Consumed.
      load: Start and commands.
      control: Constants of the run-time.
      guided: How many plans are guided.
      every: Keep every so many frames, the last one among them.

    Returns:
      Kept frames, without the axis of rollouts.
    """
    skeleton, config = load.model.skeleton, load.model.config
    driver = camdm_controller.controller(
        params, skeleton, config=config, control=control
    )
    start = dataclasses.replace(load.state, guided=jnp.asarray(guided, jnp.int32))

    def body(state: Any, xs: tuple) -> tuple[Any, tuple[Array, Array]]:
        i, command = xs
        tick_key = jax.random.fold_in(key, i)
        state, frame = rollout.tick(driver, tick_key, state, command)
        return state, (frame.root_position, frame.joint_rotation)

    ticks = load.commands.label.shape[0]
    _, shown = jax.lax.scan(body, start, (jnp.arange(ticks), load.commands))
    root, rotation = jax.tree.map(lambda x: x[(ticks - 1) % every :: every], shown)
    motion = Motion(root_position=root, joint_rotation=rotation, fps=config.fps / every)
    world = joint_positions(skeleton, motion)
    pose = style_evaluator.recognizer_input(skeleton, motion).reshape(world.shape)
    return Motions(world=world, pose=pose)


def _function(load: Load, number: int, every: int, chunk: int) -> Callable:
    """All rollouts: (params, key, guided, scale) -> Motions."""

    def roll(params: Params, key: Key, guided: Array, scale: Array) -> Motions:
        # The scale is traced: one program serves all of them.
        control = dataclasses.replace(camdm_controller.Control(), guidance_scale=scale)

        def one(i: Array) -> Motions:
            return one_rollout(
                params,
                jax.random.fold_in(key, i),
                load,
                control=control,
                guided=guided,
                every=every,
            )

        return jax.lax.map(one, jnp.arange(number), batch_size=chunk)

    return jax.jit(roll)


def fit_program(
    load: Load, number: int, *, every: int, limit: float, chunk: int | None
) -> Program:
    """Compiles rollouts, with the largest chunk whose program fits the limit.

    Args:
      load: What to roll out.
      number: Rollouts.
      every: Frames between kept ones.
      limit: Bytes.
      chunk: Rollouts at a time; None to choose it.

    Returns:
      The program.

    Raises:
      ValueError: if it does not fit.
    """
    cap = CPU_CHUNK if jax.default_backend() == "cpu" else number
    size = min(number, cap if chunk is None else chunk)

    def compiled(size: int) -> Any:
        given = load.params, jax.random.key(0), jnp.int32(0), jnp.float32(1.0)
        return _function(load, number, every, size).lower(*given).compile()

    program, needs = memory.fit(compiled, size, limit=limit, shrink=chunk is None)
    ticks = load.commands.label.shape[0]

    def roll(key: Key, scale: float | None) -> Motions:
        guided = 0 if scale is None else ticks
        given = jnp.int32(guided), jnp.float32(1.0 if scale is None else scale)
        return program(load.params, key, *given)

    return Program(roll=roll, steps=load.model.config.num_steps, memory=needs)


def measure(
    key: Key, motions: Motions, *, num_pairs: int
) -> dict[str, Float[Array, ""]]:
    """Columns of the table.

    Args:
      key: Consumed.
      motions: A set of rollouts.
      num_pairs: Random pairs of each mean.

    Returns:
      Meters, and square meters.
    """
    found = _measure(key, motions, num_pairs)
    # Compiled functions return dictionaries in alphabetical order.
    return {name: found[name] for name in COLUMNS}


@functools.partial(jax.jit, static_argnums=2)
def _measure(key: Key, motions: Motions, num_pairs: int) -> dict[str, Array]:
    key_world, key_pose, key_frames = jax.random.split(key, 3)
    frames = jnp.swapaxes(motions.pose, 0, 1)
    frames = frames.reshape(*frames.shape[:2], -1)

    def of_frame(x: tuple[Array, Array]) -> Array:
        return diversity.diversity(*x, num_pairs=num_pairs)

    keys = jax.random.split(key_frames, frames.shape[0])
    distance = diversity.joint_distance
    return {
        "world_m": distance(key_world, motions.world, num_pairs=num_pairs),
        "pose_m": distance(key_pose, motions.pose, num_pairs=num_pairs),
        "diversity_m": jnp.mean(jax.lax.map(of_frame, (keys, frames))),
        "variance_m2": diversity.intra_style_variance(motions.pose),
    }
