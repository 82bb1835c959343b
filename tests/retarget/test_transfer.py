import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

import jaxmotion as jm
from jaxmotion.motion import anatomy
from jaxmotion.motion.skeleton import Motion, joint_positions
from jaxmotion.retarget import transfer
from tests.motion.test_anatomy import along_x
from tests.retarget import rigs
from tests.viz import samples


def walk(seconds=2.0, speed=1.4):
    return samples.person(seconds=seconds, speed=speed)


def places(skeleton, motion):
    return np.asarray(joint_positions(skeleton, motion))


def toes(function, side="target"):
    one = getattr(function, side)
    return [one.joint(side + "Toes") for side in ("left", "right")]


def test_onto_itself_a_motion_stays_as_it_is():
    skeleton, motion = walk()
    same = jm.retarget(skeleton, skeleton, motion=motion)(motion)
    away = np.linalg.norm(places(skeleton, same) - places(skeleton, motion), axis=-1)
    assert away.max() < 0.02 and away.mean() < 1e-3
    feet = toes(jm.retarget(skeleton, skeleton))
    assert away[:, feet].max() < 1e-3


def test_another_size_moves_as_a_scaled_copy():
    skeleton, motion = walk()
    half = dataclasses.replace(skeleton, offsets=0.5 * skeleton.offsets)
    function = jm.retarget(skeleton, half)
    assert abs(function.scale - 0.5) < 1e-6
    found, expected = places(half, function(motion)), 0.5 * places(skeleton, motion)
    assert np.linalg.norm(found - expected, axis=-1).max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("body", rigs.BODIES)
def test_planted_feet_stay_planted_and_out_of_the_ground(body):
    skeleton, motion = walk(seconds=3.0)
    target = rigs.proportioned(*rigs.BODIES[body])
    function = jm.retarget(skeleton, target, motion=motion)
    before, after = places(skeleton, motion), places(target, function(motion))
    low = before[1:, toes(function, "source"), 1] < 0.045
    assert 0.2 < low.mean() < 0.9
    slide = lambda p, feet: np.linalg.norm(  # noqa: E731
        np.diff(p[:, feet][..., [0, 2]], axis=0), axis=-1
    )
    source = slide(before, toes(function, "source"))[low].mean()
    made = slide(after, toes(function))[low].mean()
    assert made < 1.1 * function.scale * source + 1e-5
    rest = function.target
    for toe in toes(function):
        height = rest.places[toe, 1] - rest.sole
        assert after[:, toe, 1].min() > height - 0.003, "not below the ground"
    # Knees bend back, or not at all; bones keep their lengths.
    world = anatomy.kinematics(target, function(motion))[1]
    for leg in rest.anatomy.legs:
        hip, knee, ankle = (after[:, j] for j in (leg.upper, leg.middle, leg.end))
        thigh, shank = knee - hip, ankle - knee
        hinge = np.sum(np.cross(thigh, shank) * world[:, leg.upper, :, 0], axis=-1)
        assert hinge.min() > -1e-3
        for bone, length in zip((thigh, shank), rest.lengths(leg), strict=True):
            np.testing.assert_allclose(np.linalg.norm(bone, axis=-1), length, rtol=1e-4)


@pytest.mark.slow
def test_there_and_back_is_where_it_was():
    skeleton, motion = walk()
    target = rigs.person("child")
    there = jm.retarget(skeleton, target)
    back = jm.retarget(target, skeleton)
    away = np.linalg.norm(
        places(skeleton, back(there(motion))) - places(skeleton, motion), axis=-1
    )
    assert away.mean() < 0.004
    assert np.percentile(away, 95) < 0.01


@pytest.mark.slow
def test_other_rest_poses_and_axes_change_nothing_in_the_world():
    """An A-pose with joints of other axes moves as the T-pose does."""
    skeleton, motion = walk(1.0)
    straight = rigs.proportioned(1.1, 0.9, 1.0)
    posed = np.tile(np.eye(3), (22, 1, 1))
    for arm in anatomy.find_anatomy(straight).arms:
        angle = np.deg2rad(-50 if arm.side == "left" else 50)
        for j in range(22):
            if arm.upper in anatomy.chain(straight.parents, j):
                posed[j] = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    offsets = np.asarray(straight.offsets).copy()
    for j, parent in enumerate(straight.parents[1:], 1):
        offsets[j] = posed[parent] @ offsets[j]
    a_pose = dataclasses.replace(straight, offsets=jnp.asarray(offsets))
    found = places(a_pose, jm.retarget(skeleton, a_pose)(motion))
    expected = places(straight, jm.retarget(skeleton, straight)(motion))
    np.testing.assert_allclose(found, expected, atol=2e-3)


@pytest.mark.slow
def test_a_source_whose_zero_pose_is_none_moves_a_person():
    """LaFAN1's convention: bones along x."""
    skeleton = along_x()
    bind = anatomy.t_pose(skeleton)[1]
    motion = Motion(
        root_position=jnp.full((3, 3), jnp.array([0.0, 0.9, 0.0])),
        joint_rotation=anatomy.local_columns(skeleton.parents, np.stack([bind] * 3)),
        fps=30.0,
    )
    target = rigs.walker()
    found = places(target, jm.retarget(skeleton, target)(motion))
    expected = anatomy.t_pose(target)[0]
    found = found[1] - found[1, :1]
    np.testing.assert_allclose(found, expected, atol=0.02)


