import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxmotion.motion import ground

YAWS = np.array([0.0, 0.3, -2.0, 3.1, -3.1])


def directions(angles):
    return jnp.asarray(np.stack([np.sin(angles), np.cos(angles)], -1), jnp.float32)


def test_turn_is_scipys_rotation_about_y():
    vectors = np.random.default_rng(0).normal(size=(5, 3))
    vectors[:, 1] = 0
    turns = Rotation.from_rotvec(np.outer(YAWS, [0, 1, 0]))
    got = ground.turn(
        jnp.asarray(vectors[:, ::2], jnp.float32), jnp.asarray(YAWS, jnp.float32)
    )
    np.testing.assert_allclose(got, turns.apply(vectors)[:, ::2], atol=1e-6)


def test_angle_is_what_turns_one_into_the_other():
    start, end = directions(YAWS), 3 * directions(YAWS[::-1])
    angle = ground.angle_from_to(start, end)
    assert np.abs(angle).max() <= np.pi
    np.testing.assert_allclose(3 * ground.turn(start, angle), end, atol=1e-5)
    gap = ground.angle_from_to(directions(np.array(3.1)), directions(np.array(-3.1)))
    np.testing.assert_allclose(gap, 2 * np.pi - 6.2, atol=1e-5)


def test_frame_has_its_facing_as_z_and_inverts():
    facing = directions(YAWS)
    np.testing.assert_allclose(
        ground.into_frame(facing, facing), [[0, 1]] * 5, atol=1e-6
    )
    x = jnp.asarray(np.random.default_rng(1).normal(size=(5, 2)), jnp.float32)
    back = ground.out_of_frame(ground.into_frame(x, facing), facing)
    np.testing.assert_allclose(back, x, atol=1e-6)
    np.testing.assert_allclose(
        ground.out_of_frame(x, facing),
        ground.turn(x, jnp.asarray(YAWS, jnp.float32)),
        atol=1e-6,
    )


def test_unit_of_zero_is_the_fallback_with_finite_gradients():
    x = jnp.array([[0.0, 0.0], [3.0, 4.0]])
    np.testing.assert_allclose(ground.unit(x), [[0, 1], [0.6, 0.8]], atol=1e-7)
    fallback = jnp.array([[1.0, 0.0], [1.0, 0.0]])
    np.testing.assert_allclose(ground.unit(x, fallback)[0], [1, 0])

    def total(x):
        return jnp.sum(ground.unit(x)) + jnp.sum(ground.angle_from_to(x, x[::-1]))

    assert np.isfinite(jax.grad(total)(x)).all()
