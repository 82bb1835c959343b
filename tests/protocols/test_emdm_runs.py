"""Folders of EMDM: rows, their training, what is read back, and sampling of many."""

import dataclasses
import functools
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.learning import adversarial, checkpoint, training
from jaxmotion.protocols import emdm_runs, stages
from jaxmotion.systems import emdm, emdm_loss
from tests import tiny

# Orbax abandons its other reads when one fails.
pytestmark = [
    pytest.mark.usefixtures("quick_compile"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

CONFIG = emdm.Config(
    features=3,
    frames=4,
    condition_size=2,
    num_steps=3,
    latent=2,
    width=8,
    depth=1,
    heads=2,
    hidden=8,
    discriminator_width=64,
    r1_every=2,
)
# One joint; it is its own foot.
GEOMETRY = emdm_loss.Geometry(
    positions=lambda x: x[..., None, :], feet=(0,), channels=slice(0, 3), fps=20.0
)
BUDGET = stages.Budget(
    steps=4,
    batch=4,
    optimizer="adam",
    learning_rate=1e-2,
    ema=0.5,
    chunk=2,
    save_every=2,
)
DATA = jnp.asarray(np.random.default_rng(0).normal(size=(20, 4, 3)), jnp.float32)


def batch(key, data, size):
    """The first ten motions have action 0."""
    chosen = jax.random.randint(key, (size,), 0, data.shape[0])
    return emdm_loss.Batch(
        x_0=data[chosen],
        vector=jax.nn.one_hot(chosen // 10, 2),
        mask=jnp.ones((size, 4), bool),
    )


def task(config=CONFIG, **describe):
    return emdm_runs.Task(
        base=config,
        data=DATA,
        batch=batch,
        geometry=GEOMETRY,
        describe={"source": "tests", "actions": ["a", "b"]} | describe,
    )


def fit(folder, row, *, given=None, steps=4):
    budget = dataclasses.replace(BUDGET, steps=steps)
    emdm_runs.train_row(
        folder, given or task(), row, generator=budget, discriminator=budget
    )


# --- rows --------------------------------------------------------------------------


def test_rows_are_changes_of_the_base():
    base = emdm.Config(features=150, weight_recon=100.0)
    make = functools.partial(emdm_runs.row_config, base)
    flat = dict(weight_position=0.0, weight_velocity=0.0, weight_foot=0.0)
    mdm = dict(latent=0, schedule="cosine", weight_recon=1.0)
    expected = {
        "emdm": {},
        "emdm_5": dict(num_steps=5),
        "emdm_2": dict(num_steps=2),
        "emdm_1": dict(num_steps=1),
        "naive": dict(discriminator_condition=False, weight_recon=0.0, **flat),
        "ddpm_50": dict(num_steps=50, **mdm),
        "ddpm_1000": dict(num_steps=1000, **mdm),
        "ddim_10": dict(num_steps=1000, **mdm),
        "no_r1": dict(weight_r1=0.0),
    }
    for weight in (0, 1, 10, 100):
        expected[f"recon_{weight}"] = dict(weight_recon=float(weight), **flat)
    assert set(expected) == {*emdm_runs.ROWS, *emdm_runs.SAMPLERS}
    for row, changes in expected.items():
        assert make(row) == dataclasses.replace(base, **changes)


def test_unknown_rows_are_named_with_the_known_ones():
    emdm_runs.check_rows((*emdm_runs.ROWS, *emdm_runs.SAMPLERS))
    emdm_runs.check_rows(())
    for call in (
        lambda: emdm_runs.check_rows(("emdm", "emdn", "x")),
        lambda: emdm_runs.row_config(CONFIG, "emdn"),
        lambda: emdm_runs.load_row(None, "emdn"),
        lambda: fit(None, "emdn"),
    ):
        with pytest.raises(ValueError, match="'emdn': expected.*emdm_5.*ddim_10"):
            call()


def test_the_penalty_is_due_every_kth_update():
    config = dataclasses.replace(CONFIG, r1_every=3)
    optimizers = (training.gan_adam(learning_rate=0.0),) * 2
    update = emdm_runs.gan_update(optimizers, config=config, geometry=None, ema=0.5)
    params = tiny.random_params(emdm.init, config)
    state = adversarial.GanState(
        **{n: training.init_train_state(params[n], optimizers[0]) for n in params}
    )
    draw = lambda key, data: batch(key, data, 4)  # noqa: E731
    run = training.train_chunk(update, draw, num_steps=4)
    state, info = run(state, jax.random.key(0), DATA)
    penalties = [info["discriminator/r1"]]
    # The count goes on in the next chunk.
    state, info = run(state, jax.random.key(1), DATA)
    due = np.concatenate([*penalties, info["discriminator/r1"]]) > 0
    np.testing.assert_array_equal(due, np.arange(8) % 3 == 0)


# --- training ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(tmp_path_factory, quick_compile):
    """A run folder with a row of each kind."""
    folder = tmp_path_factory.mktemp("run")
    for row in ("emdm", "ddpm_1000"):
        fit(folder, row)
    return folder


def losses(folder):
    lines = (folder / "losses.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


def same(a, b):
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y) for x, y in pairs)


@pytest.mark.parametrize("row", ["emdm", "ddpm_1000"])
def test_a_row_leaves_checkpoints_and_losses(trained, row):
    folder = trained / row
    assert checkpoint.latest_step(folder / "checkpoints") == 4
    rows = losses(folder)
    assert [r["step"] for r in rows] == [2, 4]
    terms = {"recon", "position", "velocity", "foot"}
    prefix = "generator/" if row == "emdm" else ""
    assert {f"{prefix}{term}" for term in terms} <= set(rows[0])
    assert ("discriminator/r1" in rows[0]) == (row == "emdm")
    value = stages.check_stage(folder, row, system="emdm")
    assert value["source"] == "tests" and value["actions"] == ["a", "b"]
    # Updates 0 and 2 had the penalty, so each mean of two has some.
    assert row != "emdm" or all(r["discriminator/r1"] > 0 for r in rows)


@pytest.mark.parametrize("row", ["emdm", "ddpm_1000"])
def test_a_row_is_read_back(trained, row):
    params, config = emdm_runs.load_row(trained, row)
    assert config == emdm_runs.row_config(CONFIG, row)
    start = emdm.init(jax.random.key(0), config)["generator"]
    assert jax.tree.structure(params) == jax.tree.structure(start)
    assert not same(params, start)
    state = training.init_train_state(start, training.gan_adam())
    within = "generator" if row == "emdm" else None
    like = {"params": state.params, "ema_params": state.params}
    found = checkpoint.restore_part(trained / row / "checkpoints", like, within=within)
    assert same(params, found["ema_params"]) and not same(params, found["params"])


def test_a_sampler_is_another_way_to_use_a_row(trained):
    params, config = emdm_runs.load_row(trained, "ddim_10")
    plain, same_config = emdm_runs.load_row(trained, "ddpm_1000")
    assert same(params, plain) and config == same_config
    sample = jax.jit(emdm_runs.row_sampler(params, config, "ddim_10"))
    condition = jax.tree.map(
        lambda x: x[0], emdm.make_condition(jnp.eye(2)[:1], config=config)
    )
    found = sample(jax.random.key(0), condition)
    by_hand = emdm.sampler(
        params, config=config, step="ddim", steps=tuple(range(1, 1000, 100))
    )
    np.testing.assert_allclose(
        found, jax.jit(by_hand)(jax.random.key(0), condition), rtol=1e-5, atol=1e-5
    )
    other = jax.jit(emdm_runs.row_sampler(params, config, "ddpm_1000"))
    assert np.abs(other(jax.random.key(0), condition) - found).max() > 1e-3


@pytest.mark.parametrize("row", ["emdm", "ddpm_1000"])
def test_a_resumed_row_ends_as_one_without_a_break(trained, tmp_path, row):
    fit(tmp_path, row, steps=2)
    assert checkpoint.latest_step(tmp_path / row / "checkpoints") == 2
    fit(tmp_path, row)
    found, _ = emdm_runs.load_row(tmp_path, row)
    expected, _ = emdm_runs.load_row(trained, row)
    assert same(found, expected)
    assert [r["step"] for r in losses(tmp_path / row)] == [2, 4]


def test_a_finished_row_is_not_trained_again(trained):
    before = losses(trained / "emdm")
    fit(trained, "emdm")
    assert losses(trained / "emdm") == before


@pytest.mark.parametrize(
    ("changes", "describe", "field"),
    [
        (dict(width=16), {}, "config"),
        (dict(weight_r1=0.5), {}, "config"),
        ({}, dict(source="others"), "source"),
    ],
)
def test_other_sizes_or_data_are_refused(trained, changes, describe, field):
    given = task(dataclasses.replace(CONFIG, **changes), **describe)
    for row in ("emdm", "ddpm_1000"):
        with pytest.raises(ValueError, match=f"{row}.*trained with other {field}"):
            fit(trained, row, given=given)
        assert checkpoint.latest_step(trained / row / "checkpoints") == 4


def test_rows_that_are_not_there_or_others_are_named(trained, tmp_path):
    with pytest.raises(checkpoint.CheckpointError, match="emdm_5"):
        emdm_runs.load_row(trained, "emdm_5")
    shutil.copytree(trained / "ddpm_1000", tmp_path / "ddpm_50")
    with pytest.raises(checkpoint.CheckpointError) as error:
        emdm_runs.load_row(tmp_path, "ddpm_50")
    for word in (str(tmp_path / "ddpm_50"), "'ddpm_1000'", "'ddpm_50'"):
        assert word in str(error.value)
    with pytest.raises(checkpoint.CheckpointError, match="another stage"):
        fit(tmp_path, "ddpm_50")


def test_a_row_of_another_system_is_named(tmp_path):
    value = {"system": "aamdm", "stage": "emdm"}
    folder = tmp_path / "emdm"
    checkpoint.save(folder / "checkpoints", 1, {"ema_params": DATA}, value)
    for call in (
        lambda: emdm_runs.load_row(tmp_path, "emdm"),
        lambda: fit(tmp_path, "emdm"),
    ):
        with pytest.raises(
            checkpoint.CheckpointError, match="'aamdm', expected 'emdm'"
        ):
            call()


def test_a_row_without_weights_of_joints_needs_no_geometry(tmp_path, monkeypatch):
    """Its batches may be of features that have no joints."""
    given = []

    def watched(optimizers, *, config, geometry, ema):
        given.append((config, geometry))
        raise KeyboardInterrupt

    monkeypatch.setattr(emdm_runs, "gan_update", watched)
    for row in ("recon_10", "emdm"):
        with pytest.raises(KeyboardInterrupt):
            fit(tmp_path, row)
    assert given[0][1] is None and given[1][1] is GEOMETRY
    assert given[0][0].weight_recon == 10.0


# --- sampling ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def many():
    """A sampler, and eight conditions of different lengths."""
    params = tiny.random_params(emdm.init, CONFIG)["generator"]
    conditions = emdm.make_condition(
        jnp.eye(2)[jnp.arange(8) % 2], (4, 3, 2, 1, 4, 4, 3, 2), config=CONFIG
    )
    return emdm.sampler(params, config=CONFIG), conditions


@pytest.mark.parametrize("scale", [None, 2.5])
def test_a_motion_does_not_depend_on_how_many_are_made(many, scale):
    sample, conditions = many
    scale = None if scale is None else jnp.float32(scale)
    run = emdm_runs.sample_many(sample, chunk=8)
    whole = run(jax.random.key(0), conditions, scale)
    assert whole.shape == (8, 4, 3)
    assert all(np.abs(whole[0] - whole[i]).max() > 1e-3 for i in range(1, 8))
    for chunk, number in ((1, 8), (3, 8), (8, 1), (100, 5)):
        part = jax.tree.map(lambda x, n=number: x[:n], conditions)
        run = emdm_runs.sample_many(sample, chunk=chunk)
        found = run(jax.random.key(0), part, scale)
        np.testing.assert_allclose(found, whole[:number], rtol=1e-4, atol=1e-4)


def test_each_motion_is_one_of_the_sampler_with_its_own_key(many):
    sample, conditions = many
    whole = emdm_runs.sample_many(sample, chunk=4)(
        jax.random.key(3), conditions, jnp.float32(2.0)
    )
    alone = jax.jit(sample)
    for i in (0, 5):
        key = jax.random.fold_in(jax.random.key(3), i)
        own = jax.tree.map(lambda x, i=i: x[i], conditions)
        found = alone(key, own, scale=jnp.float32(2.0))
        np.testing.assert_allclose(whole[i], found, rtol=1e-4, atol=1e-4)


def test_a_scale_of_one_is_no_guidance(many):
    sample, conditions = many
    run = emdm_runs.sample_many(sample, chunk=8)
    plain = run(jax.random.key(0), conditions, None)
    guided = run(jax.random.key(0), conditions, jnp.float32(1.0))
    np.testing.assert_allclose(guided, plain, rtol=1e-4, atol=1e-4)


# --- the folder's own settings -----------------------------------------------------


def test_settings_come_back_with_their_system(tmp_path):
    value = {"field": "content", "frames": 60, "held_out": 0.2, "merge": {"a": "b"}}
    emdm_runs.write_config(tmp_path, value)
    assert emdm_runs.read_config(tmp_path) == {"system": "emdm"} | value


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no run folder of.*config.json"),
        ("{", "no run folder"),
        ("[1]", "no run folder"),
        (
            '{"field": "content"}',
            "config.json: field 'system' is None, expected 'emdm'",
        ),
        (
            '{"system": "aamdm"}',
            "config.json: field 'system' is 'aamdm', expected 'emdm'",
        ),
    ],
)
def test_other_folders_are_named(tmp_path, content, message):
    if content is not None:
        (tmp_path / "config.json").write_text(content)
    with pytest.raises(ValueError, match=message) as error:
        emdm_runs.read_config(tmp_path)
    assert str(tmp_path) in str(error.value)
