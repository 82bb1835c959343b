"""Contacts of the feet with the ground, and of feet or hands with a ball."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxmotion.motion.ball import ball_accelerations
from jaxmotion.motion.spring import Scalar


@jax.jit
def foot_contacts(
    foot_positions: Float[Array, "*batch frames feet 3"],
    fps: Scalar,
    *,
    max_speed: Scalar = 0.3,
    max_height: Scalar = float("inf"),
) -> Bool[Array, "*batch frames feet"]:
    """Says in which frames each foot stands.

    A foot stands in frame f if it moves to frame f + 1 at `max_speed` at most and is at
    `max_height` at most in frame f. The last frame, which has no next one, takes the
    speed with which it was reached.

    Positions are in the world, meters, y up; the speed, m/s, is in space (not only on
    the ground). CAMDM's foot loss has 0.01 m a frame at 30 fps, and no test of height.
    `ValueError` for fewer than two frames.

    Source: Chen et al. 2024 (CAMDM), released code, with thresholds per second.
    """
    frames = foot_positions.shape[-3]
    if frames < 2:
        raise ValueError(f"{frames} frames, expected at least 2 to have a speed")
    step = foot_positions[..., 1:, :, :] - foot_positions[..., :-1, :, :]
    speed = jnp.linalg.norm(step, axis=-1) * fps
    speed = jnp.concatenate([speed, speed[..., -1:, :]], axis=-2)
    return (speed <= max_speed) & (foot_positions[..., 1] <= max_height)


@jax.jit
def ball_contact_gate(
    ball: Float[Array, "*batch frames 3"], fps: Scalar, *, threshold: Scalar
) -> Bool[Array, "*batch frames"]:
    """Frames in which something must have pushed the ball, never the first and last.

    The ball's center is in meters, the threshold in m/s^2. The paper's 2 is 2.2 mm of
    second difference at 30 fps, which a model's jitter exceeds; a ball that flies falls
    with 9.8. `ValueError` for fewer than three frames.

    Source: SMGDiff, eq. 10.
    """
    square = jnp.sum(ball_accelerations(ball, fps) ** 2, axis=-1)
    return square > jnp.square(threshold)


@jax.jit
def ball_contact_loss(
    joints: Float[Array, "*batch frames touching 3"],
    ball: Float[Array, "*batch frames 3"],
    grounded: Float[Array, "*batch frames touching"],
    gate: Bool[Array, "*batch frames"],
    *,
    max_distance: Scalar,
    grounded_weight: Scalar,
) -> Float[Array, "*batch"]:
    """How far the nearest joint is from the ball in the frames of a touch, meters.

    The sum over frames of the weighted distances (whole) that exceed `max_distance`.
    Distances of joints that stand on the ground count `grounded_weight` times, so that
    the lifted foot is chosen. The gate, the choice and the comparison are constants of
    the gradient, which is zero where a joint is at the ball's center.

    Positions, of the joints that may touch and of the ball's center, are in the world,
    meters. `grounded` says whether each joint stands, 0 to 1; its weight is at least 1.

    Source: SMGDiff, eq. 11-12, with the missing norm; the quotient there divides a
    frame's term by one.
    """
    offset = joints - jnp.expand_dims(ball, -2)
    square = jnp.sum(offset * offset, axis=-1)
    distance = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    weight = 1.0 + (grounded_weight - 1.0) * jax.lax.stop_gradient(grounded)
    nearest = jnp.min(distance * weight, axis=-1)
    return jnp.sum(jnp.where(gate & (nearest > max_distance), nearest, 0.0), axis=-1)
