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


def test_an_interrupted_write_leaves_the_old_file(saved, monkeypatch):
    before = saved.read_bytes()

    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(clips_io.os, "fsync", stop)
    with pytest.raises(KeyboardInterrupt):
        clips_io.save_clips(saved, samples.clips())
    assert saved.read_bytes() == before
    assert os.listdir(saved.parent) == ["c.npz"]


def test_unwritable_folder_is_an_os_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError):
        clips_io.save_clips(tmp_path / "file" / "c.npz", samples.clips())


def test_missing_damaged_and_foreign_files_are_named(tmp_path, saved):
    with pytest.raises(FileNotFoundError, match="none.npz"):
        clips_io.load_clips(tmp_path / "none.npz")
    whole = saved.read_bytes()
    for cut in (0, 10, len(whole) // 2, len(whole) - 30):
        saved.write_bytes(whole[:cut])
        with pytest.raises(ValueError, match="c.npz: not a clips file, or a damaged"):
            clips_io.load_clips(saved)
    middle = len(whole) // 2
    saved.write_bytes(
        whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :]
    )
    with pytest.raises(ValueError, match="c.npz: not a clips file, or a damaged"):
        clips_io.load_clips(saved)
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    with pytest.raises(ValueError, match="other.npz: not a clips file.*weights"):
        clips_io.load_clips(tmp_path / "other.npz")
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(ValueError, match="array.npy: not a clips file"):
        clips_io.load_clips(tmp_path / "array.npy")


def test_pickles_are_not_opened(tmp_path):
    fields = {"format": np.array("jaxmotion-clips"), "x": np.array([{}], dtype=object)}
    np.savez(tmp_path / "p.npz", **fields)
    with pytest.raises(ValueError, match="p.npz: not a clips file"):
        clips_io.load_clips(tmp_path / "p.npz")


NAN = np.full((52, 3), np.nan, np.float32)
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
    "nan": ({"root_position": NAN}, r"'root_position' is not finite at \[0, 0\]"),
    "rows of 9": ({"joint_rotation": np.zeros((52, 6, 9))}, "'joint_rotation' has sh"),
    "other joints": ({"skeleton_offsets": np.zeros((5, 3))}, "'skeleton_offsets' has"),
    "offsets end": ({"offsets": np.arange(9)}, "'offsets' should run from 0 to 52"),
    "empty clip": (
        {"offsets": np.array([0, 0, 1, 2, 3, 4, 5, 6, 52])},
        "'offsets': clip 0 has no frames",
    ),
    "clip names": ({"clip_names": np.array(["a"])}, "'clip_names' has shape"),
    "rate": ({"fps": np.array(0.0)}, "'fps' should be positive"),
    "feet": ({"skeleton_feet": np.array([6])}, "'skeleton_feet' names no joint"),
    "label": ({"label.style": np.full(8, 3)}, r"'label.style' should be in 0\.\.2"),
    "parents": ({"skeleton_parents": np.arange(6)}, "'skeleton_parents': parent of"),
}


@pytest.mark.parametrize("case", BAD)
def test_inconsistent_fields_are_named(saved, case):
    changes, message = BAD[case]
    rewrite(saved, **changes)
    with pytest.raises(ValueError, match=f"c.npz.*{message}"):
        clips_io.load_clips(saved)