def best_middle(start, goal, pole, a, b, guess):
    """Of all middles of a limb, how far the farthest one is to the pole's side."""
    away = lambda point, far: {  # noqa: E731
        "type": "eq",
        "fun": lambda x: np.linalg.norm(x - point) - far,
    }
    limits = [away(start, a), away(goal, b)]
    return -minimize(lambda x: -((x - start) @ pole), guess, constraints=limits).fun


def test_two_bones_reach_as_an_optimizer_does():
    draw = np.random.default_rng(0)
    for _ in range(20):
        a, b = draw.uniform(0.2, 0.5, 2)
        start, pole = draw.normal(size=(2, 3))
        goal = start + draw.normal(size=3) * 0.3
        points = jnp.float32([start, goal, pole])[:, None, :, None]
        lengths = (jnp.full((1, 1, 1), x, jnp.float32) for x in (a, b))
        middle = np.asarray(transfer.two_bones(*points, *lengths), float)[0, :, 0]
        far = np.linalg.norm(goal - start)
        assert abs(np.linalg.norm(middle - start) - a) < 1e-4
        if abs(a - b) * 1.01 < far < 0.99 * (a + b):
            assert abs(np.linalg.norm(goal - middle) - b) < 1e-4
            best = best_middle(start, goal, pole, a, b, middle + 0.01)
            assert (middle - start) @ pole > best - 2e-3


@pytest.mark.slow
def test_it_is_jitted_and_mapped_over_characters_and_frames():
    skeleton, motion = walk(1.0)
    function = jm.retarget(skeleton, rigs.person("giant"))
    whole = function(motion)
    jitted = jax.jit(function.__call__)(motion)
    many = jax.tree.map(lambda x: jnp.stack([x, x]), motion)
    mapped = jax.vmap(function.__call__)(many)
    batched = function(many)
    one = jax.jit(function.pose)(motion.root_position[7], motion.joint_rotation[7])
    for name in ("root_position", "joint_rotation"):
        expected = np.asarray(getattr(whole, name))
        for found in (jitted, mapped[1], batched[0]):
            np.testing.assert_allclose(getattr(found, name), expected, atol=2e-5)
    np.testing.assert_allclose(one[0], whole.root_position[7], atol=2e-5)
    np.testing.assert_allclose(one[1], whole.joint_rotation[7], atol=2e-5)


@pytest.mark.slow
def test_other_clips_and_rigs_read_again_compile_nothing(monkeypatch):
    traced = []
    many = transfer.Retarget._many
    monkeypatch.setattr(
        transfer.Retarget,
        "_many",
        lambda self, *given: traced.append(given) or many(self, *given),
    )
    skeleton, motion = walk(1.0)
    for frames in (30, 17, 29):  # filled up to 32
        part = dataclasses.replace(
            motion,
            root_position=motion.root_position[:frames],
            joint_rotation=motion.joint_rotation[:frames],
        )
        function = jm.retarget(skeleton, rigs.person("long arms", "Unreal"))
        found = function(part)
        assert found.joint_rotation.shape[:-1] == (frames, skeleton.num_joints)
    assert len(traced) == 1
    whole = jax.jit(function.__call__)(motion)
    np.testing.assert_allclose(found.root_position, whole.root_position[:29], atol=1e-6)
    assert function != jm.retarget(skeleton, rigs.person("giant", "Unreal"))


def test_spines_of_other_numbers_of_joints_turn_as_far():
    skeleton, motion = walk(0.5)
    base = rigs.walker()
    # One spine joint instead of three.
    keep = [j for j, n in enumerate(base.names) if n not in ("Spine", "Spine1")]
    offsets = anatomy.zero_pose(base)[keep]
    parents = []
    for j in keep:
        up = base.parents[j]
        while up >= 0 and up not in keep:
            up = base.parents[up]
        parents.append(keep.index(up) if up >= 0 else -1)
    offsets = offsets - offsets[[max(p, 0) for p in parents]]
    short = rigs.plain(offsets, parents, tuple(base.names[j] for j in keep))
    function = jm.retarget(skeleton, short)
    rows, _ = transfer._sources(function.source, function.target)
    np.testing.assert_allclose(rows.sum(axis=1), 1.0)
    world = anatomy.kinematics(short, function(motion))[1]
    source = anatomy.kinematics(skeleton, motion)[1]
    for name in ("Hips", "Spine2", "Head", "LeftHand"):
        np.testing.assert_allclose(
            world[:, short.index(name)], source[:, skeleton.index(name)], atol=1e-3
        )


