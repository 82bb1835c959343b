"""SMGDiff's first stage: from a skill and a target point to a path on the ground.

A diffusion model with T = 1: its only step starts from noise that knows next to nothing
of the path, so its loss is a regression and the best answer does not depend on the
noise. T >= 2 is the same chain, and can draw different paths.

Paths are seen from the last displayed pose and divided by `Config.meters`; so noise of
unit deviation is as large as a path. What a target leaves open is a tenth of that and
smooth, and a few steps over white noise leave a mean of it. Noise as smooth and as
small (`noise="bridge"`, ours) keeps half.

Source: SMGDiff, section 3.1, eq. 3.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.diffusion import chain, schedule
from jaxmotion.learning import losses
from jaxmotion.motion import ground, trajectory
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.networks import blocks
from jaxmotion.systems.smgdiff.network import CHANNELS, TrajectoryGenerator
from jaxmotion.typing import Key, Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Architecture and method.

    Attributes:
      num_steps: T (paper 1).
      token_margin, token_window: As in `transformer.CamdmTransformer`.
      noise: "white", of each frame on its own (paper), or "bridge": as smooth as paths
        are, and as large as what a target leaves open of them (`_sines`).
      soon: Frames to a second target, short of the path's end; 0 for none (paper).
      seconds: Length of a path.
      meters: Unit of the network's positions.
      weight_velocity: Weight of the displacements, beside the data's 1.
    """

    num_labels: int
    past: int = 10
    future: int = 45
    num_steps: int = 1
    width: int = 128
    depth: int = 2
    heads: int = 4
    hidden: int = 256
    frames_per_token: int = 5
    token_margin: int = 0
    token_window: Literal["hann", "trapezoid"] = "hann"
    noise: Literal["white", "bridge"] = "white"
    soon: int = 0
    seconds: float = 1.5
    meters: float = 1.0
    weight_velocity: float = 1.0

    def __post_init__(self):
        """Checks the second target's place."""
        if not 0 <= self.soon <= self.future:
            raise ValueError(f"soon is {self.soon}, expected 0..{self.future}")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Wish:
    """What a path is made for, in the frame of the last displayed pose.

    The target point is one second of the velocity (x, z; m/s) away; past is displayed.
    For a generator with a second target, `soon` is the mean velocity until that.
    """

    past: trajectory.Trajectory
    velocity: Float[Array, "*batch 2"]
    label: Int[Array, "*batch"]
    soon: Float[Array, "*batch 2"] | None = None


SamplePath = Callable[[Key, Wish], trajectory.Trajectory]


def network(config: Config) -> TrajectoryGenerator:
    """The denoiser's Flax module."""
    return blocks.sized(TrajectoryGenerator, config)


@functools.partial(jax.jit, static_argnames="config")
def init(key: Key, config: Config) -> Params:
    """Initial parameters."""
    x_t, past = (jnp.zeros((n, CHANNELS)) for n in (config.future, config.past))
    t, label = jnp.ones((), jnp.int32), jnp.zeros((), jnp.int32)
    target = jnp.zeros(4 if config.soon else 2)
    return network(config).init(key, x_t, t, past, target, label)["params"]


def _pack(path: trajectory.Trajectory, config: Config) -> Array:
    return jnp.concatenate([path.position / config.meters, path.facing], axis=-1)


# Deviation of the first sine of positions, meters, and of facings, in 1.5 s of
# locomotion; the n-th one's falls with n^2.
_SWAY, _TURN = 0.25, 0.5


@functools.cache
def _sines(future: int, meters: float) -> tuple[np.ndarray, np.ndarray]:
    """What unit noise stands for, [kind, frame, sine], and its inverse.

    Positions end at the target, facings, the second kind, anywhere.
    """
    number = np.arange(1, future + 1)
    odd, times = 2 * number - 1, number / future
    sway = _SWAY * np.sin(np.pi * np.outer(times, number)) / number**2
    sway[-1] = sway[:, -1] = 0.0  # sines of multiples of pi
    turn = _TURN * np.sin(np.pi / 2 * np.outer(times, odd)) / odd**2
    sines = np.stack([sway / meters, turn])
    return sines.astype(np.float32), np.linalg.pinv(sines).astype(np.float32)


