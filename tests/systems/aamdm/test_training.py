"""Folders of AAMDM: prepared once, loaded or refused, and the chains in them."""

import dataclasses
import functools
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import clips, clips_io, selection
from jaxmotion.learning import checkpoint, runs
from jaxmotion.systems.aamdm import data as aamdm_data
from jaxmotion.systems.aamdm import embedding as aamdm_embedding
from jaxmotion.systems.aamdm import model as aamdm_model
from jaxmotion.systems.aamdm import space as aamdm_space
from jaxmotion.systems.aamdm import training as aamdm_training
from tests import person, tiny

# Orbax abandons its other reads when one fails.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

LENGTHS = (160, 90, 160, 30)
MADE = dict(field="theme", labels=("walk",), fps=60.0, held_out=0.2, mirrored=True)
BUDGET = runs.Budget(steps=2, batch=4, chunk=1, save_every=2, optimizer="adamw")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "clips.npz"
    clips_io.save_clips(path, person.clips(LENGTHS))
    return path


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    """The walks, clips 0 and 2, and their mirror images."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    return aamdm_training.prepare(folder, data, **MADE)


# --- data of a folder --------------------------------------------------------------


def test_clips_are_chosen_mirrored_described_and_split(run, data):
    assert run.train.offsets.tolist() == [0, 68, 136, 204, 272]
    assert run.held_out.offsets.tolist() == [0, 32, 64, 96, 128]
    assert run.skeleton.names == person.NAMES and run.source == "made in the tests"
    assert run.embedding.num_joints == 6 and run.embedding.fps == 60.0
    chosen = selection.select(clips_io.load_clips(data), "theme", ("walk",))
    assert run.toe_height == pytest.approx(clips.toe_height(chosen), abs=2e-3)
    record = run.record
    assert record.settings["mirrored"] is True and record.settings["labels"] == ["walk"]
    assert len(record.split["train"]) == len(record.split["held_out"]) == 4
    # Sideways and turning velocities of the mirror images are the opposite ones.
    own, image = run.train.poses[:136], run.train.poses[136:]
    for channel, sign in ((-8, -1.0), (-6, 1.0), (-4, -1.0)):
        np.testing.assert_allclose(
            image[:, channel], sign * own[:, channel], rtol=1e-3, atol=1e-3
        )


def test_what_is_prepared_is_not_prepared_again(run, data, monkeypatch):
    monkeypatch.setattr(clips_io, "load_clips", lambda path: pytest.fail("read"))
    again = aamdm_training.prepare(run.record.folder, data, **MADE)
    pairs = zip(jax.tree.leaves(again.train), jax.tree.leaves(run.train), strict=True)
    for a, b in pairs:
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    "change", [dict(fps=120.0), dict(labels=()), dict(held_out=0.3), dict(mirrored=0)]
)
def test_a_folder_keeps_to_how_it_was_made(run, data, change):
    change = {k: bool(v) if k == "mirrored" else v for k, v in change.items()}
    before = (run.record.folder / "config.json").read_text()
    with pytest.raises(ValueError, match=f"{run.record.folder}.*another folder"):
        aamdm_training.prepare(run.record.folder, data, **MADE | change)
    assert (run.record.folder / "config.json").read_text() == before


def test_data_that_do_not_fit_are_named(data, tmp_path):
    with pytest.raises(OSError, match="gone.npz"):
        aamdm_training.prepare(tmp_path, tmp_path / "gone.npz", **MADE)
    for change, message in (
        (dict(labels=("fly",)), "unknown theme 'fly'"),
        (dict(field="mood"), "unknown label field 'mood'"),
        (dict(fps=24.0), "cannot be resampled to 24"),
    ):
        with pytest.raises(ValueError, match=message):
            aamdm_training.prepare(tmp_path, data, **MADE | change)
    assert not (tmp_path / "config.json").exists()


@pytest.mark.parametrize(
    ("field", "change", "message"),
    [
        ("skeleton", None, "field 'skeleton': a JSON NoneType"),
        ("config", {"num_joints": 6, "fps": 1e9}, "field 'config': fps is 1000000000"),
        ("config", {"num_joints": 7}, "field 'skeleton' has 6 joints, the config 7"),
    ],
)
def test_a_config_of_other_networks_is_named(run, monkeypatch, field, change, message):
    model = run.record.model | {field: change}
    record = dataclasses.replace(run.record, model=model)
    monkeypatch.setattr(runs, "load", lambda folder, system: record)
    with pytest.raises(ValueError, match=f"^{record.config}: {message}"):
        aamdm_training.load_run(record.folder)


BAD_FRAMES = {
    "not a frame file": dict(content=b"hello"),
    "'poses' has shape": dict(poses=np.zeros((3, 5))),
    "'offsets' should ascend": dict(offsets=np.array([0, 0])),
    "not within": dict(paths=np.full((272, 12), 1e30)),
}


@pytest.mark.parametrize("message", BAD_FRAMES)
def test_frames_that_do_not_fit_are_named(run, tmp_path, monkeypatch, message):
    """In a folder that agrees with itself; one that does not is refused before."""
    content, path = BAD_FRAMES[message], tmp_path / "data" / "train.npz"
    path.parent.mkdir()
    with np.load(run.record.file("train.npz")) as file:
        np.savez(path, **dict(file) | {k: content[k] for k in content if k in file})
    if "content" in content:
        path.write_bytes(content["content"])
    record = dataclasses.replace(run.record, folder=tmp_path)
    monkeypatch.setattr(runs, "load", lambda folder, system: record)
    with pytest.raises(ValueError, match=f"^{path}: .*{message}"):
        aamdm_training.load_run(tmp_path)


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(OSError, match="gone.*expected a run folder .*aamdm.py train"):
        aamdm_training.load_run(tmp_path / "gone")


# --- spaces and chains -------------------------------------------------------------


@pytest.fixture(scope="module")
def space(run):
    return aamdm_training.make_space(run, None)


CONFIG = aamdm_model.Config(
    features=110, latent=2, width=16, depth=1, window=2, predict="change"
)


@pytest.fixture(scope="module")
def chain(run, space):
    """Parameters of both stages, of chains of five steps."""
    given, init = (run, "full_pose", space, CONFIG, BUDGET), aamdm_model.init
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(aamdm_model, "init", lambda k, c: tiny.random_params(init, c))
        return {
            "polisher": aamdm_training.train_polisher(*given),
            "generator": aamdm_training.train_generator(*given),
        }


def test_a_space_of_a_run_is_read_back(run, space):
    found = aamdm_training.load_space(run, "full_pose")
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(space), strict=True):
        np.testing.assert_array_equal(a, b)
    frames = aamdm_space.to_frames(found, run.train.poses, run.train.paths)
    np.testing.assert_allclose(jnp.mean(frames, axis=0), 0.0, atol=1e-3)
    with pytest.raises(
        checkpoint.CheckpointError, match=str(run.record.folder / "embedded")
    ):
        aamdm_training.load_space(run, "embedded")


def test_a_space_that_is_there_is_loaded(run, space, monkeypatch):
    monkeypatch.setattr(checkpoint, "save", lambda *a, **k: pytest.fail("saved"))
    again = aamdm_training.make_space(run, None)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(space), strict=True):
        np.testing.assert_array_equal(a, b)


def test_an_embedded_space_is_read_back(run, tmp_path):
    config, data = run.embedding, run.train
    statistics = aamdm_embedding.fit_statistics(data.poses, data.paths, config=config)
    autoencoder = aamdm_space.Autoencoder(
        params=tiny.random_params(aamdm_embedding.init, config),
        statistics=statistics,
        config=config,
    )
    record = dataclasses.replace(run.record, folder=tmp_path)
    other = dataclasses.replace(run, record=record)
    made = aamdm_training.make_space(other, autoencoder)
    found = aamdm_training.load_space(other, "embedded")
    assert jax.tree.structure(found) == jax.tree.structure(made)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(made), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(("drafts", "polishes"), [(3, 2), (4, 1), (5, 0), (0, 5)])
def test_chains_of_one_length_share_their_networks(run, space, chain, drafts, polishes):
    params, config = aamdm_training.load_networks(
        run, "full_pose", space, drafts=drafts, polishes=polishes
    )
    assert config == dataclasses.replace(CONFIG, drafts=drafts, polishes=polishes)
    used = {"generator": drafts, "polisher": polishes}
    assert set(params) == {name for name, steps in used.items() if steps}
    for name, found in params.items():
        pairs = zip(jax.tree.leaves(found), jax.tree.leaves(chain[name]), strict=True)
        for a, b in pairs:
            np.testing.assert_array_equal(a, b)


def test_a_stored_chain_makes_frames(run, space, chain):
    step = aamdm_training.load_chain(run, "full_pose", space, drafts=3, polishes=2)
    previous = aamdm_space.to_frames(space, run.train.poses[0], run.train.paths[0])
    found = jax.jit(step)(jax.random.key(0), previous)
    made = aamdm_model.sampler(chain, config=CONFIG, change=space.change)
    expected = jax.jit(made)(jax.random.key(0), previous)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_a_chain_that_was_not_trained_is_named(run, space, chain):
    for missing, options in (
        ("T6", dict(drafts=4, polishes=2)),
        ("T5_frame", dict(drafts=3, polishes=2, predict="frame")),
    ):
        folder = str(run.record.folder / "full_pose" / missing)
        with pytest.raises(checkpoint.CheckpointError, match=folder):
            aamdm_training.load_chain(run, "full_pose", space, **options)


def test_a_chain_of_another_space_is_named(run, space, chain):
    narrow = jax.tree.map(lambda x: x[:-1], space)
    with pytest.raises(ValueError, match="110 channels, expected the 109"):
        aamdm_training.load_chain(run, "full_pose", narrow, drafts=3, polishes=2)


def test_a_chain_is_not_trained_over_another(run, space, chain):
    wide = dataclasses.replace(CONFIG, window=3)
    with pytest.raises(
        ValueError, match="polisher: of another model: window is 2, given 3"
    ):
        aamdm_training.train_polisher(run, "full_pose", space, wide, BUDGET)


def test_a_chain_in_a_folder_of_another_length_is_named(run, space, chain):
    folder = run.record.folder / "full_pose"
    shutil.copytree(folder / "T5", folder / "T7")
    with pytest.raises(
        checkpoint.CheckpointError,
        match="T7/polisher: field 'stage' is 'full_pose/T5/pol",
    ):
        aamdm_training.load_chain(run, "full_pose", space, drafts=5, polishes=2)


def test_chains_of_own_levels_share_no_networks(run, space, chain):
    """Of one length, but with other drafts; and beside a chain of all levels."""
    config = dataclasses.replace(CONFIG, levels="own", drafts=3, polishes=2)
    aamdm_training.train_polisher(run, "full_pose", space, config, BUDGET)
    aamdm_training.train_generator(run, "full_pose", space, config, BUDGET)
    load = functools.partial(aamdm_training.load_networks, run, "full_pose", space)
    assert load(drafts=3, polishes=2)[1].levels == "own"
    assert load(drafts=2, polishes=3)[1].levels == "all"
    shutil.rmtree(run.record.folder / "full_pose" / "P2_D3")
    assert load(drafts=3, polishes=2)[1].levels == "all"


# --- windows -----------------------------------------------------------------------


def numbered():
    """Frames that hold their clip and their number."""
    clip, number = np.repeat([0, 1], [7, 5]), np.arange(12)
    return aamdm_data.PoseData(
        poses=person.float32(np.stack([clip, number], axis=-1)),
        paths=jnp.zeros((12, 12)),
        offsets=jnp.array([0, 7, 12], jnp.int32),
        fps=60.0,
    )


def test_windows_of_frames_lie_within_clips():
    sample, arrays = aamdm_training.frame_windows(
        numbered().poses, numbered(), 4, batch=200
    )
    found = np.asarray(jax.jit(sample)(jax.random.key(0), arrays))
    assert found.shape == (200, 4, 2)
    assert np.all(found[..., 0] == found[:, :1, 0])
    assert np.all(np.diff(found[..., 1], axis=1) == 1)
    # Four starts in the first clip and two in the second, all of them drawn.
    assert set(found[:, 0, 1].astype(int)) == {0, 1, 2, 3, 7, 8}
    with pytest.raises(ValueError, match="8 frames.*longest has 7"):
        aamdm_training.frame_windows(numbered().poses, numbered(), 8, batch=2)
