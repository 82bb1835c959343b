"""Contacts of the feet with the ground."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

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

    Args:
      foot_positions: World positions, metres, y up.
      fps: Frames a second.
      max_speed: Metres a second, in space (not only on the ground). CAMDM's foot loss
        has 0.01 m a frame at 30 fps, which is 0.3.
      max_height: Metres above the ground; infinite, that is no test of height, as in
        CAMDM's foot loss.

    Returns:
      Whether each foot stands.

    Raises:
      ValueError: if there are fewer than two frames.

    Source: Chen et al. 2024 (CAMDM), released code, with thresholds a second.
    """
    frames = foot_positions.shape[-3]
    if frames < 2:
        raise ValueError(f"{frames} frames, expected at least 2 to have a speed")
    step = foot_positions[..., 1:, :, :] - foot_positions[..., :-1, :, :]
    speed = jnp.linalg.norm(step, axis=-1) * fps
    speed = jnp.concatenate([speed, speed[..., -1:, :]], axis=-2)
    return (speed <= max_speed) & (foot_positions[..., 1] <= max_height)
