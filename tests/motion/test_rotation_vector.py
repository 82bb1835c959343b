import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxmotion.motion import rotation_vector


def test_rotation_vectors_agree_with_scipy():
    vectors = np.random.default_rng(0).normal(size=(50, 3))
    vectors[0], vectors[1] = 0.0, [1e-7, 0, 0]
    turns = Rotation.from_rotvec(vectors)
    got = rotation_vector.to_matrix(jnp.asarray(vectors, jnp.float32))
    np.testing.assert_allclose(got, turns.as_matrix(), atol=1e-6)
    back = rotation_vector.from_matrix(jnp.asarray(turns.as_matrix(), jnp.float32))
    np.testing.assert_allclose(back, turns.as_rotvec(), atol=2e-5)


def test_nearest_takes_the_other_way_round():
    near = rotation_vector.nearest(
        jnp.array([0.0, np.pi - 0.1, 0.0]), jnp.array([0.0, -np.pi + 0.1, 0.0])
    )
    np.testing.assert_allclose(near, [0, -np.pi - 0.1, 0], atol=1e-6)


def test_gradients_are_finite_at_no_rotation():
    def total(vector):
        matrix = rotation_vector.to_matrix(vector)
        back = rotation_vector.from_matrix(matrix)
        return jnp.sum(rotation_vector.nearest(back, vector))

    np.testing.assert_allclose(jax.grad(total)(jnp.zeros(3)), 1.0, atol=1e-6)
