import dataclasses
import io
import itertools
import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmotion.data import bvh, bvh_text
from jaxmotion.data.bvh_text import format_bvh
from jaxmotion.motion import skeleton as skeletons
from jaxmotion.motion.skeleton import Motion
from tests import tiny
from tests.data import samples

TURNS = {"X": "Xrotation", "Y": "Yrotation", "Z": "Zrotation"}


def reference_world(content: bvh_text.Bvh) -> tuple[np.ndarray, np.ndarray]:
    """World transforms from SciPy's Euler angles, joint by joint, frame by frame."""
    positions = np.zeros((content.num_frames, content.num_joints, 3))
    turns = np.zeros((content.num_frames, content.num_joints, 3, 3))
    for frame, row in enumerate(content.values):
        cells = iter(row)
        for joint, channels in enumerate(content.channels):
            local = np.array(content.offsets[joint])
            order, angles = "", []
            for channel in channels:
                value = next(cells)
                if channel.endswith("position"):
                    local["XYZ".index(channel[0])] = value
                else:
                    order, angles = order + channel[0], [*angles, value]
            turn = np.eye(3)
            if order:  # Upper case: intrinsic, so R = R_first R_second R_third.
                turn = Rotation.from_euler(order, angles, degrees=True).as_matrix()
                turn = turn.reshape(3, 3)
            parent = content.parents[joint]
            above = turns[frame, parent] if parent >= 0 else np.eye(3)
            origin = positions[frame, parent] if parent >= 0 else np.zeros(3)
            positions[frame, joint] = origin + above @ local
            turns[frame, joint] = above @ turn
    return positions, turns


def second_library(path, frames) -> tuple[list[str], np.ndarray]:
    """Names and world positions of all joints, as bvhio has them."""
    bvhio = pytest.importorskip("bvhio", reason="the second BVH reader, extra [test]")
    root = bvhio.readAsHierarchy(str(path))
    joints = [joint for joint, _, _ in root.layout()]
    positions = np.empty((len(frames), len(joints), 3))
    for row, frame in enumerate(frames):
        root.loadPose(int(frame))
        positions[row] = [list(joint.PositionWorld) for joint in joints]
    return [joint.Name for joint in joints], positions


def test_fields_of_a_file_with_every_oddity():
    values = samples.bvh_values()
    content = bvh_text.parse_bvh(samples.bvh_text(values))
    assert content.names == ("Root", "mixamorig:Hips", "Left Leg", "Head", "Prop")
    assert content.parents == (-1, 0, 1, 1, 0)
    assert content.channels[2] == ("Xrotation", "Zrotation", "Yrotation")
    assert content.channels[3:] == (("Yrotation",), ())
    assert content.end_sites[2] == ((0.0, -40.0, 0.0), (0.0, -40.0, 8.0))
    assert content.end_sites[4] == ()
    np.testing.assert_allclose(content.values, values, atol=5e-7)
    assert content.values.dtype == np.float64
    assert bvh.frame_rate(content.frame_time) == 60.0


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\r"),
        lambda text: text.replace("\t", "  ").replace(" ", "  \t").replace("L\t", "L"),
        lambda text: text.replace("\n", "\n\n") + "\n\n",
        lambda text: "\ufeff" + text,
        lambda text: text.replace("\n{", " {").replace("\n\t{", "{"),
        lambda text: text.replace("Frames: ", "Frames:\t").replace("OFFSET", "Offset"),
        lambda text: text.replace("Xrotation", "XROTATION").rstrip("\n"),
    ],
)
def test_spacing_line_ends_and_case_do_not_matter(change):
    expected = bvh_text.parse_bvh(samples.bvh_text())
    found = bvh_text.parse_bvh(change(samples.bvh_text()))
    np.testing.assert_array_equal(found.values, expected.values)
    assert found.channels == expected.channels
    assert found.end_sites == expected.end_sites
    joined = ["".join(name.split()) for name in found.names]
    assert joined == ["".join(name.split()) for name in expected.names]


