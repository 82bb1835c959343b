"""Checkpoints: equal to the bit, whole or absent, and errors that name the folder."""

import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxmotion.learning import checkpoint, training

absl = logging.getLogger("absl")

# Orbax abandons its other reads when one fails.
pytestmark = pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)


def state_of(seed, width=4):
    params = {
        "layer": {"kernel": jax.random.normal(jax.random.key(seed), (width, 3))},
        "bias": jnp.full(3, 0.1 * seed),
    }
    optimizer = optax.adamw(1e-3)
    state = training.init_train_state(params, optimizer)
    gradient = jax.tree.map(jnp.ones_like, params)
    _, opt_state = optimizer.update(gradient, state.opt_state, params)
    return training.TrainState(
        step=jnp.int32(seed),
        params=params,
        ema_params=jax.tree.map(lambda x: 0.5 * x, params),
        opt_state=opt_state,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Steps 1, 2 and 3 were saved with keep=2."""
    folder = tmp_path_factory.mktemp("run") / "checkpoints"
    for step in (1, 2, 3):
        checkpoint.save(folder, step, state_of(step), {"step": step, "name": "é"})
    return folder


def test_restored_equals_saved_to_the_bit(folder):
    like = jax.eval_shape(lambda: state_of(0))
    for found in (
        checkpoint.restore(folder, like),
        checkpoint.restore(folder, state_of(0)),
    ):
        assert jax.tree.structure(found) == jax.tree.structure(state_of(3))
        jax.tree.map(np.testing.assert_array_equal, found, state_of(3))
        types = [leaf.dtype for leaf in jax.tree.leaves(found)]
        assert types == [leaf.dtype for leaf in jax.tree.leaves(state_of(3))]


def test_the_oldest_goes_and_steps_can_be_chosen(folder):
    assert checkpoint.latest_step(folder) == 3
    found = checkpoint.restore(folder, state_of(0), step=2)
    jax.tree.map(np.testing.assert_array_equal, found, state_of(2))
    assert checkpoint.load_config(folder) == {"step": 3, "name": "é"}
    assert checkpoint.load_config(folder, step=2)["step"] == 2
    with pytest.raises(checkpoint.CheckpointError, match=f"{folder}.*step 1"):
        checkpoint.restore(folder, state_of(0), step=1)


def test_restore_part(folder):
    like = {"ema_params": jax.eval_shape(lambda: state_of(0).ema_params)}
    found = checkpoint.restore_part(folder, like)
    assert list(found) == ["ema_params"]
    jax.tree.map(
        np.testing.assert_array_equal, found["ema_params"], state_of(3).ema_params
    )


def test_restore_part_of_a_part(tmp_path):
    """What one of two players left, without the other's."""
    folder = tmp_path / "checkpoints"
    players = {"generator": state_of(4), "discriminator": state_of(5, width=6)}
    checkpoint.save(folder, 1, players, {})
    for name, width in (("generator", 4), ("discriminator", 6)):
        own = state_of(0, width=width).ema_params
        found = checkpoint.restore_part(
            folder, {"ema_params": jax.eval_shape(lambda x=own: x)}, within=name
        )
        assert list(found) == ["ema_params"]
        jax.tree.map(
            np.testing.assert_array_equal, found["ema_params"], players[name].ema_params
        )
    like = {"ema_params": state_of(0).ema_params}
    for within in ("discriminator", "other", None):
        with pytest.raises(checkpoint.CheckpointError, match=f"{folder}.*step 1"):
            checkpoint.restore_part(folder, like, within=within)


def test_of_another_model(folder):
    wide = state_of(0, width=5)
    named = f"{folder}.*step 3"
    with pytest.raises(checkpoint.CheckpointError, match=named):
        checkpoint.restore(folder, wide)
    with pytest.raises(checkpoint.CheckpointError, match=named):
        checkpoint.restore_part(folder, {"ema_params": wide.ema_params})
    with pytest.raises(checkpoint.CheckpointError, match=named):
        checkpoint.restore(folder, {"other": jnp.zeros(2)})
    with pytest.raises(checkpoint.CheckpointError, match=named):
        checkpoint.restore_part(folder, {"other": jnp.zeros(2)})
    deeper = state_of(0).params | {"layer_2": {"kernel": jnp.zeros((3, 3))}}
    shallower = {"bias": jnp.zeros(3)}
    for params in (deeper, shallower):
        with pytest.raises(checkpoint.CheckpointError, match=f"{named}.*layer"):
            checkpoint.restore_part(folder, {"params": params})


def test_missing(tmp_path):
    for folder in (tmp_path / "none", tmp_path):
        assert checkpoint.latest_step(folder) is None
        for read in (
            lambda f: checkpoint.restore(f, state_of(0)),
            lambda f: checkpoint.restore_part(f, {"params": state_of(0).params}),
            checkpoint.load_config,
        ):
            with pytest.raises(checkpoint.CheckpointError, match=str(folder)):
                read(folder)
    assert not (tmp_path / "none").exists()


def damage(folder, how):
    files = [path for path in folder.rglob("*") if path.is_file()]
    for path in files:
        content = path.read_bytes()
        if how == "truncated":
            path.write_bytes(content[: len(content) // 2])
        elif how == "flipped":
            path.write_bytes(bytes(255 - byte for byte in content))
        else:
            path.unlink()


@pytest.mark.parametrize("how", ["truncated", "flipped", "emptied"])
def test_corrupt(tmp_path, how):
    folder = tmp_path / "checkpoints"
    checkpoint.save(folder, 7, state_of(7), {})
    damage(folder / "7", how)
    for read in (
        lambda: checkpoint.restore(folder, state_of(0)),
        lambda: checkpoint.restore_part(folder, {"params": state_of(0).params}),
        lambda: checkpoint.load_config(folder),
    ):
        with pytest.raises(checkpoint.CheckpointError, match=str(folder)):
            read()


def flipped(path, bit):
    """Turns one bit of a file over; the second time turns it back."""
    content = bytearray(path.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(bytes(content))


def equal(found, expected):
    if jax.tree.structure(found) != jax.tree.structure(expected):
        return False
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    return all(
        np.array_equal(a, b) and np.asarray(a).dtype == np.asarray(b).dtype
        for a, b in pairs
    )


@pytest.mark.slow
def test_a_flipped_bit_in_any_file_is_noticed_or_changes_nothing(tmp_path):
    folder = tmp_path / "checkpoints"
    config = {"width": 8, "name": "small"}
    state = state_of(7, width=64)
    checkpoint.save(folder, 7, state, config)
    like = jax.eval_shape(lambda: state)
    reads = (
        (lambda: checkpoint.restore(folder, like), state),
        (
            lambda: checkpoint.restore_part(folder, {"ema_params": like.ema_params}),
            {"ema_params": state.ema_params},
        ),
        (lambda: checkpoint.load_config(folder), config),
    )
    files = sorted(path for path in (folder / "7").rglob("*") if path.is_file())
    assert len(files) > 10
    generator = np.random.default_rng(0)
    noticed = 0
    for path in files:
        for bit in generator.integers(0, 8 * path.stat().st_size, size=4).tolist():
            flipped(path, bit)
            for read, expected in reads:
                try:
                    found = read()
                except checkpoint.CheckpointError as error:
                    noticed += 1
                    assert str(folder) in str(error) and "\n" not in str(error)
                else:
                    assert equal(found, expected), (path, bit)
            flipped(path, bit)
    assert noticed > 20
    assert equal(checkpoint.restore(folder, like), state)


def test_a_damaged_step_says_which_other_step_counts_without_it(tmp_path):
    folder = tmp_path / "checkpoints"
    for step in (1, 2):
        checkpoint.save(folder, step, state_of(step), {})
    where = folder / "2" / "checksums" / "metadata"
    value = json.loads(where.read_text())
    value["state"]["params/bias"] = 64 * "0"
    where.write_text(json.dumps(value))
    with pytest.raises(checkpoint.CheckpointError, match="2 is corrupt.*step 1 counts"):
        checkpoint.restore(folder, state_of(0))
    assert checkpoint.load_config(folder) == {}
    where.write_text(json.dumps(value | {"config": 64 * "0"}))
    with pytest.raises(checkpoint.CheckpointError, match="config is not.*1 counts"):
        checkpoint.load_config(folder)


def test_a_step_without_checksums_is_read_with_a_warning(tmp_path):
    """As earlier versions wrote them."""
    folder = tmp_path / "checkpoints"
    checkpoint.save(folder, 7, state_of(7), {"a": 1})
    shutil.rmtree(folder / "7" / "checksums")
    with pytest.warns(UserWarning, match="step 7 has no checksums"):
        found = checkpoint.restore(folder, state_of(0))
    assert equal(found, state_of(7))
    with pytest.warns(UserWarning, match="step 7 has no checksums"):
        assert checkpoint.load_config(folder) == {"a": 1}


@pytest.mark.parametrize("field", ["config", "state"])
def test_checksums_that_lack_one_are_none(tmp_path, field):
    folder = tmp_path / "checkpoints"
    checkpoint.save(folder, 7, state_of(7), {})
    path = folder / "7" / "checksums" / "metadata"
    path.write_text(json.dumps(json.loads(path.read_text()) | {field: None}))
    with pytest.raises(checkpoint.CheckpointError, match="no readable checksums"):
        checkpoint.load_config(folder)


def test_a_config_that_is_no_object(tmp_path):
    folder = tmp_path / "checkpoints"
    checkpoint.save(folder, 7, state_of(7), {})
    for text in ("[1]", "5", "null", "{"):
        (folder / "7" / "config" / "metadata").write_text(text)
        with pytest.raises(checkpoint.CheckpointError, match="no readable config"):
            checkpoint.load_config(folder)


def test_reading_a_part_warns_of_nothing(tmp_path, caplog):
    folder = tmp_path / "checkpoints"
    checkpoint.save(folder, 7, state_of(7), {})
    # absl logs past pytest's handler unless it is told.
    with caplog.at_level(logging.WARNING, logger="absl"):
        absl.addHandler(caplog.handler)
        checkpoint.restore_part(folder, {"ema_params": state_of(0).ema_params})
        absl.removeHandler(caplog.handler)
    assert caplog.text == ""


def test_a_torn_step_does_not_count(tmp_path):
    """What a kill in the midst of a save leaves behind is neither read nor fatal."""
    folder = tmp_path / "checkpoints"
    checkpoint.save(folder, 1, state_of(1), {})
    torn = folder / "2.orbax-checkpoint-tmp-17"
    (torn / "state").mkdir(parents=True)
    (torn / "state" / "manifest.ocdbt").write_bytes(b"half")
    assert checkpoint.latest_step(folder) == 1
    found = checkpoint.restore(folder, state_of(0))
    jax.tree.map(np.testing.assert_array_equal, found, state_of(1))
    checkpoint.save(folder, 2, state_of(2), {})
    assert checkpoint.latest_step(folder) == 2


def test_the_newest_step_is_read_without_the_other_processes(tmp_path, monkeypatch):
    """One process asks while another, already ahead, waits within its save."""
    folder = tmp_path / "checkpoints"
    checkpoint.save(folder, 1, state_of(1), {})
    (folder / "2.orbax-checkpoint-tmp-17").mkdir()

    def waits(*args, **kwargs):
        raise AssertionError("waits for the other processes")

    monkeypatch.setattr(checkpoint, "_manager", waits)
    assert checkpoint.latest_step(folder) == 1
    assert checkpoint.latest_step(folder / "2.orbax-checkpoint-tmp-17") is None


def test_unwritable(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(OSError, match="file"):
        checkpoint.save(tmp_path / "file" / "run", 1, state_of(1), {})


SAVER = """
import itertools, sys
import numpy as np
from jaxmotion.learning import checkpoint
for step in itertools.count(1):
    state = {name: np.full(200_000, step, np.float32) for name in "abcd"}
    checkpoint.save(sys.argv[1], step, state, {"step": step})
    print(step, flush=True)
"""


@pytest.mark.slow
def test_a_kill_in_the_midst_of_saving_leaves_a_whole_step(tmp_path):
    folder = tmp_path / "checkpoints"
    process = subprocess.Popen(
        [sys.executable, "-c", SAVER, str(folder)],
        stdout=subprocess.PIPE,
        cwd=Path(__file__).parents[2],
        text=True,
    )
    told = 0
    for _ in range(6):
        told = int(process.stdout.readline())
    time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    step = checkpoint.latest_step(folder)
    assert step >= told
    assert checkpoint.load_config(folder)["step"] == step
    like = {name: jnp.zeros(200_000) for name in "abcd"}
    for array in checkpoint.restore(folder, like).values():
        np.testing.assert_array_equal(array, step)


def test_export_and_import(tmp_path):
    params = state_of(3).params
    path = tmp_path / "folder" / "model.npz"
    checkpoint.export_params(path, params, {"a": [1, 2]}, dtype=np.float32)
    found, config = checkpoint.import_params(path)
    checkpoint.check_params(path, found, params)
    assert checkpoint.export_config(path) == config
    jax.tree.map(np.testing.assert_array_equal, found, params)
    assert config == {"a": [1, 2]}
    checkpoint.export_params(path, params, {})
    half, _ = checkpoint.import_params(path)
    assert half["bias"].dtype == jnp.float32
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3), half, params)
    assert [p.name for p in path.parent.iterdir()] == ["model.npz"]
    for value in (1e5, jnp.nan):
        with pytest.raises(ValueError, match="bias has numbers that are not finite in"):
            checkpoint.export_params(path, {"bias": jnp.full(2, value)}, {})
    deep = {"a": {"b": {"c": jnp.ones(2)}, "d": jnp.zeros(1)}}
    checkpoint.export_params(path, deep, {})
    checkpoint.check_params(path, checkpoint.import_params(path)[0], deep)


@pytest.mark.slow
def test_a_flipped_bit_of_an_export_is_noticed_or_changes_nothing(tmp_path):
    path = tmp_path / "model.npz"
    params = state_of(3, width=64).params
    checkpoint.export_params(path, params, {"a": [1, 2]}, dtype=np.float32)
    generator = np.random.default_rng(0)
    noticed = 0
    for bit in generator.integers(0, 8 * path.stat().st_size, size=300).tolist():
        flipped(path, bit)
        try:
            found, config = checkpoint.import_params(path)
        except checkpoint.CheckpointError:
            noticed += 1
        else:
            assert equal(found, params) and config == {"a": [1, 2]}, bit
        flipped(path, bit)
    assert noticed > 200


def test_an_export_that_was_changed_and_one_without_a_checksum(tmp_path):
    """Its zip archive is whole, so only the checksum can tell."""
    path = tmp_path / "model.npz"
    checkpoint.export_params(path, state_of(3).params, {"width": 8})
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **arrays | {"config": np.array('{"width": 9}')})
    with pytest.raises(checkpoint.CheckpointError, match="model.npz: corrupt"):
        checkpoint.import_params(path)
    np.savez(path, **arrays | {"bias": arrays["bias"] + 1})
    with pytest.raises(checkpoint.CheckpointError, match="model.npz: corrupt"):
        checkpoint.import_params(path)
    del arrays["checksum"]
    np.savez(path, **arrays)
    with pytest.warns(UserWarning, match="model.npz: no checksum"):
        checkpoint.import_params(path)
    np.savez(path, **arrays | {"config": np.array("[1]")})
    with pytest.raises(
        checkpoint.CheckpointError, match="'config' is a list, expected an object"
    ):
        checkpoint.import_params(path)


def test_an_export_to_a_folder_leaves_nothing_beside_it(tmp_path):
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="folder.*expected a file"):
        checkpoint.export_params(tmp_path / "folder", state_of(0).params, {})
    assert [path.name for path in tmp_path.rglob("*")] == ["folder"]


def test_import_of_something_else(tmp_path):
    path = tmp_path / "model.npz"
    contents = {
        "text": b"hello",
        "empty": b"",
        "json": json.dumps({"config": 1}).encode(),
    }
    for content in contents.values():
        path.write_bytes(content)
        with pytest.raises(checkpoint.CheckpointError, match="model.npz"):
            checkpoint.import_params(path)
    np.savez(path, a=np.zeros(3))
    with pytest.raises(checkpoint.CheckpointError, match="model.npz"):
        checkpoint.export_config(path)
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(checkpoint.CheckpointError, match="array.npy"):
        checkpoint.import_params(tmp_path / "array.npy")
    checkpoint.export_params(path, state_of(0).params, {})
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(checkpoint.CheckpointError, match="model.npz"):
        checkpoint.import_params(path)
    with pytest.raises(checkpoint.CheckpointError, match="none.npz"):
        checkpoint.import_params(tmp_path / "none.npz")
    checkpoint.export_params(path, state_of(0).params, {})
    with pytest.raises(checkpoint.CheckpointError, match="model.npz.*another model"):
        found, _ = checkpoint.import_params(path)
        checkpoint.check_params(path, found, state_of(0, width=9).params)


GARBAGE = {
    "all NaN": (dict(a=np.full(3, np.nan, np.float32)), "field 'a' .*not finite"),
    "float64 1e300": (dict(a=np.array([1e300])), "field 'a' .*not finite"),
    "text": (dict(a=np.array(["x"])), "field 'a' .*not finite float32"),
    "array in array": ({"a": np.zeros(2), "a/b": np.zeros(2)}, "'a/b' is within"),
    "array over array": ({"a/b": np.zeros(2), "a": np.zeros(2)}, "'a' is within"),
    "list as config": (dict(config=np.array("[1]")), "'config' is a list"),
    "deep config": (dict(config=np.array("[" * 100_000)), "'config' is missing or no"),
    "pickle": (dict(a=np.array([{}], object)), "field 'a': .*[Oo]bject"),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("case", GARBAGE)
def test_import_of_garbage_names_the_field(tmp_path, case):
    fields, message = GARBAGE[case]
    np.savez(tmp_path / "model.npz", **{"config": np.array("{}")} | fields)
    with pytest.raises(checkpoint.CheckpointError, match=message) as caught:
        checkpoint.import_params(tmp_path / "model.npz")
    assert str(caught.value).startswith(f"{tmp_path}/model.npz: ")
    assert "\n" not in str(caught.value)


def test_import_of_a_pipe_does_not_wait(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(checkpoint.CheckpointError, match="pipe.*regular file"):
        checkpoint.import_params(tmp_path / "pipe")
