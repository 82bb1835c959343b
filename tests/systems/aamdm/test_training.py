"""Stages of AAMDM's training: resumed, told apart, and read back."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxmotion.learning import adversarial, checkpoint, training
from jaxmotion.systems.aamdm import data as aamdm_data
from jaxmotion.systems.aamdm import embedding as aamdm_embedding
from jaxmotion.systems.aamdm import space as aamdm_space
from jaxmotion.systems.aamdm import training as aamdm_training
from tests import person, tiny

# Orbax abandons its other reads when one fails.
pytestmark = [
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

BUDGET = aamdm_training.Budget(
    steps=4, batch=4, learning_rate=0.1, ema=0.5, chunk=2, save_every=2
)
CONFIG = {"config": {"width": 3}, "source": "tests"}


def data():
    """Frames that hold their clip and their number."""
    clip, number = np.repeat([0, 1], [7, 5]), np.arange(12)
    return aamdm_data.PoseData(
        poses=person.float32(np.stack([clip, number], axis=-1)),
        paths=jnp.zeros((12, 12)),
        offsets=jnp.array([0, 7, 12], jnp.int32),
        fps=60.0,
    )


def init(size=3):
    return {"w": jnp.arange(2.0 * size).reshape(size, 2), "b": jnp.ones(2)}


def loss(params, key, batch):
    noise = jax.random.normal(key, params["b"].shape)
    bias = (params["b"] + noise).reshape(1, 1, 2)
    gap = batch - params["w"][:1].reshape(1, 1, 2) - bias
    return jnp.mean(gap**2), {}


def fit(folder, *, steps=4, stage="polisher", config=CONFIG, frames=b"1", **changes):
    """A stage up to some of the steps of the whole budget."""
    source = folder.with_name(f"{folder.name}.frames")
    source.parent.mkdir(parents=True, exist_ok=True)
    source.write_bytes(frames)
    optimizer = aamdm_training.make_optimizer(BUDGET)
    sample, arrays = aamdm_training.frame_windows(
        data().poses, data(), 2, batch=BUDGET.batch
    )
    return aamdm_training.fit(
        folder,
        training.init_train_state(init(), optimizer),
        training.make_update(loss, optimizer, ema_decay=BUDGET.ema),
        sample,
        arrays,
        stage=stage,
        budget=dataclasses.replace(BUDGET, steps=steps, **changes),
        config=config,
        source=source,
    )


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A stage of four updates, and the state that it returned."""
    folder = tmp_path_factory.mktemp("run") / "polisher"
    return folder, fit(folder)


def assert_same(found, expected):
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    for a, b in pairs:
        np.testing.assert_array_equal(a, b)


def contents(folder):
    return {x: x.read_bytes() for x in folder.rglob("*") if x.is_file()}


# --- training ----------------------------------------------------------------------


