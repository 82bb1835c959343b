"""Losses on arrays: data, velocity, position and foot sliding.

All are means over the elements that a mask keeps, so that they do not depend on padding
or batch size. "Displacement" is the difference of neighbouring frames, in the unit of
the input per frame: the losses of MDM and CAMDM are written so, with weight 1.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def masked_mse(
    prediction: Float[Array, "*batch frames features"],
    target: Float[Array, "*batch frames features"],
    mask: Bool[Array, "*#batch frames"],
) -> Float[Array, ""]:
    """Mean squared error over the frames that count.

    Args:
      prediction: Any features.
      target: The same features.
      mask: Frames that count. A batch with none gives 0.

    Returns:
      Mean over kept frames and all features.

    Source: MDM's masked L2; Chen et al. 2024 (CAMDM), eq. 2.
    """
    weight = jnp.broadcast_to(mask, prediction.shape[:-1]).astype(prediction.dtype)
    square = jnp.mean((prediction - target) ** 2, axis=-1)
    return jnp.sum(square * weight) / jnp.maximum(jnp.sum(weight), 1.0)


def displacement(x: Float[Array, "*batch frames n"]) -> Array:
    """Difference of neighbouring frames.

    Args:
      x: Frames.

    Returns:
      One frame less, per frame.
    """
    return x[..., 1:, :] - x[..., :-1, :]


def velocity_loss(
    prediction: Float[Array, "*batch frames features"],
    target: Float[Array, "*batch frames features"],
    mask: Bool[Array, "*#batch frames"],
) -> Float[Array, ""]:
    """Mean squared error of displacements; both frames of a pair must count.

    Args:
      prediction: Any features.
      target: The same features.
      mask: Frames that count.

    Returns:
      Mean over kept pairs and all features, per frame squared.

    Source: MDM (Tevet et al. 2023), eq. 5.
    """
    pairs = mask[..., 1:] & mask[..., :-1]
    return masked_mse(displacement(prediction), displacement(target), pairs)


def foot_slide_loss(
    foot_positions: Float[Array, "*batch frames feet 3"],
    contact: Bool[Array, "*batch frames feet"],
) -> Float[Array, ""]:
    """Squared displacement of feet that stand on the ground.

    The mean runs over all frames and feet, standing or not, as in the released code
    of CAMDM: so a moving character's loss is not dominated by its few stances.

    Args:
      foot_positions: Predicted world positions, metres.
      contact: Whether the foot stands between this frame and the next (the last
        frame's value is unused).

    Returns:
      Mean squared displacement, square metres per frame squared.

    Source: MDM, eq. 4; released code of CAMDM.
    """
    moved = foot_positions[..., 1:, :, :] - foot_positions[..., :-1, :, :]
    return jnp.mean(moved**2 * contact[..., :-1, :, None])
