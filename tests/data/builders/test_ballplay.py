import io

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmotion.data.builders import ball_base, ballplay, base
from jaxmotion.motion.facing import hip_facing
from jaxmotion.motion.skeleton import forward_kinematics

# The file's joints, and their parents as a list of numbers.
SIDE = "Thorax Shoulder Elbow Wrist".split()
SIDE += [f"{f}{i}" for f in "Index Middle Pinky Ring Thumb".split() for i in (1, 2, 3)]
NAMES = "Pelvis L_Hip L_Knee L_Ankle L_Toe R_Hip R_Knee R_Ankle R_Toe".split()
NAMES += "Torso Spine Spine2 Chest Neck Head".split()
NAMES += [f"{side}_{name}" for side in "LR" for name in SIDE]
PARENTS = [-1, 0, 1, 2, 3, 0, 5, 6, 7, 0, 9, 10, 11, 12, 13]
for first in (15, 34):
    PARENTS += [12, first, first + 1, first + 2]
    for finger in range(5):
        start = first + 4 + 3 * finger
        PARENTS += [first + 3, start, start + 1]
LENGTHS = (7, 4, 5)
CLIPS = ("take2_run", "take1__exp3", "take3_catch")
LABELS = ("run", "exp3_mini", "catch")
BODY = [*range(19), *range(34, 38)]


def y_up(vectors):
    x, y, z = np.moveaxis(np.asarray(vectors), -1, 0)
    return np.stack([x, z, -y], axis=-1)


def content(wobble: float = 0.0) -> dict[str, np.ndarray]:
    """A file of three clips; its rotations are off by about `wobble` radians."""
    generator = np.random.default_rng(0)
    frames = sum(LENGTHS)
    offsets = generator.normal(0, 0.15, (53, 3))
    local = Rotation.from_rotvec(generator.normal(0, 0.4, (frames * 53, 3)))
    local = local.as_matrix().reshape(frames, 53, 3, 3)
    world, position = [local[:, 0]], [generator.normal(size=(frames, 3))]
    for joint in range(1, 53):
        parent = PARENTS[joint]
        position.append(position[parent] + world[parent] @ offsets[joint])
        world.append(world[parent] @ local[:, joint])
    noise = Rotation.from_rotvec(generator.normal(0, wobble, (frames * 53, 3)))
    published = local @ noise.as_matrix().reshape(local.shape)
    vectors = Rotation.from_matrix(published.reshape(-1, 3, 3)).as_rotvec()
    vectors = vectors.reshape(frames, 53, 3).astype(np.float32)
    position = np.stack(position, axis=1)
    # The ball is nearer to the left wrist in the first ten frames.
    wrist = np.where(np.arange(frames) < 10, NAMES.index("L_Wrist"), 37)
    ball = position[np.arange(frames), wrist] + [0.0, 0.0, 0.01]
    contact = np.zeros(frames, bool)
    contact[[1, 4, 8, 12]] = True
    return {
        "body_position": position.astype(np.float32),
        "root_position": position[:, 0].astype(np.float32),
        "root_rotation_expmap": vectors[:, 0],
        "joint_rotation_expmap": vectors[:, 1:],
        "ball_position": ball.astype(np.float32),
        "hand_ball_contact": contact,
        "clip_offset": np.cumsum([0, *LENGTHS]),
        "clip_name": np.array(CLIPS),
        "clip_label": np.array(LABELS),
        "body_name": np.array(NAMES),
        "fps": np.float32(60.0),
    }


def as_bytes(fields) -> bytes:
    file = io.BytesIO()
    np.savez(file, **fields)
    return file.getvalue()


def write(folder, fields):
    folder.mkdir(exist_ok=True)
    (folder / "ballplay_m.npz").write_bytes(as_bytes(fields))
    return folder


def build(tmp_path, fields):
    builder = ballplay.Ballplay(
        data_dir=str(tmp_path / "tfds"), file_format="array_record"
    )
    base.prepare(builder, write(tmp_path / "raw", fields))
    return ball_base.ball_clips_from_source(builder)


# The file's clips in the order of their names, and every second frame of each.
ORDER = [1, 0, 2]
FRAMES = [7, 9, 0, 2, 4, 6, 11, 13, 15]


def test_the_file_becomes_clips_with_a_ball(tmp_path):
    fields = content()
    found = build(tmp_path, fields)
    clips = found.clips
    assert clips.clip_names == tuple(CLIPS[i] for i in ORDER)
    np.testing.assert_array_equal(clips.offsets, [0, 2, 6, 9])
    assert clips.names("skill") == ("catch", "other", "run")
    np.testing.assert_array_equal(clips.labels["skill"], [1, 2, 0])
    assert (clips.fps, found.radius) == (30.0, 0.112)
    assert "Apache-2.0" in clips.source
    skeleton = clips.skeleton
    assert skeleton.names == tuple(NAMES[joint] for joint in BODY)
    assert [skeleton.names[foot] for foot in skeleton.feet] == ["L_Toe", "R_Toe"]
    assert [skeleton.names[j] for j in found.joints] == ["L_Wrist", "R_Wrist"]
    np.testing.assert_allclose(
        found.position, y_up(fields["ball_position"][FRAMES]), atol=1e-6
    )
    # Contacts of file frames 1, 4, 8 and 12 are those of 0, 4, 7 and 11, whose ball is
    # at the left wrist in the first three.
    touch = np.zeros((9, 2), bool)
    touch[[FRAMES.index(frame) for frame in (0, 4, 7)], 0] = True
    touch[FRAMES.index(11), 1] = True
    np.testing.assert_array_equal(found.touch, touch)


