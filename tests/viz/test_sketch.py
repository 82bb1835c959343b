import numpy as np
import pytest

from jaxmotion.viz import sketch as body
from tests.viz import samples


def test_left_is_blue_and_right_is_red():
    left, right, middle = body.LEFT, body.RIGHT, body.MIDDLE
    names = {
        "LeftArm": left,
        "r_foot": right,
        "mixamorig:RightLeg": right,
        "hand_l": left,
        "UpperArm_L": left,
        "L_Wrist": left,
        "rHip": right,
        "l_uparm_JNT": left,
        "Head": middle,
        "C_pelvis_JNT": middle,
        "Chest": middle,
        "lowerback": middle,
    }
    assert body.bone_colors(tuple(names), len(names)) == list(names.values())
    assert body.bone_colors(None, 3) == [middle] * 3


@pytest.fixture(scope="module")
def person():
    return samples.person()


def heights(made, color):
    """Lowest and highest point of all shapes of a color, over the frames."""
    mine = [s for s, c in enumerate(made.colors) if c == color]
    ends, radii = made.points[:, made.ends[mine]], made.radii[mine]
    return (ends[..., 1] - radii).min(), (ends[..., 1] + radii).max()


def test_a_head_stands_on_the_last_joint_and_feet_on_the_ground(person):
    positions, skeleton = person
    made = body.build(positions, skeleton.parents, skeleton.names)
    head = positions[:, skeleton.names.index("Head"), 1].max()
    top = heights(made, body.SKIN)[1]
    # From the first vertebra to the vertex an adult measures about 0.2 m.
    assert 0.12 < top - head < 0.25
    for side in (body.LEFT_DARK, body.RIGHT_DARK):
        assert -0.03 < heights(made, side)[0] < 0.02
    # Every joint is inside the body: nearer to a capsule's axis than its radius.
    for joint in range(positions.shape[1]):
        place = positions[40, joint]
        a, b = np.moveaxis(made.points[40, made.ends], 1, 0)
        along = np.sum((b - a) ** 2, -1)
        part = np.sum((place - a) * (b - a), -1) / np.maximum(along, 1e-9)
        part = np.clip(part, 0, 1)
        away = np.linalg.norm(place - a - part[:, None] * (b - a), axis=-1)
        radius = made.radii[:, 0] + part * np.diff(made.radii)[:, 0]
        assert (away - radius).min() < 0.005, skeleton.names[joint]


def test_toes_point_and_the_nose_looks_ahead(person):
    positions, skeleton = person
    made = body.build(positions, skeleton.parents, skeleton.names)
    joint = skeleton.names.index
    left = positions[:, joint("LeftArm")] - positions[:, joint("RightArm")]
    ahead = np.cross(left, [0.0, 1.0, 0.0])
    nose = made.points[:, made.ends[-1, 0]] - positions[:, joint("Head")]
    assert np.all(np.sum(nose * ahead, axis=-1) > 0)


def test_a_head_is_found_without_names_and_sides_are_gray(person):
    positions, skeleton = person
    made = body.build(positions, skeleton.parents, None)
    named = body.build(positions, skeleton.parents, skeleton.names)
    np.testing.assert_allclose(made.points, named.points)
    assert set(made.colors) == {body.MIDDLE, body.SKIN}


def test_the_body_grows_with_the_bones(person):
    positions, skeleton = person
    small = body.build(0.5 * positions, skeleton.parents, skeleton.names)
    large = body.build(positions, skeleton.parents, skeleton.names)
    np.testing.assert_allclose(2 * small.radii, large.radii)
    np.testing.assert_allclose(2 * small.points, large.points, atol=1e-9)


def test_any_tree_is_drawn():
    positions, _ = samples.circle()
    made = body.build(positions, samples.PARENTS, samples.NAMES)
    assert made.ends.tolist() == [[0, 1], [1, 2], [0, 3]]
    assert made.colors == (body.MIDDLE, body.LEFT, body.RIGHT)
    assert made.radii.min() > 0
    ball = body.build(positions[:, :1], (-1,), None)
    assert ball.ends.tolist() == [[0, 0]] and ball.radii.min() > 0
