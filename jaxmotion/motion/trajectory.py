"""Paths of a character's root on the ground, and what a controller does with them.

A path is a position and a facing a frame: both (x, z), facing a unit vector, so that no
angle ever wraps. The facing of a pose comes from its hips (`facing`).

Heuristic future trajectory extension (HFTE) continues a path p_0 .. p_{F-1} by point
reflection of its last K points about its end,

    e_j = 2 p_{F-1} - p_{F-2-j},   j = 0 .. K-1                               (1)

and repeats that about each new end. "Flipping in the local frame of the last point" is
a half turn, hence a point reflection, whatever that frame's orientation. Position and
tangent are continuous; the curvature changes its sign at every block.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmotion.motion import ground
from jaxmotion.motion.facing import hip_facing, hip_joints
from jaxmotion.motion.rotation import safe_normalize
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.motion.spring import Scalar, facing_spring, velocity_spring
from jaxmotion.typing import Key


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PlanarFrame:
    """A frame on the ground.

    Attributes:
      origin: World position (x, z), meters.
      facing: World direction (x, z) of the frame's +z, unit length.
    """

    origin: Float[Array, "*batch 2"]
    facing: Float[Array, "*batch 2"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """A path on the ground.

    Attributes:
      position: Root position (x, z) of each frame, meters.
      facing: Facing (x, z) of each frame, unit length.
    """

    position: Float[Array, "*batch frames 2"]
    facing: Float[Array, "*batch frames 2"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Command:
    """What the user asks for in one tick.

    Attributes:
      velocity: Wanted velocity (x, z), meters per second, world.
      facing: Wanted facing (x, z), unit length, world.
      label: Style or skill.
    """

    velocity: Float[Array, "*batch 2"]
    facing: Float[Array, "*batch 2"]
    label: Int[Array, "*batch"]


# A wanted velocity below this one is a stop, meters per second.
STILL = 0.02


def is_still(velocity: Float[Array, "*batch 2"]) -> Bool[Array, "*batch"]:
    """Whether who wants this velocity wants to stand."""
    return jnp.sum(velocity**2, axis=-1) < STILL**2


def root_trajectory(skeleton: Skeleton, motion: Motion) -> Trajectory:
    """Path of the root and the facing of the hips in every frame, world.

    Hips are found by name (else `ValueError`).
    Source: Chen et al. 2024 (CAMDM), released code: facing from the hips only.
    """
    facing = hip_facing(skeleton, motion.joint_rotation, hips=hip_joints(skeleton))
    return Trajectory(position=motion.root_position[..., ::2], facing=facing)


@functools.partial(jax.jit, static_argnames=("num_frames", "fps"))
def desired_trajectory(
    frame: PlanarFrame,
    velocity: Float[Array, "*batch 2"],
    command: Command,
    *,
    num_frames: int,
    fps: float,
    half_life: Scalar = 0.27,
    acceleration: Float[Array, "*batch 2"] | None = None,
    turn_rate: Float[Array, "*batch"] | None = None,
) -> Trajectory:
    """Path that a user's command asks for, from where the character is now.

    Position follows the goal-velocity spring, facing the spring on the circle, all
    times at once and in closed form. Frame i of the path is (i + 1) / fps seconds
    ahead. All is in the world, in meters, seconds and radians; acceleration and turn
    rate are zero if not given.

    Source: Chen et al. 2024 (CAMDM), sec. 3.2; Büttner and Clavet 2015.
    """
    times = jnp.arange(1, num_frames + 1, dtype=velocity.dtype) / fps
    batch = velocity.shape[:-1]
    times = jnp.broadcast_to(times, (*batch, num_frames))

    def over_time(x: Array) -> Array:
        return jnp.repeat(jnp.expand_dims(x, len(batch)), num_frames, axis=len(batch))

    acceleration = jnp.zeros_like(velocity) if acceleration is None else acceleration
    turn_rate = jnp.zeros(batch, velocity.dtype) if turn_rate is None else turn_rate
    position, _, _ = velocity_spring(
        over_time(frame.origin),
        over_time(velocity),
        over_time(acceleration),
        over_time(command.velocity),
        half_life=half_life,
        dt=times[..., None],
    )
    facing, _ = facing_spring(
        over_time(frame.facing),
        over_time(turn_rate),
        over_time(command.facing),
        half_life=half_life,
        dt=times,
    )
    return Trajectory(position=position, facing=facing)


@functools.partial(jax.jit, static_argnames=("num_frames", "reuse"))
def extend(trajectory: Trajectory, num_frames: int, *, reuse: int) -> Trajectory:
    """Heuristic future trajectory extension: (1) of this module, block by block.

    Args:
      trajectory: The predicted path, F frames.
      num_frames: Frames to add (zero returns the path as it is).
      reuse: K, how many points are reflected at a time, 1 .. F-1. The paper uses 15,
        the released code 23 of 45.

    The last facing is held, as the released code does; the paper copies those of the
    reflected points.

    `ValueError` if `reuse` is not in that range, or `num_frames` is negative.

    Source: Chen et al. 2024 (CAMDM), sec. 3.2 and fig. 3.
    """
    position, facing = trajectory.position, trajectory.facing
    frames = position.shape[-2]
    if not 1 <= reuse <= frames - 1:
        raise ValueError(
            f"reuse is {reuse}, expected 1..{frames - 1} ({frames} frames)"
        )
    if num_frames < 0:
        raise ValueError(f"num_frames is {num_frames}, expected 0 or more")
    while position.shape[-2] < frames + num_frames:
        end = position[..., -1:, :]
        back = slice(-2, -2 - reuse, -1)
        position = jnp.concatenate([position, 2 * end - position[..., back, :]], -2)
        facing = jnp.concatenate([facing, *[facing[..., -1:, :]] * reuse], axis=-2)
    total = frames + num_frames
    return Trajectory(position=position[..., :total, :], facing=facing[..., :total, :])


def rest_of(
    plan: Trajectory, cursor: Int[Array, ""], num_frames: int, *, reuse: int
) -> Trajectory:
    """So many frames of a plan's path from `cursor` on, extended where it ends."""
    # A plan may come late, until all frames were displayed.
    own = extend(plan, num_frames, reuse=reuse)
    cut = lambda x: jax.lax.dynamic_slice_in_dim(x, cursor, num_frames)  # noqa: E731
    return jax.tree.map(cut, own)


