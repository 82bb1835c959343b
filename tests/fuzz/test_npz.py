"""Clips, clips with a ball, motions with captions, and features: npz and npy files."""

import io

import jax
import numpy as np
import pytest

from jaxmotion import files
from jaxmotion.data import ball_clips, clips_io, text_files, text_motion
from tests import ball_walker
from tests.data import samples, test_text_motion
from tests.fuzz import harness, mutations

pytestmark = pytest.mark.slow
INPUTS = {"clips": 1200, "ball": 400, "captions": 500, "arrays": 400, "features": 300}


def fields_of(data):
    """The arrays of an npz file by NumPy's own reader."""
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def same(found, expected):
    """Equal numbers, after the cast to the type that is held."""
    np.testing.assert_array_equal(
        np.asarray(found), np.asarray(expected).astype(np.asarray(found).dtype)
    )


def confirm_clips(data, clips):
    fields = fields_of(data)
    for name in ("root_position", "joint_rotation", "offsets"):
        same(getattr(clips, name), fields[name])
    for name in ("offsets", "parents", "names", "feet"):
        same(np.array(getattr(clips.skeleton, name)), fields[f"skeleton_{name}"])
    assert clips.fps == float(fields["fps"]) and clips.source == str(fields["source"])
    for field, words in clips.label_names:
        same(clips.labels[field], fields[f"label.{field}"])
        assert words == tuple(fields[f"names.{field}"].tolist())
    assert clips.clip_names == tuple(fields["clip_names"].tolist())
    # What is promised of clips, whatever the file says.
    for leaf in jax.tree.leaves(clips):
        assert np.isfinite(np.asarray(leaf)).all()
    columns = np.asarray(clips.joint_rotation, np.float64)
    lengths = np.linalg.norm(columns.reshape(*columns.shape[:2], 2, 3), axis=-1)
    np.testing.assert_allclose(lengths, 1.0, atol=0.02)
    assert (np.diff(np.asarray(clips.offsets)) > 0).all()
    assert len(set(clips.skeleton.names)) == clips.skeleton.num_joints


def confirm_ball(data, found):
    confirm_clips(data, found.clips)
    fields = fields_of(data)
    same(found.position, fields["ball_position"])
    same(found.touch, fields["ball_touch"])
    assert found.joints == tuple(fields["ball_joints"].tolist())
    assert found.radius == float(fields["ball_radius"])


def confirm_captions(data, motions):
    fields = fields_of(data)
    for name in ("features", "offsets", "mean", "std", "caption_clip", "split"):
        same(getattr(motions, name), fields[name])
        assert np.isfinite(getattr(motions, name)).all()
    for name in ("captions", "tokens", "clip_names", "split_names"):
        assert getattr(motions, name) == tuple(fields[name].tolist())


def written(path, save, value):
    save(path, value)
    return path.read_bytes()


def run(target, data, count, path):
    for seed in range(count):
        random = np.random.default_rng(seed)
        # A file that is right must be accepted, or the target tests nothing.
        content = data if seed == 0 else mutations.mutate_npz(random, data)
        path.write_bytes(content)
        target.feed(f"seed {seed}", content)


def test_clips(tmp_path, capsys):
    path = tmp_path / "x.npz"
    data = written(path, clips_io.save_clips, samples.clips())
    target = harness.Target(
        "clips", lambda _: clips_io.load_clips(path), confirm_clips, names=("x.npz",)
    )
    run(target, data, INPUTS["clips"], path)
    target.report(capsys.disabled, accepted=20, refused=INPUTS["clips"] // 2)


def test_clips_with_a_ball(tmp_path, capsys):
    path = tmp_path / "x.npz"
    data = written(path, ball_clips.save_ball_clips, ball_walker.clips(12))
    target = harness.Target(
        "clips with a ball",
        lambda _: ball_clips.load_ball_clips(path),
        confirm_ball,
        names=("x.npz",),
    )
    run(target, data, INPUTS["ball"], path)
    target.report(capsys.disabled, accepted=10, refused=INPUTS["ball"] // 2)


def test_motions_with_captions(tmp_path, capsys):
    path = tmp_path / "x.npz"
    data = written(path, text_motion.save_text_motions, test_text_motion.motions())

    def read(_):
        is_one = text_motion.is_text_motions(path)
        found = text_motion.load_text_motions(path)
        assert is_one
        return found

    target = harness.Target("captions", read, confirm_captions, names=("x.npz",))
    run(target, data, INPUTS["captions"], path)
    target.report(capsys.disabled, accepted=10, refused=INPUTS["captions"] // 2)


def test_arrays_of_any_file(tmp_path, capsys):
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer, a=np.arange(50.0), b=np.array(["x", "yz"]), c=np.eye(9, dtype=bool)
    )

    def confirm(data, found):
        expected = fields_of(data)
        assert found.keys() == expected.keys()
        for name, array in found.items():
            assert array.dtype == expected[name].dtype
            np.testing.assert_array_equal(array, expected[name])

    target = harness.Target(
        "arrays",
        lambda data: files.read_arrays(io.BytesIO(data), name="x.npz", what="test"),
        confirm,
        names=("x.npz",),
    )
    for seed in range(INPUTS["arrays"]):
        random = np.random.default_rng(seed)
        target.feed(f"seed {seed}", mutations.mutate_npz(random, buffer.getvalue()))
    target.report(capsys.disabled, accepted=20, refused=20)


def test_features(tmp_path, capsys):
    path = tmp_path / "x.npy"
    buffer = io.BytesIO()
    np.save(buffer, np.random.default_rng(0).normal(size=(7, 5)))

    def confirm(data, found):
        same(found, np.load(io.BytesIO(data), allow_pickle=False))

    target = harness.Target(
        "features", lambda _: text_files.read_array(path), confirm, names=("x.npy",)
    )
    for seed in range(INPUTS["features"]):
        random = np.random.default_rng(seed)
        data = mutations.mutate_bytes(random, buffer.getvalue())
        path.write_bytes(data)
        target.feed(f"seed {seed}", data)
    target.report(capsys.disabled, accepted=20, refused=20)
