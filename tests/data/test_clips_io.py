import dataclasses
import os

import jax
import numpy as np
import pytest

from jaxmotion.data import clips_io
from tests.data import samples


@pytest.fixture
def saved(tmp_path):
    clips_io.save_clips(tmp_path / "c.npz", samples.clips())
    return tmp_path / "c.npz"


def rewrite(path, **changes):
    """The file with other fields; None drops one."""
    with np.load(path) as file:
        fields = {name: file[name] for name in file.files}
    fields = {k: v for k, v in {**fields, **changes}.items() if v is not None}
    np.savez(path, **fields)


def test_round_trip_is_exact_and_leaves_one_file(saved):
    clips, found = samples.clips(), clips_io.load_clips(saved)
    assert jax.tree.structure(found) == jax.tree.structure(clips)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(clips), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    assert os.listdir(saved.parent) == ["c.npz"]


def test_folders_are_made_and_old_files_replaced(tmp_path):
    path = tmp_path / "new" / "folder" / "c.npz"
    clips_io.save_clips(path, samples.clips())
    clips_io.save_clips(path, samples.clips())
    assert clips_io.load_clips(path).num_clips == 8


def test_missing_damaged_and_foreign_files_are_named(tmp_path, saved):
    with pytest.raises(FileNotFoundError, match="none.npz"):
        clips_io.load_clips(tmp_path / "none.npz")
    saved.write_bytes(saved.read_bytes()[:-30])
    with pytest.raises(ValueError, match="c.npz: not a clips file, or a damaged"):
        clips_io.load_clips(saved)
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    with pytest.raises(ValueError, match="other.npz: not a clips file.*weights"):
        clips_io.load_clips(tmp_path / "other.npz")


NAN = np.full((52, 3), np.nan, np.float32)
FOUR = {"clip_names": np.array(list("abcd"))}
FOUR |= {f"label.{field}": np.zeros(4, int) for field in ("style", "content")}
BAD = {
    "other version": ({"version": np.array(2)}, "version 2.*expected 1"),
    "no version": ({"version": None}, "version None.*expected 1"),
    "field gone": ({"offsets": None}, "field 'offsets' is missing"),
    "label gone": ({"label.style": None}, "field 'label.style' is missing"),
    "names gone": ({"names.content": None}, "field 'names.content' is missing"),
    "text for numbers": ({"offsets": np.array(["a"])}, "field 'offsets' should have"),
    "too few axes": ({"root_position": np.zeros(52)}, "'root_position' should have 2"),
    "too few frames": (
        {"root_position": np.zeros((5, 3))},
        "'root_position' has shape",
    ),
    "nan": ({"root_position": NAN}, r"'root_position' is not within .* at \[0, 0\]"),
    "rows of 9": ({"joint_rotation": np.zeros((52, 6, 9))}, "'joint_rotation' has sh"),
    "other joints": ({"skeleton_offsets": np.zeros((5, 3))}, "'skeleton_offsets' has"),
    "offsets end": ({"offsets": np.arange(9)}, "'offsets' should run from 0 to 52"),
    "empty clip": (
        {"offsets": np.array([0, 0, 1, 2, 3, 4, 5, 6, 52])},
        "'offsets': clip 0 has no frames",
    ),
    "clip names": ({"clip_names": np.array(["a"])}, "'clip_names' has shape"),
    "rate": ({"fps": np.array(0.0)}, "'fps' should be in .*, found 0.0"),
    "negative rate": ({"fps": np.array(-1.0)}, "'fps' should be in .*, found -1.0"),
    "wild rate": ({"fps": np.array(1e300)}, r"'fps' should be in .*, found 1e\+300"),
    "feet": ({"skeleton_feet": np.array([6])}, "'skeleton': feet .*in 0..5"),
    "float64 1e300": (
        {"root_position": np.full((52, 3), 1e300)},
        r"'root_position' is not within 1e\+06 m at \[0, 0\]: found 1e\+300",
    ),
    "no rotations": (
        {"joint_rotation": np.zeros((52, 6, 6))},
        "'joint_rotation' of frame 0, joint 0 is no rotation",
    ),
    "rotations of 1e30": (
        {"joint_rotation": np.full((52, 6, 6), 1e30)},
        "'joint_rotation' of frame 0, joint 0 is no rotation",
    ),
    "nan rotations": (
        {"joint_rotation": np.full((52, 6, 6), np.nan)},
        "'joint_rotation' of frame 0, joint 0 is no rotation",
    ),
    "small offsets": (
        # As int8 the difference of 100 and -128 would be 28 again.
        {"offsets": np.array([0, 10, 100, -128, 52], np.int8), **FOUR},
        "'offsets': clip 2 has no frames",
    ),
    "label field twice": (
        {"label_fields": np.array(["style", "style"])},
        "'label_fields' has one twice",
    ),
    "label": ({"label.style": np.full(8, 3)}, r"'label.style' should be in 0\.\.2"),
}


@pytest.mark.parametrize("case", BAD)
def test_inconsistent_fields_are_named(saved, case):
    changes, message = BAD[case]
    rewrite(saved, **changes)
    with pytest.raises(ValueError, match=f"c.npz.*{message}"):
        clips_io.load_clips(saved)


def test_what_cannot_be_read_is_not_written(tmp_path):
    clips = samples.clips()
    broken = dataclasses.replace(clips, joint_rotation=0.0 * clips.joint_rotation)
    with pytest.raises(ValueError, match="c.npz: field 'joint_rotation' of frame 0"):
        clips_io.save_clips(tmp_path / "c.npz", broken)
    assert os.listdir(tmp_path) == []
