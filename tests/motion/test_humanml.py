import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmotion.motion import humanml, humanml_layout
from jaxmotion.motion.features import unpack
from tests import person
from tests.person import float32
from tests.reference import humanml as reference

FRAMES = 240  # of nearly all clips, so that each layout is compiled once
HUMANML3D, KIT_ML = humanml_layout.HUMANML3D, humanml_layout.KIT_ML
PUBLISHED = dataclasses.replace(HUMANML3D, hip_weight=-1.0)
# Rotations are those of the world: while somebody faces -z, the swings of hips and
# collars are nearly half turns, which magnify the rounding of the positions.
TOLERANCE = dict.fromkeys((name for name, _, _ in HUMANML3D.channels.fields), 2e-5)
TOLERANCE["joint_rotation"] = 2e-3
each_layout = pytest.mark.parametrize("layout", [HUMANML3D, KIT_ML], ids=["t2m", "kit"])


def rest_pose(layout):
    """Somebody who stands about as the layout's rest directions say, facing +z."""
    lengths = np.random.default_rng(1).uniform(0.15, 0.35, layout.num_joints)
    lengths[list(layout.hips)] = 0.08
    pose = np.zeros((layout.num_joints, 3))
    for chain in layout.chains:
        for parent, joint in zip(chain[:-1], chain[1:], strict=True):
            pose[joint] = pose[parent] + lengths[joint] * np.array(
                layout.raw_offsets[joint]
            )
    if layout.chains == KIT_ML.chains:  # its rest directions have left at -x
        pose[:, 0] *= -1.0
    return pose


def wandering(layout, frames=FRAMES, turns=2.5, reach=3.0, seed=0, wobble=0.03):
    """Clip in which every joint moves and the person turns about more than once."""
    time = np.arange(frames) / 20.0
    pose = rest_pose(layout) + person.waves(
        time, (layout.num_joints, 3), seed, wobble
    ).reshape(frames, -1, 3)
    yaw = 0.7 + 2.0 * np.pi * turns * np.arange(frames) / frames
    root = person.waves(0.2 * time, 3, seed + 1, reach) * [1.0, 0.05, 1.0]
    turned = np.einsum("fij,fkj->fki", person.about_y(yaw), pose)
    return turned + root[:, None] + [5.0, 1.0, -2.0]


def expected_parts(joints, layout):
    return reference.features(
        joints,
        chains=layout.chains,
        raw_offsets=layout.raw_offsets,
        hips=layout.hips,
        shoulders=layout.shoulders,
        feet=layout.feet,
        threshold=layout.contact_threshold,
        weight=layout.hip_weight,
    )


def parts_of(joints, layout=HUMANML3D):
    vectors = humanml.features_from_joints(float32(joints), layout)
    return {k: np.asarray(v) for k, v in unpack(layout.channels, vectors).items()}


def round_trip(joints, layout):
    """Largest error of a coordinate, and the canonical joints."""
    canonical = np.asarray(humanml.canonical_joints(float32(joints), layout))
    vectors = humanml.features_from_joints(float32(joints), layout)
    found = humanml.joints_from_features(vectors, layout)
    return np.abs(np.asarray(found) - canonical[:-1]).max(), canonical


# --- layouts -----------------------------------------------------------------------


def test_22_joints_have_263_features_in_the_published_order():
    assert HUMANML3D.num_features == 263
    assert HUMANML3D.channels.fields == (
        ("root_yaw_velocity", 0, 1),
        ("root_velocity", 1, 3),
        ("root_height", 3, 4),
        ("joint_position", 4, 67),
        ("joint_rotation", 67, 193),
        ("joint_velocity", 193, 259),
        ("contact", 259, 263),
    )


def test_21_joints_of_kit_have_251_features():
    assert KIT_ML.num_joints == 21
    assert KIT_ML.num_features == 251


def test_parents_follow_from_the_chains():
    assert HUMANML3D.parents == (
        *(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8),
        *(9, 9, 9, 12, 13, 14, 16, 17, 18, 19),
    )
    assert KIT_ML.parents == (
        *(-1, 0, 1, 2, 3, 3, 5, 6, 3, 8, 9, 0, 11, 12, 13, 14, 0, 16, 17, 18, 19),
    )


