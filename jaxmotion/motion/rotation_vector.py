"""Rotation vectors: axis times angle, in radians; safe at no rotation."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.motion import rotation

_TINY = 1e-12


@jax.jit
def from_matrix(matrix: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3"]:
    """Rotation vector, at most pi long, of a rotation matrix."""
    quaternion = rotation.quaternion_from_matrix(matrix)
    w, axis = quaternion[..., :1], quaternion[..., 1:]
    square = jnp.sum(axis * axis, axis=-1, keepdims=True)
    is_zero = square < _TINY
    sine = jnp.sqrt(jnp.where(is_zero, 1.0, square))
    # angle / sin(angle / 2), whose limit at no rotation is 2.
    return axis * jnp.where(is_zero, 2.0, 2.0 * jnp.arctan2(sine, w) / sine)


@jax.jit
def to_matrix(vector: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Rotation matrix of a rotation vector of any length."""
    square = jnp.sum(vector * vector, axis=-1, keepdims=True)
    is_zero = square < _TINY
    angle = jnp.sqrt(jnp.where(is_zero, 1.0, square))
    w = jnp.where(is_zero, 1.0, jnp.cos(0.5 * angle))
    axis = vector * jnp.where(is_zero, 0.5, jnp.sin(0.5 * angle) / angle)
    return rotation.matrix_from_quaternion(jnp.concatenate([w, axis], axis=-1))


@jax.jit
def nearest(
    vector: Float[Array, "*batch 3"], reference: Float[Array, "*batch 3"]
) -> Float[Array, "*batch 3"]:
    """A rotation vector, or the other of the same rotation if nearer to the reference.

    Without it the difference of two rotation vectors near a half turn jumps by a full
    turn. Both are at most pi long.
    """
    square = jnp.sum(vector * vector, axis=-1, keepdims=True)
    is_zero = square < _TINY
    length = jnp.sqrt(jnp.where(is_zero, 1.0, square))
    other = vector * jnp.where(is_zero, 1.0, 1.0 - 2.0 * math.pi / length)
    gap = jnp.sum((vector - reference) ** 2, axis=-1, keepdims=True)
    other_gap = jnp.sum((other - reference) ** 2, axis=-1, keepdims=True)
    return jnp.where(other_gap < gap, other, vector)
