import pickle

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmotion.data.builders import base, humanact12, humanml3d
from jaxmotion.motion.skeleton import forward_kinematics

WHOLE = "a person waves.#a/DET person/NOUN wave/VERB#0.0#0.0\n"
TEXTS = {
    "000001": WHOLE + "he steps back#he/PRON step/VERB back/ADV#1.0#3.5\n",
    "M000001": WHOLE + "someone waves#someone/PRON wave/VERB#nan#nan\n",
    "000002": WHOLE,
    "000003": "too short a part#part/NOUN#1.0#1.5\n",
    "000004": WHOLE,
    "000005": WHOLE,
    "000006": WHOLE,
}
LENGTHS = {
    "000001": 100,
    "M000001": 100,
    "000002": 39,  # too short for HumanML3D
    "000003": 60,
    "000004": 200,  # too long
    "000005": 199,
    "000006": 40,
}
LISTS = {
    "train": ["M000001", "000001", "000002", "000003"],
    "val": ["000004", "000005"],
    "test": ["000006"],
}


def features(name, width):
    generator = np.random.default_rng(int(name[1:]) + len(name))
    return generator.normal(size=(LENGTHS[name], width))  # float64, as published


def put(tmp_path, width=263, inner="HumanML3D"):
    """The published layout; returns the folder with the lists."""
    folder = tmp_path / "raw" / inner
    for part in ("new_joint_vecs", "texts"):
        (folder / part).mkdir(parents=True)
    for name, text in TEXTS.items():
        path = folder / "new_joint_vecs" / f"{name}.npy"
        np.save(path, features(name, width))
        (folder / "texts" / f"{name}.txt").write_text(text, encoding="utf-8")
    for split, names in LISTS.items():
        (folder / f"{split}.txt").write_text("\n".join(names) + "\n")
    np.save(folder / "Mean.npy", np.arange(width) / 10)
    np.save(folder / "Std.npy", np.arange(width) / 7 + 0.3)
    return folder


def build(tmp_path, config="humanml3d"):
    builder = humanml3d.HumanML3D(
        config=config, data_dir=str(tmp_path / "tfds"), file_format="array_record"
    )
    return base.prepare(builder, tmp_path / "raw")


def test_humanml3d_is_read_cut_and_selected(tmp_path):
    put(tmp_path)
    found = humanml3d.text_motions_from_source(build(tmp_path))
    names = ("000001", "000001_line2", "M000001", "000005", "000006")
    assert found.clip_names == names
    np.testing.assert_array_equal(found.split, [0, 0, 0, 1, 2])
    np.testing.assert_array_equal(np.diff(found.offsets), [100, 50, 100, 199, 40])
    np.testing.assert_array_equal(found.caption_clip, [0, 1, 2, 2, 3, 4])
    assert found.captions[1] == "he steps back"
    assert found.tokens[1] == "he/PRON step/VERB back/ADV"
    whole = features("000001", 263).astype(np.float32)
    np.testing.assert_array_equal(found.features[:100], whole)
    np.testing.assert_array_equal(found.features[100:150], whole[20:70])
    np.testing.assert_array_equal(found.mean, np.float32(np.arange(263) / 10))
    np.testing.assert_array_equal(found.std, np.float32(np.arange(263) / 7 + 0.3))
    assert found.fps == 20.0 and "HumanML3D" in found.source


def test_kit_ml_has_its_own_width_rate_and_lengths(tmp_path):
    put(tmp_path, 251, inner=".")
    builder = build(tmp_path, "kit_ml")
    found = humanml3d.text_motions_from_source(builder)
    assert found.num_features == 251 and found.fps == 12.5
    # 000002 has 39 frames; the part of 0.5 s has 10 at the released 20 per second.
    assert "000002" in found.clip_names and "000003_line1" not in found.clip_names
    lengths = dict(zip(found.clip_names, np.diff(found.offsets), strict=True))
    assert lengths["000001_line2"] == 50
    own = humanml3d.text_motions_from_source(builder, cut_fps=12.5)
    lengths = dict(zip(own.clip_names, np.diff(own.offsets), strict=True))
    assert lengths["000001_line2"] == 43 - 12


