"""A player with a ball under SMGDiff's run-time: constants, state, displayed frames.

Source: SMGDiff, section 3; Chen et al. 2024 (CAMDM) for the constants.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxmotion.motion import skeleton, trajectory
from jaxmotion.motion.ball import Scene
from jaxmotion.systems.smgdiff import Config


@dataclasses.dataclass(frozen=True, kw_only=True)
class Control:
    """Constants of the run-time.

    Attributes:
      apply: M, frames of a plan to play while the command stays (CAMDM's 15).
      reuse: K of HFTE, points reflected at a time.
      bias_position: Exponent of the blend of positions (CAMDM's).
      bias_facing: Exponent of the blend of facings (CAMDM's).
      seam: Duration of the inertialised seam, seconds; 0 for none.
    """

    apply: int = 15
    reuse: int = 15
    bias_position: float = 0.7
    bias_facing: float = 2.2
    seam: float = 0.2


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PlayerState:
    """A player and a ball between two ticks; everything in the world.

    Attributes:
      past: The last displayed frames.
      plan: The frames being played.
      cursor: Next frame of the plan.
      command: The last command; its label is -1 before the first.
    """

    past: Scene
    plan: Scene
    cursor: Int[Array, "*batch"]
    command: trajectory.Command


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """What one tick displays.

    Attributes:
      root_position: Of the displayed pose, metres, world.
      joint_rotation: Of the displayed pose, two columns.
      ball: Centre of the displayed ball, metres, world.
      touch: How sure the model is that each joint touches the ball, 0..1.
      desired_velocity: What the user asks for now, metres a second.
      desired_facing: Likewise, unit.
      planned: Whether this tick made a new plan.
    """

    root_position: Float[Array, "*batch 3"]
    joint_rotation: Float[Array, "*batch joints 6"]
    ball: Float[Array, "*batch 3"]
    touch: Float[Array, "*batch touching"]
    desired_velocity: Float[Array, "*batch 2"]
    desired_facing: Float[Array, "*batch 2"]
    planned: Bool[Array, "*batch"]


def init_state(bones: skeleton.Skeleton, past: Scene, *, config: Config) -> PlayerState:
    """State of a player that has shown `past` and has no plan yet.

    Args:
      bones: The skeleton.
      past: At least `config.past` displayed frames, world.
      config: The method.

    Returns:
      The state; until the first plan it would go on with its mean velocity.

    Raises:
      ValueError: if there are fewer frames.
    """
    frames = past.ball.shape[-2]
    if frames < config.past:
        raise ValueError(f"past has {frames} frames, expected {config.past} or more")
    past = jax.tree.map(lambda x: x[-config.past :], past)
    root = past.motion.root_position
    step = (root[-1] - root[0]) / (config.past - 1) * jnp.array([1.0, 0.0, 1.0])
    ahead = jnp.arange(1, config.future + 1, dtype=root.dtype)[:, None] * step[None]
    held = jax.tree.map(lambda x: jnp.repeat(x[-1:], config.future, axis=0), past)
    motion = dataclasses.replace(
        held.motion, root_position=held.motion.root_position + ahead
    )
    return PlayerState(
        past=past,
        plan=dataclasses.replace(held, motion=motion),
        cursor=jnp.zeros((), jnp.int32),
        command=trajectory.Command(
            velocity=step[::2] * config.fps,
            facing=trajectory.root_trajectory(bones, past.motion).facing[-1],
            label=jnp.full((), -1, jnp.int32),
        ),
    )


def urgency(
    state: PlayerState, command: trajectory.Command, *, control: Control
) -> Int[Array, ""]:
    """Whether a tick needs a plan.

    Args:
      state: The player's state.
      command: What the user wants now.
      control: Constants.

    Returns:
      0 for none, 1 for a plan.
    """
    old = state.command
    changed = jnp.any(jnp.abs(old.velocity - command.velocity) > 1e-3)
    changed = changed | (old.label != command.label)
    return (changed | (state.cursor >= control.apply)).astype(jnp.int32)
