import types

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import bvh, bvh_text, fbx, own
from jaxmotion.data.walker import walker_skeleton
from jaxmotion.motion import anatomy
from jaxmotion.motion.skeleton import Motion

PLAIN = walker_skeleton()


def motion(frames=20):
    """The walker's skeleton on a straight way, arms down."""
    columns = np.zeros((frames, 22, 6), np.float32)
    columns[..., 0] = columns[..., 4] = 1.0
    for name, sign in (("LeftArm", -1.0), ("RightArm", 1.0)):
        columns[:, PLAIN.index(name)] = [0.1, sign, 0, -sign, 0.1, 0]
    root = np.zeros((frames, 3), np.float32)
    root[:, 1], root[:, 2] = 0.95, np.arange(frames) / 30
    return Motion(
        root_position=jnp.asarray(root), joint_rotation=jnp.asarray(columns), fps=30.0
    )


def odd_file(scale=1.0, z_up=True, bone=1.0, name="a.bvh"):
    """Another tool's file of that motion: its names, order of channels, and axes."""
    plain = bvh.bvh_from_motion(PLAIN, motion(), scale=1.0)
    positions, rotations = map(np.array, bvh.bvh_transforms(plain))
    offsets = np.array(plain.offsets)
    offsets[7] *= bone
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) if z_up else np.eye(3)
    positions, rotations[:, 0] = positions[:, 0] @ turn.T, turn @ rotations[:, 0]
    order = ("Yrotation", "Xrotation", "Zrotation")
    # R = Ry Rx Rz.
    x = np.arcsin(np.clip(-rotations[..., 1, 2], -1, 1))
    y = np.arctan2(rotations[..., 0, 2], rotations[..., 2, 2])
    z = np.arctan2(rotations[..., 1, 0], rotations[..., 1, 1])
    angles = np.rad2deg(np.stack([y, x, z], axis=-1)).reshape(len(positions), -1)
    root = scale * positions[:, [2, 0, 1]]
    names = [f"J{j:02d}" for j in range(22)]
    channels = [order] * 22
    channels[0] = ("Zposition", "Xposition", "Yposition", *order)
    content = bvh_text.Bvh(
        name=name,
        names=tuple(names),
        parents=plain.parents,
        offsets=scale * offsets,
        end_sites=plain.end_sites,
        channels=tuple(channels),
        frame_time=plain.frame_time,
        values=np.concatenate([root, angles], axis=-1),
    )
    return bvh_text.format_bvh(content).encode()


@pytest.mark.parametrize("scale, z_up", [(1.0, True), (100.0, False), (39.37, True)])
def test_a_file_of_another_tool_becomes_the_same_motion(scale, z_up):
    read = own.read_bvh("takes/calm/a.bvh", odd_file(scale, z_up))
    clips, notes = own.clips_from_recordings([read], folder="takes")
    assert clips.skeleton.names == PLAIN.names, "found from the tree"
    assert [clips.skeleton.names[foot] for foot in clips.skeleton.feet] == [
        "LeftToeBase",
        "RightToeBase",
    ]
    expected = anatomy.kinematics(PLAIN, motion())[0]
    found = Motion(
        root_position=clips.root_position, joint_rotation=clips.joint_rotation, fps=30.0
    )
    places = anatomy.kinematics(clips.skeleton, found)[0]
    np.testing.assert_allclose(places, expected, atol=2e-3)
    assert dict(clips.label_names) == {"style": ("calm",), "take": ("calm/a",)}
    text = "\n".join(notes)
    word = {1.0: "meters", 100.0: "centimeters", 39.37: "inches"}[scale]
    assert word in text and f"up       {'z' if z_up else 'y'}" in text


def two(**changes):
    return [
        own.read_bvh("takes/a.bvh", odd_file()),
        own.read_bvh("takes/b.bvh", odd_file(**changes)),
    ]


def test_labels_from_a_table_cut_parts():
    table = own.read_labels(
        "t.csv", "file,start,end,label\na.bvh,0,0.2,walk\n\na,0.3,,stop\nb, ,0.1,walk\n"
    )
    clips, _ = own.clips_from_recordings(two(), folder="takes", table=table)
    assert clips.clip_names == ("a_0", "a_1", "b")
    assert np.diff(np.asarray(clips.offsets)).tolist() == [6, 11, 3]
    style = dict(clips.label_names)["style"]
    assert [style[i] for i in np.asarray(clips.labels["style"])] == [
        "walk",
        "stop",
        "walk",
    ]


def test_feet_of_renamed_joints_are_told_by_their_own_names():
    found, _ = own.clips_from_recordings(two()[:1], feet=("J04", "J08"))
    names = [found.skeleton.names[foot] for foot in found.skeleton.feet]
    assert names == [PLAIN.names[4], PLAIN.names[8]]
    with pytest.raises(ValueError, match="unknown joint 'J99': the skeleton has J00"):
        own.clips_from_recordings(two()[:1], feet=("J04", "J99"))


