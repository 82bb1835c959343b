import json
import re
import zipfile

import numpy as np
import pytest

from jaxmotion.data import bvh, bvh_text, clips
from jaxmotion.data.builders import bandai_namco, base, lafan1, o3de, style100
from jaxmotion.data.bvh_text import format_bvh
from tests import test_files
from tests.data import samples


def bandai_text(seed: int, num_frames: int = 4) -> str:
    """A file in the publisher's manner: six channels everywhere, a still joint_Root."""
    names = ("joint_Root", "Hips", "Toes_L", "Toes_R")
    parents = (-1, 0, 1, 1)
    generator = np.random.default_rng(seed)
    values = generator.uniform(-50, 50, (num_frames, 4, 6))
    values[:, 0] = 0.0
    values[:, 2:, :3] = [[1.0, -80.0, 2.0], [1.0, -80.0, -2.0]]
    six = ("Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation")
    content = bvh_text.Bvh(
        names=names,
        parents=parents,
        # OFFSET is the first frame's position here, so it differs from clip to clip.
        offsets=values[0, :, :3],
        channels=(six,) * 4,
        end_sites=((), (), ((0.0, 0.0, 0.0),), ((0.0, 0.0, 0.0),)),
        values=values.reshape(num_frames, 24),
        frame_time=0.0333333,
    )
    return format_bvh(content)


def bandai_files() -> dict[str, str]:
    """Set 2 with two clips, as the publisher lays it out."""
    lists = bandai_namco._CONTENTS["2"].split(), bandai_namco._STYLES["2"].split()
    top = "Bandai-Namco-Research-Motiondataset-2"
    files = {f"{top}/README.md": "x"}
    for field, names in zip(("content", "style"), lists, strict=True):
        text = "\n".join(f"dataset-2_{name}" for name in names)
        files[f"{top}/cfg/{field}_label.txt"] = text
    for seed, (content, style) in enumerate([("walk", "elderly"), ("run", "active")]):
        stem = f"{top}/data/dataset-2_{content}_{style}_001"
        ids = {"content": lists[0].index(content), "style": lists[1].index(style)}
        files |= {f"{stem}.bvh": bandai_text(seed), f"{stem}.json": json.dumps(ids)}
    return files


def put(folder, files, archive: str | None = None):
    """Writes files into a folder or into a zip in it; returns the folder."""
    folder.mkdir(exist_ok=True)
    if archive:
        with zipfile.ZipFile(folder / archive, "w") as file:
            for name, text in files.items():
                file.writestr(name, text)
        return folder
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def build(cls, tmp_path, source, config=None):
    builder = cls(
        config=config, data_dir=str(tmp_path / "tfds"), file_format="array_record"
    )
    return base.clips_from_source(base.prepare(builder, source))


def test_what_another_process_prepared_meanwhile_is_taken(tmp_path, monkeypatch):
    source = put(tmp_path / "raw", bandai_files())
    generate = bandai_namco.BandaiNamco._generate_examples

    def late(own, *args):
        yield from generate(own, *args)
        if not own.is_prepared():
            monkeypatch.setattr(type(own), "_generate_examples", generate)
            build(bandai_namco.BandaiNamco, tmp_path, source, "2")

    monkeypatch.setattr(bandai_namco.BandaiNamco, "_generate_examples", late)
    found = build(bandai_namco.BandaiNamco, tmp_path, source, "2")
    assert found.num_clips == 2