def test_a_resumed_stage_ends_as_one_without_a_break(trained, tmp_path):
    half = fit(tmp_path, steps=2)
    assert int(half.step) == 2
    whole = fit(tmp_path, override=True)
    assert_same(whole, trained[1])
    assert np.abs(whole.params["w"] - init()["w"]).max() > 0
    rows = [json.loads(x) for x in (tmp_path / "losses.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [2, 4]


def test_any_number_of_updates_can_be_made_and_gone_on_from(trained, tmp_path):
    """Three are not a multiple of the chunk of two."""
    assert int(fit(tmp_path, steps=3).step) == 3
    assert checkpoint.latest_step(tmp_path / "checkpoints") == 3
    assert_same(fit(tmp_path, override=True), trained[1])


def test_a_finished_stage_is_not_trained_again(trained):
    folder, state = trained
    before = (folder / "losses.jsonl").read_text()
    again = fit(folder)
    assert_same(again, state)
    assert (folder / "losses.jsonl").read_text() == before
    assert checkpoint.latest_step(folder / "checkpoints") == 4


def test_other_settings_are_refused_and_named(trained):
    folder, state = trained
    other = CONFIG | {"config": {"width": 5}}
    before = contents(folder)
    changes = {
        "of another model: config.width is 3, given 5": dict(config=other),
        "at step 4, .*: batch is 4, given 5; seed is .*--override": dict(
            batch=5, seed=8
        ),
        "learning_rate is .*, given 0.5": dict(learning_rate=0.5),
        "ema is 0.5, given 0.25": dict(ema=0.25),
        "optimizer is .*, given 'radam'": dict(optimizer="radam"),
        "steps is 4, given 6": dict(steps=6),
        "data is '[0-9a-f]{12}', .* .other data.;": dict(frames=b"2"),
        "has 4 steps, expected at most the 3 to train": dict(steps=3),
    }
    for message, change in changes.items():
        with pytest.raises(ValueError, match=f"^{folder}: .*{message}"):
            fit(folder, **change)
        assert contents(folder) == before
    with pytest.raises(ValueError, match="has 4 steps"):
        fit(folder, steps=3, override=True)
    # How often it is saved changes nothing that is trained.
    assert_same(fit(folder, chunk=1, save_every=1), state)
    assert contents(folder) == before


def test_a_stage_is_not_trained_in_the_folder_of_another(trained):
    folder, _ = trained
    with pytest.raises(checkpoint.CheckpointError) as error:
        fit(folder, stage="generator")
    for word in (str(folder), "'polisher'", "'generator'"):
        assert word in str(error.value)


@pytest.mark.parametrize("name", ["muon", "adamw", "radam"])
def test_every_optimizer_lowers_a_bowl(name):
    budget = dataclasses.replace(BUDGET, optimizer=name, steps=40, learning_rate=0.1)
    optimizer = aamdm_training.make_optimizer(budget)
    params = {"w": jnp.full((2, 2), 3.0), "b": jnp.full(2, 3.0)}
    bowl = lambda p: sum(jnp.sum(x**2) for x in jax.tree.leaves(p))  # noqa: E731

    def one(carry, _):
        params, state = carry
        changes, state = optimizer.update(jax.grad(bowl)(params), state, params)
        return (optax.apply_updates(params, changes), state), bowl(params)

    start = params, optimizer.init(params)
    values = jax.jit(lambda c: jax.lax.scan(one, c, None, 40)[1])(start)
    assert np.all(np.isfinite(values)) and values[-1] < 0.7 * values[0]


# --- what it leaves behind ---------------------------------------------------------


def test_averaged_parameters_are_read_back(trained):
    folder, state = trained
    assert aamdm_training.check_stage(folder, "polisher")["source"] == "tests"
    found = aamdm_training.load_params(folder, "polisher", init)
    assert_same(found, state.ema_params)
    assert np.abs(state.ema_params["w"] - state.params["w"]).max() > 0


def test_one_stage_is_not_taken_for_another(trained):
    folder, _ = trained
    for read in (
        lambda: aamdm_training.check_stage(folder, "generator"),
        lambda: aamdm_training.load_params(folder, "generator", init, adversarial=True),
        lambda: aamdm_training.restore_space(folder, lambda: space(None)),
    ):
        with pytest.raises(checkpoint.CheckpointError, match=str(folder)) as error:
            read()
        assert "'polisher'" in str(error.value)
        assert "'generator'" in str(error.value) or "'space'" in str(error.value)


def test_a_checkpoint_of_another_system_is_named(tmp_path):
    state = {"ema_params": init()}
    checkpoint.save(tmp_path / "checkpoints", 1, state, {"system": "camdm"})
    with pytest.raises(checkpoint.CheckpointError, match=f"{tmp_path}.*'camdm'.*aamdm"):
        aamdm_training.check_stage(tmp_path, "polisher")


def test_a_folder_without_checkpoints_is_named(tmp_path):
    for read in (
        lambda: aamdm_training.check_stage(tmp_path, "polisher"),
        lambda: aamdm_training.load_params(tmp_path, "polisher", init),
        lambda: aamdm_training.restore_space(tmp_path, lambda: space(None)),
    ):
        with pytest.raises(checkpoint.CheckpointError, match=str(tmp_path)):
            read()


def test_parameters_of_another_size_are_refused(trained):
    folder, _ = trained
    with pytest.raises(checkpoint.CheckpointError, match=f"{folder}.*another model"):
        aamdm_training.load_params(folder, "polisher", lambda: init(size=4))
    with pytest.raises(checkpoint.CheckpointError, match=f"{folder}.*another model"):
        aamdm_training.load_params(folder, "polisher", init, adversarial=True)


def test_of_two_players_the_generator_is_read(tmp_path):
    optimizer = aamdm_training.make_optimizer(BUDGET)

    def player(factor):
        params = jax.tree.map(lambda x: factor * x, init())
        return training.init_train_state(params, optimizer)

    players = adversarial.GanState(generator=player(2.0), discriminator=player(3.0))
    config = {"system": "aamdm", "stage": "generator"}
    checkpoint.save(tmp_path / "checkpoints", 1, players, config)
    found = aamdm_training.load_params(tmp_path, "generator", init, adversarial=True)
    assert_same(found, jax.tree.map(lambda x: 2.0 * x, init()))


# --- windows -----------------------------------------------------------------------


def test_windows_of_frames_lie_within_clips():
    sample, arrays = aamdm_training.frame_windows(data().poses, data(), 4, batch=200)
    found = np.asarray(jax.jit(sample)(jax.random.key(0), arrays))
    assert found.shape == (200, 4, 2)
    assert np.all(found[..., 0] == found[:, :1, 0])
    assert np.all(np.diff(found[..., 1], axis=1) == 1)
    # Four starts in the first clip and two in the second, all of them drawn.
    assert set(found[:, 0, 1].astype(int)) == {0, 1, 2, 3, 7, 8}
    with pytest.raises(ValueError, match="8 frames.*longest has 7"):
        aamdm_training.frame_windows(data().poses, data(), 8, batch=2)


# --- spaces ------------------------------------------------------------------------

SIZES = aamdm_embedding.Config(num_joints=6, latent=4, width=8)


def space(autoencoder):
    poses, paths = jnp.ones((4, 98)), jnp.ones((4, 12))
    poses = poses * jnp.arange(4.0)[:, None]
    if autoencoder:
        statistics = aamdm_embedding.fit_statistics(poses, paths, config=SIZES)
        params = tiny.random_params(aamdm_embedding.init, SIZES)
        autoencoder = aamdm_space.Autoencoder(
            params=params, statistics=statistics, config=SIZES
        )
    return aamdm_space.fit_space(
        poses, paths, jnp.arange(3, dtype=jnp.int32), autoencoder=autoencoder or None
    )


@pytest.mark.parametrize("embedded", [False, True])
def test_a_space_is_read_back(tmp_path, embedded):
    made = space(embedded)
    aamdm_training.save_space(tmp_path, made, {"source": "tests"})
    found = aamdm_training.restore_space(tmp_path, lambda: jax.tree.map(jnp.copy, made))
    assert jax.tree.structure(found) == jax.tree.structure(made)
    assert_same(found, made)
    with pytest.raises(checkpoint.CheckpointError, match=str(tmp_path)):
        other = space(not embedded)
        aamdm_training.restore_space(tmp_path, lambda: jax.tree.map(jnp.copy, other))
