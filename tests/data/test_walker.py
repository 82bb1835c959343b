"""Inverse kinematics of the walker, on feet and hips placed by the tests."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import walker
from jaxmotion.data.footsteps import Footsteps
from jaxmotion.data.gaits import GAITS, Gait
from jaxmotion.motion import rotation
from jaxmotion.motion.skeleton import check_parents, forward_kinematics

FRAMES = 40
STIFF = Gait(sway=0.0, twist=0.0)


def standing(toe, yaw=0.0):
    """Feet that stand, given as [2, 3] toes."""
    return Footsteps(
        toe=np.broadcast_to(np.asarray(toe, float), (FRAMES, 2, 3)).copy(),
        yaw=np.full((FRAMES, 2), yaw),
        contact=np.ones((FRAMES, 2), bool),
        swing=np.zeros((FRAMES, 2)),
        phase=np.zeros(FRAMES),
    )


def at_rest(half_width=0.09, ahead=walker.TOE_AHEAD):
    y = walker.TOE_HEIGHT
    return standing([[half_width, y, ahead], [-half_width, y, ahead]])


def positions(root, local):
    skeleton = walker.walker_skeleton()
    rot6d = rotation.rot6d_from_matrix(jnp.asarray(local, jnp.float32))
    joint = jnp.asarray(root, jnp.float32)
    return np.asarray(forward_kinematics(skeleton, joint, rot6d), float)


def solve(steps, gait=STIFF, path=(0.0, 0.0), yaw=0.0):
    path = np.broadcast_to(np.asarray(path, float), (FRAMES, 2))
    root, local = walker.solve_pose(path, np.full(FRAMES, yaw), steps, gait, fps=30.0)
    eye = local @ np.swapaxes(local, -1, -2)
    np.testing.assert_allclose(eye, np.broadcast_to(np.eye(3), eye.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(local), 1.0, atol=1e-9)
    return positions(root, local)


def test_the_skeleton_is_a_tree_of_plain_measures():
    skeleton = walker.walker_skeleton()
    check_parents(skeleton.parents)
    assert [skeleton.names[foot] for foot in skeleton.feet] == [
        "LeftToeBase",
        "RightToeBase",
    ]
    lengths = np.linalg.norm(np.asarray(skeleton.offsets), axis=-1)
    named = dict(zip(skeleton.names, lengths, strict=True))
    for name in skeleton.names:
        if name.startswith("Left"):
            twin = "Right" + name.removeprefix("Left")
            assert named[name] == named[twin]
    assert named["LeftLeg"] == pytest.approx(walker.THIGH)
    assert named["LeftFoot"] == pytest.approx(walker.SHANK)


@pytest.mark.parametrize("name", GAITS)
def test_toes_are_where_the_steps_are(name):
    steps = at_rest(half_width=0.12, ahead=0.2)
    found = solve(steps, GAITS[name])
    np.testing.assert_allclose(found[:, [17, 21]], steps.toe, atol=1e-5)


def test_standing_upright_has_level_soles_and_nearly_straight_knees():
    found = solve(at_rest())
    skeleton = walker.walker_skeleton()
    for thigh in (14, 18):
        knee, ankle, toe = (found[0, thigh + i] for i in (1, 2, 3))
        bend = np.linalg.norm(ankle - found[0, thigh])
        assert 0.97 * (walker.THIGH + walker.SHANK) < bend
        sole = toe - ankle
        np.testing.assert_allclose(sole, np.asarray(skeleton.offsets)[17], atol=1e-5)
        assert knee[2] > 0.5 * (found[0, thigh, 2] + ankle[2]), "the knee is in front"


def test_crouch_lowers_the_pelvis_by_itself():
    upright = solve(at_rest())[:, 0, 1]
    low = solve(at_rest(), dataclasses.replace(STIFF, crouch=0.15))[:, 0, 1]
    np.testing.assert_allclose(upright - low, 0.15, atol=1e-6)


def test_everything_turns_with_the_body():
    yaw = 1.1
    turn = np.array(
        [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
    )
    steps = at_rest()
    straight = solve(steps, GAITS["neutral"])
    turned = solve(standing(steps.toe[0] @ turn.T, yaw), GAITS["neutral"], yaw=yaw)
    np.testing.assert_allclose(turned, straight @ turn.T, atol=2e-5)


def test_a_foot_behind_lifts_its_heel_but_not_its_toe():
    y = walker.TOE_HEIGHT
    steps = standing([[0.09, y, 0.45], [-0.09, y, -0.35]])
    found = solve(steps)
    np.testing.assert_allclose(found[:, [17, 21]], steps.toe, atol=1e-5)
    front, behind = found[0, 16, 1] - y, found[0, 20, 1] - y
    assert behind > front + 0.02


@pytest.mark.parametrize("away", [1.2, 40.0])
def test_feet_out_of_reach_are_an_error_that_names_the_frame(away):
    y = walker.TOE_HEIGHT
    steps = at_rest()
    steps.toe[25] = [[away, y, 0], [-away, y, 0]]
    with pytest.raises(ValueError, match=r"frame 2[0-9] \(0\.\d\d s\).*lower speed"):
        solve(steps)


def test_a_pelvis_on_its_ankles_is_an_error_not_a_wrong_toe():
    with pytest.raises(ValueError, match="too long for the legs|a leg is"):
        solve(at_rest(), dataclasses.replace(STIFF, crouch=0.8))
