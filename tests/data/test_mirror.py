import dataclasses
import re

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmotion.data import mirror
from jaxmotion.data.clips import take_clips
from jaxmotion.motion import skeleton as skeletons
from tests import tiny
from tests.data import samples

PARTNER = np.array([0, 1, 4, 5, 2, 3])
RIGS = {"plain": samples.PLAIN, "turned": samples.TURNED}


@pytest.mark.parametrize("rig", RIGS)
def test_joints_of_the_mirror_image_are_the_mirrored_joints(rig):
    skeleton, motion = samples.skeleton(RIGS[rig]), samples.motion(6, 0)
    found = mirror.mirror(skeleton, motion)
    before = np.asarray(tiny.positions(skeleton, motion))
    after = np.asarray(tiny.positions(skeleton, found))
    np.testing.assert_allclose(after, before[:, PARTNER] * [-1, 1, 1], atol=2e-6)
    assert np.abs(np.asarray(found.joint_rotation - motion.joint_rotation)).max() > 0.5


@pytest.mark.parametrize("rig", RIGS)
def test_mirroring_twice_is_the_identity_to_the_bit(rig):
    skeleton, motion = samples.skeleton(RIGS[rig]), samples.motion(6, 1)
    twice = mirror.mirror(skeleton, mirror.mirror(skeleton, motion))
    np.testing.assert_array_equal(twice.joint_rotation, motion.joint_rotation)
    np.testing.assert_array_equal(twice.root_position, motion.root_position)


def test_plain_rig_equals_quaternions_with_y_and_z_negated():
    # The mirroring of CAMDM's released code, for a rig whose axes are the world's.
    skeleton, motion = samples.skeleton(), samples.motion(5, 2)
    x, y = (
        np.asarray(motion.joint_rotation, np.float64).reshape(-1, 2, 3).swapaxes(0, 1)
    )
    quaternion = Rotation.from_matrix(
        np.stack([x, y, np.cross(x, y)], axis=-1)
    ).as_quat()
    matrix = Rotation.from_quat(quaternion * [1, -1, -1, 1]).as_matrix()
    expected = samples.columns(matrix.reshape(5, 6, 3, 3))[:, PARTNER]
    found = mirror.mirror(skeleton, motion).joint_rotation
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_mirrored_global_rotations_are_reflections_of_the_partners():
    skeleton, motion = samples.skeleton(samples.TURNED), samples.motion(4, 3)
    plan = mirror.mirror_plan(skeleton)
    found = mirror.mirror(skeleton, motion, plan=plan)
    turns = [
        np.asarray(
            skeletons.global_transforms(skeleton, m.root_position, m.joint_rotation)[1]
        )
        for m in (motion, found)
    ]
    for joint in range(6):
        own = np.diag(plan.signs[joint])
        assert np.linalg.det(own) == -1
        expected = np.diag([-1.0, 1, 1]) @ turns[0][:, PARTNER[joint]] @ own
        np.testing.assert_allclose(turns[1][:, joint], expected, atol=2e-6)


def test_a_reference_motion_settles_the_twist():
    # The leaves have no bones, so any reflection puts them in place; the motion, which
    # is symmetric under the reflection chosen here, says which one is meant.
    skeleton = samples.skeleton(samples.TURNED)
    expected = np.array(mirror.mirror_plan(skeleton).signs)
    expected[[3, 5]] = [-1, 1, 1]
    plan = mirror.MirrorPlan(
        partner=tuple(PARTNER.tolist()), signs=tuple(map(tuple, expected.tolist()))
    )
    half = samples.motion(40, 4)
    # Rotations near the identity: a distribution with a clear mean.
    turns = Rotation.from_rotvec(np.random.default_rng(0).normal(0, 0.3, (240, 3)))
    rot6d = samples.columns(turns.as_matrix().reshape(40, 6, 3, 3))
    half = dataclasses.replace(half, joint_rotation=jnp.array(rot6d, jnp.float32))
    other = mirror.mirror(skeleton, half, plan=plan)
    both = dataclasses.replace(
        half,
        root_position=jnp.concatenate([half.root_position, other.root_position]),
        joint_rotation=jnp.concatenate([half.joint_rotation, other.joint_rotation]),
    )
    found = mirror.mirror_plan(skeleton, motion=both)
    assert found.signs[3] == found.signs[5] == (-1.0, 1.0, 1.0)
    assert mirror.mirror_plan(skeleton).signs[3] != (-1.0, 1.0, 1.0)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("LeftArm", "RightArm"),
        ("mixamorig:RightFoot", "mixamorig:LeftFoot"),
        ("leftarm", "rightarm"),
        ("LEFT_ARM", "RIGHT_ARM"),
        ("Hand_L", "Hand_R"),
        ("R_Hand", "L_Hand"),
        ("hand.r", "hand.l"),
        ("bone_l_knee", "bone_r_knee"),
        ("lHip", "rHip"),
        ("RThumb", "LThumb"),
        ("HandL", "HandR"),
        ("walk-turn-left", "walk-turn-right"),
        ("WristLeft", "WristRight"),
        ("ARM_LEFT", "ARM_RIGHT"),
        ("handleft", "handright"),
        ("turn left upright", "turn right upright"),
        *((x, x) for x in ("upright", "bright", "very_bright", "frightened", "cleft")),
        ("Spine", "Spine"),
        ("Root", "Root"),
        ("joint_Root", "joint_Root"),
    ],
)
def test_sides_in_names(name, expected):
    assert mirror.swap_sides(name) == expected
    assert mirror.swap_sides(expected) == name