@jax.jit
def blend(
    predicted: Trajectory,
    desired: Trajectory,
    *,
    bias_position: Scalar,
    bias_facing: Scalar,
) -> Trajectory:
    """Blends from the predicted path (now) to the desired one (at the end).

    The weight of the desired path at frame i of F, counted from 1, is
    1 - (1 - i/F)^bias: the greater the bias, the more responsive.

    Released exponents: of positions 0.7 (its scene) and 0.4 (its code), of facings 2.2.
    Where the blend of two opposite facings is zero, it faces as desired.

    Source: Holden et al. 2017 (PFNN); Chen et al. 2024 (CAMDM), released code.
    """
    frames = desired.position.shape[-2]
    # 1 - i/F counted down, so that the last is exactly zero.
    left = jnp.arange(frames - 1, -1, -1, dtype=desired.position.dtype) / frames

    def mix(bias: Scalar, a: Array, b: Array) -> Array:
        weight = (1.0 - left**bias)[:, None]
        return a + weight.reshape((1,) * (b.ndim - 2) + weight.shape) * (b - a)

    position = mix(bias_position, predicted.position, desired.position)
    facing = mix(bias_facing, predicted.facing, desired.facing)
    return Trajectory(position=position, facing=ground.unit(facing, desired.facing))


@jax.jit
def to_local(trajectory: Trajectory, frame: PlanarFrame) -> Trajectory:
    """A world path in one frame: the frame's origin at zero, its facing along +z."""
    moved = trajectory.position - frame.origin[..., None, :]
    facing = jnp.broadcast_to(frame.facing[..., None, :], moved.shape)
    return Trajectory(
        position=ground.into_frame(moved, facing),
        facing=ground.into_frame(trajectory.facing, facing),
    )


def smoothing_matrices(
    frames: int, sigmas: tuple[float, ...]
) -> Float[Array, "sigmas {frames} {frames}"]:
    """Gaussian filters along time as matrices with rows that sum to 1.

    The border reflects; standard deviations are in frames, 0 gives the identity.
    """
    matrices = []
    for sigma in sigmas:
        radius = int(4 * sigma + 0.5)
        offset = np.arange(-radius, radius + 1)
        weight = np.exp(-0.5 * (offset / sigma) ** 2) if sigma else np.ones(1)
        place = (np.arange(frames)[:, None] + offset) % (2 * frames)
        place = np.where(place < frames, place, 2 * frames - 1 - place)
        matrix = np.zeros((frames, frames))
        np.add.at(matrix, (np.arange(frames)[:, None], place), weight / weight.sum())
        matrices.append(matrix)
    return jnp.asarray(np.stack(matrices), jnp.float32)


def smooth_course(
    key: Key, course: Trajectory, *, last: int, cubic: float = 0.0
) -> Trajectory:
    """A recorded path as a user might have asked for it.

    The path is raw, or smoothed with sigma 5 or 10 frames (probabilities 1/2, 1/4, 1/4)
    such that it stays where it was in frame `last`; the facings are smoothed with sigma
    5 or 10. Ours: with probability `cubic` either is, instead, the cubic of time that
    fits it best, which has no sway and no slower ends, as the springs' paths have not.

    Source: released code of CAMDM. Differs: facings are smoothed within the window,
    there within the whole clip.
    """
    frames = course.position.shape[0]
    key_path, key_facing, key_cubic = jax.random.split(key, 3)
    filters = smoothing_matrices(frames, (0.0, 5.0, 10.0))
    weights = jnp.log(jnp.array([0.5, 0.25, 0.25]))
    matrix = filters[jax.random.categorical(key_path, weights)]
    turn = filters[1 + jax.random.bernoulli(key_facing).astype(int)]
    if cubic:
        powers = np.vander(np.linspace(-1.0, 1.0, frames), 4)
        fit = jnp.asarray(powers @ np.linalg.pinv(powers), jnp.float32)
        fitted = jax.random.bernoulli(key_cubic, cubic, (2,))
        matrix, turn = (
            jnp.where(chosen, fit, other)
            for chosen, other in zip(fitted, (matrix, turn), strict=True)
        )
    path = smooth(course.position, matrix)
    path = path + (course.position[last] - path[last])[None]
    facings = safe_normalize(smooth(course.facing, turn), jnp.array([0.0, 1.0]))
    return Trajectory(position=path, facing=facings)


def smooth(
    x: Float[Array, "*batch frames n"], matrix: Float[Array, "frames frames"]
) -> Float[Array, "*batch frames n"]:
    """Filters along time with a matrix whose row f holds the weights of frame f."""
    # In full precision also where matrix products are rounded by default.
    return jnp.einsum("fg,...gn->...fn", matrix, x, precision="highest")


def integrate_path(
    velocity: Float[Array, "*batch frames 2"], fps: float
) -> Float[Array, "*batch frames 2"]:
    """Path, meters, from the origin: after each frame of velocities, m/s."""
    return jnp.cumsum(velocity, axis=-2) / fps
