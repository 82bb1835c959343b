import io

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmotion.data.builders import ball_base, base, soccer_x
from jaxmotion.motion.skeleton import forward_kinematics

# SMPL's kinematic tree.
PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19]
PARENTS += [20, 21]
OFFSETS = np.random.default_rng(5).normal(0, 0.2, (24, 3))
Z_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # of y-up vectors


def sequence(frames: int, seed: int, *, fps: float = 240, up: str = "y"):
    """Fields of a file; the motion is the same for both axes and rates."""
    generator = np.random.default_rng(seed)
    poses = generator.normal(0, 0.5, (frames, 24, 3))
    root, ball = generator.normal(size=(2, frames, 3))
    if up == "z":
        # SMPL's model origin, not the pelvis, is what turns with the axes.
        turned = Z_UP @ Rotation.from_rotvec(poses[:, 0]).as_matrix()
        poses[:, 0] = Rotation.from_matrix(turned).as_rotvec()
        root = (root + OFFSETS[0]) @ Z_UP.T - OFFSETS[0]
        ball = ball @ Z_UP.T
    return {
        "trans": root,
        "poses": poses.reshape(frames, 72),
        "ball_trans": ball,
        "fps": np.array(fps),
        "up": np.array(up),
    }


def as_bytes(fields) -> bytes:
    file = io.BytesIO()
    np.savez(file, **fields)
    return file.getvalue()


def write(folder, files):
    files = {"skeleton.npz": {"offsets": OFFSETS}, **files}
    for name, fields in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(as_bytes(fields))
    return folder


def build(tmp_path, files):
    builder = soccer_x.SoccerX(
        data_dir=str(tmp_path / "tfds"), file_format="array_record"
    )
    base.prepare(builder, write(tmp_path / "raw", files))
    return ball_base.ball_clips_from_source(builder)


def smpl_joints(fields):
    """Joints of a y-up sequence, by 4 x 4 products of rotation vectors."""
    poses = fields["poses"].reshape(-1, 24, 3)
    found = np.zeros((len(poses), 24, 4, 4))
    for frame, pose in enumerate(poses):
        for joint, parent in enumerate(PARENTS):
            step = np.eye(4)
            step[:3, :3] = Rotation.from_rotvec(pose[joint]).as_matrix()
            step[:3, 3] = OFFSETS[joint]
            if parent < 0:
                step[:3, 3] += fields["trans"][frame]
            above = np.eye(4) if parent < 0 else found[frame, parent]
            found[frame, joint] = above @ step
    return found[..., :3, 3]


@pytest.mark.parametrize("up", ["y", "z"])
def test_sequences_become_clips_with_a_ball(tmp_path, up):
    files = {
        "p1/dribble_left_001.npz": sequence(33, 0, up=up),
        "p1/off_ball/a.npz": sequence(4, 1, fps=30, up=up)
        | {"ball_rot": np.zeros((4, 3))},
    }
    found = build(tmp_path, files)
    people = found.clips
    assert people.clip_names == ("off_ball/a", "p1/dribble_left_001")
    assert people.names("skill") == soccer_x.SKILLS
    np.testing.assert_array_equal(people.labels["skill"], [5, 0])
    assert (people.fps, found.radius, found.joints) == (30.0, 0.11, (7, 8, 10, 11))
    feet = ["left_ankle", "right_ankle", "left_foot", "right_foot"]
    assert [people.skeleton.names[foot] for foot in people.skeleton.feet] == feet
    assert people.skeleton.parents == tuple(PARENTS)
    np.testing.assert_array_equal(people.offsets, [0, 4, 9])
    joints = forward_kinematics(
        people.skeleton, people.root_position, people.joint_rotation
    )
    short, long = sequence(4, 1), sequence(33, 0)
    expected = np.concatenate([smpl_joints(short), smpl_joints(long)[::8]])
    np.testing.assert_allclose(joints, expected, atol=2e-5)
    expected = np.concatenate([short["ball_trans"], long["ball_trans"][::8]])
    np.testing.assert_allclose(found.position, expected, atol=1e-6)


def test_a_foot_touches_the_ball_where_it_is_near_and_the_ball_changes_course():
    # The ball rolls at 3 m/s, is stopped in frame 10 and lies from there on.
    frames = np.arange(20)
    ball = np.stack([np.minimum(frames, 10) * 0.1, 0.11 + 0 * frames, 0 * frames], -1)
    joints = np.full((20, 4, 3), 5.0)
    joints[:, 1] = [1.0, 0.11, 0.15]  # 0.15 m beside the ball's end
    joints[:, 2] = [1.0, 0.11, 0.17]
    joints[:, 3] = ball + [0.0, 0.0, 0.1]  # always near
    expected = np.zeros((20, 4), bool)
    expected[10, [1, 3]] = True
    np.testing.assert_array_equal(soccer_x.ball_touch(joints, ball), expected)


