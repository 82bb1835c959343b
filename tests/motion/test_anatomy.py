import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data.walker import walker_skeleton
from jaxmotion.motion import anatomy
from jaxmotion.motion.rotation import matrix_from_rot6d
from jaxmotion.motion.skeleton import Motion, Skeleton
from tests.retarget import rigs

# LaFAN1's convention: all bones along x, the zero pose is no pose of a person.
BONES = (
    ("Hips", None, (0, 0, 0)),
    ("LeftUpLeg", "Hips", (0, 0.02, 0.105)),
    ("LeftLeg", "LeftUpLeg", (0.435, 0, 0)),
    ("LeftFoot", "LeftLeg", (0.42, 0, 0)),
    ("LeftToe", "LeftFoot", (0.17, 0, 0)),
    ("RightUpLeg", "Hips", (0, 0.02, -0.105)),
    ("RightLeg", "RightUpLeg", (0.435, 0, 0)),
    ("RightFoot", "RightLeg", (0.42, 0, 0)),
    ("RightToe", "RightFoot", (0.17, 0, 0)),
    ("Spine", "Hips", (0.07, -0.03, 0)),
    ("Spine1", "Spine", (0.25, 0, 0)),
    ("Head", "Spine1", (0.37, 0, 0)),
    ("LeftShoulder", "Spine1", (0.2, -0.01, 0.06)),
    ("LeftArm", "LeftShoulder", (0.11, 0, 0)),
    ("LeftForeArm", "LeftArm", (0.33, 0, 0)),
    ("LeftHand", "LeftForeArm", (0.25, 0, 0)),
    ("RightShoulder", "Spine1", (0.2, -0.01, -0.06)),
    ("RightArm", "RightShoulder", (0.11, 0, 0)),
    ("RightForeArm", "RightArm", (0.33, 0, 0)),
    ("RightHand", "RightForeArm", (0.25, 0, 0)),
)


def along_x():
    names = [name for name, _, _ in BONES]
    return Skeleton(
        offsets=jnp.asarray([place for _, _, place in BONES], jnp.float32),
        parents=tuple(-1 if up is None else names.index(up) for _, up, _ in BONES),
        names=tuple(names),
    )


def test_sides_are_read_from_names():
    names = {
        "LeftArm": "left",
        "r_foot": "right",
        "mixamorig:RightLeg": "right",
        "hand_l": "left",
        "UpperArm_L": "left",
        "L_Wrist": "left",
        "rHip": "right",
        "l_uparm_JNT": "left",
        "Head": "middle",
        "C_pelvis_JNT": "middle",
        "Chest": "middle",
        "lowerback": "middle",
    }
    assert {name: anatomy.side_of(name) for name in names} == names


def test_limbs_of_a_person_are_found():
    skeleton = walker_skeleton()
    found = anatomy.find_anatomy(skeleton)
    name = lambda joints: [skeleton.names[j] for j in joints]  # noqa: E731
    assert name(found.trunk) == ["Hips", "Spine", "Spine1", "Spine2", "Neck", "Head"]
    arm = next(arm for arm in found.arms if arm.side == "left")
    assert name((*arm.before, arm.upper, arm.middle, arm.end)) == [
        "LeftShoulder",
        "LeftArm",
        "LeftForeArm",
        "LeftHand",
    ]
    leg = next(leg for leg in found.legs if leg.side == "right")
    assert name((leg.upper, leg.middle, leg.end, *leg.after)) == [
        "RightUpLeg",
        "RightLeg",
        "RightFoot",
        "RightToeBase",
    ]
    assert found.upright and not anatomy.find_anatomy(along_x()).upright


def test_both_legs_and_both_arms_may_leave_the_trunk_at_one_joint():
    base, forked = rigs.forked("child", "Mixamo")
    plain, found = anatomy.find_anatomy(base), anatomy.find_anatomy(forked)
    named = lambda one, limbs: [  # noqa: E731
        [one.names[j] for j in (x.upper, x.middle, x.end)] for x in limbs
    ]
    assert named(forked, found.legs) == named(base, plain.legs)
    assert named(forked, found.arms) == named(base, plain.arms)
    columns = [forked.index(name) for name in base.names[1:]]
    expected = anatomy.t_pose(base)[0][1:]
    np.testing.assert_allclose(anatomy.t_pose(forked)[0][columns], expected, atol=1e-6)
    names = anatomy.mixamo_names(forked)
    assert names[forked.index("mixamorig:LeftUpLeg")] == "mixamorig:LeftUpLeg"
    assert "mixamorig:Left" not in names