def test_paths_bytes_and_open_files_read_alike(tmp_path):
    path = tmp_path / "a.bvh"
    path.write_text(samples.bvh_text())
    sources = [path, str(path), path.read_bytes(), io.BytesIO(path.read_bytes())]
    found = [bvh_text.read_bvh(source).values for source in sources]
    for values in found[1:]:
        np.testing.assert_array_equal(values, found[0])
    with pytest.raises(FileNotFoundError, match="none.bvh"):
        bvh_text.read_bvh(tmp_path / "none.bvh")


@pytest.mark.parametrize("order", ["".join(p) for p in itertools.permutations("XYZ")])
def test_every_channel_order_equals_scipy(order):
    channels = " ".join(TURNS[axis] for axis in order)
    text = samples.bvh_text().replace("Xrotation Zrotation Yrotation", channels)
    content = bvh_text.parse_bvh(text)
    expected = Rotation.from_euler(order, content.values[:, 12:15], degrees=True)
    rotations = bvh.bvh_transforms(content)[1]
    np.testing.assert_allclose(rotations[:, 2], expected.as_matrix(), atol=1e-12)


def test_positions_replace_the_offset_component_by_component():
    text = samples.bvh_text().replace("CHANNELS 1 Yrotation", "CHANNELS 1 Yposition")
    content = bvh_text.parse_bvh(text)
    positions, rotations = bvh.bvh_transforms(content)
    np.testing.assert_array_equal(positions[:, 0], content.values[:, :3])
    np.testing.assert_array_equal(positions[:, 3, 0], 0.0)
    np.testing.assert_array_equal(positions[:, 3, 1], content.values[:, 15])
    np.testing.assert_array_equal(positions[:, 4], np.tile([0.0, 0, 1], (3, 1)))
    np.testing.assert_array_equal(rotations[:, 3], np.tile(np.eye(3), (3, 1, 1)))


def constant_bone_values(num_frames: int = 4) -> np.ndarray:
    """Rows in which the hips do not move against the root."""
    values = samples.bvh_values(num_frames, seed=1)
    values[:, 6:9] = [1.0, 90.0, 3.0]
    return values


def test_motion_has_the_world_positions_of_the_file():
    content = bvh_text.parse_bvh(samples.bvh_text(constant_bone_values()))
    skeleton, motion = bvh.motion_from_bvh(content, feet=("Left Leg",))
    assert (skeleton.names, skeleton.feet) == (content.names, (2,))
    assert motion.fps == 60.0
    found = np.asarray(tiny.positions(skeleton, motion))
    np.testing.assert_allclose(100 * found, reference_world(content)[0], atol=1e-3)
    np.testing.assert_array_equal(np.asarray(skeleton.offsets[0]), 0.0)


def test_ancestors_are_composed_into_the_new_root():
    # The hips move against their parent here; dropping it must not lose that.
    content = bvh_text.parse_bvh(samples.bvh_text())
    skeleton, motion = bvh.motion_from_bvh(content, root="mixamorig:Hips", scale=1.0)
    assert skeleton.names == ("mixamorig:Hips", "Left Leg", "Head")
    assert skeleton.parents == (-1, 0, 0)
    positions, turns = reference_world(content)
    found = np.asarray(tiny.positions(skeleton, motion))
    np.testing.assert_allclose(found, positions[:, 1:4], atol=1e-3)
    expected = samples.columns(turns[:, 1])
    np.testing.assert_allclose(motion.joint_rotation[:, 0], expected, atol=1e-6)


def test_a_bone_that_changes_is_an_error():
    content = bvh_text.parse_bvh(samples.bvh_text(), name="stretch.bvh")
    with pytest.raises(bvh_text.BvhError, match="stretch.bvh.*mixamorig:Hips.*changes"):
        bvh.motion_from_bvh(content)


