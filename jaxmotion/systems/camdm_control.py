"""CAMDM's run-time: a character that plans, plays, and plans again when told.

One tick (1/30 s) of one character:

1. If the command changed, or M frames of the plan have been played, plan anew:
   a. the path the user wants: springs from the desired velocity and facing;
   b. the model's own path: the rest of the plan, extended by HFTE to its length;
   c. the blend of both is the condition, with the last 10 *displayed* poses;
   d. sample 45 poses; within the first plans after a change of style with
      classifier-free guidance on the past, which frees the model from its old style;
   e. an inertialised seam: the plan starts where the displayed motion is, with its
      velocity, and takes up the model's motion within 0.2 s.
2. Display the next pose of the plan, and move the springs on.

Source: Chen et al. 2024 (CAMDM), section 3.2; the released Unity run-time for what the
paper does not say (noted at each constant).
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxmotion.control import inertia
from jaxmotion.control.rollout import Controller
from jaxmotion.diffusion import schedule
from jaxmotion.motion import features, skeleton, spring, trajectory
from jaxmotion.systems import camdm
from jaxmotion.systems.camdm_state import (
    RELEASED,
    CharacterState,
    Control,
    Frame,
    init_state,
    is_new_style,
    urgency,
)
from jaxmotion.typing import Key, Params

__all__ = [
    "RELEASED",
    "CharacterState",
    "Control",
    "Frame",
    "advance",
    "controller",
    "init_state",
    "plan_frame",
    "replan",
    "urgency",
    "wanted_trajectory",
]


def plan_frame(
    bones: skeleton.Skeleton, past: skeleton.Motion, *, config: camdm.Config
) -> trajectory.PlanarFrame:
    """Frame of the next plan: at the last displayed pose.

    Args:
      bones: The skeleton.
      past: Displayed poses, world.
      config: Says whether the frame turns with the character.

    Returns:
      The frame. With heading "random" its axes are the world's, as in the release.
    """
    last = jax.tree.map(lambda x: x[-1:], past)
    here = trajectory.root_trajectory(bones, last)
    facing = here.facing[0] if config.heading == "facing" else jnp.array([0.0, 1.0])
    return trajectory.PlanarFrame(origin=here.position[0], facing=facing)


def wanted_trajectory(
    bones: skeleton.Skeleton,
    state: CharacterState,
    command: trajectory.Command,
    *,
    config: camdm.Config,
    control: Control,
) -> trajectory.Trajectory:
    """Steps 1a to 1c: the user's path, blended with the model's own.

    Args:
      bones: The skeleton.
      state: The character's state.
      command: What the user wants.
      config: The method.
      control: Constants.

    Returns:
      The path of the next `config.future` frames, world.
    """
    here = trajectory.PlanarFrame(
        origin=state.past.root_position[-1, ::2], facing=state.facing
    )
    desired = trajectory.desired_trajectory(
        here,
        state.velocity,
        command,
        num_frames=config.future,
        fps=config.fps,
        half_life=control.half_life,
        acceleration=state.acceleration,
        turn_rate=state.turn_rate,
    )
    if control.follow > 0:
        ahead = jnp.arange(1, config.future + 1) / config.fps
        returned = 1.0 - 0.5 ** (ahead / control.follow)
        pull = returned[:, None] * (state.anchor - here.origin)[None]
        desired = dataclasses.replace(desired, position=desired.position + pull)
    if not control.extend:
        return desired
    own = trajectory.extend(
        trajectory.root_trajectory(bones, state.plan),
        control.apply,
        reuse=control.reuse,
    )
    ahead = jax.tree.map(
        lambda x: jax.lax.dynamic_slice_in_dim(x, state.cursor, config.future), own
    )
    return trajectory.blend(
        ahead,
        desired,
        bias_position=control.bias_position,
        bias_facing=control.bias_facing,
    )


def replan(
    sample: camdm.Plan,
    key: Key,
    bones: skeleton.Skeleton,
    state: CharacterState,
    command: trajectory.Command,
    *,
    config: camdm.Config,
    control: Control,
    guided: bool,
) -> CharacterState:
    """Step 1: a new plan.

    Args:
      sample: From `camdm.planner`.
      key: Consumed.
      bones: The skeleton.
      state: The character's state.
      command: What the user wants now.
      config: The method.
      control: Constants.
      guided: Sample with guidance; a character that needs none gets the scale that
        changes nothing (it may stand beside a guided one in a batch).

    Returns:
      The state with the plan, none of it displayed yet.
    """
    frame = plan_frame(bones, state.past, config=config)
    wanted = wanted_trajectory(bones, state, command, config=config, control=control)
    is_new = is_new_style(state, command, control=control)
    left = jnp.where(is_new, control.guided_plans, state.guided)
    condition = camdm.Condition(
        past=camdm.to_features(features.to_frame(state.past, frame), config=config),
        trajectory=trajectory.to_local(wanted, frame),
        label=command.label,
        keep_past=jnp.ones((), bool),
    )
    scale = jnp.where(left > 0, control.guidance_scale, 1.0) if guided else None
    poses = sample(key, condition, scale=scale)
    chunk = features.from_frame(camdm.to_motion(poses, config=config), frame)
    if control.seam > 0:
        shown = jax.tree.map(lambda x: x[-2:], state.past)
        chunk = inertia.inertialize(shown, chunk, duration=control.seam)
    return dataclasses.replace(
        state,
        plan=chunk,
        cursor=jnp.zeros_like(state.cursor),
        guided=jnp.maximum(left - 1, 0),
    )


def advance(
    state: CharacterState,
    command: trajectory.Command,
    *,
    config: camdm.Config,
    control: Control,
) -> tuple[CharacterState, Frame]:
    """Step 2: displays the next pose, and moves the springs on.

    Args:
      state: The character's state.
      command: What the user wants now.
      config: The method.
      control: Constants.

    Returns:
      The next state, and what is displayed.
    """
    pose = jax.tree.map(
        lambda x: jax.lax.dynamic_slice_in_dim(x, state.cursor, 1), state.plan
    )
    past = jax.tree.map(
        lambda old, new: jnp.concatenate([old[1:], new]), state.past, pose
    )
    times = {"half_life": control.half_life, "dt": 1.0 / config.fps}
    anchor, velocity, acceleration = spring.velocity_spring(
        state.anchor, state.velocity, state.acceleration, command.velocity, **times
    )
    facing, turn_rate = spring.facing_spring(
        state.facing, state.turn_rate, command.facing, **times
    )
    frame = Frame(
        root_position=pose.root_position[0],
        joint_rotation=pose.joint_rotation[0],
        desired_velocity=velocity,
        desired_facing=facing,
        planned=state.cursor == 0,
    )
    # A style that changes while the old plan still plays arms the next plans.
    armed = is_new_style(state, command, control=control) & (state.cursor > 0)
    return dataclasses.replace(
        state,
        past=past,
        guided=jnp.where(armed, control.guided_plans, state.guided),
        cursor=state.cursor + 1,
        velocity=velocity,
        acceleration=acceleration,
        facing=facing,
        turn_rate=turn_rate,
        anchor=anchor,
        command=command,
    ), frame


def controller(
    params: Params,
    bones: skeleton.Skeleton,
    *,
    config: camdm.Config,
    control: Control | None = None,
    table: schedule.Schedule | None = None,
) -> Controller:
    """The run-time of one character, for `rollout.tick` and `rollout.rollout`.

    Args:
      params: The network's parameters.
      bones: The skeleton.
      config: The method.
      control: Constants; None for the defaults.
      table: Schedule; None for the cosine one of `config.num_steps`.

    Returns:
      A controller whose frames are `Frame`s. Its second planner is the guided one.

    Raises:
      ValueError: if `control.apply` is not in 1..`config.future`.
    """
    control = Control() if control is None else control
    if not 1 <= control.apply <= config.future:
        raise ValueError(f"apply is {control.apply}, expected 1..{config.future}")
    sample = camdm.planner(params, config=config, table=table)

    def plan(guided: bool) -> Callable:
        return lambda key, state, command: replan(
            sample,
            key,
            bones,
            state,
            command,
            config=config,
            control=control,
            guided=guided,
        )

    return Controller(
        urgency=functools.partial(urgency, control=control),
        plans=(plan(False), plan(True)),
        advance=functools.partial(advance, config=config, control=control),
    )
