"""Robots: MuJoCo's own kinematics, limits and distances say what is right."""

import json
import sys

import jax
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxmotion as jm
from jaxmotion.motion import anatomy
from jaxmotion.retarget import robot, robot_motion
from jaxmotion.viz import capsules, stage
from tests.retarget import robots
from tests.viz import samples


@pytest.fixture(scope="module")
def walk():
    return samples.person(seconds=2.0, speed=1.2)


@pytest.fixture(scope="module")
def ours(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "ours.xml"
    path.write_text(robots.mjcf())
    return path


@pytest.fixture(scope="module")
def walked(ours, walk):
    return robot_motion.follow(robot.read_robot(ours), *walk)


def read(tmp_path, text, suffix=".xml"):
    path = tmp_path / f"x{suffix}"
    path.write_text(text)
    return robot.read_robot(path)


def with_ground(path):
    """The file's model on a plane, which MuJoCo measures distances from."""
    spec = mujoco.MjSpec.from_file(str(path))
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(name="ground", type=plane, size=[0, 0, 1])
    return spec.compile()


def distances(model, qpos):
    """[F, 2] of the feet's boxes from the ground."""
    data, found = mujoco.MjData(model), []
    ground = model.geom("ground").id
    for state in qpos:
        data.qpos[:] = state
        mujoco.mj_forward(model, data)
        found.append(
            [
                mujoco.mj_geomDistance(
                    model, data, ground, model.geom(f"{side}_foot").id, 1.0, None
                )
                for side in ("left", "right")
            ]
        )
    return np.array(found)


def test_axes_that_meet_are_a_persons_joints(ours):
    found = robot.read_robot(ours)
    rest, index = found.rest, found.rest.joint
    # Hips .1 to each side; yaw, roll and pitch meet .13 below the pelvis, thigh .36
    # and shank .38 below, the ankle's two axes .02 apart.
    offsets = np.asarray(rest.skeleton.offsets)
    np.testing.assert_allclose(offsets[index("leftUpperLeg")], [0.1, 0, 0], atol=1e-5)
    thigh, shank = rest.lengths(rest.anatomy.legs[0])
    assert abs(thigh - 0.36) < 0.021 and abs(shank - 0.39) < 0.021
    assert rest.lengths(rest.anatomy.arms[0]) == pytest.approx((0.24, 0.29), abs=0.04)
    np.testing.assert_allclose(offsets[index("leftToes")][2], 0.16, atol=1e-5)
    assert found.joint_names[:2] == ("left_hip_yaw_joint", "left_hip_roll_joint")
    assert found.body_names[0] == "pelvis" and len(found.body_names) == 22


def test_feet_stay_where_they_are_planted_and_limits_are_kept(ours, walked):
    low, high = walked.robot.limits.T
    assert (walked.joint_pos >= low).all() and (walked.joint_pos <= high).all()
    model = with_ground(ours)
    away = distances(model, walked.qpos)
    planted = walked.planted
    assert 0.3 < planted.mean() < 0.9 and planted.any(axis=0).all()
    assert np.abs(away[planted]).max() < 2e-3, "on the ground"
    assert away.min() > -2e-3, "and never below it"
    assert away.max() > 0.03, "they are lifted"
    # The box's front edge while it stands, by MuJoCo.
    data, edges = mujoco.MjData(model), []
    for state in walked.qpos:
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        edges.append(
            [
                data.geom(f"{s}_foot").xpos
                + data.geom(f"{s}_foot").xmat.reshape(3, 3) @ [0.11, 0, -0.02]
                for s in ("left", "right")
            ]
        )
    moved = np.linalg.norm(np.diff(np.array(edges)[..., :2], axis=0), axis=-1)
    both = planted[1:] & planted[:-1]
    assert moved[both].mean() * walked.fps < 0.01
    np.testing.assert_allclose(walked.soles[..., 2], np.array(edges)[..., 0], atol=1e-5)


def test_hands_do_not_go_through_the_body(ours, walked):
    model = mujoco.MjModel.from_xml_path(str(ours))
    data, deepest = mujoco.MjData(model), 0.0
    for state in walked.qpos:
        data.qpos[:] = state
        mujoco.mj_forward(model, data)
        for contact in data.contact:
            bodies = model.geom_bodyid[[contact.geom1, contact.geom2]]
            if any("elbow" in model.body(body).name for body in bodies):
                deepest = min(deepest, contact.dist)
    assert deepest > -2e-3


def test_it_goes_where_the_person_goes_in_lengths_of_the_leg(walk, walked):
    skeleton, motion = walk
    function = jm.retarget(skeleton, walked.robot.rest, motion=motion)
    person = np.asarray(motion.root_position)
    root = walked.bodies[0][:, 0]
    way = person[-1, [2, 0]] - person[0, [2, 0]]
    np.testing.assert_allclose(
        root[-1, :2] - root[0, :2], function.scale * way, atol=0.08
    )
    # It faces where it goes: +z is MuJoCo's +x.
    turn = Rotation.from_quat(np.roll(walked.bodies[1][:, 0], -1, axis=-1))
    ahead = anatomy.kinematics(skeleton, motion)[1][:, 0, [2, 0], 2]
    ahead = ahead[np.minimum(np.arange(len(root)) * motion.fps / 50.0, 59).astype(int)]
    assert np.sum(turn.apply([1, 0, 0])[:, :2] * ahead, axis=-1).min() > 0.95
    knees = [n for n, name in enumerate(walked.robot.joint_names) if "knee" in name]
    assert walked.joint_pos[:, knees].min() > 0, "bent, to the right side"


def test_velocities_are_the_differences_of_places(walked):
    places, quats, velocities, spins = walked.bodies
    step = 2 / walked.fps
    found = (places[2:] - places[:-2]) / step
    away = np.abs(velocities[1:-1] - found)
    assert away.mean() < 0.01 and np.percentile(away, 99.5) < 0.1
    turns = Rotation.from_quat(np.roll(quats.reshape(-1, 4), -1, axis=-1))
    shape = quats.shape[:2]
    index = np.arange(np.prod(shape)).reshape(shape)
    between = turns[index[2:].ravel()] * turns[index[:-2].ravel()].inv()
    found = between.as_rotvec().reshape(-1, shape[1], 3) / step
    assert np.abs(spins[1:-1] - found).mean() < 0.03
    speed = walked.joint_pos[2:] - walked.joint_pos[:-2]
    np.testing.assert_allclose(walked.joint_vel[1:-1], speed / step, atol=1e-9)


def test_the_file_is_what_mjlab_reads(ours, walk, walked, tmp_path):
    path = tmp_path / "below" / "walk.npz"
    jm.save(path, *walk, robot=ours)
    content = np.load(path)
    frames, joints, bodies = len(walked.qpos), 22, 22
    # As its MotionLoader does.
    for field, shape in {
        "joint_pos": (joints,),
        "joint_vel": (joints,),
        "body_pos_w": (bodies, 3),
        "body_quat_w": (bodies, 4),
        "body_lin_vel_w": (bodies, 3),
        "body_ang_vel_w": (bodies, 3),
    }.items():
        assert content[field].shape == (frames, *shape)
        assert content[field].dtype == np.float32 and np.isfinite(content[field]).all()
    assert content["fps"].tolist() == [50.0]
    # Replayed by name in MuJoCo's own model: every body is where the file says.
    model = mujoco.MjModel.from_xml_path(str(ours))
    data = mujoco.MjData(model)
    for frame in range(0, frames, 9):
        data.qpos[:7] = [
            *content["body_pos_w"][frame, 0],
            *content["body_quat_w"][frame, 0],
        ]
        for name, value in zip(
            content["joint_names"], content["joint_pos"][frame], strict=True
        ):
            data.joint(str(name)).qpos = value
        mujoco.mj_kinematics(model, data)
        for name, place in zip(
            content["body_names"], content["body_pos_w"][frame], strict=True
        ):
            np.testing.assert_allclose(data.body(str(name)).xpos, place, atol=1e-5)
    report = json.loads(str(content["report"]))
    assert report["frames"] == frames and report["fastest_limit"] is None
    np.testing.assert_array_equal(content["foot_contact"], walked.planted)


def test_what_it_cannot_do_is_limited_and_counted(walk, tmp_path):
    servo = '<velocity joint="left_knee_joint" kv="1" ctrlrange="-3 3"/>'
    stiff = read(tmp_path, robots.mjcf(tight=0.25, servos=servo))
    found = robot_motion.follow(stiff, *walk)
    low, high = stiff.limits.T
    assert (found.joint_pos >= low).all() and (found.joint_pos <= high).all()
    report = found.report()
    near = np.minimum(found.joint_pos - low, high - found.joint_pos).min(axis=1) < 1e-3
    assert report["at_limit"] == pytest.approx(near.mean()) and near.mean() > 0.5
    assert any("knee" in name for name in report["limited"])
    knee = stiff.joint_names.index("left_knee_joint")
    assert stiff.speeds[knee] == 3.0
    steps = np.abs(np.diff(found.joint_pos[:, knee])) * found.fps
    assert steps.max() < 3.0 + 1e-6


def test_a_urdf_gets_its_free_joint_and_its_speeds(walk, tmp_path):
    found = read(tmp_path, robots.urdf(velocity=4.0), ".urdf")
    assert (found.speeds == 4.0).all() and len(found.joint_names) == 20
    moved = robot_motion.follow(found, *walk)
    steps = np.abs(np.diff(moved.joint_pos, axis=0)) * moved.fps
    assert steps.max() < 4.0 + 1e-6
    assert moved.report()["fastest_limit"] == 4.0


@pytest.mark.parametrize("facing", [90.0, -135.0])
def test_which_way_the_file_faces_does_not_matter(walk, walked, tmp_path, facing):
    turned = read(tmp_path, robots.mjcf(facing=facing))
    moved = robot_motion.follow(turned, *walk)
    np.testing.assert_allclose(moved.joint_pos, walked.joint_pos, atol=0.02)
    np.testing.assert_allclose(moved.bodies[0], walked.bodies[0], atol=0.01)


def test_other_frame_rates_and_other_bodies_in_the_scene(walk, tmp_path):
    ball = (
        '<body name="ball" pos="1 0 1"><freejoint/><geom size=".1"/></body>'
        '<geom name="floor" type="plane" size="5 5 1"/>'
    )
    found = read(tmp_path, robots.mjcf(extra=ball))
    assert found.body_names[0] == "pelvis" and "ball" not in found.body_names
    slow = robot_motion.follow(found, *walk, fps=25.0)
    assert slow.fps == 25.0 and len(slow.qpos) == 50
    still = np.tile([1.0, 0.0, 1.0], (50, 1))
    np.testing.assert_allclose(slow.qpos[:, :3], still, atol=1e-9)


def test_bodies_may_be_told(tmp_path):
    text = robots.mjcf().replace("hip_pitch_link", "a").replace("knee_link", "b")
    text = text.replace("ankle_roll_link", "c").replace("shoulder_yaw_link", "d")
    path, given = tmp_path / "x.xml", {}
    path.write_text(text.replace("elbow_link", "e"))
    for side in ("left", "right"):
        names = dict(UpperLeg="a", LowerLeg="b", Foot="c", UpperArm="d", LowerArm="e")
        given |= {f"{side}{role}": f"{side}_{name}" for role, name in names.items()}
        given[f"{side}Hand"] = f"{side}_e"
    with pytest.raises(ValueError, match=r"x\.xml: no person: missing"):
        robot.read_robot(path)
    found = robot.read_robot(path, given)
    bodies = {role: found.model.body(n).name for role, n in found.bodies.items()}
    assert given.items() <= bodies.items() and bodies["hips"] == "pelvis"


def test_bodies_need_no_names(tmp_path):
    """The pelvis, and another body before it: marks are on those of the roles."""
    path = tmp_path / "x.xml"
    text = robots.mjcf().replace(' name="pelvis"', "")
    at = text.index("<worldbody>") + len("<worldbody>")
    other = '<body pos="3 0 0"><geom type="sphere" size=".1"/></body>'
    path.write_text(text[:at] + other + text[at:])
    found = robot.read_robot(path)
    assert found.model.body(found.bodies["hips"]).name == ""
    for role, body in found.bodies.items():
        assert found.model.site(robot.MARK + role).bodyid[0] == body


WRONG = {
    "free joint": (robots.mjcf(free=False), "no free joint: expected a robot that"),
    "legs": (robots.mjcf(legs=False), "no person: missing leftUpperLeg"),
    "quadruped": (robots.quadruped(), "no person: missing"),
    "include": ('<mujoco><include file="gone.xml"/></mujoco>', "gone.xml"),
    "mesh": ('<mujoco><asset><mesh file="gone.stl"/></asset></mujoco>', "gone.stl"),
    "empty": ("", "MuJoCo reads no MJCF or URDF"),
    "other": ("<svg/>", "MuJoCo reads no MJCF or URDF"),
    "attribute": ('<mujoco><worldbody foo="1"/></mujoco>', "foo"),
    "feet": (robots.mjcf(foot=""), "mass and inertia"),
    "ball": (
        robots.mjcf().replace('axis="0 1 0" range="-2.4 0.0"', 'type="ball"'),
        "joint 'left_elbow_joint' is a ball, expected hinges",
    ),
    "lying": (
        robots.mjcf().replace('pos="0 0 .96" euler="0 0', 'pos="0 0 .96" euler="0 1.5'),
        "stands on its feet in the zero pose",
    ),
    "no knees": (
        robots.mjcf().replace(
            '<joint name="left_knee_joint" axis="0 1 0" range="-0.1 2.4"/>', ""
        ),
        "no joint moves the lower part of the limb of left foot",
    ),
}


@pytest.mark.parametrize("what", WRONG)
def test_bad_files_end_with_one_line(what, tmp_path):
    text, message = WRONG[what]
    with pytest.raises(ValueError) as error:
        read(tmp_path, text)
    words = str(error.value)
    assert words.startswith(str(tmp_path / "x.xml")) and "\n" not in words
    assert message in words


def test_bad_arguments_end_with_one_line(ours, walk, tmp_path, monkeypatch):
    skeleton, motion = walk
    found = robot.read_robot(ours)
    many = jax.tree.map(lambda x: x[None], motion)
    with pytest.raises(ValueError, match="at least two frames of one character"):
        robot_motion.follow(found, skeleton, many)
    with pytest.raises(ValueError, match="fps is nan, expected 1 to 1000"):
        robot_motion.follow(found, skeleton, motion, fps=float("nan"))
    with pytest.raises(FileNotFoundError, match=r"gone\.xml"):
        robot.read_robot(tmp_path / "gone.xml")
    for path, more in (("x.glb", {}), ("x.npz", {"onto": "y.glb"})):
        with pytest.raises(ValueError, match=r"a robot's motion is an \.npz"):
            jm.save(tmp_path / path, skeleton, motion, robot=ours, **more)
    monkeypatch.setitem(sys.modules, "mink", None)
    with pytest.raises(ModuleNotFoundError, match=r'pip install -e "\.\[robot\]"'):
        robot.read_robot(ours)


def test_without_opengl_it_is_drawn_as_capsules(walked):
    skeleton, motion = walked.as_skeleton()
    places = anatomy.kinematics(skeleton, motion)[0]
    np.testing.assert_allclose(places, walked.bodies[0] @ robot.WORLD, atol=1e-4)
    joints, ends, radii = robot.capsules(walked.robot)
    foot = skeleton.names.index("left_ankle_roll_link")
    assert 0.02 < radii[joints.tolist().index(foot)] < 0.06
    body = capsules.describe(skeleton, joints, ends, radii)
    shown = stage.make_stage(skeleton, motion, body=body)
    vertices = shown.body.skin(shown.positions, shown.rotations)[0][0]
    assert -0.06 < vertices[..., 1].min() < 0.03, "stands on the ground"
    assert 1.2 < np.ptp(vertices[0, :, 1]) < 1.6