@pytest.mark.parametrize("option", [{"root": "Pelvis"}, {"feet": ("Pelvis",)}])
def test_unknown_joints_are_named_with_the_known_ones(option):
    content = bvh_text.parse_bvh(samples.bvh_text(constant_bone_values()))
    with pytest.raises(bvh_text.BvhError, match="unknown joint 'Pelvis'.*Left Leg"):
        bvh.motion_from_bvh(content, **option)
    with pytest.raises(bvh_text.BvhError, match="'Prop' is not below"):
        bvh.motion_from_bvh(content, root="mixamorig:Hips", feet=("Prop",))


def test_write_then_read_gives_the_same_content(tmp_path):
    content = bvh_text.parse_bvh(samples.bvh_text())
    path = tmp_path / "a.bvh"
    bvh_text.write_bvh(path, content)
    found = bvh_text.read_bvh(path)
    for field in ("names", "parents", "channels", "end_sites", "frame_time"):
        assert getattr(found, field) == getattr(content, field)
    np.testing.assert_array_equal(found.offsets, content.offsets)
    np.testing.assert_array_equal(found.values, content.values)
    assert format_bvh(found) == path.read_text()
    assert os.listdir(tmp_path) == ["a.bvh"]
    with pytest.raises(OSError):
        bvh_text.write_bvh(path / "a.bvh", content)


def test_writing_puts_breadth_first_joints_depth_first(tmp_path):
    # NAMES is depth first; the order 0 1 2 4 3 5 is not.
    order = np.array([0, 1, 2, 4, 3, 5])
    base = samples.skeleton()
    skeleton = skeletons.Skeleton(
        offsets=base.offsets[order],
        parents=(-1, 0, 0, 0, 2, 3),
        names=tuple(base.names[i] for i in order),
    )
    motion = samples.motion(5, 3)
    bvh_text.write_bvh(tmp_path / "a.bvh", bvh.bvh_from_motion(skeleton, motion))
    found, moved = bvh.motion_from_bvh(bvh_text.read_bvh(tmp_path / "a.bvh"))
    assert found.names == base.names
    positions = np.asarray(tiny.positions(skeleton, motion))
    again = np.asarray(tiny.positions(found, moved))
    np.testing.assert_allclose(again[:, order], positions, atol=2e-6)


def test_motion_to_bvh_and_back_keeps_rotations_also_at_a_locked_gimbal():
    motion = samples.motion(6, 4, fps=24.0)
    locked = Rotation.from_euler("ZYX", [[30, 90, 0], [-50, -90, 20]], degrees=True)
    rot6d = np.asarray(motion.joint_rotation).copy()
    rot6d[:2, 1] = samples.columns(locked.as_matrix())
    motion = Motion(
        root_position=motion.root_position, joint_rotation=jnp.array(rot6d), fps=24.0
    )
    content = bvh.bvh_from_motion(samples.skeleton(), motion)
    content = bvh_text.parse_bvh(format_bvh(content, decimals=9))
    skeleton, found = bvh.motion_from_bvh(content, feet=("LeftToe", "RightToe"))
    assert (found.fps, skeleton.feet) == (24.0, (3, 5))
    np.testing.assert_allclose(found.joint_rotation, rot6d, atol=1e-6)
    np.testing.assert_allclose(found.root_position, motion.root_position, atol=1e-6)


def test_only_leaves_have_end_sites_and_the_root_is_at_its_positions():
    content = bvh.bvh_from_motion(samples.skeleton(), samples.motion(2, 4))
    leaves = [j not in content.parents for j in range(content.num_joints)]
    assert [bool(sites) for sites in content.end_sites] == leaves
    np.testing.assert_array_equal(content.offsets[0], 0.0)


