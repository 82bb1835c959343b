import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.motion.skeleton import Motion, joint_positions
from jaxmotion.viz import stage
from tests.viz import samples


def test_the_joints_are_those_of_the_kinematics():
    skeleton, (motion, _) = samples.figure(), samples.circle()
    shown = stage.make_stage(skeleton, motion)
    expected = np.asarray(joint_positions(skeleton, motion))
    np.testing.assert_allclose(shown.positions[0], expected, atol=1e-5)
    np.testing.assert_allclose(shown.walked[0], expected[:, 0, ::2], atol=1e-6)
    # A scaled rotation is the same rotation.
    doubled = dataclasses.replace(motion, joint_rotation=2 * motion.joint_rotation)
    same = stage.make_stage(skeleton, doubled)
    np.testing.assert_allclose(same.positions, shown.positions, atol=1e-6)
    assert shown.ghost_pose is None
    both = stage.make_stage(skeleton, motion, ghost=motion).outline
    assert len(both) == 2 and len(shown.outline) == 1
    np.testing.assert_allclose(both[1], shown.outline[0], atol=1e-6)


def test_the_outline_is_around_the_whole_body():
    skeleton, motion = samples.person(seconds=1.0)
    shown = stage.make_stage(skeleton, motion)
    vertices, _ = shown.body.skin(shown.positions, shown.rotations)
    for axis in range(3):
        for end in (np.min, np.max):
            whole, rough = (end(x[..., axis]) for x in (vertices, shown.outline))
            assert abs(whole - rough) < 0.02


def test_characters_keep_their_places_unless_they_overlap():
    motion, path = samples.circle()
    place = np.array([[0.0, 0, 0], [2.0, 0, 0]], np.float32)
    many = Motion(
        root_position=jnp.asarray(np.array(motion.root_position) + place[:, None]),
        joint_rotation=jnp.stack([motion.joint_rotation] * 2),
        fps=samples.FPS,
    )
    wanted = path + place[:, None, ::2]
    for apart, expected in ((None, 2.0), (0.0, 2.0), (3.0, 5.0)):
        shown = samples.circle_stage(many, wanted=wanted, apart=apart)
        away = np.linalg.norm(shown.walked[0, 0] - shown.walked[1, 0])
        np.testing.assert_allclose(away, expected, rtol=1e-5)
        np.testing.assert_allclose(shown.wanted, shown.walked, atol=1e-5)


def motion(shape=(12, 3), turns=None, **changes):
    turns = (*shape[:-1], 4, 6) if turns is None else turns
    made = Motion(root_position=jnp.zeros(shape), joint_rotation=jnp.ones(turns))
    return dataclasses.replace(made, **changes)


BALL = dict(position=np.zeros((12, 3)), joints=(3,), radius=0.1)
BAD = [
    (dict(motion=motion(turns=(12, 3, 6))), r"motion is \(12, 3\) and \(12, 3, 6\)"),
    (dict(motion=motion((0, 3))), "0 frames"),
    (dict(motion=motion(fps=0.0)), "0.0 fps"),
    (
        dict(wanted=np.zeros((5, 2))),
        r"wanted path is \(1, 5, 2\), expected \(1, 12, 2\)",
    ),
    (dict(wanted=np.zeros((12, 3))), r"wanted path is \(1, 12, 3\)"),
    (dict(ghost=motion((5, 3))), r"ghost is \(1, 5\) .*, expected \(1, 12\)"),
    (
        dict(ball=stage.Ball(**BALL, touch=np.zeros((12, 2), bool))),
        r"touch is \(12, 2\) beside 1 characters, expected \(12, 1\)",
    ),
    (
        dict(ball=stage.Ball(**BALL | dict(position=np.zeros((5, 3))))),
        r"ball is \(5, 3\) beside 1 characters",
    ),
    (
        dict(ball=stage.Ball(**BALL | dict(position=np.full((1, 12, 3), np.nan)))),
        "ball: frame 0 is not finite",
    ),
    (dict(sides=("left",)), "expected 4 of left, right, middle"),
]


@pytest.mark.parametrize("bad, message", BAD)
def test_wrong_shapes_are_named(bad, message):
    with pytest.raises(ValueError, match=message):
        samples.circle_stage(**bad)


def test_each_of_many_has_a_ball_that_is_set_apart_with_him():
    one, _ = samples.circle()
    many = Motion(
        root_position=jnp.stack([one.root_position] * 3),
        joint_rotation=jnp.stack([one.joint_rotation] * 3),
        fps=samples.FPS,
    )
    place = np.asarray(many.root_position) + [0.5, -0.8, 0.0]
    ball = stage.Ball(position=place)
    made = stage.make_stage(samples.figure(), many, ball=ball)
    assert np.ptp(made.positions[:, 0, 0, 0]) > 1
    gap = made.ball.position - made.positions[:, :, 0]
    np.testing.assert_allclose(
        gap, np.broadcast_to([0.5, -0.8, 0.0], gap.shape), atol=1e-5
    )
    touched = dataclasses.replace(ball, touch=np.zeros((12, 1), bool), joints=(3,))
    for wrong, message in (
        (
            dataclasses.replace(ball, position=place[:2]),
            r"ball is \(2, 12, 3\) beside 3",
        ),
        (touched, "touch is .* beside 3 characters, expected .* beside one"),
    ):
        with pytest.raises(ValueError, match=message):
            stage.make_stage(samples.figure(), many, ball=wrong)


def test_a_frame_that_is_not_finite_is_named():
    made, path = samples.circle()
    root = np.array(made.root_position)
    root[7, 1] = np.nan
    with pytest.raises(ValueError, match="motion: frame 7 is not finite"):
        samples.circle_stage(dataclasses.replace(made, root_position=jnp.asarray(root)))
    path = np.array(path)
    path[3] = np.inf
    with pytest.raises(ValueError, match="wanted path: frame 3 is not finite"):
        samples.circle_stage(wanted=path)