@pytest.mark.parametrize(
    "archive",
    [None, "Bandai-Namco-Research-Motiondataset-2.zip"],
    ids=["folder", "zip"],
)
def test_bandai_namco_reads_the_published_layout(tmp_path, archive):
    found = build(
        bandai_namco.BandaiNamco,
        tmp_path,
        put(tmp_path / "raw", bandai_files(), archive),
        "2",
    )
    assert found.clip_names == (
        "dataset-2_run_active_001",
        "dataset-2_walk_elderly_001",
    )
    assert found.names("content")[:4] == (
        "walk",
        "walk-turn-left",
        "walk-turn-right",
        "run",
    )
    np.testing.assert_array_equal(found.labels["content"], [3, 0])
    np.testing.assert_array_equal(found.labels["style"], [0, 1])
    assert found.skeleton.names == ("Hips", "Toes_L", "Toes_R")
    assert (found.skeleton.feet, found.fps) == ((1, 2), 30.0)
    assert "CC BY-NC 4.0" in found.source
    offsets = [[0, 0, 0], [0.01, -0.8, 0.02], [0.01, -0.8, -0.02]]
    np.testing.assert_allclose(found.skeleton.offsets, offsets, atol=1e-6)
    # Clip 1 is the walk, written with seed 0; its bytes come through unchanged.
    walk = bvh.motion_from_bvh(bvh_text.parse_bvh(bandai_text(0)), root="Hips")[1]
    np.testing.assert_array_equal(
        clips.clip_motion(found, 1).joint_rotation, walk.joint_rotation
    )
    np.testing.assert_array_equal(
        clips.clip_motion(found, 1).root_position, walk.root_position
    )


def broken(change):
    files = bandai_files()
    stem = "Bandai-Namco-Research-Motiondataset-2/data/dataset-2_walk_elderly_001"
    change(files, stem)
    return files