def test_twist_bones_take_their_part_and_fingers_stay():
    base = rigs.walker()
    names, parents = list(base.names), list(base.parents)
    offsets = np.asarray(base.offsets).tolist()
    for name, parent, offset in (
        ("LeftForeArmTwist", "LeftForeArm", [0.125, 0, 0]),
        ("LeftArmTwist", "LeftArm", [0.07, 0, 0]),
        ("LeftIndex", "LeftHand", [0.09, 0, 0]),
    ):
        parents.append(names.index(parent))
        names.append(name)
        offsets.append(offset)
    target = rigs.plain(offsets, parents, tuple(names))
    # The hand turns by 80 degrees about the forearm, the arm by 40 about itself.
    local = np.tile(np.eye(3), (1, 22, 1, 1))
    about = lambda d: Rotation.from_euler("x", d, degrees=True).as_matrix()  # noqa: E731
    local[0, base.index("LeftHand")] = about(80)
    local[0, base.index("LeftArm")] = about(40)
    motion = Motion(
        root_position=jnp.array([[0.0, 1.0, 0.0]]),
        joint_rotation=jnp.asarray(
            np.concatenate([local[..., 0], local[..., 1]], -1), jnp.float32
        ),
    )
    world = anatomy.kinematics(target, jm.retarget(base, target)(motion))[1][0]

    def angle(name, over):
        between = world[names.index(over)].T @ world[names.index(name)]
        return Rotation.from_matrix(between).as_rotvec(degrees=True)

    np.testing.assert_allclose(
        angle("LeftForeArmTwist", "LeftForeArm"), [40, 0, 0], atol=0.5
    )
    np.testing.assert_allclose(angle("LeftArmTwist", "LeftArm"), [-30, 0, 0], atol=0.5)
    np.testing.assert_allclose(angle("LeftIndex", "LeftHand"), 0.0, atol=0.1)


@pytest.mark.slow
def test_a_root_above_the_hips_is_only_moved():
    base = rigs.person("giant", "Unreal")
    names = ("root", *base.names)
    parents = (-1, *(p + 1 for p in base.parents))
    offsets = np.concatenate([np.zeros((1, 3)), np.asarray(base.offsets)])
    offsets[1] = [0, 1.4, 0]
    target = rigs.plain(offsets, parents, names)
    skeleton, motion = walk(0.5)
    made = jm.retarget(skeleton, target)(motion)
    plain = jm.retarget(skeleton, base)(motion)
    np.testing.assert_allclose(
        places(target, made)[:, 1:], places(base, plain), atol=1e-4
    )
    expected = np.tile([1.0, 0, 0, 0, 1, 0], (len(made.root_position), 1))
    np.testing.assert_allclose(made.joint_rotation[:, 0], expected, atol=1e-6)


@pytest.mark.slow
def test_limbs_may_hang_on_joints_beside_the_spine():
    base, forked = rigs.forked()
    skeleton, motion = walk(0.5)
    function, plain = jm.retarget(skeleton, forked), jm.retarget(skeleton, base)
    roles = function.target.roles
    assert (roles["hips"], roles["chest"]) == (
        "CC_Base_Hip",
        plain.target.roles["chest"],
    )
    sides = dict(zip(forked.names, function.target.anatomy.sides, strict=True))
    assert sides["thigh_l"] == "left" and sides["hand_r"] == "right"
    assert sides["pelvis"] == sides["CC_Base_Shoulders"] == "middle"
    columns = [forked.index(name) for name in base.names[1:]]
    np.testing.assert_allclose(
        places(forked, function(motion))[:, columns],
        places(base, plain(motion))[:, 1:],
        atol=1e-4,
    )
    for role, joint, line in (
        ("hips", "pelvis", r"'spine_\d+' does not hang on the hips \('pelvis'\)"),
        (
            "chest",
            "CC_Base_Shoulders",
            r"'head' does not hang on the chest \('CC_Base_S",
        ),
    ):
        with pytest.raises(ValueError, match=line):
            jm.retarget(skeleton, forked, roles={role: joint})


def test_feet_are_toes_or_else_ankles_where_the_skeleton_names_none():
    base = dataclasses.replace(rigs.person("child"), feet=())
    for names in (base.names, [x.replace("ToeBase", "Tip") for x in base.names]):
        skeleton = dataclasses.replace(base, names=tuple(names))
        found = transfer.rest(skeleton).skeleton.feet
        part = "ToeBase" if skeleton.names == base.names else "Foot"
        sides = [f"mixamorig:{side}{part}" for side in ("Left", "Right")]
        assert [skeleton.names[joint] for joint in found] == sides
    named = rigs.person("child")
    assert transfer.rest(named).skeleton.feet == named.feet


def test_bad_bones_are_named():
    base = rigs.walker()
    offsets = np.asarray(base.offsets).copy()
    offsets[base.index("LeftLeg")] = 0.0
    flat = dataclasses.replace(base, offsets=jnp.asarray(offsets))
    with pytest.raises(
        ValueError, match="target: the bone from 'LeftUpLeg' to 'LeftLeg'"
    ):
        jm.retarget(base, flat)
    with pytest.raises(ValueError, match="source: no person: missing"):
        jm.retarget(samples.figure(), base)
