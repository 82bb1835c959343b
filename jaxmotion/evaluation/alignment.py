"""How well a motion goes and faces where it was told. Angles are in radians."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.motion import ground
from jaxmotion.motion.spring import Scalar


class TrajectoryError(NamedTuple):
    """Mean angle of direction, and which part of the frames it could be taken of."""

    error: Float[Array, "*batch"]
    used: Float[Array, "*batch"]


@jax.jit
def heading_error(
    expected: Float[Array, "*batch 2"], actual: Float[Array, "*batch 2"]
) -> Float[Array, "*batch"]:
    """Signed angle from the expected direction to the actual one, wrapped.

    Args:
      expected: Ground directions (x, z) of any length.
      actual: Ground directions of any length.

    Returns:
      Angle in [-pi, pi] radians, positive from +z toward +x.

    Source: own.
    """
    return ground.angle_from_to(expected, actual)


@jax.jit
def trajectory_error(
    wanted_velocity: Float[Array, "*batch frames 2"],
    position: Float[Array, "*batch frames 2"],
    fps: Scalar,
    *,
    min_speed: Scalar = 0.1,
) -> TrajectoryError:
    """Mean absolute angle between the wanted and the actual direction of the root.

    Frame f's actual velocity is the step from f to f + 1; it is compared with the
    velocity wanted at f. A direction means nothing at rest, so frames in which either
    speed is below `min_speed` are left out; the part that remains is returned.

    Args:
      wanted_velocity: Velocity (x, z) that the user asked for in each frame, meters a
        second; the last is not used.
      position: Root position (x, z) in each frame, meters.
      fps: Frames per second.
      min_speed: Meters per second.

    Returns:
      Mean error in [0, pi] radians (zero where no frame remains), and the part of the
      frames used.

    Raises:
      ValueError: if there are fewer than two frames.

    Source: Chen et al. 2024 (CAMDM), sec. 4.1, metric 5; wrapped.
    """
    if position.shape[-2] < 2:
        raise ValueError("1 frame or none, expected at least 2 to have a direction")
    actual = jnp.diff(position, axis=-2) * fps
    wanted = wanted_velocity[..., :-1, :]
    speed = jnp.minimum(
        jnp.linalg.norm(actual, axis=-1), jnp.linalg.norm(wanted, axis=-1)
    )
    is_used = speed >= min_speed
    angle = jnp.where(is_used, jnp.abs(heading_error(wanted, actual)), 0.0)
    count = jnp.sum(is_used, axis=-1)
    return TrajectoryError(
        error=jnp.sum(angle, axis=-1) / jnp.maximum(count, 1),
        used=jnp.mean(is_used, axis=-1),
    )


@jax.jit
def orientation_error(
    wanted: Float[Array, "*batch frames 2"], actual: Float[Array, "*batch frames 2"]
) -> Float[Array, "*batch"]:
    """Mean absolute angle between the wanted and the actual facing.

    Args:
      wanted: Facing (x, z) that the user asked for in each frame.
      actual: Facing of the root in each frame.

    Returns:
      Mean error in [0, pi] radians.

    Source: Chen et al. 2024 (CAMDM), sec. 4.1, metric 6; wrapped.
    """
    return jnp.mean(jnp.abs(heading_error(wanted, actual)), axis=-1)