def test_motion_with_nan_or_other_joints_is_not_written():
    motion = samples.motion(4, 5)
    for other in (samples.motion(4, 5, num_joints=4), samples.motion(0, 5)):
        with pytest.raises(ValueError, match="expected frames, 6 joints"):
            bvh.bvh_from_motion(samples.skeleton(), other)
    broken = Motion(
        root_position=motion.root_position.at[2, 1].set(jnp.nan),
        joint_rotation=motion.joint_rotation,
    )
    with pytest.raises(ValueError, match="out.bvh: frame 2 .* not finite"):
        bvh.bvh_from_motion(samples.skeleton(), broken, name="out.bvh")


def test_dropping_joints_drops_what_hangs_below_them():
    content = bvh_text.parse_bvh(samples.bvh_text())
    rest = bvh.without_joints(content, ["Left Leg", "Prop"])
    assert rest.names == ("Root", "mixamorig:Hips", "Head")
    assert rest.parents == (-1, 0, 1)
    np.testing.assert_array_equal(rest.values, content.values[:, [*range(12), 15]])
    assert bvh.without_joints(content, ["mixamorig:Hips"]).names == ("Root", "Prop")
    with pytest.raises(bvh_text.BvhError, match="root"):
        bvh.without_joints(content, ["Root"])


@pytest.mark.parametrize(
    ("time", "rate"), [(0.0333333, 30), (0.033333, 30), (0.008333, 120), (0.04, 25)]
)
def test_rounded_frame_times_mean_whole_rates(time, rate):
    assert bvh.frame_rate(time) == rate


def test_broadcast_rates_are_not_rounded():
    assert bvh.frame_rate(1 / 29.97) == pytest.approx(29.97)


def test_second_library_has_the_same_positions(tmp_path):
    values = constant_bone_values(5)
    text = samples.bvh_text(values).replace("Left Leg", "LeftLeg")
    (tmp_path / "a.bvh").write_text(text)
    content = bvh_text.read_bvh(tmp_path / "a.bvh")
    skeleton, motion = bvh.motion_from_bvh(content)
    names, expected = second_library(tmp_path / "a.bvh", range(5))
    found = 100 * np.asarray(tiny.positions(skeleton, motion))
    order = [names.index(name) for name in skeleton.names]
    np.testing.assert_allclose(found, expected[:, order], atol=1e-3)


def test_second_library_reads_what_is_written(tmp_path):
    motion = samples.motion(5, 6)
    bvh_text.write_bvh(
        tmp_path / "a.bvh", bvh.bvh_from_motion(samples.skeleton(), motion)
    )
    names, found = second_library(tmp_path / "a.bvh", range(5))
    expected = 100 * np.asarray(tiny.positions(samples.skeleton(), motion))
    order = [names.index(name) for name in samples.NAMES]
    np.testing.assert_allclose(found[:, order], expected, atol=1e-3)