def test_a_prepared_set_is_read_without_its_files(tmp_path):
    folder = put(tmp_path)
    build(tmp_path)
    for path in folder.glob("*.npy"):
        path.unlink()
    found = humanml3d.text_motions_from_source(build(tmp_path))
    assert found.num_clips == 5 and found.std[7] == np.float32(1.3)


def test_recordings_with_nan_are_dropped_and_named(tmp_path, caplog):
    folder = put(tmp_path)
    broken = features("M000001", 263)
    broken[50, 3] = np.nan
    np.save(folder / "new_joint_vecs" / "M000001.npy", broken)
    found = humanml3d.text_motions_from_source(build(tmp_path))
    assert "M000001" not in found.clip_names and found.num_clips == 4
    assert "1 recordings with NaN dropped: M000001" in caplog.text


def write(name, text):
    return lambda folder: (folder / name).write_text(text)


def save(name, array):
    return lambda folder: np.save(folder / name, array)


def remove(name):
    return lambda folder: (folder / name).unlink()


BAD = {
    "width": (
        save("new_joint_vecs/000001.npy", np.zeros((50, 251))),
        r"000001.npy: expected frames of 263 features, found shape \(50, 251\)",
    ),
    "integers": (
        save("new_joint_vecs/000001.npy", np.zeros((50, 263), int)),
        "000001.npy: not a feature file, or a damaged one .expected floating",
    ),
    "objects": (
        save("new_joint_vecs/000001.npy", np.array([{}], dtype=object)),
        "000001.npy: not a feature file, or a damaged",
    ),
    "damaged": (
        write("new_joint_vecs/000001.npy", "x"),
        "000001.npy: not a feature file, or a damaged",
    ),
    "no features": (
        remove("new_joint_vecs/M000001.npy"),
        r"train.txt: 1 names have no file in new_joint_vecs: M000001 \(line 1\)",
    ),
    "no text": (remove("texts/000001.txt"), "000001.txt: no such file"),
    "no tags": (
        write("texts/000001.txt", "a man waves\n"),
        "000001.txt, line 1: expected caption#",
    ),
    "no lines": (write("texts/000001.txt", "\n"), "000001.txt: no captions"),
    "bytes": (
        lambda folder: (folder / "texts/000001.txt").write_bytes(b"\xff"),
        "000001.txt: not UTF-8",
    ),
    "std zero": (
        save("Std.npy", np.where(np.arange(263) == 9, 0.0, 1.0)),
        r"Std.npy: channels \[9\] are not positive",
    ),
    "mean short": (save("Mean.npy", np.ones(251)), "Mean.npy: expected 263 numbers"),
    "no mean": (remove("Mean.npy"), "Mean.npy: no such file"),
    "no list": (remove("val.txt"), "val.txt: no such file"),
    "empty list": (write("val.txt", "\n"), "val.txt: no names"),
    "listed twice": (
        write("test.txt", "000006\n000001\n"),
        "test.txt, line 2: '000001' is also in train.txt, line 2",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_wrong_is_named(tmp_path, case):
    change, message = BAD[case]
    change(put(tmp_path))
    with pytest.raises(ValueError, match=message):
        build(tmp_path)


def test_other_folders_are_named(tmp_path):
    put(tmp_path)
    put(tmp_path, inner="KIT-ML")
    with pytest.raises(
        FileNotFoundError, match="raw: expected new_joint_vecs.*found 2"
    ):
        build(tmp_path)


PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14]
PARENTS += [16, 17, 18, 19, 20, 21]


def smpl_clip(seed, num_frames, bones):
    """Rotation vectors and the joint positions that they and the bones make."""
    generator = np.random.default_rng(seed)
    vectors = generator.uniform(-1.5, 1.5, (num_frames, 24, 3))
    positions = np.zeros((num_frames, 24, 3))
    positions[:, 0] = generator.normal(size=(num_frames, 3))
    for frame in range(num_frames):
        world = [Rotation.from_rotvec(vectors[frame, 0])]
        for joint in range(1, 24):
            p = PARENTS[joint]
            positions[frame, joint] = positions[frame, p] + world[p].apply(bones[joint])
            world.append(world[p] * Rotation.from_rotvec(vectors[frame, joint]))
    return vectors.reshape(num_frames, 72), positions


@pytest.fixture(scope="module")
def act():
    """Three clips of one body, the published fields."""
    bones = np.random.default_rng(9).normal(size=(24, 3)) * 0.2
    pairs = [smpl_clip(seed, frames, bones) for seed, frames in enumerate((4, 3, 5))]
    content = {
        "poses": [pose for pose, _ in pairs],
        "joints3D": [joints for _, joints in pairs],
        "y": [11, np.int64(0), 8],
        "oldvid": ["a", "b", "c"],
    }
    return bones, content


def build_act(tmp_path, content):
    folder = tmp_path / "raw"
    folder.mkdir()
    (folder / "humanact12poses.pkl").write_bytes(pickle.dumps(content, 2))
    builder = humanact12.Humanact12(
        data_dir=str(tmp_path / "tfds"), file_format="array_record"
    )
    return base.clips_from_source(base.prepare(builder, folder))


def test_humanact12_poses_become_clips(tmp_path, act):
    bones, content = act
    found = build_act(tmp_path, content)
    names = ("clip0000_throw", "clip0001_warm_up", "clip0002_turn_steering_wheel")
    assert found.clip_names == names
    assert found.names("action") == humanact12.ACTIONS and len(humanact12.ACTIONS) == 12
    np.testing.assert_array_equal(found.labels["action"], [11, 0, 8])
    assert found.fps == 20.0
    assert found.skeleton.parents == tuple(PARENTS)
    assert [found.skeleton.names[foot] for foot in found.skeleton.feet] == [
        "left_foot",
        "right_foot",
    ]
    np.testing.assert_allclose(found.skeleton.offsets[1:], bones[1:], atol=1e-6)
    joints = forward_kinematics(
        found.skeleton, found.root_position, found.joint_rotation
    )
    np.testing.assert_allclose(joints, np.concatenate(content["joints3D"]), atol=1e-5)


def test_bones_of_different_bodies_are_averaged_over_frames(act):
    bones, content = act
    pose, joints = smpl_clip(5, 4, bones * 1.1)
    skeleton = humanact12.fit_skeleton(
        [content["poses"][0], pose], [content["joints3D"][0], joints]
    )
    np.testing.assert_allclose(skeleton.offsets[1:], 1.05 * bones[1:], atol=1e-6)


def first(field, value):
    return lambda content: {**content, field: [value, *content[field][1:]]}


BAD_ACT = {
    "list": (lambda content: [1], "expected a dictionary, found list"),
    "field": (
        lambda content: {"poses": content["poses"], "y": content["y"]},
        "no field 'joints3D'; it has poses, y",
    ),
    "counts": (
        lambda content: {**content, "y": [1]},
        "3 poses, 3 joints3D and 1 y",
    ),
    "width": (
        first("poses", np.zeros((4, 66))),
        r"poses\[0\].*\(frames, 72\).*\(4, 66",
    ),
    "frames": (first("poses", np.zeros((2, 72))), "clip 0 has 2 frames of poses and 4"),
    "nan": (
        first("joints3D", np.full((4, 24, 3), np.nan)),
        r"joints3D\[0\]: frame 0 is not finite",
    ),
    "no list": (lambda content: {**content, "y": 3}, "field 'y' should list one"),
    "word": (first("y", "run"), r"y\[0\] is 'run', expected 0..11"),
    "action": (first("y", 12), r"y\[0\] is 12, expected 0..11"),
}


@pytest.mark.parametrize("case", BAD_ACT)
def test_humanact12_names_what_is_wrong(act, case):
    change, message = BAD_ACT[case]
    data = pickle.dumps(change(act[1]))
    with pytest.raises(ValueError, match=f"h.pkl: .*{message}|h.pkl: {message}"):
        humanact12.read_clips("h.pkl", data)


class Evil:
    def __reduce__(self):
        return print, ("harm",)


def test_humanact12_runs_nothing(tmp_path, act, capsys):
    with pytest.raises(ValueError, match="humanact12poses.pkl.*__builtin__.print"):
        build_act(tmp_path, {**act[1], "oldvid": [Evil()]})
    assert "harm" not in capsys.readouterr().out
