"""A character under CAMDM's run-time: constants, state between ticks, frames.

Source: Chen et al. 2024 (CAMDM), section 3.2; the released Unity run-time for what the
paper does not say (noted at each constant).
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxmotion.motion import skeleton, trajectory
from jaxmotion.systems import camdm


@dataclasses.dataclass(frozen=True, kw_only=True)
class Control:
    """Constants of the run-time; the defaults are the paper's where it has them.

    Attributes:
      apply: M, frames of a plan to play while the command stays (paper 15).
      replan_on_change: The lazy trigger of the paper; the release plans only every
        M frames (False).
      extend: Use HFTE; without it the user's path alone is the condition (ablation).
      reuse: K of HFTE, points reflected at a time (paper 15, released code 23).
      guidance_scale: Of the past after a change of style (paper 0.7, code 0.5).
      guided_plans: Plans that are guided after a change of style (paper: "when the
        style label has just changed", so 1; code 2).
      guide_start: The first plans after the start are guided as those after a change of
        style are (released code: its counter starts full).
      half_life: Of the springs of velocity and facing, seconds (orangeduck 0.27).
      bias_position: Exponent of the blend of positions (released scene 0.7, code
        0.4).
      bias_facing: Exponent of the blend of facings (released code 2.2).
      seam: Duration of the inertialised seam, seconds (released code 0.2); 0 for none.
      follow: Half-life, seconds, in which the wanted path returns to the commanded
        one, the integral of the desired velocity; 0 to steer by velocity alone, as
        the paper does. Ours: without it every rollout drifts off its course.
    """

    apply: int = 15
    replan_on_change: bool = True
    extend: bool = True
    reuse: int = 15
    guidance_scale: float = 0.7
    guided_plans: int = 1
    guide_start: bool = False
    half_life: float = 0.27
    bias_position: float = 0.7
    bias_facing: float = 2.2
    seam: float = 0.2
    follow: float = 0.0


# The released Unity run-time (its code; its scene has bias_position 0.7). It smooths
# commands by a linear interpolation instead of springs, which is not offered here.
RELEASED = Control(
    replan_on_change=False,
    reuse=23,
    guidance_scale=0.5,
    guided_plans=2,
    guide_start=True,
    bias_position=0.4,
)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class CharacterState:
    """A character between two ticks; everything in the world.

    Attributes:
      past: The last displayed poses.
      plan: The poses being played.
      cursor: Next pose of the plan.
      velocity: Of the desired motion (the spring), metres a second.
      acceleration: Of the desired motion, metres a second squared.
      facing: Desired facing (the spring), unit.
      turn_rate: Of the desired facing, radians a second.
      anchor: Where the desired motion is, (x, z) metres: the commanded path's end.
      command: The last command; its label is -1 before the first.
      guided: Plans that are still to be guided.
    """

    past: skeleton.Motion
    plan: skeleton.Motion
    cursor: Int[Array, "*batch"]
    velocity: Float[Array, "*batch 2"]
    acceleration: Float[Array, "*batch 2"]
    facing: Float[Array, "*batch 2"]
    turn_rate: Float[Array, "*batch"]
    anchor: Float[Array, "*batch 2"]
    command: trajectory.Command
    guided: Int[Array, "*batch"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """What one tick displays.

    Attributes:
      root_position: Of the displayed pose, metres, world.
      joint_rotation: Of the displayed pose, two columns.
      desired_velocity: What the user's springs ask for now, metres a second.
      desired_facing: Likewise, unit.
      planned: Whether this tick made a new plan.
    """

    root_position: Float[Array, "*batch 3"]
    joint_rotation: Float[Array, "*batch joints 6"]
    desired_velocity: Float[Array, "*batch 2"]
    desired_facing: Float[Array, "*batch 2"]
    planned: Bool[Array, "*batch"]


def init_state(
    bones: skeleton.Skeleton, past: skeleton.Motion, *, config: camdm.Config
) -> CharacterState:
    """State of a character that has shown `past` and has no plan yet.

    Args:
      bones: The skeleton.
      past: At least `config.past` displayed poses of one character, world.
      config: The method.

    Returns:
      The state; the springs start at the mean velocity of the poses.

    Raises:
      ValueError: if there are fewer poses.
    """
    frames = past.root_position.shape[-2]
    if frames < config.past:
        raise ValueError(f"past has {frames} frames, expected {config.past} or more")
    past = jax.tree.map(lambda x: x[-config.past :], past)
    position = past.root_position
    step = (position[-1] - position[0]) / (config.past - 1)
    ahead = jnp.arange(1, config.future + 1, dtype=position.dtype)[:, None]
    level = step * jnp.array([1.0, 0.0, 1.0])
    plan = skeleton.Motion(
        root_position=position[-1:] + ahead * level[None],
        joint_rotation=jnp.repeat(past.joint_rotation[-1:], config.future, axis=0),
        fps=past.fps,
    )
    facing = trajectory.root_trajectory(bones, past).facing[-1]
    velocity = level[::2] * config.fps
    return CharacterState(
        past=past,
        plan=plan,
        cursor=jnp.zeros((), jnp.int32),
        velocity=velocity,
        acceleration=jnp.zeros(2),
        facing=facing,
        turn_rate=jnp.zeros(()),
        anchor=position[-1, ::2],
        command=trajectory.Command(
            velocity=velocity, facing=facing, label=jnp.full((), -1, jnp.int32)
        ),
        guided=jnp.zeros((), jnp.int32),
    )


def _changed(state: CharacterState, command: trajectory.Command) -> Bool[Array, ""]:
    old = state.command
    return (
        jnp.any(jnp.abs(old.velocity - command.velocity) > 1e-3)
        | jnp.any(jnp.abs(old.facing - command.facing) > 1e-3)
        | (old.label != command.label)
    )


def is_new_style(
    state: CharacterState, command: trajectory.Command, *, control: Control
) -> Bool[Array, ""]:
    """Whether a command changes the style; the first one does with `guide_start`."""
    started = (state.command.label >= 0) | control.guide_start
    return (state.command.label != command.label) & started


def urgency(
    state: CharacterState, command: trajectory.Command, *, control: Control
) -> Int[Array, ""]:
    """Which plan a tick needs.

    Args:
      state: The character's state.
      command: What the user wants now.
      control: Constants.

    Returns:
      0 for none, 1 for a plan, 2 for a guided one.
    """
    need = (state.command.label < 0) | (state.cursor >= control.apply)
    if control.replan_on_change:
        need = need | _changed(state, command)
    new_style = is_new_style(state, command, control=control) & (
        control.guided_plans > 0
    )
    guided = need & (new_style | (state.guided > 0))
    return need.astype(jnp.int32) + guided.astype(jnp.int32)
