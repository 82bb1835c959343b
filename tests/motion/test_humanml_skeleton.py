import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmotion.data import bvh, bvh_text
from jaxmotion.motion import humanml_layout, humanml_skeleton
from jaxmotion.motion.skeleton import Skeleton
from tests import mostly_slow, person, tiny
from tests.person import float32

SMPL = humanml_skeleton.SMPL_JOINTS
PARENTS = humanml_layout.HUMANML3D.parents
LAFAN1 = (
    *("Hips", "LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToe"),
    *("RightUpLeg", "RightLeg", "RightFoot", "RightToe"),
    *("Spine", "Spine1", "Spine2", "Neck", "Head"),
    *("LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand"),
    *("RightShoulder", "RightArm", "RightForeArm", "RightHand"),
)
BANDAI = (
    *("Hips", "Spine", "Chest", "Neck", "Head"),
    *("Shoulder_L", "UpperArm_L", "LowerArm_L", "Hand_L"),
    *("Shoulder_R", "UpperArm_R", "LowerArm_R", "Hand_R"),
    *("UpperLeg_L", "LowerLeg_L", "Foot_L", "Toes_L"),
    *("UpperLeg_R", "LowerLeg_R", "Foot_R", "Toes_R"),
)
FRAMES = 50

fit = humanml_skeleton.motion_from_joints


def rig(names):
    """A skeleton of which only the names matter."""
    return Skeleton(
        offsets=jnp.zeros((len(names), 3)),
        parents=tuple(range(-1, len(names) - 1)),
        names=tuple(names),
    )


def sources(names):
    """For each of the 22 joints the joints it is made of, with their weights."""
    mapping = np.asarray(humanml_skeleton.joint_mapping(rig(names)))
    return [{names[i]: float(row[i]) for i in np.flatnonzero(row)} for row in mapping]


# --- mapping -----------------------------------------------------------------------


def test_22_names_are_those_of_smpl_in_its_order():
    assert len(SMPL) == 22
    for left, right in [(1, 2), (4, 5), (7, 8), (10, 11), (13, 14), (16, 17), (18, 19)]:
        assert SMPL[right] == SMPL[left].replace("left", "right")
    assert [SMPL[i] for i in (0, 3, 6, 9, 12, 15, 20, 21)] == [
        *("pelvis", "spine1", "spine2", "spine3", "neck", "head"),
        *("left_wrist", "right_wrist"),
    ]


def test_smpl_maps_onto_itself_in_any_order_of_its_joints():
    np.testing.assert_array_equal(humanml_skeleton.joint_mapping(rig(SMPL)), np.eye(22))
    assert sources(SMPL[::-1]) == [{name: 1.0} for name in SMPL]


@pytest.mark.parametrize(
    ("prefix", "toe"), [("", "Toe"), ("mixamorig:", "ToeBase"), ("", "Toe_Base")]
)
def test_rigs_of_lafan1_and_mixamo(prefix, toe):
    names = [prefix + name.replace("Toe", toe) for name in LAFAN1]
    expected = [
        *("Hips", "LeftUpLeg", "RightUpLeg", "Spine", "LeftLeg", "RightLeg"),
        *("Spine1", "LeftFoot", "RightFoot", "Spine2", f"Left{toe}", f"Right{toe}"),
        *("Neck", "LeftShoulder", "RightShoulder", "Head", "LeftArm", "RightArm"),
        *("LeftForeArm", "RightForeArm", "LeftHand", "RightHand"),
    ]
    assert sources(names) == [{prefix + name: 1.0} for name in expected]


def test_rig_of_bandai_namco_lacks_a_spine_joint():
    expected = [
        *("Hips", "UpperLeg_L", "UpperLeg_R", None, "LowerLeg_L", "LowerLeg_R"),
        *("Spine", "Foot_L", "Foot_R", "Chest", "Toes_L", "Toes_R"),
        *("Neck", "Shoulder_L", "Shoulder_R", "Head", "UpperArm_L", "UpperArm_R"),
        *("LowerArm_L", "LowerArm_R", "Hand_L", "Hand_R"),
    ]
    found = sources(BANDAI)
    assert found[3] == {"Hips": 0.5, "Spine": 0.5}
    del found[3], expected[3]
    assert found == [{name: 1.0} for name in expected]


def test_other_joints_are_left_out():
    names = ("Root", *LAFAN1, "LeftHandThumb1")
    assert sources(names) == sources(LAFAN1)


