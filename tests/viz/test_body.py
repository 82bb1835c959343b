import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data.walker import walker_skeleton
from jaxmotion.motion import anatomy
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.viz import body


def renamed(skeleton, name):
    return Skeleton(
        offsets=skeleton.offsets,
        parents=skeleton.parents,
        names=tuple(name(j) for j in range(skeleton.num_joints)),
        feet=skeleton.feet,
    )


def standing(skeleton, sides=None):
    """Ends [S, 2, 3] in the T-pose, and the body."""
    made = body.describe(skeleton, sides)
    return made.ends(*anatomy.t_pose(skeleton)), made


def parts(ends, made, *colors):
    mine = [s for s, color in enumerate(made.colors) if color in colors]
    return ends[mine], made.radii[mine]


def test_it_stands_with_hands_and_a_head_that_looks_ahead():
    skeleton = walker_skeleton()
    ends, made = standing(skeleton)
    joints = anatomy.t_pose(skeleton)[0]
    skin, radii = parts(ends, made, body.SKIN)
    top = (skin[..., 1] + radii).max() - joints[skeleton.index("Head"), 1]
    assert 0.12 < top < 0.25, "an adult's head"
    nose = skin[np.argmin(radii.max(axis=1)), 0]
    assert nose[2] > joints[skeleton.index("Head"), 2] + 0.05
    assert skin[..., 0].max() > joints[:, 0].max() + 0.05, "hands"
    soles = [
        (e[..., 1] - r).min()
        for e, r in (parts(ends, made, c) for c in (body.LEFT_DARK, body.RIGHT_DARK))
    ]
    assert abs(soles[0] - soles[1]) < 1e-6
    assert (ends[..., 1] - made.radii[..., None][..., 0]).min() == min(soles)
    left, _ = parts(ends, made, body.LEFT, body.LEFT_DARK)
    right, _ = parts(ends, made, body.RIGHT, body.RIGHT_DARK)
    np.testing.assert_allclose(left * [-1, 1, 1], right, atol=1e-6)


def test_names_only_help():
    skeleton = walker_skeleton()
    odd = renamed(skeleton, lambda j: f"bone {j:02d}")
    ends, made = standing(skeleton)
    same, unnamed = standing(odd)
    np.testing.assert_allclose(same, ends, atol=1e-9)
    assert unnamed.colors == made.colors, "the zero pose tells the sides"
    sides = anatomy.find_anatomy(skeleton).sides
    assert standing(odd, sides)[1].colors == made.colors
    with pytest.raises(ValueError, match="expected 22 of left, right, middle"):
        body.describe(odd, ("left",))


def test_the_body_follows_joints_and_scales():
    skeleton = walker_skeleton()
    ends, made = standing(skeleton)
    positions, rotations = anatomy.t_pose(skeleton)
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    there = np.stack([positions @ turn.T + [1.0, 2, 3]] * 2)
    moved = made.ends(there, np.stack([turn @ rotations] * 2))
    np.testing.assert_allclose(moved[1], ends @ turn.T + [1.0, 2, 3], atol=1e-9)
    half = Skeleton(
        offsets=0.5 * skeleton.offsets, parents=skeleton.parents, names=skeleton.names
    )
    small, low = standing(half)
    np.testing.assert_allclose(2 * small, ends, atol=1e-6)
    np.testing.assert_allclose(2 * low.radii, made.radii, rtol=1e-6)


def test_any_tree_has_a_body():
    tail = Skeleton(
        offsets=jnp.asarray([[0.0, 0, 0], [0, 0, 0.3], [0, 0, 0.2], [0.1, 0, 0]]),
        parents=(-1, 0, 1, 0),
        names=("a", "b", "c_l", "d_r"),
    )
    ends, made = standing(tail)
    assert ends.shape == (3, 2, 3) and made.radii.min() > 0
    assert made.colors == (body.MIDDLE, body.LEFT, body.RIGHT)
    one = Skeleton(offsets=jnp.zeros((1, 3)), parents=(-1,), names=("a",))
    assert standing(one)[0].shape == (1, 2, 3)


def test_a_capsules_mesh_is_closed_and_solid():
    ends, radii = np.array([[0.0, 0, 0], [0, 0, 0.4]]), np.array([0.1, 0.05])
    vertices, normals, owner, faces = body.capsule_mesh(ends, radii)
    away = np.linalg.norm(vertices - ends[owner], axis=-1)
    np.testing.assert_allclose(away, radii[owner])
    corner = vertices[faces]
    outward = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    assert (np.sum(outward * normals[faces].mean(axis=1), axis=-1) > 0).all()
    # The volume of the solid: two balls' parts and a cone between.
    volume = np.sum(corner[:, 0] * np.cross(corner[:, 1], corner[:, 2])) / 6
    between = np.pi * 0.4 / 3 * (0.1**2 + 0.1 * 0.05 + 0.05**2)
    caps = 2 / 3 * np.pi * (0.1**3 + 0.05**3)
    np.testing.assert_allclose(volume, between + caps, rtol=0.1)