@each_layout
def test_every_bone_has_a_unit_rest_direction(layout):
    lengths = np.linalg.norm(np.array(layout.raw_offsets), axis=-1)
    np.testing.assert_array_equal(lengths, [0.0, *np.ones(layout.num_joints - 1)])


# --- swings ------------------------------------------------------------------------


def test_minimal_swing_turns_by_the_angle_between():
    generator = np.random.default_rng(0)
    start, end = generator.normal(size=(2, 50, 3))
    start /= np.linalg.norm(start, axis=-1, keepdims=True)
    end /= np.linalg.norm(end, axis=-1, keepdims=True)
    found = np.asarray(humanml.minimal_swing(float32(start), float32(end)))
    np.testing.assert_allclose(np.einsum("nij,nj->ni", found, start), end, atol=1e-6)
    angle = Rotation.from_matrix(found).magnitude()
    np.testing.assert_allclose(
        angle, np.arccos(np.sum(start * end, axis=-1)), atol=1e-5
    )


@pytest.mark.parametrize("gap", [0.0, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3])
def test_minimal_swing_of_nearly_opposite_directions_is_a_rotation_between_them(gap):
    start = np.array([[1, 0, 0], [0, -1, 0], [0.6, 0, 0.8]])
    end = -start + gap * np.array([[0, 1, 0], [0, 0, 1], [0, 1, 0]])
    end /= np.linalg.norm(end, axis=-1, keepdims=True)
    found = np.asarray(humanml.minimal_swing(float32(start), float32(end)))
    np.testing.assert_allclose(np.einsum("nij,nj->ni", found, start), end, atol=2e-5)
    product = np.einsum("nij,nkj->nik", found, found)
    np.testing.assert_allclose(product, np.tile(np.eye(3), (3, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(found), 1.0, atol=1e-6)


# --- canonical clips ---------------------------------------------------------------


@each_layout
def test_canonical_joints_agree_with_the_reference(layout):
    joints = wandering(layout)
    found = humanml.canonical_joints(float32(joints), layout)
    expected = reference.canonical(joints, layout.hips, layout.shoulders)
    np.testing.assert_allclose(found, expected, atol=1e-5)


@each_layout
def test_canonical_clip_is_on_the_floor_at_the_origin_and_faces_z(layout):
    found = humanml.canonical_joints(float32(wandering(layout)), layout)
    found = np.asarray(found, np.float64)
    assert abs(found[..., 1].min()) < 1e-6
    np.testing.assert_allclose(found[0, 0, ::2], 0.0, atol=1e-6)
    (right_hip, left_hip), (right, left) = layout.hips, layout.shoulders
    pose = found[0]
    left_side = pose[left_hip] - pose[right_hip] + pose[left] - pose[right]
    forward = np.cross(left_side, [0.0, 1.0, 0.0])
    assert abs(forward[0]) < 1e-6
    assert forward[2] > 0.1
    again = humanml.canonical_joints(float32(found), layout)
    np.testing.assert_allclose(again, found, atol=1e-6)


@each_layout
def test_features_do_not_depend_on_where_the_clip_was(layout):
    joints = wandering(layout)
    moved = joints @ person.about_y(1.9).T + [2.0, -3.0, 1.0]
    found = parts_of(moved, layout)
    for name, part in parts_of(joints, layout).items():
        np.testing.assert_allclose(
            found[name], part, atol=TOLERANCE[name], err_msg=name
        )


# --- features ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "layout", [HUMANML3D, PUBLISHED, KIT_ML], ids=["t2m", "published", "kit"]
)
def test_features_agree_with_the_reference(layout):
    joints = wandering(layout)
    found, expected = parts_of(joints, layout), expected_parts(joints, layout)
    assert list(found) == list(expected)
    for name in expected:
        assert np.abs(expected[name]).max() > 0.01, name
        np.testing.assert_allclose(
            found[name], expected[name], atol=TOLERANCE[name], err_msg=name
        )


def test_swapped_hips_of_the_published_code_change_the_facing():
    joints = wandering(HUMANML3D)
    as_is, swapped = parts_of(joints), parts_of(joints, PUBLISHED)
    gap = np.abs(as_is["root_yaw_velocity"] - swapped["root_yaw_velocity"])
    assert gap.max() > 1e-3
    np.testing.assert_array_equal(as_is["contact"], swapped["contact"])


def test_walk_straight_ahead_is_its_speed_along_z():
    joints = np.tile(rest_pose(HUMANML3D), (FRAMES, 1, 1))
    way = (
        0.06
        * np.arange(FRAMES)[:, None, None]
        * np.array([np.sin(2.0), 0, np.cos(2.0)])
    )
    walk = joints @ person.about_y(2.0).T + way
    parts = parts_of(walk)
    np.testing.assert_allclose(
        parts["root_velocity"], np.tile([0.0, 0.06], (FRAMES - 1, 1)), atol=1e-5
    )
    np.testing.assert_allclose(parts["root_yaw_velocity"], 0.0, atol=1e-5)
    lowest = rest_pose(HUMANML3D)[:, 1].min()
    np.testing.assert_allclose(parts["root_height"], -lowest, atol=1e-5)
    velocity = parts["joint_velocity"].reshape(FRAMES - 1, 22, 3)
    np.testing.assert_allclose(
        velocity, np.tile([0.0, 0.0, 0.06], (FRAMES - 1, 22, 1)), atol=1e-5
    )
    np.testing.assert_allclose(
        parts["joint_position"].reshape(FRAMES - 1, 21, 3),
        np.tile((rest_pose(HUMANML3D) - [0, lowest, 0])[1:], (FRAMES - 1, 1, 1)),
        atol=1e-5,
    )


@pytest.mark.parametrize("rate", [0.05, -0.03])
def test_yaw_velocity_is_minus_half_the_turn_of_a_frame(rate):
    yaw = rate * np.arange(FRAMES)
    pose = np.tile(rest_pose(HUMANML3D), (FRAMES, 1, 1))
    parts = parts_of(np.einsum("fij,fkj->fki", person.about_y(yaw), pose))
    # 80 frames from the ends, where the filter does not see them; through +-pi.
    np.testing.assert_allclose(
        parts["root_yaw_velocity"][80:-80, 0], -0.5 * rate, atol=1e-6
    )


@each_layout
def test_rotations_along_the_chains_rebuild_the_pose(layout):
    joints = wandering(layout)
    canonical = reference.canonical(joints, layout.hips, layout.shoulders)
    turns = reference.root_rotations(
        canonical, layout.hips, layout.shoulders, layout.hip_weight
    )
    vectors = np.asarray(
        humanml.features_from_joints(float32(joints), layout), np.float64
    )
    for t in range(0, FRAMES - 1, 30):
        skeleton = canonical[t] - canonical[t][np.maximum(layout.parents, 0)]
        found = reference.joints_from_rotations(
            vectors[t],
            turns[t],
            canonical[t, 0],
            np.linalg.norm(skeleton, axis=-1),
            layout.chains,
            layout.raw_offsets,
        )
        np.testing.assert_allclose(found, canonical[t], atol=2e-5)


@pytest.mark.parametrize(
    ("joint", "channel"), [(7, 0), (10, 1), (8, 2), (11, 3), (4, None)]
)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_foot_stands_if_its_squared_step_is_below_the_threshold(joint, channel, axis):
    joints = np.tile(rest_pose(HUMANML3D), (FRAMES, 1, 1))
    step = np.sqrt(0.002)
    joints[2:, joint, axis] += 0.99 * step
    joints[4:, joint, axis] += 1.01 * step
    expected = np.ones((FRAMES - 1, 4))
    if channel is not None:
        expected[3, channel] = 0.0
    np.testing.assert_array_equal(parts_of(joints)["contact"], expected)


# --- the way back ------------------------------------------------------------------


@pytest.mark.parametrize(
    "layout", [HUMANML3D, PUBLISHED, KIT_ML], ids=["t2m", "published", "kit"]
)
@pytest.mark.parametrize("turns", [2.5, -1.3])
def test_features_of_240_frames_give_the_canonical_joints(layout, turns):
    joints = wandering(layout, turns=turns, seed=3)
    error, canonical = round_trip(joints, layout)
    assert error < 1e-5
    # It went somewhere and came to face every way.
    assert np.ptp(canonical[:, 0, 0]) > 2.0


def test_features_of_three_minutes_give_the_canonical_joints():
    joints = wandering(HUMANML3D, frames=3600, turns=10.0, reach=8.0)
    error, _ = round_trip(joints, HUMANML3D)
    assert error < 1e-4


def test_somebody_who_turns_about_in_one_frame_comes_back():
    joints = wandering(HUMANML3D, turns=0.0)
    joints[90:] *= [-1.0, 1.0, -1.0]
    error, _ = round_trip(joints, HUMANML3D)
    assert error < 1e-5


@each_layout
def test_way_back_agrees_with_running_sums_for_any_vectors(layout):
    vectors = np.random.default_rng(5).normal(size=(2, 3, 25, layout.num_features))
    vectors[..., :3] *= 0.3
    found = humanml.joints_from_features(float32(vectors), layout)
    assert found.shape == (2, 3, 25, layout.num_joints, 3)
    for index in np.ndindex(2, 3):
        expected = reference.joints(vectors[index], layout.num_joints)
        np.testing.assert_allclose(found[index], expected, atol=2e-5)


def test_way_back_reads_only_root_and_positions():
    vectors = np.random.default_rng(6).normal(size=(10, 263))
    before = humanml.joints_from_features(float32(vectors), HUMANML3D)
    vectors[:, 67:] += 1.0
    vectors[-1, :3] += 1.0  # leads to a frame that is not there
    after = humanml.joints_from_features(float32(vectors), HUMANML3D)
    np.testing.assert_array_equal(after, before)


def test_batches_are_clips_by_themselves():
    clips = [[wandering(HUMANML3D, seed=s + 2 * b) for s in (0, 1)] for b in (0, 1)]
    joints = float32(clips)
    vectors = humanml.features_from_joints(joints, HUMANML3D)
    assert vectors.shape == (2, 2, FRAMES - 1, 263)
    mapped = jax.vmap(lambda clip: humanml.features_from_joints(clip, HUMANML3D))(
        joints[:, 0]
    )
    single = humanml.features_from_joints(joints[1, 1], HUMANML3D)
    for found, expected in ((mapped, vectors[:, 0]), (single, vectors[1, 1])):
        np.testing.assert_allclose(found[..., :67], expected[..., :67], atol=1e-5)
        np.testing.assert_allclose(found[..., 67:], expected[..., 67:], atol=2e-3)


def test_what_is_at_rest_or_in_one_point_stays_finite():
    def error(vectors):
        return jnp.sum(humanml.joints_from_features(vectors, HUMANML3D) ** 2)

    assert np.all(np.isfinite(jax.grad(error)(jnp.zeros((4, 263)))))
    point = jnp.zeros((FRAMES, 22, 3))
    assert np.all(np.isfinite(humanml.features_from_joints(point, HUMANML3D)))


# --- bad input ---------------------------------------------------------------------


def test_another_number_of_joints_or_features_is_refused():
    joints = float32(wandering(KIT_ML, frames=5))
    with pytest.raises(ValueError, match="21 joints, expected 22"):
        humanml.features_from_joints(joints, HUMANML3D)
    with pytest.raises(ValueError, match="21 joints, expected 22"):
        humanml.canonical_joints(joints, HUMANML3D)
    with pytest.raises(ValueError, match="251 numbers, expected 263"):
        humanml.joints_from_features(jnp.zeros((5, 251)), HUMANML3D)


def test_one_frame_is_refused_and_two_give_one_vector():
    joints = float32(wandering(HUMANML3D, frames=2))
    assert humanml.features_from_joints(joints, HUMANML3D).shape == (1, 263)
    with pytest.raises(ValueError, match="1 frames, expected at least 2"):
        humanml.features_from_joints(joints[:1], HUMANML3D)
