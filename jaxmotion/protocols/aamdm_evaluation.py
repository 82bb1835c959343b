"""Rollouts of AAMDM and its baselines, free and under control.

Every method is a stepper in a space, and goes through the same run-time, from the same
held-out poses, with the same commands.

Source: Li et al. 2024 (AAMDM), section 4.1.
"""

import functools
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.control import presets, rollout
from jaxmotion.motion import pose, skeleton
from jaxmotion.motion.trajectory import Command, PlanarFrame
from jaxmotion.protocols.aamdm_data import PoseData, starts
from jaxmotion.protocols.aamdm_runs import Run
from jaxmotion.systems import aamdm_control
from jaxmotion.systems.aamdm_control import CharacterState, Frame, Stepper
from jaxmotion.systems.aamdm_space import Space
from jaxmotion.typing import Key


def start_states(run: Run, space: Space, number: int, *, seed: int) -> CharacterState:
    """Characters in held-out poses, each at the origin and facing +z.

    Args:
      run: The run.
      space: Their space.
      number: Characters.
      seed: Of the choice of poses.

    Returns:
      States, batch axis first.
    """
    data = run.held_out
    chosen = np.random.default_rng(seed).integers(0, data.num_frames, number)
    init = functools.partial(
        aamdm_control.init_state, space, num_joints=run.bones.num_joints
    )
    return jax.jit(jax.vmap(init))(data.poses[chosen], data.paths[chosen])


def commands(
    run: Run, number: int, ticks: int, *, preset: str, speed: float
) -> Command:
    """The same commands for every character.

    Args:
      run: The run.
      number: Characters.
      ticks: Length.
      preset: Of `presets.PRESETS`.
      speed: Metres a second.

    Returns:
      Commands [characters, ticks, ...].

    Raises:
      ValueError: if there is no such preset.
    """
    fps = run.train.fps
    one = presets.preset_commands(
        preset, seconds=ticks / fps, fps=fps, speed=speed, label=0
    )
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (number, *x.shape)), one)


def roller(
    run: Run,
    space: Space,
    step: Stepper,
    *,
    steered: bool,
    bounded: bool = True,
) -> Callable[[Key, CharacterState, Command], tuple[CharacterState, Frame]]:
    """Rollouts as one jitted function.

    Args:
      run: The run.
      space: The space.
      step: Makes the next frame.
      steered: Whether commands matter.
      bounded: Whether frames are kept within the bounds of the data.

    Returns:
      `roll(key, states, commands) -> (states, frames)`.
    """
    driver = aamdm_control.controller(
        step,
        space,
        num_joints=run.bones.num_joints,
        fps=run.train.fps,
        steered=steered,
        bounded=bounded,
    )
    return jax.jit(functools.partial(rollout.rollout, driver))


@jax.jit
def positions_of(bones: skeleton.Skeleton, frames: Frame) -> jax.Array:
    """World positions of the joints in rollouts.

    Args:
      bones: The skeleton.
      frames: Displayed frames.

    Returns:
      Positions [characters, ticks, joints, 3], metres.
    """
    return skeleton.forward_kinematics(
        bones, frames.root_position, frames.joint_rotation
    )


def data_frames(
    run: Run, data: PoseData, number: int, ticks: int, *, seed: int
) -> Frame:
    """Windows of real frames as if they were rollouts.

    Args:
      run: The run.
      data: Where they come from.
      number: Windows.
      ticks: Frames a window.
      seed: Of their choice.

    Returns:
      Frames; what they wanted is their own path and velocity.

    Raises:
      ValueError: if no clip is that long.
    """
    first = starts(data, ticks)
    chosen = np.random.default_rng(seed).integers(0, first.shape[0], number)
    joints, fps = run.bones.num_joints, data.fps

    @jax.jit
    def window(start: jax.Array) -> Frame:
        cut = functools.partial(
            jax.lax.dynamic_slice_in_dim, start_index=start, slice_size=ticks
        )
        poses, paths = cut(data.poses), cut(data.paths)
        origin = PlanarFrame(origin=jnp.zeros(2), facing=jnp.array([0.0, 1.0]))
        bone = pose.integrate_root(poses, origin, num_joints=joints, fps=fps)
        root, rot6d = pose.place(poses, bone, num_joints=joints)
        velocity = jnp.gradient(bone.origin, axis=0) * fps
        return Frame(
            root_position=root,
            joint_rotation=rot6d,
            bone=bone,
            velocity=velocity,
            path=paths,
            wanted=paths,
            desired_velocity=velocity,
            desired_facing=bone.facing,
        )

    return jax.lax.map(window, first[chosen])


def frames_per_second(
    run: Run, space: Space, step: Stepper, *, ticks: int = 300, repeats: int = 5
) -> float:
    """Frames a second of one character, generated one after the other.

    Args:
      run: The run.
      space: The space.
      step: Makes the next frame.
      ticks: Frames of a timed rollout.
      repeats: Timed rollouts; the median counts.

    Returns:
      Frames a second, decoding and placing included, compilation not.
    """
    states = start_states(run, space, 1, seed=0)
    given = commands(run, 1, ticks, preset="forward", speed=1.0)
    roll = roller(run, space, step, steered=False)
    jax.block_until_ready(roll(jax.random.key(0), states, given))
    times = []
    for i in range(repeats):
        begun = time.perf_counter()
        jax.block_until_ready(roll(jax.random.key(i), states, given))
        times.append(time.perf_counter() - begun)
    return ticks / float(np.median(times))
