import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.motion import facing, rotation
from jaxmotion.motion.skeleton import Skeleton, forward_kinematics


def biped(names):
    return Skeleton(
        offsets=jnp.array(
            [[0, 0, 0], [0, 0.1, 0], [0.1, 0, 0.02], [-0.1, 0, 0.02]], jnp.float32
        ),
        parents=(-1, 0, 1, 1),
        names=names,
    )


@pytest.mark.parametrize(
    "names",
    [
        ("Hips", "Spine", "LeftUpLeg", "RightUpLeg"),
        ("mixamorig:Hips", "a", "mixamorig:LeftUpLeg", "mixamorig:RightUpLeg"),
        ("joint_Root", "Hips", "UpperLeg_L", "UpperLeg_R"),
        ("Hips", "Chest", "LeftHip", "RightHip"),
        ("Pelvis", "Torso", "L_Hip", "R_Hip"),
    ],
)
def test_hips_are_found_by_name(names):
    assert facing.hip_joints(biped(names)) == (2, 3)


def test_unknown_hips_name_what_was_expected():
    with pytest.raises(ValueError, match=r"LeftUpLeg/RightUpLeg.*a, b, c, d"):
        facing.hip_joints(biped(("a", "b", "c", "d")))


def test_facing_is_that_of_full_kinematics():
    skeleton = biped(("Root", "Hips", "UpperLeg_L", "UpperLeg_R"))
    rot6d = jax.random.normal(jax.random.key(1), (2, 5, 4, 6))
    joints = forward_kinematics(skeleton, jnp.zeros((2, 5, 3)), rot6d)
    joints = np.asarray(joints, np.float64)
    forward = np.cross(joints[..., 2, :] - joints[..., 3, :], [0, 1, 0])[..., ::2]
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    got = facing.hip_facing(skeleton, rot6d)
    np.testing.assert_allclose(got, forward, atol=1e-5)
    swapped = facing.hip_facing(skeleton, rot6d, hips=(3, 2))
    np.testing.assert_allclose(swapped, -forward, atol=1e-5)


def test_facing_turns_with_the_root():
    skeleton = biped(("Root", "Hips", "LeftUpLeg", "RightUpLeg"))
    yaw = np.array([0.0, 0.5, 3.1, -3.1], np.float32)
    rest = rotation.rot6d_from_matrix(jnp.broadcast_to(jnp.eye(3), (4, 4, 3, 3)))
    ahead = jnp.stack([jnp.sin(yaw), jnp.cos(yaw)], axis=-1)
    turned = rotation.rot6d_from_matrix(rotation.matrix_from_facing(ahead))
    got = facing.hip_facing(skeleton, rest.at[:, 0].set(turned))
    np.testing.assert_allclose(got, np.stack([np.sin(yaw), np.cos(yaw)], -1), atol=1e-6)


def test_collar_bones_that_begin_at_one_point_count_for_nothing():
    """As CMU's do."""
    skeleton = biped(("LeftUpLeg", "RightUpLeg", "LeftShoulder", "RightShoulder"))
    hips = [[0.1, 1.0, 0.0], [-0.1, 1.0, 0.0]]
    positions = jnp.array([*hips, [0.0, 1.5, 0.0], [0.0, 1.5, 0.0]])
    found = facing.body_facing(skeleton, positions)
    np.testing.assert_allclose(found, [0.0, 1.0], atol=1e-6)


def test_facing_of_hips_above_each_other_is_finite():
    across = jnp.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    np.testing.assert_array_equal(facing.facing_from_across(across), [[0, 1]] * 2)
    grad = jax.grad(lambda a: jnp.sum(facing.facing_from_across(a)))(across)
    assert np.isfinite(grad).all()
