"""SMGDiff's run-time: a player and a ball that are steered.

One tick (1/30 s) of one player:

1. If the command changed, or M frames of the plan have been played, plan anew:
   a. the trajectory generator turns the wish (a target point and a skill) into a path;
   b. the rest of the plan's own path, extended by HFTE, is blended into it;
   c. the motion model makes 45 frames of body, ball and contacts for that path, with
      contact guidance in some of its steps;
   d. an inertialised seam: body and ball start where they are displayed.
2. Display the next frame of the plan.

The paper blends when the control changes; here at every plan, as CAMDM does, since a
path that jumps at a regular plan would be no better.

Source: SMGDiff, section 3; Chen et al. 2024 (CAMDM) for HFTE and the seam.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxmotion.control import inertia
from jaxmotion.control.rollout import Controller
from jaxmotion.motion import ground, skeleton, trajectory
from jaxmotion.motion.ball import Scene
from jaxmotion.systems import smgdiff_scene
from jaxmotion.systems.smgdiff import Condition, Config
from jaxmotion.systems.smgdiff_guidance import Plan
from jaxmotion.systems.smgdiff_scene import Representation
from jaxmotion.systems.smgdiff_state import (
    Control,
    Frame,
    PlayerState,
    init_state,
    urgency,
)
from jaxmotion.systems.smgdiff_trajectory import Generate, Wish
from jaxmotion.typing import Key

__all__ = [
    "Control",
    "Frame",
    "PlayerState",
    "advance",
    "controller",
    "init_state",
    "replan",
    "urgency",
    "wanted_trajectory",
]


def wanted_trajectory(
    generate: Generate,
    key: Key,
    bones: skeleton.Skeleton,
    state: PlayerState,
    command: trajectory.Command,
    *,
    config: Config,
    control: Control,
) -> trajectory.Trajectory:
    """Steps 1a and 1b: the generated path, blended with the plan's own.

    Args:
      generate: From `smgdiff_trajectory`.
      key: Consumed.
      bones: The skeleton.
      state: The player's state.
      command: What the user wants.
      config: The method.
      control: Constants.

    Returns:
      The path of the next `config.future` frames, in the frame of the plan.
    """
    frame = smgdiff_scene.plan_frame(bones, state.past.motion)
    past = trajectory.root_trajectory(bones, state.past.motion)
    wish = Wish(
        past=trajectory.to_local(past, frame),
        velocity=ground.into_frame(command.velocity, frame.facing),
        label=command.label,
    )
    wanted = generate(key, wish)
    own = trajectory.extend(
        trajectory.root_trajectory(bones, state.plan.motion),
        control.apply,
        reuse=control.reuse,
    )
    ahead = jax.tree.map(
        lambda x: jax.lax.dynamic_slice_in_dim(x, state.cursor, config.future), own
    )
    return trajectory.blend(
        trajectory.to_local(ahead, frame),
        wanted,
        bias_position=control.bias_position,
        bias_facing=control.bias_facing,
    )


def replan(
    generate: Generate,
    sample: Plan,
    key: Key,
    state: PlayerState,
    command: trajectory.Command,
    *,
    representation: Representation,
    config: Config,
    control: Control,
) -> PlayerState:
    """Step 1: a new plan.

    Args:
      generate: From `smgdiff_trajectory`.
      sample: From `smgdiff_guidance.planner`.
      key: Consumed.
      state: The player's state.
      command: What the user wants now.
      representation: What features mean.
      config: The method.
      control: Constants.

    Returns:
      The state with the plan, none of it displayed yet.
    """
    key_path, key_motion = jax.random.split(key)
    bones = representation.bones
    wanted = wanted_trajectory(
        generate, key_path, bones, state, command, config=config, control=control
    )
    frame = smgdiff_scene.plan_frame(bones, state.past.motion)
    past = smgdiff_scene.to_frame(state.past, frame)
    condition = Condition(
        past=smgdiff_scene.to_features(past, representation),
        trajectory=wanted,
        label=command.label,
        ball=past.ball[-1],
    )
    x = sample(key_motion, condition)
    scene, _ = smgdiff_scene.to_scene(x, past.ball[-1], representation)
    chunk = smgdiff_scene.from_frame(scene, frame)
    if control.seam > 0:
        chunk = _seam(state.past, chunk, duration=control.seam)
    return dataclasses.replace(state, plan=chunk, cursor=jnp.zeros_like(state.cursor))


def _seam(past: Scene, chunk: Scene, *, duration: float) -> Scene:
    """A chunk that starts where body and ball are displayed."""
    fps = chunk.motion.fps
    shown = jax.tree.map(lambda x: x[-2:], past.motion)
    motion = inertia.inertialize(shown, chunk.motion, duration=duration)
    # The ball's offset alone: its velocity jumps at touches, which is no error.
    step = chunk.ball[1] - chunk.ball[0]
    offset = past.ball[-1] - (chunk.ball[0] - step)
    times = jnp.arange(1, chunk.ball.shape[0] + 1, dtype=offset.dtype) / fps
    fade = inertia.decay(offset, jnp.zeros_like(offset), times, duration=duration)
    return dataclasses.replace(chunk, motion=motion, ball=chunk.ball + fade)


def advance(
    state: PlayerState, command: trajectory.Command
) -> tuple[PlayerState, Frame]:
    """Step 2: displays the next frame.

    Args:
      state: The player's state.
      command: What the user wants now.

    Returns:
      The next state, and what is displayed.
    """
    shown = jax.tree.map(
        lambda x: jax.lax.dynamic_slice_in_dim(x, state.cursor, 1), state.plan
    )
    past = jax.tree.map(
        lambda old, new: jnp.concatenate([old[1:], new]), state.past, shown
    )
    frame = Frame(
        root_position=shown.motion.root_position[0],
        joint_rotation=shown.motion.joint_rotation[0],
        ball=shown.ball[0],
        touch=shown.touch[0],
        desired_velocity=command.velocity,
        desired_facing=command.facing,
        planned=state.cursor == 0,
    )
    return dataclasses.replace(
        state, past=past, cursor=state.cursor + 1, command=command
    ), frame


def controller(
    generate: Generate,
    sample: Plan,
    *,
    representation: Representation,
    config: Config,
    control: Control | None = None,
) -> Controller:
    """The run-time of one player, for `rollout.tick` and `rollout.rollout`.

    Args:
      generate: Paths: `smgdiff_trajectory.generator`, or `straight`.
      sample: Plans: `smgdiff_guidance.planner`.
      representation: What features mean.
      config: The method.
      control: Constants; None for the defaults.

    Returns:
      A controller whose frames are `Frame`s.

    Raises:
      ValueError: if `control.apply` is not in 1..`config.future`.
    """
    control = Control() if control is None else control
    if not 1 <= control.apply <= config.future:
        raise ValueError(f"apply is {control.apply}, expected 1..{config.future}")
    plan: Callable = lambda key, state, command: replan(  # noqa: E731
        generate,
        sample,
        key,
        state,
        command,
        representation=representation,
        config=config,
        control=control,
    )
    return Controller(
        urgency=functools.partial(urgency, control=control),
        plans=(plan,),
        advance=advance,
    )
