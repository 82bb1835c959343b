"""What the benchmark of AAMDM rolls out, and the Python loop it is compared with."""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import workload

from jaxmotion.data import procedural
from jaxmotion.diffusion import schedule
from jaxmotion.motion import pose, trajectory
from jaxmotion.motion.features import unpack
from jaxmotion.systems.aamdm import controller as aamdm_controller
from jaxmotion.systems.aamdm import data as aamdm_data
from jaxmotion.systems.aamdm import embedding as aamdm_embedding
from jaxmotion.systems.aamdm import model as aamdm_model
from jaxmotion.systems.aamdm import space as aamdm_space
from jaxmotion.systems.aamdm import training as aamdm_training
from jaxmotion.typing import Params

FPS = 60.0


def _random(
    width: int,
) -> tuple[aamdm_model.Config, Params, aamdm_space.Space, Any, int]:
    """A character of the procedural walker with untrained networks."""
    clips = procedural.make_clips(minutes=1.0)
    joints = clips.skeleton.num_joints
    data, _ = aamdm_data.pose_data(clips, fps=FPS)
    sizes = aamdm_embedding.Config(num_joints=joints, fps=FPS)
    own = aamdm_space.Autoencoder(
        params=aamdm_embedding.init(jax.random.key(0), sizes),
        statistics=aamdm_embedding.fit_statistics(data.poses, data.paths, config=sizes),
        config=sizes,
    )
    space = aamdm_space.fit_space(
        data.poses, data.paths, aamdm_data.starts(data, 2), autoencoder=own
    )
    config = aamdm_model.Config(features=space.num_features, width=width)
    return config, aamdm_model.init(jax.random.key(1), config), space, data, joints


def _trained(
    folder: Path,
) -> tuple[aamdm_model.Config, Params, aamdm_space.Space, Any, int]:
    """Likewise, of a run folder."""
    run = aamdm_training.load_run(folder)
    space = aamdm_training.load_space(run, "embedded")
    params, config = aamdm_training.load_networks(
        run, "embedded", space, drafts=3, polishes=2
    )
    return config, params, space, run.held_out, run.skeleton.num_joints


def make_load(run: Path | None, *, width: int, seconds: float) -> workload.Load:
    """Free characters, each frame generated in 3 + 2 steps.

    Args:
      run: Run folder; None for random parameters.
      width: Channels of a hidden layer, without a run.
      seconds: Length of a rollout.

    Returns:
      The load; its parameters are the networks' and the space.
    """
    config, params, space, data, joints = _trained(run) if run else _random(width)

    def controller(params: Params) -> Any:
        step = aamdm_model.sampler(params["networks"], config=config)
        return aamdm_controller.controller(
            aamdm_controller.guided(step, scale=0.0),
            params["space"],
            num_joints=joints,
            fps=FPS,
            steered=False,
        )

    def start(number: int) -> tuple[Any, trajectory.Command]:
        rows = jnp.arange(number) * 7 % data.num_frames
        states = jax.vmap(
            lambda pose, path: aamdm_controller.init_state(
                space, pose, path, num_joints=joints
            )
        )(data.poses[rows], data.paths[rows])
        shape = (number, round(seconds * FPS))
        facing = jnp.broadcast_to(jnp.array([0.0, 1.0]), (*shape, 2))
        return states, trajectory.Command(
            velocity=facing, facing=facing, label=jnp.zeros(shape, jnp.int32)
        )

    return workload.Load(
        params={"networks": params, "space": space},
        controller=controller,
        start=start,
        plans=lambda frames: float(frames.extra["path"][..., 0].size),
        fps=FPS,
        config=config,
        joints=joints,
    )


def _networks(load: workload.Load) -> dict[str, Callable]:
    """The three networks, each jitted: draft, polish, and the decoder of poses."""
    params, config = load.params["networks"], load.config
    net, space = aamdm_model.network(config), load.params["space"]
    return {
        "draft": jax.jit(
            lambda x, t, previous, z: net.apply(
                {"params": params["generator"]}, x, t, previous, z
            )
        ),
        "polish": jax.jit(
            lambda x, t, previous: net.apply(
                {"params": params["polisher"]}, x, t, previous
            )
        ),
        "decode": jax.jit(lambda x: aamdm_space.to_poses(space, x)),
    }


def _show(load: workload.Load, decode: Callable, joints: int, state: Any) -> Any:
    """Decodes a frame, moves the bone on, and places the pose, one call at a time."""
    vector = decode(state.frame)
    parts = unpack(pose.pose_layout(joints), vector)
    moved, turned = parts["root_velocity"], parts["root_angular_velocity"]
    bone = pose.advance_frame(state.bone, moved, turned, fps=FPS)
    shown = pose.place(vector, bone, num_joints=joints)
    return dataclasses.replace(state, bone=bone), shown


def python_loop(load: workload.Load, *, limit_s: float, glue: bool) -> float:
    """Frames per second of one character in a Python loop over its jitted networks.

    The loops over frames and over steps are Python. The networks are jitted, and so are
    the posterior of a step and the placing of a pose, which the library jits itself.

    Args:
      load: From `make_load`.
      limit_s: Seconds to run for, at most.
      glue: Jit what lies between the networks too: a whole step, and all that follows
        the last one. Without it that is called operation by operation.

    Returns:
      Frames per second.
    """
    config, table, nets = load.config, load.config.table(), _networks(load)
    states, commands = load.start(1)
    state, command = jax.tree.map(lambda x: x[0], (states, commands))
    command = jax.tree.map(lambda x: x[0], command)
    joints = load.joints

    def step(key: jax.Array, x: jax.Array, t: int, previous: jax.Array) -> jax.Array:
        key_net, key_noise = jax.random.split(jax.random.fold_in(key, t))
        if t > config.polishes:
            latent = jax.random.normal(key_net, (config.latent,))
            x_0 = nets["draft"](x, t, previous, latent)
        else:
            x_0 = nets["polish"](x, t, previous)
        mean, variance = schedule.posterior(table, x_0, x, t)
        return mean + jnp.sqrt(variance) * jax.random.normal(key_noise, x.shape)

    if glue:
        step = jax.jit(step, static_argnums=2)
        advance = jax.jit(load.controller(load.params).advance)
        show = lambda state: advance(state, command)  # noqa: E731
    else:
        show = lambda state: _show(load, nets["decode"], joints, state)  # noqa: E731

    def frame(key: jax.Array, state: Any) -> Any:
        key_start, key_chain = jax.random.split(key)
        x = jax.random.normal(key_start, state.frame.shape)
        for t in range(config.num_steps, 0, -1):
            x = step(key_chain, x, t, state.frame)
        return show(dataclasses.replace(state, frame=x))[0]

    key = jax.random.key(0)
    state = jax.block_until_ready(frame(key, state))
    count, begun = 0, time.perf_counter()
    while count < 300 and time.perf_counter() - begun < limit_s:
        state = jax.block_until_ready(frame(jax.random.fold_in(key, count), state))
        count += 1
    return count / (time.perf_counter() - begun)
