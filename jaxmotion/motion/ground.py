"""Directions on the ground plane as unit vectors (x, z), never as stored angles.

An angle here is a yaw: it turns +z toward +x, so the direction of yaw a is
(sin a, cos a). Differences of directions come from atan2 of their cross and dot
products, which wraps by itself; nothing needs to be unwrapped.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_TINY = 1e-12


@jax.jit
def unit(
    vector: Float[Array, "*batch 2"], fallback: Float[Array, "*batch 2"] | None = None
) -> Float[Array, "*batch 2"]:
    """Unit vector along a ground vector (x, z); `fallback`, or +z, where that is zero.

    Zero is a length below 1e-6; the fallback is of unit length. The gradient is finite
    everywhere: at a zero vector it is zero.
    """
    if fallback is None:
        fallback = jnp.broadcast_to(jnp.array([0.0, 1.0], vector.dtype), vector.shape)
    square = jnp.sum(vector * vector, axis=-1, keepdims=True)
    is_zero = square < _TINY
    # The branch that is not taken must have a finite gradient as well.
    length = jnp.sqrt(jnp.where(is_zero, 1.0, square))
    return jnp.where(is_zero, fallback, vector / length)


@jax.jit
def turn(
    vector: Float[Array, "*batch 2"], yaw: Float[Array, "*batch"]
) -> Float[Array, "*batch 2"]:
    """Turns ground vectors (x, z) about +y, by radians from +z toward +x."""
    x, z = vector[..., 0], vector[..., 1]
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.stack([cos * x + sin * z, cos * z - sin * x], axis=-1)


@jax.jit
def angle_from_to(
    start: Float[Array, "*batch 2"], end: Float[Array, "*batch 2"]
) -> Float[Array, "*batch"]:
    """Yaw that turns one direction (x, z) into another, by the shorter way.

    In [-pi, pi] radians, positive from +z toward +x. Directions have any length; a zero
    vector counts as +z.
    """
    # Unit vectors never have both products zero, where atan2 has no gradient.
    a, b = unit(start), unit(end)
    cross = b[..., 0] * a[..., 1] - b[..., 1] * a[..., 0]
    return jnp.arctan2(cross, jnp.sum(a * b, axis=-1))


@jax.jit
def into_frame(
    vector: Float[Array, "*batch 2"], facing: Float[Array, "*batch 2"]
) -> Float[Array, "*batch 2"]:
    """World ground vectors (x, z) in the axes of a frame with unit +z `facing`."""
    x, z = vector[..., 0], vector[..., 1]
    fx, fz = facing[..., 0], facing[..., 1]
    return jnp.stack([fz * x - fx * z, fx * x + fz * z], axis=-1)


@jax.jit
def out_of_frame(
    vector: Float[Array, "*batch 2"], facing: Float[Array, "*batch 2"]
) -> Float[Array, "*batch 2"]:
    """Inverse of `into_frame`."""
    x, z = vector[..., 0], vector[..., 1]
    fx, fz = facing[..., 0], facing[..., 1]
    return jnp.stack([fz * x + fx * z, fz * z - fx * x], axis=-1)