@pytest.mark.slow
def test_ten_recordings_agree_with_the_second_library():
    folder = os.environ.get("JAXMOTION_DATA")
    if not folder:
        pytest.skip("JAXMOTION_DATA names no folder with unzipped recordings")
    files = sorted(Path(folder).rglob("*.bvh"))
    if not files:
        pytest.skip(f"JAXMOTION_DATA: no BVH files below {folder}")
    for path in files[:: max(1, len(files) // 10)][:10]:
        content = bvh_text.read_bvh(path)
        top = "Hips" if "Hips" in content.names else None
        skeleton, motion = bvh.motion_from_bvh(content, root=top)
        frames = np.linspace(0, content.num_frames - 1, 20).astype(int)
        names, expected = second_library(path, frames)
        found = np.asarray(tiny.positions(skeleton, motion))[frames]
        order = [names.index(name) for name in skeleton.names]
        np.testing.assert_allclose(100 * found, expected[:, order], atol=1e-3)


def chain(num_joints: int) -> bvh_text.Bvh:
    """Every joint the child of the one before."""
    return bvh_text.Bvh(
        names=tuple(f"j{i}" for i in range(num_joints)),
        parents=tuple(range(-1, num_joints - 1)),
        offsets=np.arange(3.0 * num_joints).reshape(num_joints, 3),
        channels=(("Yrotation",),) * num_joints,
        end_sites=((),) * (num_joints - 1) + (((0.0, 1.0, 0.0),),),
        values=np.ones((1, num_joints)),
        frame_time=0.1,
    )


@pytest.mark.parametrize("fps", [62.5, 31.25, 500 / 3, 1000 / 13, 59.94, 30.0, 120.0])
def test_rates_that_are_not_whole_survive(fps):
    """Zeros at the end of a frame time say how far it is rounded."""
    motion = Motion(
        root_position=jnp.zeros((2, 3)),
        joint_rotation=jnp.tile(jnp.array([1.0, 0, 0, 0, 1, 0]), (2, 5, 1)),
        fps=fps,
    )
    text = format_bvh(bvh.bvh_from_motion(tiny.skeleton(), motion))
    found = bvh_text.parse_bvh(text)
    rate = bvh.frame_rate(found.frame_time, found.frame_decimals)
    assert rate == pytest.approx(fps, rel=1e-6)
    assert format_bvh(found) == text
    # As far as anybody can tell, 0.016 is one of 60.
    for time, decimals, meant in ((0.016, 3, 60.0), (0.016, 6, 62.5), (0.0333, 4, 30)):
        assert bvh.frame_rate(time, decimals) == pytest.approx(meant)


def test_names_end_where_others_read_them():
    named = dataclasses.replace(chain(3), names=("Hips", "Spine {1}", "a\nb"))
    found = bvh_text.parse_bvh(format_bvh(named))
    assert found.names == ("Hips", "Spine _1_", "a_b")


def test_long_chains_are_written_and_read():
    text = format_bvh(chain(5000))
    assert len(text) < 5_000_000
    found = bvh_text.parse_bvh(text)
    assert found.parents == chain(5000).parents
    np.testing.assert_array_equal(found.offsets, chain(5000).offsets)


@pytest.mark.parametrize("rate", [24, 25, 30, 50, 60, 72, 90, 100, 120, 144, 240])
@pytest.mark.parametrize("decimals", [4, 5, 6, 7, 9])
def test_rates_survive_few_decimals(rate, decimals):
    unit = 10**decimals
    rounded, cut = round(unit / rate) / unit, int(unit / rate) / unit
    assert bvh.frame_rate(rounded) == rate
    # Cut to 4 decimals, 240 frames per second are 243.9 and what not.
    if decimals > 4 or rate <= 60:
        assert bvh.frame_rate(cut) == rate


@pytest.mark.parametrize(
    ("frame_time", "rate"),
    [
        (0.0333, 30),
        (0.033, 30),
        (0.03, 33.333),  # 25, cut, or 30, rounded
        (0.0167, 60),
        (0.017, 60),
        (0.008, 125),  # exactly
        (0.05, 20),
        (0.02, 50),
        (1.0, 1),
        (0.033366667, 29.97),
        (0.0333667, 29.97),
        (0.03337, 29.967),
        (0.041708, 23.976),
        (0.0299, 33.445),
    ],
)
def test_rates_that_are_not_whole_stay(frame_time, rate):
    assert bvh.frame_rate(frame_time) == pytest.approx(rate, abs=1e-3)


@pytest.mark.parametrize("place", ["OFFSET 0.0 50.0 0.0", "OFFSET 10.0 -5.0 0.5"])
def test_positions_beyond_float32_are_refused(place):
    text = samples.bvh_text(constant_bone_values()).replace(place, "OFFSET 0 1e39 0")
    content = bvh_text.parse_bvh(text, name="far.bvh")
    with pytest.raises(bvh_text.BvhError, match=r"far.bvh: '.*' is 1e\+39 .* along y"):
        bvh.motion_from_bvh(content)


def test_a_pipe_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe.bvh")
    with pytest.raises(OSError, match="pipe.bvh: expected a regular file"):
        bvh_text.read_bvh(tmp_path / "pipe.bvh")
