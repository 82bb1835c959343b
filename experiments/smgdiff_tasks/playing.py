"""One steered player through several skills, to look at."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion import reporting
from jaxmotion.control import rollout
from jaxmotion.motion.skeleton import joint_positions
from jaxmotion.motion.trajectory import Command
from jaxmotion.systems.smgdiff import controller as smgdiff_controller
from jaxmotion.systems.smgdiff import guidance as smgdiff_guidance
from jaxmotion.systems.smgdiff import players as smgdiff_players
from jaxmotion.systems.smgdiff import scoring as smgdiff_scoring
from jaxmotion.systems.smgdiff import training as smgdiff_training
from jaxmotion.systems.smgdiff import trajectory as smgdiff_trajectory
from jaxmotion.systems.smgdiff.guidance import Guidance
from jaxmotion.systems.smgdiff.model import Model
from jaxmotion.systems.smgdiff.training import Run
from jaxmotion.systems.smgdiff.trajectory import SamplePath

# The direction of the command turns by so much, every so often.
_TURN, _SECONDS = np.pi / 3, 4.0


def commands(model: Model, skills: tuple[str, ...], *, seconds: float) -> Command:
    """Each skill at its own speed, for an equal time, with turns to either side.

    Args:
      model: The model.
      skills: In this order.
      seconds: Length.

    Returns:
      One command a tick.

    Raises:
      ValueError: if the model has no such skill, or there is less than a tick of each.
    """
    ticks = round(seconds * model.config.fps)
    if ticks < len(skills):
        raise ValueError(f"{seconds:g} s are too short for {len(skills)} skills")
    labels = np.array([model.label(skill) for skill in skills])
    label = labels[np.arange(ticks) * len(skills) // ticks]
    turn = np.floor(np.arange(ticks) / (_SECONDS * model.config.fps)).astype(int)
    yaw = _TURN * np.array([0, 1, 0, -1])[turn % 4]
    facing = np.stack([np.sin(yaw), np.cos(yaw)], axis=-1)
    speed = np.array(model.speeds)[label]
    return Command(
        velocity=jnp.asarray(speed[:, None] * facing, jnp.float32),
        facing=jnp.asarray(facing, jnp.float32),
        label=jnp.asarray(label, jnp.int32),
    )


def generator_of(run: Run, stage: str) -> SamplePath:
    """Paths of a stage, or straight ones.

    Args:
      run: The run.
      stage: "paths_1", ..., or "straight".

    Returns:
      The generator.
    """
    if stage == "straight":
        return smgdiff_players.straight(run.model)
    model, params = smgdiff_training.load_stage(run, stage)
    return smgdiff_trajectory.sampler(params, config=model.paths)


def play(args: Any, run: Run, guided: Guidance, out: Path) -> None:
    """Rolls out and writes the files.

    Args:
      args: Of `smgdiff.py rollout`.
      run: The run.
      guided: Contact guidance.
      out: Folder.
    """
    model, params = smgdiff_training.load_stage(run, f"motion_{args.steps}")
    features, skeleton = model.representation, model.representation.skeleton
    steered = commands(model, args.skills or model.labels, seconds=args.seconds)
    driver = smgdiff_controller.controller(
        generator_of(run, args.paths),
        smgdiff_guidance.sampler(
            params,
            config=model.config,
            representation=features,
            guided=guided,
        ),
        representation=features,
        config=model.config,
    )
    known = smgdiff_scoring.eval_windows(run.train, model, number=2000, seed=args.seed)
    first = int(np.flatnonzero(np.asarray(known.label) == int(steered.label[0]))[0])
    past = jax.tree.map(lambda x: x[first], known.past)
    state = smgdiff_controller.init_state(skeleton, past, config=model.config)
    one = lambda tree: jax.tree.map(lambda x: x[None], tree)  # noqa: E731
    run_all = jax.jit(lambda *given: rollout.rollout(driver, *given)[1])
    frames = run_all(jax.random.key(args.seed), one(state), one(steered))
    scene = smgdiff_players.to_scene(frames[0])
    touch = np.asarray(scene.touch) > 0.5
    reporting.write_rollout(
        out,
        skeleton,
        scene.motion,
        steered.velocity,
        title=", ".join(args.skills or model.labels),
        caption=model.source,
        ball=reporting.Ball(
            position=np.asarray(scene.ball),
            touch=touch,
            joints=features.joints,
            radius=features.radius,
        ),
    )
    report(model, scene, touch)


def report(model: Model, scene: Any, touch: np.ndarray) -> None:
    """Prints what is worth knowing before one looks.

    Args:
      model: The model.
      scene: The rollout.
      touch: Frames and joints that touch.
    """
    skeleton, joints = (
        model.representation.skeleton,
        jnp.array(model.representation.joints),
    )
    places = joint_positions(skeleton, scene.motion)[:, joints]
    nearest = jnp.min(jnp.linalg.norm(places - scene.ball[:, None], axis=-1), axis=-1)
    away = jnp.linalg.norm((scene.ball - scene.motion.root_position)[:, ::2], axis=-1)
    print(
        f"ball {float(jnp.median(away)):.2f} m from the root (median), nearest foot "
        f"{float(jnp.min(nearest)):.2f} m from its center, "
        f"{int(np.any(touch, axis=1).sum())} frames with a touch"
    )