def test_free_fall_is_no_touch_and_a_kick_is():
    time = np.arange(15) / 30
    height = 2.0 - 0.5 * 9.81 * time**2
    ball = np.stack([0 * time, height, 0 * time], axis=-1)
    joints = ball[:, None] + [[0.0, -0.1, 0.0]]
    assert not soccer_x.ball_touch(joints, ball).any()
    # A change of speed by v in one frame is an acceleration of 30 v.
    for speed, touches in ((0.05, False), (0.5, True)):
        kicked = ball + np.maximum(time - time[7], 0)[:, None] * [speed, 0.0, 0.0]
        found = soccer_x.ball_touch(joints, kicked)
        assert found[7, 0] == touches and found.sum() == touches


@pytest.mark.parametrize(
    ("path", "skill"),
    [
        ("x/shoot_1.npz", "shoot"),
        ("dribble/off_ball_3.npz", "off_ball"),
        ("a.zip/trick/007.npz", "trick"),
        (r"c:\data\stand\1.npz", "stand"),
    ],
)
def test_skills_come_from_names_or_folders(path, skill):
    assert soccer_x.read_skill(path) == skill


@pytest.mark.parametrize("path", ["x/shooting1.npz", "dribble/x/1.npz", "jump_1.npz"])
def test_names_without_a_skill_are_refused(path):
    with pytest.raises(ValueError, match=f"{path}: no skill.*dribble, trick, shoot"):
        soccer_x.read_skill(path)


def without(field):
    return lambda fields: {k: v for k, v in fields.items() if k != field}


def nan_at(field, row):
    def apply(fields):
        fields[field][row, 1] = np.nan
        return fields

    return apply


BAD = {
    "no trans": (without("trans"), "field 'trans' is missing"),
    "no fps": (without("fps"), "field 'fps' is missing"),
    "no up": (without("up"), "field 'up' is missing"),
    "smpl-x": (
        lambda fields: {**fields, "poses": np.zeros((33, 165))},
        r"field 'poses' has shape \(33, 165\), expected \(frames, 72\)",
    ),
    "lengths": (
        lambda fields: {**fields, "ball_trans": np.zeros((32, 3))},
        "field 'ball_trans' has 32 frames, 'trans' has 33",
    ),
    "axes": (
        lambda fields: {**fields, "poses": np.zeros((33, 24, 3))},
        "field 'poses' should have 2 axes",
    ),
    "nan": (nan_at("ball_trans", 7), "field 'ball_trans' is not within .*in row 7"),
    "fps": (
        lambda fields: {**fields, "fps": np.array(60)},
        "field 'fps' is 60, expected 240 or 30",
    ),
    "up": (
        lambda fields: {**fields, "up": np.array("x")},
        "field 'up' is x, expected 'y' or 'z'",
    ),
    "short": (
        lambda fields: {**fields, **sequence(16, 0)},
        "2 frames at 30 per second, expected at least 3",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_sequences_are_named_with_the_field(case):
    change, message = BAD[case]
    data = as_bytes(change(sequence(33, 0)))
    skeleton = soccer_x.read_skeleton("s.npz", as_bytes({"offsets": OFFSETS}))
    with pytest.raises(ValueError, match=f"a/trick_1.npz: {message}"):
        soccer_x.read_sequence("a/trick_1.npz", data, skeleton)


def test_bad_skeletons_are_named(tmp_path):
    for fields, message in (
        ({"offsets": OFFSETS[:22]}, r"field 'offsets' has shape \(22, 3\)"),
        ({"joints": OFFSETS}, "field 'offsets' is missing"),
        ({"offsets": np.full((24, 3), np.inf)}, "field 'offsets' is not within"),
    ):
        with pytest.raises(ValueError, match=f"s.npz: {message}"):
            soccer_x.read_skeleton("s.npz", as_bytes(fields))
    files = {"p1/skeleton.npz": {"offsets": OFFSETS}, "stand_1.npz": sequence(9, 0)}
    with pytest.raises(ValueError, match=r"a second skeleton.npz, expected one"):
        build(tmp_path, files)


def test_a_folder_without_a_skeleton_or_sequences_is_refused(tmp_path):
    source = write(tmp_path / "raw", {"stand_1.npz": sequence(33, 0)})
    builder = soccer_x.SoccerX(
        data_dir=str(tmp_path / "tfds"), file_format="array_record"
    )
    (source / "skeleton.npz").rename(source / "bones.txt")
    with pytest.raises(FileNotFoundError, match=r"\*skeleton.npz"):
        base.prepare(builder, source)
    (source / "bones.txt").rename(source / "skeleton.npz")
    (source / "stand_1.npz").unlink()
    with pytest.raises(FileNotFoundError, match="no sequences"):
        base.prepare(builder, source)
