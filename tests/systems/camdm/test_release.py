"""Columns of the released evaluation: of whole clips, against commands as they were."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.control import courses
from jaxmotion.data import windows
from jaxmotion.data.clips import clip_motion
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.evaluators.style import Config
from jaxmotion.motion.skeleton import Motion
from jaxmotion.systems.camdm import release as camdm_release
from tests import samples, tiny
from tests.reference import metrics as oracle

LABELS = np.array([0, 1, 1])
SECONDS = 5.0


@functools.cache
def rollouts():
    """Frames of three characters, and what they were told."""
    commands = courses.course_batch(
        "forward", LABELS, np.full(3, 0.8), seconds=SECONDS, fps=30.0
    )
    return samples.walking(LABELS, seconds=SECONDS), commands


@functools.cache
def scored():
    """The row of the rollouts."""
    return camdm_release.row(
        camdm_release.metrics(samples.run().model.skeleton, recordings())
    )


def recordings():
    frames, commands = rollouts()
    return camdm_release.of_rollouts(frames, commands)


def joints(motion):
    return tiny.positions(samples.run().model.skeleton, motion)


def of_scripts(motion, command=None):
    told = () if command is None else (command.velocity, command.facing)
    return oracle.camdm_release(
        samples.run().model.skeleton.names, joints(motion), *told
    )


@pytest.mark.slow
def test_rollouts_are_measured_whole_against_what_was_told():
    """From the first frame, and not against the springs that follow the commands."""
    frames, commands = rollouts()
    row = scored()
    wanted = []
    for i in range(3):
        motion, command = jax.tree.map(lambda x, i=i: x[i], (frames, commands))
        motion = Motion(
            root_position=motion.root_position, joint_rotation=motion.joint_rotation
        )
        wanted.append(of_scripts(motion, command))
    assert len(row) == 4
    for name, (column, _) in camdm_release.COLUMNS.items():
        if name != "fid":
            mean = np.mean([x[name] for x in wanted])
            assert row[column].value == pytest.approx(mean, rel=2e-5), column
            assert row[column].samples == 3


@pytest.mark.slow
def test_clips_are_measured_whole_whatever_their_length():
    clips = samples.clips()
    # Different lengths: the first is cut short.
    cut = np.asarray(clips.offsets).copy()
    cut[1] -= 37
    keep = np.r_[0 : cut[1], cut[1] + 37 : clips.num_frames]
    clips = dataclasses.replace(
        clips,
        root_position=clips.root_position[keep],
        joint_rotation=clips.joint_rotation[keep],
        offsets=jnp.asarray(np.r_[0, cut[1], cut[2:] - 37]),
    )
    whole = camdm_release.of_clips(clips, field="style")
    found = camdm_release.metrics(clips.skeleton, whole)
    assert set(found) == {"slide", "coherence"}
    np.testing.assert_array_equal(whole.label, clips.labels["style"])
    for i in range(clips.num_clips):
        wanted = of_scripts(clip_motion(clips, i))
        for name, value in wanted.items():
            got = found[name][i]
            assert got == pytest.approx(value, rel=1e-5, abs=1e-6), (i, name)


@pytest.mark.slow
def test_distances_are_of_each_recording_to_its_style(monkeypatch):
    """Windows one after the other from the first frame on, and no others."""
    rng = np.random.default_rng(0)
    table = rng.normal(size=(500, 8)).astype(np.float32)

    def recognized(skeleton, found, evaluator):
        seen = np.asarray(joints(found.motion))[..., 0, 0].sum(-1)
        chosen = table[np.abs(seen * 1000).astype(int) % 500]
        return chosen + 0.5 * np.asarray(found.label)[:, None], None

    monkeypatch.setattr(camdm_release, "features_and_hits", recognized)
    clips, skeleton = samples.clips(), samples.run().model.skeleton
    evaluator = style_evaluator.StyleEvaluator(
        params={}, config=Config(num_classes=2, num_joints=22)
    )
    styles = camdm_release.style_features(skeleton, clips, evaluator, field="style")
    found = camdm_release.distances(skeleton, recordings(), evaluator, styles)
    dense = windows.eval_windows(clips, stride=windows.EVAL_WINDOW, field="style")
    reference, _ = recognized(skeleton, dense, None)
    frames, commands = rollouts()
    for i, label in enumerate(LABELS):
        own = jax.tree.map(lambda x, i=i: x[i : i + 1], frames)
        made = windows.rollout_windows(own, jnp.asarray([label]), skip=0)
        rows, _ = recognized(skeleton, made, None)
        assert len(rows) == 2  # 150 frames
        data = reference[np.asarray(dense.label) == label]
        assert found[i] == pytest.approx(
            oracle.frechet_of_rows(rows, data) / 8, rel=1e-4
        )
    row = camdm_release.row({"fid": np.array([1.0, np.nan, 4.0])})
    assert row["fid_camdm_release"].value == 2.5
    assert row["fid_camdm_release"].samples == 2


def test_replications_are_averaged_before_the_interval():
    values = {"slide": np.array([1.0, 2.0, 3.0, 6.0])}
    row = camdm_release.row(values, np.array([0, 0, 1, 1]))
    cell = row["slide_camdm_release"]
    assert (cell.value, cell.samples) == (3.0, 2)
    empty = camdm_release.row({"fid": np.array([np.nan])})["fid_camdm_release"]
    assert np.isnan(empty.value) and empty.samples == 0


@pytest.mark.slow
def test_features_are_512_and_found_by_style():
    run = samples.run()
    evaluator = style_evaluator.fit(
        jax.random.key(0), run.train, field="style", num_steps=2, batch=4
    )
    styles = camdm_release.style_features(
        run.model.skeleton, run.train, evaluator, field="style"
    )
    assert isinstance(styles, camdm_release.Groups)
    # Four seconds of 30 frames are two windows of 60.
    label = np.asarray(run.train.labels["style"])
    np.testing.assert_array_equal(styles.count, 2 * np.bincount(label))
    assert styles.rows.shape[-1] == 512
    found = camdm_release.distances(run.model.skeleton, recordings(), evaluator, styles)
    assert found.shape == (3,) and np.isfinite(found).all() and (found > 0).all()
