import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmotion.motion import rotation
from tests.reference import motion as reference
from tests.tiny import float32

COUNT = 200
# Half turns about the axes and about two diagonals, where trace formulas divide by 0.
AXES = np.array(
    [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, -1], [1, 1, 1]], np.float64
)
AXES /= np.linalg.norm(AXES, axis=1, keepdims=True)
HALF_TURNS = Rotation.from_rotvec(np.pi * AXES)


def same_up_to_sign(a, b, atol):
    sign = np.sign(np.sum(np.asarray(a) * b, axis=-1, keepdims=True))
    np.testing.assert_allclose(a, sign * b, atol=atol)


def assert_rotation(matrix, atol=1e-6):
    matrix = np.asarray(matrix, np.float64)
    identity = np.broadcast_to(np.eye(3), matrix.shape)
    np.testing.assert_allclose(
        matrix @ np.swapaxes(matrix, -1, -2), identity, atol=atol
    )
    np.testing.assert_allclose(np.linalg.det(matrix), 1.0, atol=atol)


def test_rot6d_is_two_columns_and_round_trips():
    matrix = reference.random_rotations(0, COUNT).as_matrix()
    rot6d = rotation.rot6d_from_matrix(float32(matrix))
    np.testing.assert_allclose(rot6d[:, :3], matrix[:, :, 0], atol=1e-6)
    np.testing.assert_allclose(rot6d[:, 3:], matrix[:, :, 1], atol=1e-6)
    np.testing.assert_allclose(rotation.matrix_from_rot6d(rot6d), matrix, atol=1e-6)


def test_rot6d_of_any_numbers_is_gram_schmidt():
    numbers = 3.0 * np.random.default_rng(1).normal(size=(COUNT, 6))
    found = rotation.matrix_from_rot6d(float32(numbers))
    assert_rotation(found, atol=3e-6)
    expected = np.stack([reference.gram_schmidt(n) for n in numbers])
    np.testing.assert_allclose(found, expected, atol=3e-5)


SINGULAR_ROT6D = {
    "zero": [0, 0, 0, 0, 0, 0],
    "zero first": [0, 0, 0, 0, 1, 0],
    "zero first, second along the fallback": [0, 0, 0, 1, 0, 0],
    "zero second": [0, 2, 0, 0, 0, 0],
    "parallel": [1, 1, 1, 2, 2, 2],
    "opposite": [0, 0, 1, 0, 0, -3],
    "nearly parallel": [1, 0, 0, 1, 1e-4, 0],
    "tiny": [1e-20, 0, 0, 0, 1e-20, 0],
    "huge": [1e12, 0, 0, 0, 1e12, 0],
    "tilted parallel": [0.3, -0.7, 0.2, 0.9, -2.1, 0.6],
}


@pytest.mark.parametrize("name", SINGULAR_ROT6D)
def test_singular_rot6d_gives_a_rotation_and_a_finite_gradient(name):
    numbers = float32(SINGULAR_ROT6D[name])
    assert_rotation(rotation.matrix_from_rot6d(numbers), atol=1e-5)
    weights = float32(np.random.default_rng(0).normal(size=(3, 3)))
    gradient = jax.grad(lambda d: jnp.sum(weights * rotation.matrix_from_rot6d(d)))
    assert bool(jnp.all(jnp.isfinite(gradient(numbers))))
    back = jax.jacrev(rotation.matrix_from_rot6d)(numbers)
    assert bool(jnp.all(jnp.isfinite(back)))


def plain_gram_schmidt(rot6d):
    """Matrix of one vector of six numbers, left to the compiler's differentiation."""
    first, second = rot6d[:3], rot6d[3:]
    x = first / jnp.sqrt(jnp.sum(first**2))
    y = second - jnp.sum(x * second) * x
    y = y / jnp.sqrt(jnp.sum(y**2))
    return jnp.stack([x, y, jnp.cross(x, y)], axis=1)


def weighted(function, weights):
    """A number that depends on all entries of all matrices."""
    return lambda rot6d: jnp.sum(weights * function(rot6d))


