"""Where a character will be: AAMDM's and Learned Motion Matching's path features.

Positions and facings of the simulation bone at a third, two thirds and a whole second
ahead, in the axes of where it is now: 6 + 6 numbers.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.motion.trajectory import PlanarFrame, Trajectory, to_local

SECONDS = (1 / 3, 2 / 3, 1.0)


def path_offsets(fps: float) -> tuple[int, ...]:
    """How many frames ahead the path is looked at; 20, 40, 60 at 60 per second.

    Source: Li et al. 2024 (AAMDM), section 3.6.
    """
    return tuple(round(seconds * fps) for seconds in SECONDS)


def query(path: Trajectory, frame: PlanarFrame) -> Float[Array, "*batch 12"]:
    """Features of three points of a path (world).

    Three positions (x, z), meters, then three facings (x, z), in the axes of the frame.

    Source: Li et al. 2024 (AAMDM), section 3.6.
    """
    local = to_local(path, frame)
    batch = local.position.shape[:-2]
    flat = [x.reshape(*batch, -1) for x in (local.position, local.facing)]
    return jnp.concatenate(flat, axis=-1)


@functools.partial(jax.jit, static_argnames=("fps",))
def path_features(bone: Trajectory, *, fps: float) -> Float[Array, "frames 12"]:
    """`query` of every frame of a clip; beyond its end the last frame counts.

    Source: Li et al. 2024 (AAMDM), section 3.6; clamped as in Holden et al. 2020.
    """
    frames = bone.position.shape[0]
    ahead = jnp.add.outer(jnp.arange(frames), jnp.array(path_offsets(fps)))
    ahead = jnp.minimum(ahead, frames - 1)
    path = Trajectory(position=bone.position[ahead], facing=bone.facing[ahead])
    return query(path, PlanarFrame(origin=bone.position, facing=bone.facing))