def test_lines_of_a_table_end_in_any_way():
    lines = ["file,start,end,label", "a,0,1,walk"]
    for end in ("\n", "\r\n", "\r"):
        assert own.read_labels("t.csv", end.join(lines)) == [("a", 0.0, 1.0, "walk")]


@pytest.mark.parametrize(
    "name, style",
    [
        ("d/a.bvh", "all"),
        ("d/calm/a.bvh", "calm"),
        ("d/calm/deep/a.bvh", "calm"),
        ("d/takes.zip/calm/a.bvh", "calm"),
        ("d/Calm.ZIP/a.bvh", "Calm"),
    ],
)
def test_the_style_is_the_folder_also_within_a_zip(name, style):
    read = own.read_bvh(name, odd_file())
    clips, _ = own.clips_from_recordings([read], folder="d")
    assert dict(clips.label_names)["style"] == (style,)


def test_long_takes_become_several_clips():
    clips, _ = own.clips_from_recordings(two()[:1], longest=0.3)
    assert clips.clip_names == ("takes/a-0", "takes/a-1", "takes/a-2")
    assert np.diff(np.asarray(clips.offsets)).tolist() == [7, 6, 7]


def test_files_of_several_skeletons_are_refused():
    with pytest.raises(ValueError, match=r"b\.bvh: the bone to .* differs by 0\.\d+ m"):
        own.clips_from_recordings(two(bone=1.4))
    clips, _ = own.clips_from_recordings(two(bone=1.4), tolerance=0.2)
    assert clips.num_clips == 2
    other = own.read_bvh(
        "c.bvh", bvh_text.format_bvh(bvh.bvh_from_motion(PLAIN, motion())).encode()
    )
    with pytest.raises(ValueError, match=r"c\.bvh: no joint 'J00'.*of one skeleton"):
        own.clips_from_recordings([two()[0], other])


@pytest.mark.parametrize(
    "text, message",
    [
        ("a,b\n", "line 1 is 'a,b', expected 'file,start,end,label'"),
        ("file,start,end,label\n", "no lines after the first"),
        ("file,start,end,label\na,0,1\n", "line 2 has 3 fields"),
        ("file,start,end,label\na,x,1,w\n", "line 2: start 'x' .* expected seconds"),
        ("file,start,end,label\na,2,1,w\n", "line 2: 2 s to 1 s is no part"),
        ("file,start,end,label\na,0,1,\n", "line 2 names no label"),
        (
            "file,start,end,label\na,0,2,w\nb,1,3,w\na,1,,w\n",
            "line 4: 1 s to inf s is in part that of another line, 0 s to 2 s",
        ),
    ],
)
def test_a_bad_line_of_a_table_is_named(text, message):
    with pytest.raises(ValueError, match=message):
        own.read_labels("t.csv", text)


def test_parts_that_are_not_there_are_named():
    for row, message in (
        (("a", 9.0, np.inf, "w"), r"a\.bvh: a part from 9 s on, but the file ends at"),
        (("a", 0.2, 10.0, "w"), r"a\.bvh: a part from 0.2 s to 10 s, but the file"),
        (("a", 0.2, 0.21, "w"), "from 0.2 s to 0.21 s has 0 frames at 30 per second"),
        (("z.bvh", 0.0, 1.0, "w"), "a file 'z.bvh', which is not there"),
    ):
        table = [("a", 0.0, 0.2, "w"), row]
        with pytest.raises(ValueError, match=message):
            own.clips_from_recordings(two(), table=table)
    with pytest.raises(ValueError, match="no files"):
        own.clips_from_recordings([])


def test_bad_fbx_is_named(monkeypatch):
    ufbx = pytest.importorskip("ufbx")
    with pytest.raises(ValueError, match=r"a\.fbx: no FBX file"):
        fbx.read_fbx("a.fbx", b"plain text")
    bone = types.SimpleNamespace(bone=object(), parent=None, element_id=1, name="x")
    empty = types.SimpleNamespace(nodes=[bone], bones=[], anim_stacks=[])
    monkeypatch.setattr(ufbx, "load_memory", lambda data: empty)
    with pytest.raises(ValueError, match=r"a\.fbx: the FBX has no animation"):
        fbx.read_fbx("a.fbx", b"")
    empty.nodes = []
    with pytest.raises(ValueError, match=r"a\.fbx: the FBX has no bones"):
        fbx.read_fbx("a.fbx", b"")
    monkeypatch.setitem(__import__("sys").modules, "ufbx", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install -e .*\[fbx\]"):
        fbx.read_fbx("a.fbx", b"")
