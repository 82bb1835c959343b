"""Bodies that sink into the ground, hover above it or slide on it.

Millimeters, y up. The source takes the vertices of a body's surface; a skeleton has
none, so joints stand in for them. Joints lie inside the body: the lowest one of a
person who stands is a few centimeters above the soles (4.2 in the bandai_namco data).
Give that height as the ground's, or standing counts as floating.

Source: Yuan et al. 2023 (PhysDiff), metrics Penetrate, Float and Skate, of which Zhou
et al. 2024 (EMDM, supplement D.10) report the first and the last.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.evaluation import contact
from jaxmotion.motion.spring import Scalar

_MILLIMETERS = 1000.0


def _lowest(positions: Float[Array, "*batch frames joints 3"], ground: Scalar) -> Array:
    """Height of the lowest joint of each frame above the ground, meters."""
    return jnp.min(positions[..., 1], axis=-1) - ground


@jax.jit
def penetration(
    positions: Float[Array, "*batch frames joints 3"],
    *,
    ground: Scalar = 0.0,
    tolerance: Scalar = 0.005,
) -> Float[Array, "*batch"]:
    """How deep the lowest joint lies below the ground, millimeters, mean over frames.

    A frame whose depth is within the tolerance (meters, inclusive) counts as zero; of a
    deeper one the whole depth counts. The ground is the height that the lowest joint
    has when the body stands; world positions, meters.

    Source: Yuan et al. 2023 (PhysDiff), with joints instead of vertices.
    """
    depth = -_lowest(positions, ground)
    return _MILLIMETERS * jnp.mean(jnp.where(depth > tolerance, depth, 0.0), axis=-1)


@jax.jit
def floating(
    positions: Float[Array, "*batch frames joints 3"],
    *,
    ground: Scalar = 0.0,
    tolerance: Scalar = 0.005,
) -> Float[Array, "*batch"]:
    """How high the lowest joint lies above the ground, millimeters, mean over frames.

    A frame whose height is within the tolerance (meters, inclusive) counts as zero; of
    a higher one the whole height counts. Jumps and the flight phases of a run float as
    well: compare with real motions. The ground is the height that the lowest joint has
    when the body stands; world positions, meters.

    Source: Yuan et al. 2023 (PhysDiff), with joints instead of vertices.
    """
    height = _lowest(positions, ground)
    return _MILLIMETERS * jnp.mean(jnp.where(height > tolerance, height, 0.0), axis=-1)


@jax.jit
def skating(
    foot_positions: Float[Array, "*batch frames feet 3"],
    *,
    ground: Scalar = 0.0,
    tolerance: Scalar = 0.005,
) -> Float[Array, "*batch"]:
    """How far feet move on the ground per frame while they touch it, millimeters.

    The mean horizontal displacement over all feet and pairs of adjacent frames in both
    of which the foot is at most `tolerance` above the ground (or below it); zero where
    there are none. It is a distance a frame, hence compare only motions of one frame
    rate. World positions of feet or toes, meters; the ground is the height that these
    have when the body stands.

    Source: Yuan et al. 2023 (PhysDiff), with joints instead of vertices.
    """
    steps = contact.foot_steps(foot_positions)
    touches = foot_positions[..., 1] - ground <= tolerance
    slides = touches[..., 1:, :] & touches[..., :-1, :]
    total = jnp.sum(jnp.where(slides, steps, 0.0), axis=(-2, -1))
    return _MILLIMETERS * total / jnp.maximum(jnp.sum(slides, axis=(-2, -1)), 1)