BAD = {
    "ids of another clip": (
        lambda files, stem: files.update({f"{stem}.json": '{"content":3,"style":1}'}),
        "walk_elderly_001.json.*content 'run'.*file name.*walk",
    ),
    "unknown id": (
        lambda files, stem: files.update({f"{stem}.json": '{"content":10,"style":1}'}),
        "walk_elderly_001.json.*content 10 is not in the label list",
    ),
    "no json": (
        lambda files, stem: files.update({f"{stem}.json": "{"}),
        "walk_elderly_001.json: expected ids",
    ),
    "label file gone": (
        lambda files, stem: files.pop(f"{stem}.json"),
        "no dataset-2_walk_elderly_001.json",
    ),
    "list gone": (
        lambda files, stem: files.pop(stem.split("/")[0] + "/cfg/style_label.txt"),
        "no cfg/style_label.txt",
    ),
    "truncated recording": (
        lambda files, stem: files.update({f"{stem}.bvh": bandai_text(0)[:-40]}),
        "walk_elderly_001.bvh, line.*frame 3 has",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bandai_namco_names_what_is_wrong(tmp_path, case):
    change, message = BAD[case]
    source = put(tmp_path / "raw", broken(change))
    with pytest.raises(ValueError, match=message):
        build(bandai_namco.BandaiNamco, tmp_path, source, "2")


def test_missing_folders_and_damaged_zips_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere.*Put Bandai"):
        build(bandai_namco.BandaiNamco, tmp_path, tmp_path / "nowhere", "2")
    (tmp_path / "other").mkdir()
    with pytest.raises(FileNotFoundError, match="other' is empty. Put Bandai"):
        build(bandai_namco.BandaiNamco, tmp_path, tmp_path / "other", "1")
    put(tmp_path / "other", bandai_files())
    with pytest.raises(FileNotFoundError, match="neither files .*Motiondataset-1"):
        build(bandai_namco.BandaiNamco, tmp_path, tmp_path / "other", "1")
    source = put(tmp_path / "raw", {"walk1_subject1.bvh": "x" * 5000}, "lafan1.zip")
    data = (source / "lafan1.zip").read_bytes()
    (source / "lafan1.zip").write_bytes(data[:-100])
    with pytest.raises(ValueError, match="lafan1.zip: unreadable zip"):
        build(lafan1.Lafan1, tmp_path, source)


def lafan_text(seed: int) -> str:
    """A take on a skeleton with toes, CRLF line ends."""
    content = bvh.bvh_from_motion(samples.skeleton(), samples.motion(5, seed))
    return format_bvh(content, decimals=9).replace("\n", "\r\n")


def test_lafan1_reads_takes_and_cuts_from_two_zips(tmp_path):
    source = tmp_path / "raw"
    put(source, {"walk1_subject5.bvh": lafan_text(0)}, "lafan1.zip")
    cuts = {"fallAndGetUp2_subject1_walk2.bvh": lafan_text(1)}
    put(source, cuts, "lafan1_cuts.zip")
    found = build(lafan1.Lafan1, tmp_path, source)
    assert found.clip_names == ("fallAndGetUp2_subject1_walk2", "walk1_subject5")
    assert found.names("theme") == ("fallAndGetUp", "walk")
    assert found.names("subject") == ("subject1", "subject5")
    assert found.names("action") == ("walk",)
    assert found.skeleton.names == samples.NAMES
    expected = samples.motion(5, 0)
    walk = clips.clip_motion(found, 1)
    np.testing.assert_allclose(walk.joint_rotation, expected.joint_rotation, atol=1e-6)
    np.testing.assert_allclose(walk.root_position, expected.root_position, atol=1e-6)


def test_o3de_labels_takes_and_cuts_those_of_two_styles(tmp_path):
    """A second of 30 frames; the cut of the crouching take is at two seconds."""
    source = tmp_path / "raw"
    motions = {
        "Walk1": samples.motion(5, 0),
        "Crouching1": samples.motion(70, 1),
        "Jumps1": samples.motion(6, 2),
        "TurnOnSpot1": samples.motion(7, 3),
    }
    texts = {
        f"{name}.bvh": format_bvh(bvh.bvh_from_motion(samples.skeleton(), motion))
        for name, motion in motions.items()
    }
    put(source, texts, "o3de_motion_matching.zip")
    found = build(o3de.O3deMotionMatching, tmp_path, source)
    style = [found.names("style")[i] for i in found.labels["style"]]
    frames = np.diff(found.offsets).tolist()
    assert list(zip(found.clip_names, style, frames, strict=True)) == [
        ("Crouching1_0", "neutral", 60),
        ("Crouching1_1", "crouch", 10),
        ("Jumps1", "jump", 6),
        ("TurnOnSpot1_0", "neutral", 7),
        ("Walk1", "neutral", 5),
    ]
    assert [found.skeleton.names[i] for i in found.skeleton.feet] == [
        "LeftToe",
        "RightToe",
    ]
    cut = clips.clip_motion(found, 1).root_position
    np.testing.assert_allclose(cut, motions["Crouching1"].root_position[60:], atol=1e-5)


@pytest.mark.parametrize("name", ["walk1", "walk1_actor5", "walk1_subject5_a_b", "1_2"])
def test_lafan1_names_that_say_nothing_are_refused(name):
    with pytest.raises(ValueError, match=name):
        lafan1.read_name(name)


CUTS_HEADER = "STYLE_NAME," + ",".join(
    f"{action}_{end}" for action in style100.ACTIONS for end in ("START", "STOP")
)
CUTS = {
    "Old": "4,13,NA,NA,0,8," + ",".join(["NA"] * 14),
    "LeanLeft": ",".join(["NA"] * 6) + ",2,20," + ",".join(["N/A"] * 12),
    "Unlisted": "0,20," + ",".join(["NA"] * 18),
}
LIST = """Style Name,Description,Stochastic,Symmetric,Notes
Old,"bent, slow",n,Y,
LeanLeft,leans,N,n,none
"""


def style_files() -> dict[str, str]:
    """100STYLE with three styles, 60 frames per second, a finger to be dropped."""
    rows = [f"{style},{cells}" for style, cells in CUTS.items()]
    files = {
        "100STYLE/Frame_Cuts.csv": "\n".join([CUTS_HEADER, *rows]) + "\n",
        "100STYLE/Dataset_List.csv": LIST,
    }
    for seed, name in enumerate(["Old_BR", "Old_BW", "Old_FR", "LeanLeft_FW"]):
        files[f"100STYLE/{name.split('_')[0]}/{name}.bvh"] = style_text(seed)
    files["100STYLE/Unlisted/Unlisted_BR.bvh"] = style_text(9)
    return files


def style_text(seed: int) -> str:
    """21 frames at 60 per second; the spine is called a thumb."""
    content = bvh.bvh_from_motion(samples.skeleton(), samples.motion(21, seed, 60.0))
    return format_bvh(content, decimals=9).replace("Spine", "LeftHandThumb1")


def test_style100_cuts_halves_labels_and_skips(tmp_path, caplog):
    source = put(tmp_path / "raw", style_files())
    found = build(style100.Style100, tmp_path, source, "original")
    assert found.clip_names == ("LeanLeft_FW", "Old_BR", "Old_FR")
    assert found.fps == 30.0
    assert found.skeleton.names == ("Hips", *samples.NAMES[2:])
    assert found.skeleton.feet == (2, 4)
    assert found.names("style") == ("LeanLeft", "Old")
    assert found.names("action") == style100.ACTIONS
    np.testing.assert_array_equal(found.labels["action"], [3, 0, 2])
    assert "1 files skipped, style not in the list: ['Unlisted_BR']" in caplog.text
    assert "1 files skipped, no cut: ['Old_BW']" in caplog.text
    # 4..13 at 60 per second are frames 2..5 at 30, which are 4, 6, 8, 10 of the file.
    expected = samples.motion(21, 0, 60.0)
    old = clips.clip_motion(found, 1)
    np.testing.assert_allclose(
        old.root_position, expected.root_position[4:11:2], atol=1e-6
    )
    np.testing.assert_allclose(
        old.joint_rotation,
        np.asarray(expected.joint_rotation)[4:11:2, [0, 2, 3, 4, 5]],
        atol=1e-6,
    )


@pytest.mark.parametrize("config", ["original", "mirror"])
def test_style100_reads_joints_behind_a_rigs_prefix(tmp_path, config):
    """As in the BVHs that CAMDM's pipeline leaves behind: mixamorig:LeftUpLeg."""
    renamed = {
        name: re.sub(r"(ROOT|JOINT) (.+)", r"\1 mixamorig:\2", text)
        for name, text in style_files().items()
    }
    plain, prefixed = (
        build(style100.Style100, tmp_path / kind, put(tmp_path / kind, files), config)
        for kind, files in (("plain", style_files()), ("prefixed", renamed))
    )
    names = tuple(f"mixamorig:{name}" for name in plain.skeleton.names)
    assert prefixed.skeleton.names == names
    assert prefixed.skeleton.feet == plain.skeleton.feet == (2, 4)
    assert prefixed.clip_names == plain.clip_names
    for field in ("root_position", "joint_rotation", "offsets"):
        np.testing.assert_array_equal(getattr(prefixed, field), getattr(plain, field))
    np.testing.assert_array_equal(prefixed.skeleton.offsets, plain.skeleton.offsets)


def test_style100_mirrors_symmetric_styles_under_the_same_label(tmp_path):
    source = put(tmp_path / "raw", style_files(), "100STYLE.zip")
    found = build(style100.Style100, tmp_path, source, "mirror")
    names = ("LeanLeft_FW", "Old_BR", "Old_BR_mirrored", "Old_FR", "Old_FR_mirrored")
    assert found.clip_names == names
    np.testing.assert_array_equal(found.labels["style"], [0, 1, 1, 1, 1])
    one, other = (clips.clip_motion(found, i).root_position for i in (1, 2))
    np.testing.assert_array_equal(other, np.asarray(one) * [-1, 1, 1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("4,13", "4,x"), r"Frame_Cuts.csv, line 2: cut of Old BR.*\['4', 'x'\]"),
        (("4,13", "4,99"), "Old_BR.bvh: the cut 4..99"),
        (("4,13", "13,4"), "Old_BR.bvh: the cut 13..4"),
        (("n,Y", "n,maybe"), "Dataset_List.csv, line 2: column 4"),
        (("0.0166666667", "0.02"), "Old_BR.bvh: 50 frames per second, expected 60"),
        (("LeftToe", "LeftFin"), "Old_BR.bvh: no toes"),
    ],
)
def test_style100_names_what_is_wrong(tmp_path, change, message):
    files = {name: text.replace(*change) for name, text in style_files().items()}
    # Only one recording is needed, and the first must not fail for the others' sake.
    files = {k: v for k, v in files.items() if k.endswith((".csv", "Old_BR.bvh"))}
    with pytest.raises(ValueError, match=message):
        build(style100.Style100, tmp_path, put(tmp_path / "raw", files), "original")


def test_style100_tables_must_be_there(tmp_path):
    files = style_files()
    del files["100STYLE/Dataset_List.csv"]
    with pytest.raises(FileNotFoundError, match="no Dataset_List.csv"):
        build(style100.Style100, tmp_path, put(tmp_path / "raw", files), "original")


def test_files_of_one_name_in_two_folders_are_both_named(tmp_path):
    name, text = "walk1_subject1.bvh", lafan_text(0)
    files = {f"a/{name}": text, f"b/{name}": text}
    for source in (
        put(tmp_path / "loose", files),
        put(tmp_path / "zipped", files, "lafan1.zip"),
    ):
        with pytest.raises(ValueError, match=name) as caught:
            build(lafan1.Lafan1, tmp_path, source)
        words = str(caught.value)
        assert f"a/{name} and {source}" in words and f"b/{name}" in words
    # In two zips as well.
    put(tmp_path / "two", {name: text}, "lafan1.zip")
    put(tmp_path / "two", {name: text}, "lafan1_cuts.zip")
    with pytest.raises(ValueError, match=f"lafan1.zip/{name} and .*cuts.zip/{name}"):
        build(lafan1.Lafan1, tmp_path, tmp_path / "two")


class Twice(base.MotionBuilder):
    """A set with a clip of the same name again."""

    name = "twice"
    MANUAL_DOWNLOAD_INSTRUCTIONS = "None."

    def _generate_examples(self, folder):
        for seed in range(2):
            yield base.example("walk", samples.skeleton(), samples.motion(5, seed), {})


def test_clips_of_one_name_are_named(tmp_path):
    source = put(tmp_path / "raw", {"a.txt": ""})
    with pytest.raises(ValueError, match="two clips have the name 'walk'"):
        build(Twice, tmp_path, source)


def test_zips_that_cannot_be_unpacked_are_one_line(tmp_path):
    source = put(tmp_path / "raw", {"walk1_subject1.bvh": lafan_text(0)}, "lafan1.zip")
    path = source / "lafan1.zip"
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x03\x04") + 6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)
    with pytest.raises(ValueError, match="lafan1.zip: .*subject1.bvh' is encrypted"):
        build(lafan1.Lafan1, tmp_path, source)
    test_files.zeros(path, 300 * 2**20, name="walk1_subject1.bvh")
    with pytest.raises(ValueError, match="lafan1.zip: .*unpack to 314572800 bytes"):
        build(lafan1.Lafan1, tmp_path, source)


@pytest.mark.parametrize("cls", [bandai_namco.BandaiNamco, style100.Style100])
def test_tables_that_are_no_text_are_named(tmp_path, cls):
    is_style = cls is style100.Style100
    source = put(tmp_path / "raw", style_files() if is_style else bandai_files())
    table = next(source.rglob("Frame_Cuts.csv" if is_style else "style_label.txt"))
    table.write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match=f"{table.name}: not UTF-8 text"):
        build(cls, tmp_path, source, "original" if is_style else "2")