def test_a_t_pose_stands_faces_ahead_and_keeps_the_bones():
    for skeleton in (walker_skeleton(), along_x()):
        places, turns = anatomy.t_pose(skeleton)
        joint = lambda name, s=skeleton, p=places: p[s.index(name)]  # noqa: E731
        assert joint("Head")[1] > 0.4 and joint("LeftFoot")[1] < -0.8
        arm = joint("LeftHand") - joint("LeftArm")
        np.testing.assert_allclose(arm / np.linalg.norm(arm), [1, 0, 0], atol=1e-6)
        leg = joint("RightFoot") - joint("RightUpLeg")
        np.testing.assert_allclose(leg / np.linalg.norm(leg), [0, -1, 0], atol=1e-6)
        toe = places[skeleton.index("RightFoot") + 1] - joint("RightFoot")
        assert toe[2] > 0.1 and toe[1] < 0
        np.testing.assert_allclose(np.linalg.det(turns), 1, atol=1e-6)
        for j, parent in enumerate(skeleton.parents):
            if parent >= 0:
                bone = turns[parent] @ np.asarray(skeleton.offsets[j], float)
                np.testing.assert_allclose(places[j], places[parent] + bone, atol=1e-6)
    # A zero pose that is a T-pose stays as it is.
    np.testing.assert_allclose(anatomy.t_pose(walker_skeleton())[1], [np.eye(3)] * 22)


def test_a_motion_against_the_t_pose_has_the_same_positions():
    skeleton = along_x()
    draw = np.random.default_rng(0)
    motion = Motion(
        root_position=jnp.asarray(draw.normal(size=(4, 3)), jnp.float32),
        joint_rotation=jnp.asarray(draw.normal(size=(4, 20, 6)), jnp.float32),
    )
    changed, moved = anatomy.as_t_pose(skeleton, motion)
    np.testing.assert_allclose(
        anatomy.kinematics(changed, moved)[0],
        anatomy.kinematics(skeleton, motion)[0],
        atol=1e-5,
    )
    np.testing.assert_allclose(anatomy.t_pose(changed)[1], [np.eye(3)] * 20, atol=1e-3)


def test_elbows_bend_ahead_in_the_t_pose():
    """LaFAN1's zero pose does not tell how arms are turned; its motions do."""
    skeleton = along_x()
    columns = np.zeros((8, 20, 6), np.float32)
    columns[..., 0] = columns[..., 4] = 1.0
    bend = np.linspace(0.3, 1.2, 8)
    for name, sign in (("LeftForeArm", 1), ("RightForeArm", -1)):
        columns[:, skeleton.index(name), 0] = np.cos(bend)  # about an axis across x
        columns[:, skeleton.index(name), 2] = sign * np.sin(bend)
        columns[:, skeleton.index(name), 3:] = [0, 1, 0]
    motion = Motion(
        root_position=jnp.zeros((8, 3)), joint_rotation=jnp.asarray(columns)
    )
    _, moved = anatomy.as_t_pose(skeleton, motion)
    for name, sign in (("LeftForeArm", -1.0), ("RightForeArm", 1.0)):
        local = matrix_from_rot6d(moved.joint_rotation[:, skeleton.index(name)])
        # About -y for the arm at +x: the forearm comes to +z.
        np.testing.assert_allclose(local[:, 0, 2], sign * np.sin(bend), atol=1e-4)


def test_a_zero_pose_that_stands_is_believed_also_of_its_feet():
    """Whatever a motion does: here it stands on the edges of its feet."""
    skeleton, edges = walker_skeleton(), np.tile(np.eye(3), (6, 22, 1, 1))
    c, s = np.cos(0.5), np.sin(0.5)
    for name in ("LeftFoot", "RightFoot"):
        for joint in range(skeleton.index(name), skeleton.index(name) + 2):
            edges[:, joint] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    np.testing.assert_allclose(
        anatomy.t_pose(skeleton, motion=edges)[1], [np.eye(3)] * 22, atol=1e-6
    )


def test_a_trunk_without_a_head_ends_at_its_last_neck():
    parents, names = (-1, 0, 1, 2), ("Hips", "Neck", "Neck1", "Neck_end")
    found = anatomy.find_head(parents, names, ("middle",) * 4, np.arange(4.0))
    assert found == (2, False)


def test_joints_get_mixamo_names():
    names = anatomy.mixamo_names(along_x(), prefix="")
    changed = {"LeftToe": "LeftToeBase", "RightToe": "RightToeBase"}
    expected = [changed.get(name, name) for name, _, _ in BONES]
    assert list(names) == expected
    walker = walker_skeleton()
    odd = Skeleton(
        offsets=walker.offsets,
        parents=walker.parents,
        names=tuple(f"b{j}" for j in range(22)),
    )
    assert anatomy.mixamo_names(odd) == tuple("mixamorig:" + n for n in walker.names)
    with pytest.raises(ValueError, match="no two arms and two legs.*c"):
        anatomy.mixamo_names(
            Skeleton(offsets=jnp.zeros((2, 3)), parents=(-1, 0), names=("a", "c"))
        )