def test_written_gradient_of_rot6d_is_that_of_finite_differences():
    rng = np.random.default_rng(9)
    numbers, weights = 2.0 * rng.normal(size=(20, 6)), rng.normal(size=(20, 3, 3))
    value = weighted(rotation.matrix_from_rot6d, float32(weights))
    found = np.asarray(jax.grad(value)(float32(numbers)))
    step = 1e-6
    for row, weight, slopes in zip(numbers, weights, found, strict=True):
        for i in range(6):
            up, down = (row + sign * step * np.eye(6)[i] for sign in (1, -1))
            change = reference.gram_schmidt(up) - reference.gram_schmidt(down)
            expected = np.sum(weight * change) / (2 * step)
            np.testing.assert_allclose(slopes[i], expected, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_written_gradient_of_columns_has_the_batch_behind(batch):
    rng = np.random.default_rng(10)
    numbers = float32(rng.normal(size=(*batch, 6)))
    weights = float32(rng.normal(size=(*batch, 3, 3)))
    behind = jnp.moveaxis(weights, (-2, -1), (0, 1))
    given = jnp.moveaxis(numbers, -1, 0)
    found = jax.jit(jax.grad(weighted(rotation.columns_from_rot6d, behind)))(given)
    plain = plain_gram_schmidt
    for _ in batch:
        plain = jax.vmap(plain)
    expected = jax.jit(jax.grad(weighted(plain, weights)))(numbers)
    chex.assert_trees_all_close(
        jnp.moveaxis(found, 0, -1), expected, rtol=1e-4, atol=1e-5
    )
    matrices = jax.jit(rotation.columns_from_rot6d)(given)
    np.testing.assert_allclose(
        jnp.moveaxis(matrices, (0, 1), (-2, -1)), jax.jit(plain)(numbers), atol=1e-5
    )


def test_gradient_of_a_gradient_is_that_of_the_plain_formula():
    rng = np.random.default_rng(11)
    numbers = float32(rng.normal(size=(10, 6)))
    weights = float32(rng.normal(size=(10, 3, 3)))

    def bent(function):
        slope = jax.grad(weighted(function, weights))
        return jax.jit(jax.grad(lambda x: jnp.sum(slope(x) ** 2)))

    found = bent(rotation.matrix_from_rot6d)(numbers)
    expected = np.asarray(bent(jax.vmap(plain_gram_schmidt))(numbers))
    np.testing.assert_allclose(found, expected, rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize("name", SINGULAR_ROT6D)
def test_gradient_of_a_gradient_is_finite_where_rot6d_is_singular(name):
    weights = float32(np.random.default_rng(0).normal(size=(3, 3)))
    slope = jax.grad(weighted(rotation.matrix_from_rot6d, weights))
    bent = jax.jit(jax.grad(lambda x: jnp.sum(slope(x) ** 2)))
    assert np.isfinite(bent(float32(SINGULAR_ROT6D[name]))).all()


def test_a_vector_that_a_fallback_replaces_has_no_gradient():
    weights = float32(np.random.default_rng(0).normal(size=(3, 3)))
    slope = jax.grad(weighted(rotation.matrix_from_rot6d, weights))
    assert np.all(slope(jnp.zeros(6)) == 0.0)
    for name, part in (("zero first", slice(0, 3)), ("parallel", slice(3, 6))):
        found = np.asarray(slope(float32(SINGULAR_ROT6D[name])))
        assert np.all(found[part] == 0.0) and np.any(found != 0.0)


@pytest.mark.parametrize("angle", [1e-2, 1e-3, 1e-4, 1e-5, 1e-6])
def test_nearly_parallel_rot6d_is_still_a_rotation(angle):
    rng = np.random.default_rng(8)
    first, other = rng.normal(size=(2, COUNT, 3))
    numbers = np.concatenate([first, 3.0 * first + angle * other], axis=-1)
    found = rotation.matrix_from_rot6d(float32(numbers))
    assert_rotation(found, atol=1e-6)
    unit = first / np.linalg.norm(first, axis=-1, keepdims=True)
    np.testing.assert_allclose(found[..., 0], unit, atol=1e-6)


def test_rows_and_columns():
    matrix = reference.random_rotations(2, COUNT).as_matrix()
    columns = rotation.rot6d_from_matrix(float32(matrix))
    rows = float32(matrix[:, :2].reshape(COUNT, 6))
    np.testing.assert_allclose(rotation.rot6d_rows_to_columns(rows), columns, atol=1e-6)
    np.testing.assert_allclose(rotation.rot6d_rows_to_columns(columns), rows, atol=1e-6)
    # Published: the rows of the identity are (1, 0, 0, 0, 1, 0).
    identity = rotation.rot6d_from_matrix(jnp.eye(3))
    np.testing.assert_array_equal(identity, [1, 0, 0, 0, 1, 0])


def test_quaternions_agree_with_scipy():
    rotations = reference.random_rotations(3, COUNT)
    wxyz = np.roll(rotations.as_quat(), 1, axis=-1)
    np.testing.assert_allclose(
        rotation.matrix_from_quaternion(float32(wxyz)),
        rotations.as_matrix(),
        atol=1e-6,
    )
    # Length does not matter.
    np.testing.assert_allclose(
        rotation.matrix_from_quaternion(float32(-7.0 * wxyz)),
        rotations.as_matrix(),
        atol=1e-6,
    )
    found = rotation.quaternion_from_matrix(float32(rotations.as_matrix()))
    same_up_to_sign(found, wxyz, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1.0, atol=1e-6)
    assert bool(jnp.all(found[:, 0] >= 0))


def test_quaternions_of_half_turns():
    matrix = float32(HALF_TURNS.as_matrix())
    found = rotation.quaternion_from_matrix(matrix)
    expected = np.concatenate([np.zeros((len(AXES), 1)), AXES], axis=-1)
    same_up_to_sign(found, expected, atol=1e-6)
    np.testing.assert_allclose(
        rotation.matrix_from_quaternion(found), matrix, atol=1e-6
    )


def test_zero_quaternion_is_the_identity():
    zero = jnp.zeros(4)
    np.testing.assert_array_equal(rotation.matrix_from_quaternion(zero), jnp.eye(3))
    jacobian = jax.jacrev(rotation.matrix_from_quaternion)(zero)
    assert bool(jnp.all(jnp.isfinite(jacobian)))


@pytest.mark.parametrize("epsilon", [0.0, 1e-7, 1e-3])
def test_quaternion_gradients_are_finite_at_half_turns_and_the_identity(epsilon):
    for vector in [*(AXES * (np.pi - epsilon)), np.array([epsilon, 0.0, 0.0])]:
        matrix = float32(Rotation.from_rotvec(vector).as_matrix())
        jacobian = jax.jacrev(rotation.quaternion_from_matrix)(matrix)
        assert bool(jnp.all(jnp.isfinite(jacobian)))
        assert float(jnp.max(jnp.abs(jacobian))) < 5.0


def test_yaw_turns_z_toward_x():
    yaw = np.linspace(-4.0, 4.0, 33)
    expected = Rotation.from_rotvec(np.outer(yaw, [0, 1, 0])).as_matrix()
    facing = float32(np.stack([np.sin(yaw), np.cos(yaw)], axis=-1))
    np.testing.assert_allclose(rotation.matrix_from_facing(facing), expected, atol=1e-6)


def test_a_fallback_in_double_precision_makes_no_doubles():
    with jax.enable_x64(True):
        ahead = jnp.array([0.0, 1.0])
        assert ahead.dtype == jnp.float64
        found = rotation.safe_normalize(jnp.ones(2, jnp.float32), ahead)
    assert found.dtype == jnp.float32


def test_safe_normalize():
    fallback = jnp.array([0.0, 1.0])
    x = jnp.array([[3.0, 4.0], [0.0, 0.0], [1e-3, 0.0]])
    found = rotation.safe_normalize(x, fallback)
    np.testing.assert_allclose(found, [[0.6, 0.8], [0, 1], [1, 0]], atol=1e-6)
    jacobian = jax.jacrev(rotation.safe_normalize)(jnp.zeros(2), fallback)
    np.testing.assert_array_equal(jacobian, np.zeros((2, 2)))


FUNCTIONS = {
    "matrix_from_rot6d": (6,),
    "rot6d_from_matrix": (3, 3),
    "rot6d_rows_to_columns": (6,),
    "matrix_from_quaternion": (4,),
    "quaternion_from_matrix": (3, 3),
    "matrix_from_facing": (2,),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_leading_axes_vmap_and_jit_are_a_loop(name):
    function, shape = getattr(rotation, name), FUNCTIONS[name]
    x = float32(np.random.default_rng(0).normal(size=(2, 3, *shape)))
    if shape == (3, 3):
        x = rotation.matrix_from_rot6d(x.reshape(2, 3, 9)[..., :6])
    batched = function(x)
    loop = np.stack([[function(x[i, j]) for j in range(3)] for i in range(2)])
    np.testing.assert_allclose(batched, loop, atol=1e-6)
    np.testing.assert_allclose(jax.vmap(jax.vmap(function))(x), loop, atol=1e-6)
    with jax.disable_jit():
        chex.assert_trees_all_close(function(x), batched, atol=1e-6)
