"""Rotations: 6D, matrix, quaternion and yaw.

Conventions: column vectors (`v' = R v`), right-handed axes, y up. A 6D rotation is two
orthonormal 3-vectors of the matrix (Zhou et al. 2019). The library stores the first two
*columns*, `[c1, c2]`; CAMDM, MDM, EMDM and AMDM store the first two *rows*, which are
the columns of the inverse: `rot6d_rows_to_columns` converts. Quaternions are wxyz. Yaw
is the angle about +y that turns +z toward +x.

Gradients stay finite at the singularities (a zero vector, the identity, a half turn):
each uses the double `where`, because the gradient of the branch that is not taken must
be finite as well.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_TINY = 1e-12


@jax.jit
def safe_normalize(
    x: Float[Array, "*batch n"], fallback: Float[Array, " n"]
) -> Float[Array, "*batch n"]:
    """Unit vector along x; the unit `fallback`, with zero gradient, below 1e-6."""
    square = jnp.sum(x * x, axis=-1, keepdims=True)
    is_zero = square < _TINY
    length = jnp.sqrt(jnp.where(is_zero, 1.0, square))
    return jnp.where(is_zero, jnp.asarray(fallback, x.dtype), x / length)


def length(x: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Length of vectors, 1e-6 of a zero one, whose gradient is zero there."""
    return jnp.sqrt(jnp.sum(x * x, axis=-1) + _TINY)


def _dot(a: Array, b: Array) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Array, b: Array) -> Array:
    pairs = ((1, 2), (2, 0), (0, 1))
    return jnp.stack([a[i] * b[j] - a[j] * b[i] for i, j in pairs])


def _axes_and_lengths(rot6d: Array) -> tuple[Array, Array, Array, Array]:
    """Two orthonormal columns, and the lengths they had; 0 where a fallback stands."""
    first, second = rot6d[:3], rot6d[3:]
    square = _dot(first, first)
    is_zero = square < _TINY
    x = first / jnp.sqrt(jnp.where(is_zero, 1.0, square))[None]
    ones = jnp.ones_like(square)
    x = jnp.where(is_zero[None], jnp.stack([ones, 0 * ones, 0 * ones]), x)
    length_x = jnp.sqrt(jnp.where(is_zero, 0.0, square))
    y = second - _dot(x, second)[None] * x
    # A fallback orthogonal to x: the coordinate axis that x is least aligned with.
    least = jnp.argmin(jnp.abs(x), axis=0)
    axis = jnp.stack([jnp.where(least == i, ones, 0 * ones) for i in range(3)])
    other = axis - _dot(x, axis)[None] * x
    other = other / jnp.sqrt(_dot(other, other))[None]
    square = _dot(y, y)
    is_zero = square < _TINY
    length_y = jnp.sqrt(jnp.where(is_zero, 0.0, square))
    y = y / jnp.sqrt(jnp.where(is_zero, 1.0, square))[None]
    y = jnp.where(is_zero[None], other, y)
    # Again, because the first pass cancels where the two vectors are nearly parallel:
    # at 1e-4 rad one pass leaves axes 0.2 off orthogonal, two leave rounding error.
    y = y - _dot(x, y)[None] * x
    return x, y / jnp.sqrt(_dot(y, y))[None], length_x, length_y


@jax.custom_vjp
def columns_from_rot6d(rot6d: Float[Array, "6 *batch"]) -> Float[Array, "3 3 *batch"]:
    """`matrix_from_rot6d`, rows then columns, the batch last: for long products.

    The compiler makes loops over the last axis, and three numbers are too short for
    one: with the batch there, kinematics and its gradient are several times as fast.
    The gradient is written out, since the compiler's version computes the roots again
    for each of its terms. It is 0 where a fallback stands.
    """
    x, y, _, _ = _axes_and_lengths(rot6d)
    return jnp.stack([x, y, _cross(x, y)], axis=1)


def _columns_forward(rot6d: Array) -> tuple[Array, tuple[Array, ...]]:
    x, y, length_x, length_y = _axes_and_lengths(rot6d)
    return jnp.stack([x, y, _cross(x, y)], axis=1), (rot6d, x, y, length_x, length_y)


def _columns_backward(kept: tuple[Array, ...], given: Array) -> tuple[Array]:
    rot6d, x, y, length_x, length_y = kept

    def across(axis: Array, length: Array, gradient: Array) -> Array:
        """Through the division by a length: what is not along the axis."""
        safe = jnp.where(length > 0, length, 1.0)
        part = gradient - _dot(axis, gradient)[None] * axis
        return jnp.where((length > 0)[None], part / safe[None], 0.0)

    second, of_z = rot6d[3:], given[:, 2]
    of_y = across(y, length_y, given[:, 1] + _cross(of_z, x))
    along = _dot(x, of_y)[None]
    of_x = given[:, 0] + _cross(y, of_z) - _dot(x, second)[None] * of_y
    of_first = across(x, length_x, of_x - along * second)
    return (jnp.concatenate([of_first, of_y - along * x]),)


