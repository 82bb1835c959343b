"""How smoothly joints move."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.motion.spring import Scalar


def _mean_derivative(positions: Array, fps: Scalar, order: int) -> Array:
    if positions.shape[-3] <= order:
        raise ValueError(
            f"{positions.shape[-3]} frames, expected at least {order + 1} for a "
            f"derivative of order {order}"
        )
    derivative = jnp.diff(positions, n=order, axis=-3) * fps**order
    return jnp.mean(jnp.linalg.norm(derivative, axis=-1), axis=(-2, -1))


@jax.jit
def acceleration(
    positions: Float[Array, "*batch frames joints 3"], fps: Scalar
) -> Float[Array, "*batch"]:
    """Mean length of the joints' acceleration (world), over frames and joints, m/s^2.

    Second differences times fps^2. Real motion does not score zero, and a frozen one
    does: compare with the data's own value.

    Source: Chen et al. 2024 (CAMDM), sec. 4.1, metric 3, in its usual meaning (the
      paper's unit is that of a speed; see `camdm_release.coherence`).
    """
    return _mean_derivative(positions, fps, 2)


@jax.jit
def jerk(
    positions: Float[Array, "*batch frames joints 3"], fps: Scalar
) -> Float[Array, "*batch"]:
    """Mean length of the joints' jerk (world), over frames and joints, m/s^3.

    Third differences times fps^3.

    Source: Flash and Hogan 1985, who make its square least.
    """
    return _mean_derivative(positions, fps, 3)
