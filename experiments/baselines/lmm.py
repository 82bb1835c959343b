"""Learned Motion Matching: the next frame, and the frame that fits a wish, regressed.

The stepper predicts velocities and is trained over windows of its own frames. The
projector maps wanted path features to the frame of the data that fits them best.

Source: Holden et al. 2020, "Learned Motion Matching", and its released code: three
linear layers in the stepper, five in the projector, queries with noise of a random
size. Differs: by default the projector looks at the path alone, as AAMDM's paper says
of it, and its frame is taken up by half. With `own` channels it looks at feet and hips,
too, as published, and its frame is taken up whole; there features are a part of a
frame, here a network reads them of it, and poses are not blended by inertia. It is
asked at random moments, on average every 0.2 s (there every 0.1 s). The stepper's
error is squared (as AAMDM's paper has it; there absolute), the projector's absolute (as
there) without one of distances, and queries have half of the noise.
"""

import dataclasses
import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.motion import pose
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.systems.aamdm.controller import Stepper
from jaxmotion.systems.aamdm.data import PoseData
from jaxmotion.systems.aamdm.embedding import character_positions
from jaxmotion.typing import Key, Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Sizes.

    Attributes:
      features: Channels of a frame.
      width: Channels of a hidden layer (released code 512).
      weight_velocity: Weight of the differences of frames against the frames.
      queries: Path features, the first channels of a frame; 0 for no projector.
      own: Features of feet and hips, which follow a frame in its windows and its
        database; 15 as published, 0 for none.
      projections: Probability a frame that the projector is asked.
    """

    features: int
    width: int = 512
    weight_velocity: float = 0.1
    queries: int = 0
    own: int = 0
    projections: float = 1 / 12


class Mlp(nn.Module):
    """Linear layers with ReLU between them."""

    features: int
    width: int
    depth: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Maps vectors to vectors."""
        for _ in range(self.depth - 1):
            x = nn.relu(nn.Dense(self.width)(x))
        return nn.Dense(self.features)(x)


def _nets(config: Config) -> tuple[Mlp, Mlp, Mlp]:
    """Stepper, projector, and what reads feet and hips of a frame."""
    return (
        Mlp(config.features, config.width, 3),
        Mlp(config.features, config.width, 5),
        Mlp(config.own, config.width, 3),
    )


def own_features(data: PoseData, skeleton: Skeleton) -> Float[Array, "frames 15"]:
    """Where feet are, how fast they and the hips move, from the character, weighed.

    Source: Holden et al. 2020, released code: in deviations of each of the five, and
    feet's places by 0.75.
    """
    points = character_positions(data.poses, skeleton.parents)
    points = points[:, jnp.array([*skeleton.feet, 0])]
    moving = pose.point_velocities(
        data.poses, points, num_joints=skeleton.num_joints, fps=data.fps
    )
    # A clip's last frame moves as the one before it.
    last = data.offsets[1:] - 1
    moving = jnp.concatenate([moving, moving[-1:]])
    moving = moving.at[last].set(moving[last - 1])
    parts = [*jnp.swapaxes(points[:, :2], 0, 1), *jnp.swapaxes(moving, 0, 1)]
    weights = (0.75, 0.75, 1.0, 1.0, 1.0)
    scaled = [
        weight * (x - jnp.mean(x, axis=0, keepdims=True)) / jnp.mean(jnp.std(x, axis=0))
        for weight, x in zip(weights, parts, strict=True)
    ]
    return jnp.concatenate(scaled, axis=-1)


@functools.partial(jax.jit, static_argnames="config")
def init(key: Key, config: Config) -> Params:
    """Initial parameters."""
    key_s, key_p = jax.random.split(key)
    net, projector, reader = _nets(config)
    params = {"stepper": net.init(key_s, jnp.zeros(config.features))["params"]}
    if config.queries:
        query = jnp.zeros(config.queries + config.own)
        params["projector"] = projector.init(key_p, query)["params"]
    if config.own:
        key_r = jax.random.fold_in(key, 2)
        params["reader"] = reader.init(key_r, jnp.zeros(config.features))["params"]
    return params


def _next(params: Params, x: Array, config: Config, change: Array | None) -> Array:
    found = _nets(config)[0].apply({"params": params["stepper"]}, x)
    scale = 1.0 if change is None else jnp.broadcast_to(change, x.shape)
    return x + scale * found


def stepper(params: Params, *, config: Config, change: Array | None = None) -> Stepper:
    """The deterministic `step(key, previous, goal) -> next`.

    With a goal for the path features, the projector's frame is asked for at some ticks.
    `change` is the deviation of each channel's changes, in which they are predicted.
    """
    _, projector, reader = _nets(config)
    taken = 1.0 if config.own else 0.5

    def step(key: Key, previous: Array, goal: Array | None = None) -> Array:
        frame = _next(params, previous, config, change)
        if goal is None:
            return frame
        query = goal
        if config.own:
            own = reader.apply({"params": params["reader"]}, frame)
            query = jnp.concatenate([goal, own], axis=-1)
        fitting = projector.apply({"params": params["projector"]}, query)
        asked = jax.random.bernoulli(key, config.projections)
        return jnp.where(asked, (1 - taken) * frame + taken * fitting, frame)

    return Stepper(step)


def loss(
    params: Params,
    key: Key,
    windows: Array,
    *,
    config: Config,
    change: Array | None = None,
    database: Array | None = None,
):
    """Mean squared error over windows that start with one frame of the data.

    With a database of frames, the projector's error is added: noisy features of the
    first frames against the frames that fit them best.
    """
    own, windows = windows[:, 0, config.features :], windows[..., : config.features]
    _, made = jax.lax.scan(
        lambda x, _: (_next(params, x, config, change),) * 2,
        windows[:, 0],
        None,
        windows.shape[1] - 1,
    )
    whole = jnp.concatenate([windows[:, :1], jnp.swapaxes(made, 0, 1)], axis=1)
    error = whole - windows
    if change is not None:
        error = error / change.reshape(1, 1, -1)
    value = jnp.mean(jnp.square(error))
    velocity = jnp.mean(jnp.square(jnp.diff(error, axis=1)))
    total = value + config.weight_velocity * velocity
    if database is None:
        return total, {"value": value}
    key_size, key_noise = jax.random.split(key)
    database, theirs = jnp.split(database, [config.features], axis=1)
    exact = jnp.concatenate([windows[:, 0, : config.queries], own], axis=1)
    size = jax.random.uniform(key_size, (len(exact), 1))
    query = exact + size * jax.random.normal(key_noise, exact.shape)
    known = jnp.concatenate([database[:, : config.queries], theirs], axis=1)
    distance = jnp.sum(known**2, axis=1)[None] - 2.0 * query @ known.T
    nearest = database[jnp.argmin(distance, axis=1)]
    _, projector, reader = _nets(config)
    found = projector.apply({"params": params["projector"]}, query)
    projection = jnp.mean(jnp.abs(found - nearest))
    told = {"value": value, "projection": projection}
    if config.own:
        read = reader.apply({"params": params["reader"]}, windows[:, 0])
        told["reading"] = jnp.mean(jnp.square(read - own))
        total = total + told["reading"]
    return total + projection, told
