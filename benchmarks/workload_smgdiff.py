"""What the benchmark of SMGDiff times: plans of a person and a ball."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxmotion.data.builders import smpl
from jaxmotion.motion.features import Normalizer
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.motion.trajectory import Trajectory
from jaxmotion.systems.smgdiff import guidance as smgdiff_guidance
from jaxmotion.systems.smgdiff import model as smgdiff_model
from jaxmotion.systems.smgdiff.guidance import UNGUIDED, Guidance
from jaxmotion.systems.smgdiff.scene import Representation, feature_layout
from jaxmotion.typing import Params


def program(
    *,
    steps: int,
    batch: int,
    width: int,
    frames_per_token: int,
    guided: bool,
    arguments: bool,
    chunk: int,
) -> tuple[Callable, tuple, int]:
    """Plans of CAMDM's network for SMPL's 24 joints with a ball: 162 channels.

    Random parameters take as long as trained ones; a threshold of zero keeps the
    gradient at work in every frame.

    Args:
      steps: Diffusion steps.
      batch: Players; 1 is the program of one player, not a batch of one.
      width: Channels of a token.
      frames_per_token: Frames of one token.
      guided: Contact guidance in the last two steps.
      arguments: Whether the parameters are arguments, not constants.
      chunk: Players at a time in batches of 16 and more; 0 for all at once.

    Returns:
      The jitted function, its arguments, and frames of a plan.
    """
    offsets = np.random.default_rng(0).normal(0.0, 0.15, (24, 3))
    skeleton = Skeleton(
        offsets=jnp.asarray(offsets, jnp.float32),
        parents=smpl.PARENTS,
        names=smpl.JOINTS,
        feet=(7, 8, 10, 11),
    )
    size = feature_layout(skeleton, skeleton.feet).size
    representation = Representation(
        skeleton=skeleton,
        normalizer=Normalizer(mean=jnp.zeros(size), std=jnp.ones(size)),
        joints=skeleton.feet,
        fps=30.0,
    )
    config = smgdiff_model.Config(
        num_features=size,
        num_labels=6,
        num_steps=steps,
        width=width,
        hidden=4 * width,
        frames_per_token=frames_per_token,
    )
    params = smgdiff_model.init(jax.random.key(0), config)
    guidance = Guidance(min_acceleration=0.0) if guided else UNGUIDED
    key_past, key_path, key_run = jax.random.split(jax.random.key(1), 3)
    facing = jnp.broadcast_to(jnp.array([0.0, 1.0]), (batch, config.future, 2))
    conditions = smgdiff_model.Condition(
        past=0.3 * jax.random.normal(key_past, (batch, config.past, size)),
        trajectory=Trajectory(
            position=jax.random.normal(key_path, (batch, config.future, 2)),
            facing=facing,
        ),
        label=jnp.arange(batch) % config.num_labels,
        ball=jnp.broadcast_to(jnp.array([0.0, 0.11, 0.5]), (batch, 3)),
    )

    def plans(
        params: Params, keys: Array, conditions: smgdiff_model.Condition
    ) -> Array:
        plan = smgdiff_guidance.sampler(
            params, config=config, representation=representation, guided=guidance
        )
        if batch == 1:
            return plan(keys[0], jax.tree.map(lambda x: x[0], conditions))
        if not chunk or batch < 16:
            return jax.vmap(plan)(keys, conditions)
        return jax.lax.map(lambda x: plan(*x), (keys, conditions), batch_size=chunk)

    given = (jax.random.split(key_run, batch), conditions)
    if arguments:
        return jax.jit(plans), (params, *given), config.future
    return jax.jit(functools.partial(plans, params)), given, config.future
