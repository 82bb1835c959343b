"""Motions with actions: labels, and how clips are drawn and cut."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import clips_io, resample
from jaxmotion.data.clips import clip_motion, clips_from_motions
from jaxmotion.motion import rotation, trajectory
from jaxmotion.systems.emdm import data as emdm_data
from tests import tiny

LENGTHS = (12, 5, 20, 7, 9, 8)
ACTIONS = ("walk", "run", "walk", "stroll", "run", "hop")


def clips(lengths=LENGTHS, actions=ACTIONS, source="made up"):
    """Root heights tell clip and frame: 10 clip + frame / 100."""
    motions = []
    for i, number in enumerate(lengths):
        motion = tiny.walk(number, speed=0.5 + 0.2 * i, turn=0.3, start=0.7 * i)
        height = 10.0 * i + 0.01 * jnp.arange(number)
        root = motion.root_position.at[:, 1].set(height)
        motions.append(dataclasses.replace(motion, root_position=root))
    return clips_from_motions(
        motions,
        tiny.skeleton(),
        names=[f"clip{i}" for i in range(len(lengths))],
        labels={"content": list(actions)},
        source=source,
    )


# --- what is kept ------------------------------------------------------------------


def prepare(paths, **changes):
    options = dict(field="content", merge={"stroll": "walk"}, least=2, fps=30.0)
    return emdm_data.prepare_clips(tuple(paths), **(options | changes))


@pytest.fixture
def files(tmp_path):
    """Two files of the same skeleton."""
    paths = [tmp_path / f"{name}.npz" for name in "ab"]
    clips_io.save_clips(paths[0], clips())
    clips_io.save_clips(paths[1], clips((6, 10), ("hop", "jump"), source="two"))
    return paths


def test_files_are_merged_and_rare_actions_left_out(files):
    found, left_out = prepare(files)
    assert left_out == ("jump",)
    assert set(found.names("content")) == {"walk", "run", "hop"}
    names = [found.names("content")[i] for i in np.asarray(found.labels["content"])]
    assert names == ["walk", "run", "walk", "walk", "run", "hop", "hop"]
    np.testing.assert_array_equal(np.diff(found.offsets), [*LENGTHS, 6])
    assert found.source == "made up; two"
    # All of them, if one clip is enough; labels as they were without a merge.
    found, left_out = prepare(files, least=1, merge={})
    assert left_out == () and found.num_clips == 8
    assert set(found.names("content")) == {"walk", "run", "stroll", "hop", "jump"}


def test_clips_get_the_rate_that_is_asked_for(files):
    found, _ = prepare(files, fps=15.0)
    assert found.fps == 15.0
    whole, _ = prepare(files)
    for i in range(found.num_clips):
        expected = resample.resample(clip_motion(whole, i), 15.0)
        own = clip_motion(found, i)
        np.testing.assert_allclose(
            own.root_position, expected.root_position, rtol=1e-6, atol=1e-5
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(least=9), "no content has 9 clips"),
        (dict(merge={"strol": "walk"}), "unknown content 'strol'.*stroll"),
        (dict(merge={"stroll": "wlak"}), "unknown content 'wlak'.*walk"),
        (dict(field="mood"), "unknown label field 'mood'.*content"),
        (dict(fps=0.0), "fps"),
    ],
)
def test_what_does_not_fit_the_clips_is_named(files, change, message):
    with pytest.raises(ValueError, match=message):
        prepare(files, **change)


def test_files_are_needed(tmp_path):
    with pytest.raises(ValueError, match="no files of clips"):
        prepare([])
    with pytest.raises(OSError, match=r"none\.npz"):
        prepare([tmp_path / "none.npz"])


@pytest.mark.slow
def test_a_folder_keeps_the_units_of_its_features(files, tmp_path):
    """They are fitted to motions that JAX draws, and its versions draw otherwise."""
    options = dict(field="content", merge={"stroll": "walk"}, least=2, fps=30.0)
    folder = tmp_path / "run"
    made = emdm_data.prepare(
        folder, tuple(files), task="action", frames=6, held_out=0.3, **options
    )
    with jax.threefry_partitionable(not jax.config.jax_threefry_partitionable):
        refitted = emdm_data._fit(made.clips, made.train).normalizer
        found = emdm_data.load_run(folder).representation.normalizer
    assert np.abs(refitted.mean - made.representation.normalizer.mean).max() > 1e-4
    for name in ("mean", "std"):
        np.testing.assert_array_equal(
            getattr(found, name), getattr(made.representation.normalizer, name)
        )
    # As a folder has it that was made before, and a damaged one.
    config = folder / "config.json"
    value = json.loads(config.read_text())
    kept = value["model"].pop("normalizer")
    config.write_text(json.dumps(value))
    fitted = emdm_data.load_run(folder).representation
    assert fitted.fps == made.representation.fps
    np.testing.assert_array_equal(
        fitted.normalizer.mean, made.representation.normalizer.mean
    )
    value["model"]["normalizer"] = {"mean": kept["mean"]}
    config.write_text(json.dumps(value))
    with pytest.raises(ValueError, match=r"config\.json: field 'normalizer': 'std' is"):
        emdm_data.load_run(folder)


# --- batches -----------------------------------------------------------------------

FRAMES = 8


def test_images_are_of_actions_of_which_clips_are_held_out(tmp_path):
    """Otherwise what is made of them could not be judged."""
    options = dict(field="content", merge={}, least=1, fps=30.0, frames=6)
    options |= dict(task="action", held_out=0.3, mirrored=True)
    for number, actions in enumerate(
        (("turn_left", "turn_left", "walk", "walk"), ("turn_left", "turn_right") * 2)
    ):
        path = tmp_path / f"{number}.npz"
        clips_io.save_clips(path, clips((12, 9, 20, 8), actions))
        make = lambda: emdm_data.prepare(  # noqa: E731
            tmp_path / f"run{number}",  # noqa: B023
            (path,),  # noqa: B023
            **options,
        )
        if number == 0:
            with pytest.raises(ValueError, match="of content 'turn_right', of which"):
                make()
            continue
        run = make()
        assert len(run.train.counts) == len(run.held_out.counts) == 2


@pytest.fixture(scope="module")
def arrays():
    """Actions 0..3 are hop, run, stroll and walk or in some other order."""
    return emdm_data.action_arrays(clips(), field="content", frames=FRAMES)


def test_clips_are_listed_by_action(arrays):
    names = arrays.clips.names("content")
    for action, name in enumerate(names):
        own = [i for i, a in enumerate(ACTIONS) if a == name]
        row = np.asarray(arrays.members[action])
        assert int(arrays.counts[action]) == len(own)
        assert row[: len(own)].tolist() == own and np.all(row[len(own) :] == -1)
    assert arrays.frames == FRAMES


@pytest.mark.slow
def test_all_windows_are_those_that_are_drawn(arrays):
    start, clip = emdm_data.all_windows(arrays)
    expected = [
        (sum(LENGTHS[:i]) + first, i)
        for i, number in enumerate(LENGTHS)
        for first in range(max(number - FRAMES, 0) + 1)
    ]
    assert list(zip(start.tolist(), clip.tolist(), strict=True)) == expected
    every = emdm_data.motions_at(arrays, start, clip).root_position[:, :, 1]
    actions = jnp.repeat(jnp.arange(arrays.counts.shape[0]), 200)
    drawn = emdm_data.sample_motions(jax.random.key(0), arrays, actions)
    unique = lambda x: np.unique(np.asarray(x).round(3), axis=0)  # noqa: E731
    np.testing.assert_array_equal(unique(drawn.root_position[:, :, 1]), unique(every))


def test_an_action_without_clips_is_named():
    given = dataclasses.replace(
        clips(), label_names=(("content", (*clips().names("content"), "swim")),)
    )
    with pytest.raises(ValueError, match="content 'swim' has no clip"):
        emdm_data.action_arrays(given, field="content", frames=FRAMES)


@pytest.fixture(scope="module")
def drawn(arrays):
    """Many motions: their actions, clips and frames."""
    action = jnp.arange(1200) % arrays.counts.shape[0]
    motions = jax.jit(emdm_data.sample_motions)(jax.random.key(0), arrays, action)
    height = np.asarray(motions.root_position[..., 1])
    clip = np.round(height[:, 0] / 10).astype(int)
    frame = np.round((height - 10.0 * clip[:, None]) * 100).astype(int)
    return motions, np.asarray(action), clip, frame


def test_motions_are_of_their_action_and_of_neighboring_frames(arrays, drawn):
    motions, action, clip, frame = drawn
    names = np.array(arrays.clips.names("content"))
    np.testing.assert_array_equal(names[action], np.array(ACTIONS)[clip])
    last = np.array(LENGTHS)[clip][:, None] - 1
    assert frame.min() == 0 and np.all(frame <= last)
    # A short clip stays in its last pose.
    expected = np.minimum(frame[:, :1] + np.arange(FRAMES), last)
    np.testing.assert_array_equal(frame, expected)
    assert np.all(frame[np.array(LENGTHS)[clip] <= FRAMES, 0] == 0)
    assert motions.fps == 30.0


def test_clips_and_starts_are_drawn_evenly(arrays, drawn):
    _, action, clip, frame = drawn
    for name in set(ACTIONS):
        own = [i for i, a in enumerate(ACTIONS) if a == name]
        chosen = clip[np.isin(clip, own)]
        share, n = 1 / len(own), chosen.size
        for i in own:
            gap = np.mean(chosen == i) - share
            assert np.abs(gap) <= 4.5 * np.sqrt(share * (1 - share) / n)
    for i, length in enumerate(LENGTHS):
        starts = frame[clip == i, 0]
        number = max(length - FRAMES, 0) + 1
        assert set(starts) == set(range(number))
        spread = np.sqrt((number**2 - 1) / 12 / starts.size)
        assert np.abs(starts.mean() - (number - 1) / 2) <= 4.5 * spread


def test_motions_start_at_the_origin_facing_ahead(arrays, drawn):
    motions, _, clip, frame = drawn
    np.testing.assert_allclose(motions.root_position[:, 0, ::2], 0.0, atol=1e-5)
    first = jax.tree.map(lambda x: x[:, :1], motions)
    path = trajectory.root_trajectory(tiny.skeleton(), first)
    np.testing.assert_allclose(
        path.facing[:, 0], np.tile([0.0, 1.0], (1200, 1)), atol=1e-5
    )
    # Moved as a rigid body: steps keep their lengths, limbs their rotations.
    for n in range(0, 1200, 173):
        own = clip_motion(arrays.clips, int(clip[n]))
        rows = frame[n]
        steps = np.diff(np.asarray(own.root_position)[rows], axis=0)
        found = np.diff(np.asarray(motions.root_position[n]), axis=0)
        lengths = (np.linalg.norm(x[:, ::2], axis=-1) for x in (steps, found))
        np.testing.assert_allclose(*lengths, atol=1e-5)
        np.testing.assert_array_equal(
            motions.joint_rotation[n, :, 1:], np.asarray(own.joint_rotation)[rows, 1:]
        )
        roots = [
            np.asarray(rotation.matrix_from_rot6d(r))
            for r in (motions.joint_rotation[n, :, 0], own.joint_rotation[rows, 0])
        ]
        turns = roots[0] @ roots[1].swapaxes(-1, -2)
        np.testing.assert_allclose(turns, turns[:1].repeat(FRAMES, 0), atol=1e-5)
        np.testing.assert_allclose(turns[0] @ [0, 1, 0], [0, 1, 0], atol=1e-5)


def test_a_key_draws_the_same_again(arrays):
    draw = jax.jit(emdm_data.sample_motions)
    action = jnp.array([0, 1, 2, 3])
    first, same, other = (
        draw(jax.random.key(n), arrays, action).root_position for n in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, same)
    assert np.abs(first - other).max() > 1e-3