columns_from_rot6d.defvjp(_columns_forward, _columns_backward)


@jax.jit
def matrix_from_rot6d(rot6d: Float[Array, "*batch 6"]) -> Float[Array, "*batch 3 3"]:
    """Rotation matrix whose first two columns are Gram-Schmidt of the six numbers.

    Any input shorter than 1e18 gives a rotation: where the first vector is zero it
    becomes +x, and where the second is parallel to it another axis takes its place.
    Differentiable in reverse mode only: its gradient is written out.

    Source: Zhou et al. 2019, eq. 15.
    """
    return jnp.moveaxis(
        columns_from_rot6d(jnp.moveaxis(rot6d, -1, 0)), (0, 1), (-2, -1)
    )


def product(a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
    """`a @ b` in full precision: for rotations, and what they turn.

    By default GPUs round the factors of matrix products to ten bits, which would move a
    joint by up to a millimeter a meter, another way in every frame.
    """
    return jnp.matmul(a, b, precision="highest")


@jax.jit
def rot6d_from_matrix(matrix: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 6"]:
    """The first two columns of a rotation matrix, `[c1, c2]`."""
    return jnp.concatenate([matrix[..., :, 0], matrix[..., :, 1]], axis=-1)


@jax.jit
def rot6d_rows_to_columns(rot6d: Float[Array, "*batch 6"]) -> Float[Array, "*batch 6"]:
    """Converts between the two-row and the two-column layout; its own inverse.

    The six numbers are Gram-Schmidted on the way, so they may come from a network.

    Source: rows as in the released code of CAMDM, MDM, EMDM and AMDM.
    """
    return rot6d_from_matrix(jnp.swapaxes(matrix_from_rot6d(rot6d), -1, -2))


@jax.jit
def matrix_from_quaternion(
    quaternion: Float[Array, "*batch 4"],
) -> Float[Array, "*batch 3 3"]:
    """Rotation matrix of a quaternion wxyz of any length; zero gives the identity."""
    identity = jnp.array([1.0, 0.0, 0.0, 0.0], quaternion.dtype)
    w, x, y, z = jnp.moveaxis(safe_normalize(quaternion, identity), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


@jax.jit
def quaternion_from_matrix(
    matrix: Float[Array, "*batch 3 3"],
) -> Float[Array, "*batch 4"]:
    """Unit quaternion wxyz of a rotation matrix, with w >= 0.

    Of the four algebraically equal forms the best conditioned one is taken, so the
    result and its gradient are finite everywhere, half turns included.

    Source: Shepperd 1978.
    """
    m = matrix
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    diagonal = jnp.stack([trace, m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]], axis=-1)
    wx, wy, wz = (
        m[..., 2, 1] - m[..., 1, 2],
        m[..., 0, 2] - m[..., 2, 0],
        m[..., 1, 0] - m[..., 0, 1],
    )
    xy, xz, yz = (
        m[..., 0, 1] + m[..., 1, 0],
        m[..., 0, 2] + m[..., 2, 0],
        m[..., 1, 2] + m[..., 2, 1],
    )
    # Row k is 4 q_k q; its own entry is 1 + 2 d_k - trace >= 1 for the largest d_k.
    own = 1.0 + 2.0 * diagonal - trace[..., None]
    own = own.at[..., 0].set(1.0 + trace)
    rows = jnp.stack(
        [
            jnp.stack([own[..., 0], wx, wy, wz], axis=-1),
            jnp.stack([wx, own[..., 1], xy, xz], axis=-1),
            jnp.stack([wy, xy, own[..., 2], yz], axis=-1),
            jnp.stack([wz, xz, yz, own[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    best = jnp.argmax(own, axis=-1)[..., None, None]
    row = jnp.take_along_axis(rows, best, axis=-2)[..., 0, :]
    quaternion = row / jnp.linalg.norm(row, axis=-1, keepdims=True)
    return jnp.where(quaternion[..., :1] < 0, -quaternion, quaternion)


@jax.jit
def matrix_from_facing(facing: Float[Array, "*batch 2"]) -> Float[Array, "*batch 3 3"]:
    """Rotation about +y that turns +z onto a unit ground direction (x, z)."""
    x, z = facing[..., 0], facing[..., 1]
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    rows = [[z, zero, x], [zero, one, zero], [-x, zero, z]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