def noise_space(
    wish: Wish, config: Config
) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """From what the chain denoises to a packed path, and back.

    With `noise="bridge"` the chain has what differs from the straight path in its own
    deviations: in meters a few steps of a chain leave a mean of it.
    """
    if config.noise == "white":
        return lambda x: x, lambda x: x
    sines, inverse = map(jnp.asarray, _sines(config.future, config.meters))
    times = jnp.arange(1, config.future + 1, dtype=jnp.float32) / config.future
    end = wish.velocity * (config.seconds / config.meters)
    facing = jnp.broadcast_to(wish.past.facing[-1:], (config.future, 2))
    middle = jnp.concatenate([times[:, None] * end[None], facing], axis=-1)

    kinds = lambda x: x.reshape(config.future, 2, 2)  # noqa: E731

    def decode(z: Array) -> Array:
        away = jnp.einsum("kfn,nkc->fkc", sines, kinds(z), precision="highest")
        return middle + away.reshape(middle.shape)

    def encode(x: Array) -> Array:
        away = kinds(x - middle)
        z = jnp.einsum("knf,fkc->nkc", inverse, away, precision="highest")
        return z.reshape(x.shape)

    return decode, encode


def _apply(params: Params, x_t: Array, t: Array, wish: Wish, config: Config) -> Array:
    target = wish.velocity
    if config.soon:
        if wish.soon is None:
            raise ValueError("a wish without soon, which this generator needs")
        target = jnp.concatenate([target, wish.soon], axis=-1)
    return blocks.apply(
        params,
        network(config),
        x_t,
        t,
        _pack(wish.past, config),
        target / config.meters,
        wish.label,
    )


def example(
    skeleton: Skeleton,
    window: Motion,
    label: Int[Array, ""],
    *,
    config: Config,
) -> tuple[Wish, trajectory.Trajectory]:
    """The wish (mean velocity of what happened) and the path of a window (world)."""
    course = trajectory.root_trajectory(skeleton, window)
    last = config.past - 1
    here = trajectory.PlanarFrame(
        origin=course.position[last], facing=course.facing[last]
    )
    local = trajectory.to_local(course, here)
    path = jax.tree.map(lambda x: x[config.past :], local)

    def mean_velocity(frames: int) -> Array:
        return path.position[frames - 1] * (window.fps / frames)

    wish = Wish(
        past=jax.tree.map(lambda x: x[: config.past], local),
        velocity=mean_velocity(config.future),
        label=label,
        soon=mean_velocity(config.soon) if config.soon else None,
    )
    return wish, path


def loss(
    params: Params,
    key: Key,
    batch: tuple[Motion, Int[Array, " batch"]],
    *,
    skeleton: Skeleton,
    config: Config,
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Weighted error of the path and of its displacements, and its terms by name.

    Source: SMGDiff, eq. 3.
    """
    windows, labels = batch
    key_t, key_noise = jax.random.split(key)
    wish, path = jax.vmap(lambda w, c: example(skeleton, w, c, config=config))(
        windows, labels
    )
    x_0 = _pack(path, config)
    table = schedule.cosine_schedule(config.num_steps)
    t = jax.random.randint(key_t, labels.shape, 1, config.num_steps + 1)
    noise = jax.random.normal(key_noise, x_0.shape)

    def noised(x_0: Array, t: Array, noise: Array, wish: Wish) -> Array:
        decode, encode = noise_space(wish, config)
        return decode(schedule.q_sample(table, encode(x_0), t, noise))

    x_t = jax.vmap(noised)(x_0, t, noise, wish)
    prediction = _apply(params, x_t, t, wish, config)
    every = jnp.ones(x_0.shape[:-1], bool)
    terms = {
        "data": losses.masked_mse(prediction, x_0, every),
        "velocity": losses.velocity_loss(prediction, x_0, every),
    }
    return terms["data"] + config.weight_velocity * terms["velocity"], terms


def sampler(
    params: Params, *, config: Config, step: chain.StepFactory = chain.ancestral_step
) -> SamplePath:
    """The sampler of paths, in the frame of the last displayed pose."""

    def sample(key: Key, wish: Wish) -> trajectory.Trajectory:
        decode, encode = noise_space(wish, config)

        def denoise(key: Key, z_t: Array, t: Array) -> Array:
            del key  # deterministic
            return encode(_apply(params, decode(z_t), t, wish, config))

        table = schedule.cosine_schedule(config.num_steps)
        shape = (config.future, CHANNELS)
        z = chain.sample(step(table, denoise), key, shape, num_steps=config.num_steps)
        x = decode(z)
        return trajectory.Trajectory(
            position=x[:, :2] * config.meters, facing=ground.unit(x[:, 2:])
        )

    return sample


def straight(key: Key, wish: Wish, *, future: int, fps: float) -> trajectory.Trajectory:
    """The path without a generator: straight to the target, facing along it.

    Where the user wants to stand, the facing stays. The key is not used.

    Source: SMGDiff, section 5.2 ("w/o TGM").
    """
    del key
    times = jnp.arange(1, future + 1) / fps
    facing = ground.unit(wish.velocity, wish.past.facing[-1])
    return trajectory.Trajectory(
        position=times[:, None] * wish.velocity[None],
        facing=jnp.broadcast_to(facing[None], (future, 2)),
    )