def test_missing_joints_are_named():
    names = [name for name in BANDAI if name not in ("Chest", "Hand_R")]
    with pytest.raises(ValueError, match="also has chest, handr; the skeleton has Hi"):
        humanml_skeleton.joint_mapping(rig(names))


def test_mapped_joints_are_weighted_means():
    generator = np.random.default_rng(0)
    positions = generator.normal(size=(2, 3, 21, 3))
    mapping = humanml_skeleton.joint_mapping(rig(BANDAI))
    found = humanml_skeleton.mapped_joints(mapping, float32(positions))
    assert found.shape == (2, 3, 22, 3)
    np.testing.assert_allclose(
        found[:, :, 3], positions[:, :, :2].mean(axis=2), atol=1e-6
    )
    np.testing.assert_allclose(found[:, :, 15], positions[:, :, 4], atol=1e-6)


# --- fit ---------------------------------------------------------------------------


def rigid_clip(seed=0, swing=0.8):
    """World positions of a body with rigid bones, each joint of which turns."""
    generator = np.random.default_rng(seed)
    offsets = humanml_skeleton._REST * generator.uniform(0.1, 0.4, (22, 1))
    # Fans as people have them, not along the axes.
    offsets[1:4] += generator.normal(scale=0.04, size=(3, 3))
    offsets[12:15] += generator.normal(scale=0.04, size=(3, 3))
    time = np.arange(FRAMES) / 20.0
    vectors = person.waves(time, (22, 3), seed, swing)
    vectors[:, 0] += np.multiply.outer(2.0 * time, [0.0, 1.0, 0.0])
    matrices = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    root = person.waves(time, 3, seed + 1, 0.8) + [2.0, 1.0, 0.0]
    body = Skeleton(offsets=float32(offsets), parents=PARENTS, names=SMPL)
    motion = person.motion(root, matrices.reshape(FRAMES, 22, 3, 3), 20.0)
    return np.asarray(tiny.positions(body, motion), np.float64)


def lengths(positions):
    skeleton = positions[..., 1:, :] - positions[..., PARENTS[1:], :]
    return np.linalg.norm(skeleton, axis=-1)