@pytest.mark.parametrize("wobble", [0.0, 0.05])
def test_joints_are_where_the_file_has_them(tmp_path, wobble):
    fields = content(wobble)
    clips = build(tmp_path, fields).clips
    joints = forward_kinematics(
        clips.skeleton, clips.root_position, clips.joint_rotation
    )
    expected = y_up(fields["body_position"][FRAMES][:, BODY])
    np.testing.assert_allclose(joints, expected, atol=2e-4)
    # Left hip - right hip, crossed with up.
    across = expected[:, 1] - expected[:, 5]
    forward = np.stack([-across[:, 2], across[:, 0]], axis=-1)
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    facing = hip_facing(clips.skeleton, clips.joint_rotation)
    np.testing.assert_allclose(facing, forward, atol=1e-3)


def test_rotations_that_fit_are_kept(tmp_path):
    fields = content()
    clips = build(tmp_path, fields).clips
    vectors = fields["joint_rotation_expmap"][FRAMES]
    local = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    local = local.reshape(9, 52, 3, 3)[:, np.array(BODY[1:]) - 1]
    expected = np.concatenate([local[..., 0], local[..., 1]], axis=-1)
    np.testing.assert_allclose(clips.joint_rotation[:, 1:], expected, atol=1e-4)
    turn = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    root = Rotation.from_rotvec(fields["root_rotation_expmap"][FRAMES]).as_matrix()
    expected = np.concatenate([(turn @ root)[..., 0], (turn @ root)[..., 1]], axis=-1)
    np.testing.assert_allclose(clips.joint_rotation[:, 0], expected, atol=1e-4)


def changed(field, change):
    def apply(fields):
        value = np.array(fields[field])
        return {**fields, field: change(value)}

    return apply


def put(index, new):
    def apply(value):
        value[index] = new
        return value

    return apply


BAD = {
    "missing": (
        lambda fields: {k: v for k, v in fields.items() if k != "ball_position"},
        "field 'ball_position' is missing",
    ),
    "short": (
        changed("ball_position", lambda x: x[:-1]),
        r"field 'ball_position' has shape \(15, 3\), expected \(16, 3\)",
    ),
    "joints": (
        changed("joint_rotation_expmap", lambda x: x[:, 1:]),
        r"field 'joint_rotation_expmap' has shape \(16, 51, 3\)",
    ),
    "labels": (
        changed("clip_label", lambda x: x[1:]),
        r"field 'clip_label' has shape \(2,\), expected \(3,\)",
    ),
    "kind": (
        changed("hand_ball_contact", lambda x: x.astype(np.float32)),
        "field 'hand_ball_contact' should have 1 axes of kind 'b'",
    ),
    "nan": (
        changed("body_position", put((5, 2, 1), np.nan)),
        "field 'body_position' of frame 5 is not within",
    ),
    "infinite": (
        changed("root_rotation_expmap", put((3, 0), np.inf)),
        "field 'root_rotation_expmap' of frame 3 is not within",
    ),
    "descending": (
        changed("clip_offset", put(1, 12)),
        "field 'clip_offset' should ascend from 0 to 16, found 0, 12, 11, 16",
    ),
    "end": (changed("clip_offset", put(3, 15)), "'clip_offset' should ascend .* 16"),
    "names": (
        changed("body_name", put(1, "Left_Hip")),
        "field 'body_name' should list 53 joints",
    ),
    "fps": (changed("fps", lambda x: x / 2), "field 'fps' is 30.0, expected 60"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_named_with_the_field(case):
    change, message = BAD[case]
    with pytest.raises(ValueError, match=f"b.npz: {message}|b.npz: .*{message}"):
        ballplay.read_fields("b.npz", as_bytes(change(content())))


def test_bones_that_stretch_are_refused(tmp_path):
    # Frame 4 is read; frame 5, between two, is not.
    fields = changed("body_position", put((4, 4, 2), 9.0))(content())
    message = "ballplay_m.npz: field 'body_position': bones are not rigid, L_Toe of"
    with pytest.raises(ValueError, match=f"{message} frame 4"):
        build(tmp_path, fields)


def test_a_missing_or_damaged_file_is_named(tmp_path):
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw" / "other.txt").write_text("x")
    builder = ballplay.Ballplay(
        data_dir=str(tmp_path / "tfds"), file_format="array_record"
    )
    with pytest.raises(FileNotFoundError, match=r"raw.*\*ballplay_m.npz"):
        base.prepare(builder, tmp_path / "raw")
    with pytest.raises(ValueError, match="b.npz: not a BallPlay-M file"):
        ballplay.read_fields("b.npz", as_bytes(content())[:-100])


def test_the_tree_is_the_one_written_here():
    assert list(ballplay.NAMES) == NAMES
    assert list(ballplay.PARENTS) == PARENTS