def test_pairs_can_be_given():
    base = samples.skeleton()
    skeleton = dataclasses.replace(base, names=("a", "b", "c", "d", "e", "f"))
    plan = mirror.mirror_plan(skeleton, pairs=(("c", "e"), ("d", "f")))
    assert plan == mirror.mirror_plan(base)
    with pytest.raises(ValueError, match="'c' and 'e'.*|'d' and 'd'.*no pair"):
        mirror.mirror_plan(skeleton, pairs=(("c", "e"),))
    with pytest.raises(ValueError, match="unknown joint 'x'"):
        mirror.mirror_plan(skeleton, pairs=(("c", "x"),))


def test_small_asymmetry_passes_and_large_is_refused_by_joint():
    offsets = np.array(samples.PLAIN)
    offsets[5, 1] += 0.008
    skeleton, motion = samples.skeleton(offsets), samples.motion(4, 5)
    found = mirror.mirror(skeleton, motion)
    before = np.asarray(tiny.positions(skeleton, motion))
    after = np.asarray(tiny.positions(skeleton, found))
    assert np.abs(after - before[:, PARTNER] * [-1, 1, 1]).max() < 0.009
    offsets[5, 1] += 0.01
    with pytest.raises(ValueError, match="not symmetric at joint 'LeftLeg'.*0.018"):
        mirror.mirror_plan(samples.skeleton(offsets))


def test_missing_partners_and_other_joints_are_refused():
    base = samples.skeleton()
    skeleton = dataclasses.replace(base, names=(*base.names[:5], "Tail"))
    with pytest.raises(ValueError, match="'LeftToe' has no partner 'RightToe'"):
        mirror.mirror_plan(skeleton)
    with pytest.raises(ValueError, match="5 joints, the plan 6"):
        mirror.mirror(base, samples.motion(4, 6, num_joints=5))


def test_mirrored_clips_swap_labels_and_get_names():
    clips = samples.clips()
    found = mirror.mirror_clips(clips)
    assert found.names("content") == ("turn-left", "walk", "turn-right")
    np.testing.assert_array_equal(found.labels["content"], [2] * 3 + [1] * 5)
    np.testing.assert_array_equal(found.labels["style"], clips.labels["style"])
    assert found.clip_names[0] == "clip0_mirrored"
    np.testing.assert_array_equal(
        found.root_position, np.asarray(clips.root_position) * [-1, 1, 1]
    )
    again = mirror.mirror_clips(found)
    assert again.clip_names == clips.clip_names
    np.testing.assert_array_equal(again.joint_rotation, clips.joint_rotation)
    np.testing.assert_array_equal(again.labels["content"], clips.labels["content"])


def test_only_clips_without_an_image_get_one():
    clips = samples.clips()
    both = mirror.with_mirrored(clips)
    assert both.num_clips == 2 * clips.num_clips
    assert mirror.with_mirrored(both) is both
    some = take_clips(both, [0, 1, 8, 10])  # 0 has its image, 2 is one without a clip
    found = mirror.with_mirrored(some)
    assert found.clip_names[4:] == ("clip1_mirrored", "clip2")
    np.testing.assert_array_equal(
        found.root_position[found.offsets[5] :],
        clips.root_position[clips.offsets[2] : clips.offsets[3]],
    )


@pytest.mark.parametrize(
    "name, other",
    [("RUN", "RUN"), ("LIMP", "LIMP"), ("LHip", "RHip"), ("rKnee", "lKnee")],
)
def test_words_in_capitals_name_no_side(name, other):
    assert mirror.swap_sides(name) == other


def test_joints_in_capitals_are_partners():
    base = samples.skeleton()
    names = [re.sub("^(L|R)(?:eft|ight)(.*)", r"\1\2", x).upper() for x in base.names]
    plan = mirror.mirror_plan(dataclasses.replace(base, names=tuple(names)))
    assert plan.partner == mirror.mirror_plan(base).partner