def errors(positions):
    """Distances [F, 22] of the joints of the fitted motion."""
    skeleton, motion = fit(float32(positions), fps=20.0)
    found = np.asarray(tiny.positions(skeleton, motion), np.float64)
    return np.linalg.norm(found - positions, axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", mostly_slow(range(3), [0]))
def test_rigid_bodies_are_followed_exactly(seed):
    assert errors(rigid_clip(seed)).max() < 2e-5


def test_fit_is_a_skeleton_and_a_motion_of_the_22_joints():
    positions = rigid_clip()
    skeleton, motion = fit(float32(positions), fps=20.0)
    assert skeleton.names == SMPL
    assert skeleton.parents == PARENTS
    assert [skeleton.names[i] for i in skeleton.feet] == ["left_foot", "right_foot"]
    assert motion.fps == 20.0
    np.testing.assert_array_equal(motion.root_position, float32(positions[:, 0]))
    np.testing.assert_array_equal(skeleton.offsets[0], 0.0)
    # Leaves have no bone to aim.
    still = np.tile([1, 0, 0, 0, 1, 0], (FRAMES, 1))
    for leaf in (10, 11, 15, 20, 21):
        np.testing.assert_array_equal(motion.joint_rotation[:, leaf], still)


def test_bones_have_their_mean_lengths():
    positions = rigid_clip()
    stretch = 1.0 + 0.1 * np.sin(np.arange(FRAMES))[:, None, None]
    positions = positions * stretch
    skeleton, _ = fit(float32(positions), fps=20.0)
    np.testing.assert_allclose(
        np.linalg.norm(skeleton.offsets, axis=-1)[1:],
        lengths(positions).mean(axis=0),
        atol=1e-5,
    )


def test_rest_pose_is_a_t_that_faces_z():
    skeleton, _ = fit(float32(rigid_clip()), fps=20.0)
    rest = np.zeros((22, 3))
    for joint, parent in enumerate(PARENTS[1:], start=1):
        rest[joint] = rest[parent] + np.asarray(skeleton.offsets[joint])
    place = dict(zip(SMPL, rest, strict=True))
    assert place["left_wrist"][0] > place["left_elbow"][0] > place["left_shoulder"][0]
    assert place["right_wrist"][0] < place["right_elbow"][0] < 0.0
    np.testing.assert_allclose(place["left_wrist"][1:], place["left_collar"][1:])
    assert place["head"][1] > place["neck"][1] > place["spine3"][1] > 0.0
    assert place["left_ankle"][1] < place["left_knee"][1] < 0.0
    assert place["left_foot"][2] > place["left_ankle"][2]


def test_single_bones_swing_without_twist():
    # An arm in rest but for its elbow, which bends by the smallest rotation.
    skeleton, _ = fit(float32(rigid_clip()), fps=20.0)
    body = np.tile(np.eye(3), (FRAMES, 22, 1, 1))
    angle = np.linspace(0.1, 2.0, FRAMES)
    body[:, 18] = Rotation.from_rotvec(np.outer(angle, [0.0, -1.0, 0.0])).as_matrix()
    motion = person.motion(np.zeros((FRAMES, 3)), body, 20.0)
    _, found = fit(tiny.positions(skeleton, motion), fps=20.0)
    np.testing.assert_allclose(found.joint_rotation, motion.joint_rotation, atol=1e-4)


@pytest.mark.parametrize("noise", mostly_slow([0.005, 0.02], [0.02]))
def test_noisy_joints_are_followed_to_about_the_noise(noise):
    positions = rigid_clip(4)
    generator = np.random.default_rng(9)
    found = errors(positions + generator.normal(scale=noise, size=positions.shape))
    # A bone of the wrong length misses by about that length, however long the limb is:
    # aimed from the noisy joints instead, errors add up to twice as much.
    assert found.mean() < 1.4 * noise
    assert found[:, [20, 21]].mean() < 1.4 * noise


def mirrored_clip():
    """Hips that flip between left and right: no rotation follows both halves."""
    positions = rigid_clip(5, swing=0.1)
    positions[::2, :, 0] *= -1.0
    return positions


@pytest.mark.parametrize(
    "make",
    [
        mirrored_clip,
        lambda: np.zeros((FRAMES, 22, 3)),
        lambda: np.ones((FRAMES, 22, 3)) * np.arange(22)[:, None],
    ],
    ids=["mirrored", "a point", "a line"],
)
def test_rotations_are_proper_whatever_the_positions(make):
    _, motion = fit(float32(make()), fps=20.0)
    columns = np.asarray(motion.joint_rotation, np.float64).reshape(-1, 2, 3)
    products = np.einsum("nai,nbi->nab", columns, columns)
    np.testing.assert_allclose(
        products, np.tile(np.eye(2), (len(columns), 1, 1)), atol=1e-5
    )


def test_fan_of_a_mirrored_body_is_not_mirrored():
    rest = humanml_skeleton._REST[[1, 2, 3]] + [[0, 0, 0.3], [0, 0, 0.3], [0, 0, 0]]
    turn = Rotation.from_rotvec([0.3, 1.0, -0.4]).as_matrix()
    for sign in (1.0, -1.0):
        seen = rest * [1.0, 1.0, sign] @ turn.T
        found = np.asarray(
            humanml_skeleton._fan_rotation(float32(rest), float32(seen[None]))
        )[0]
        assert np.linalg.det(found) == pytest.approx(1.0, abs=1e-5)
        expected, _ = Rotation.align_vectors(seen, rest)
        np.testing.assert_allclose(found, expected.as_matrix(), atol=1e-5)


def test_export_as_bvh_has_the_same_joints():
    positions = rigid_clip(2)
    skeleton, motion = fit(float32(positions), fps=20.0)
    text = bvh_text.format_bvh(bvh.bvh_from_motion(skeleton, motion))
    read_bones, read = bvh.motion_from_bvh(bvh_text.parse_bvh(text))
    assert read.fps == pytest.approx(20.0)
    found = np.asarray(tiny.positions(read_bones, read))
    order = [read_bones.names.index(name) for name in SMPL]
    np.testing.assert_allclose(found[:, order], positions, atol=1e-4)


@pytest.mark.slow
def test_fit_maps_over_clips():
    clips = float32(np.stack([rigid_clip(0), rigid_clip(1)]))
    motion = jax.vmap(lambda clip: fit(clip, fps=20.0)[1])(clips)
    _, second = fit(clips[1], fps=20.0)
    np.testing.assert_allclose(
        motion.joint_rotation[1], second.joint_rotation, atol=1e-4
    )
