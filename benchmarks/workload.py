"""What the benchmarks run: the paper's network, conditions, a walker to steer."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.control import courses
from jaxmotion.control.rollout import Controller
from jaxmotion.data import procedural
from jaxmotion.data.clips import Clips
from jaxmotion.motion import trajectory
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.typing import Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Load:
    """What a benchmark of rollouts runs.

    Attributes:
      params: Parameters of the networks.
      controller: Makes the run-time of parameters.
      start: States and commands of a number of characters.
      plans: How often networks made something, in all frames together.
      fps: Ticks per second.
      config: Of the system.
      joints: Of the skeleton.
    """

    params: Params
    controller: Callable[[Params], Controller]
    start: Callable[[int], tuple[Any, trajectory.Command]]
    plans: Callable[[Any], float]
    fps: float
    config: Any
    joints: int


def paper_config(
    *, steps: int = 8, width: int = 256, frames_per_token: int = 1, **sizes: Any
) -> camdm_model.Config:
    """The paper's network: 25 joints and 100 styles, 3.44 million parameters.

    Args:
      steps: Diffusion steps.
      width: Channels of a token; the feed-forward layers have four times as many.
      frames_per_token: 1 in the paper.
      **sizes: Other sizes of `camdm.Config`.

    Returns:
      The configuration.
    """
    defaults = {"num_joints": 25, "num_labels": 100}
    return camdm_model.Config(
        **(defaults | sizes),
        num_steps=steps,
        width=width,
        hidden=4 * width,
        frames_per_token=frames_per_token,
    )


def conditions(config: camdm_model.Config, batch: int) -> camdm_model.Condition:
    """A batch of conditions of plausible size; their values do not change the time.

    Args:
      config: The network.
      batch: Characters.

    Returns:
      Conditions, batch axis first.
    """
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, (batch, config.future))
    facing = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    normal = lambda *shape: jnp.asarray(  # noqa: E731
        rng.normal(size=(batch, *shape)), jnp.float32
    )
    return camdm_model.Condition(
        past=normal(config.past, config.num_features),
        trajectory=trajectory.Trajectory(
            position=normal(config.future, 2), facing=jnp.asarray(facing, jnp.float32)
        ),
        label=jnp.asarray(np.arange(batch) % config.num_labels, jnp.int32),
        keep_past=jnp.ones(batch, bool),
    )


def walker_model(
    clips: Clips, run: Path | None, **sizes: Any
) -> tuple[camdm_model.Model, Params]:
    """A model for the procedural walker.

    Args:
      clips: Of the walker.
      run: Run folder or exported file; None for random parameters, which take as long
        as trained ones.
      **sizes: Of `paper_config`, without a run.

    Returns:
      The model and its parameters.

    Raises:
      ValueError: if the run's model is of another skeleton or other styles.
    """
    labels = clips.names("style")
    if run is None:
        config = paper_config(
            num_joints=clips.skeleton.num_joints, num_labels=len(labels), **sizes
        )
        model = camdm_model.Model(
            config=config, skeleton=clips.skeleton, labels=labels, source=clips.source
        )
        return model, camdm_model.init(jax.random.key(0), config)
    model, params, _ = camdm_model.load(run)
    if (model.labels, model.skeleton.names) != (labels, clips.skeleton.names):
        raise ValueError(
            f"{run}: a model of {model.skeleton.num_joints} joints and the styles "
            f"{', '.join(model.labels)}: expected one of the procedural walker"
        )
    return model, params


def steered(
    model: camdm_model.Model,
    clips: Clips,
    characters: int,
    *,
    seconds: float,
    staggered: bool = False,
) -> tuple[camdm_controller.CharacterState, trajectory.Command]:
    """Start states, and commands of the course "forward" at 1 m/s.

    Args:
      model: Of the walker.
      clips: Where the start poses come from.
      characters: Their number; they take the styles in turn.
      seconds: Length of the rollout.
      staggered: Start the course at another place for each character, so that
        commands change at other ticks; without it they change at the same.

    Returns:
      States [characters], commands [characters, ticks].
    """
    labels = np.arange(characters) % len(model.labels)
    states = camdm_controller.start_states(clips, model, labels, field="style", seed=0)
    fps = model.config.fps
    ticks, extra = round(seconds * fps), 30.0 if staggered else 0.0
    commands = courses.course_batch(
        "forward", labels, np.ones(characters), seconds=seconds + extra, fps=fps
    )
    places = np.random.default_rng(0).integers(0, round(extra * fps) + 1, characters)
    rows = jnp.asarray(places[:, None] + np.arange(ticks))
    picked = jax.tree.map(lambda x: jax.vmap(lambda y, i: y[i])(x, rows), commands)
    return states, picked


def camdm_load(
    run: Path | None, *, seconds: float, staggered: bool, **sizes: Any
) -> Load:
    """Steered walkers.

    Args:
      run: As of `walker_model`.
      seconds: As of `steered`.
      staggered: As of `steered`.
      **sizes: Of `paper_config`, without a run.

    Returns:
      The load.
    """
    clips = make_clips()
    model, params = walker_model(clips, run, **sizes)
    return Load(
        params=params,
        controller=lambda params: camdm_controller.controller(
            params, model.skeleton, config=model.config
        ),
        start=lambda number: steered(
            model, clips, number, seconds=seconds, staggered=staggered
        ),
        plans=lambda frames: float(frames.planned.sum()),
        fps=model.config.fps,
        config=model.config,
        joints=model.skeleton.num_joints,
    )


def make_clips() -> Clips:
    """Two minutes of the procedural walker.

    Returns:
      Its clips, with labels "style".
    """
    return procedural.make_clips(minutes=2)
