"""Folders of EMDM: rows, their training, what is read back, and sampling of many."""

import dataclasses
import functools
import json
import shutil

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.diffusion import chain, schedule
from jaxmotion.learning import adversarial, checkpoint, runs, training
from jaxmotion.systems.emdm import loss as emdm_loss
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import training as emdm_training
from tests import mostly_slow, tiny

# Orbax abandons its other reads when one fails.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

CONFIG = emdm_model.Config(
    features=3,
    frames=8,
    condition_size=2,
    num_steps=3,
    latent=2,
    width=8,
    depth=1,
    heads=2,
    hidden=8,
    discriminator_width=64,
    r1_every=3,
)
# One joint; it is its own foot.
GEOMETRY = emdm_loss.Geometry(
    positions=lambda x: x[..., None, :], feet=(0,), channels=slice(0, 3), fps=20.0
)
BUDGET = runs.Budget(
    steps=4,
    batch=4,
    optimizer="adam",
    learning_rate=1e-2,
    ema=0.5,
    chunk=1,
    save_every=2,
)
DATA = jnp.asarray(np.random.default_rng(0).normal(size=(20, 8, 3)), jnp.float32)


def batch(key, data, size):
    """The first ten motions have action 0."""
    chosen = jax.random.randint(key, (size,), 0, data.shape[0])
    return emdm_loss.Batch(
        x_0=data[chosen],
        vector=jax.nn.one_hot(chosen // 10, 2),
        mask=jnp.ones((size, 8), bool),
    )


def run_of(folder, files="1"):
    return tiny.run_folder(folder, "emdm", files={"data.npz": files})


def load(folder, row):
    return emdm_training.load_row(run_of(folder), row)


def task(folder, config=CONFIG, files="1"):
    return emdm_training.Task(
        run=run_of(folder, files),
        base=config,
        data=DATA,
        batch=batch,
        geometry=GEOMETRY,
    )


PROGRAMS = {}


def fit(folder, row, *, config=CONFIG, files="1", steps=4, **changes):
    """Trains a row; its update is compiled once for all folders, its start never."""
    given = task(folder, config, files)
    make, start, init = training.train_chunk, training.init_train_state, emdm_model.init

    def once(*parts, **options):
        return PROGRAMS.setdefault((row, given.base), make(*parts, **options))

    def placed(*parts):
        """As a restored state is: else it would be another program's."""
        return jax.device_put(start(*parts), jax.devices()[0])

    budget = dataclasses.replace(BUDGET, steps=steps, **changes)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            emdm_model, "init", lambda _, config: tiny.random_params(init, config)
        )
        patch.setattr(training, "train_chunk", once)
        patch.setattr(training, "init_train_state", placed)
        emdm_training.train_row(given, row, generator=budget, discriminator=budget)


# --- rows --------------------------------------------------------------------------


def test_rows_are_changes_of_the_base():
    base = emdm_model.Config(features=150, weight_recon=100.0)
    make = functools.partial(emdm_training.row_config, base)
    flat = dict(weight_position=0.0, weight_velocity=0.0, weight_foot=0.0)
    flat |= dict(weight_position_velocity=0.0, weight_acceleration=0.0)
    mdm = dict(latent=0, schedule="cosine", weight_recon=1.0)
    fine = (0.999, 0.99, 0.95, 0.86, 0.71, 0.5, 0.3, 0.14, 0.04, 4e-5)
    expected = {
        "emdm": {},
        "emdm_5": dict(num_steps=5),
        "emdm_3": dict(num_steps=3),
        "emdm_2": dict(num_steps=2),
        "emdm_1": dict(num_steps=1),
        "naive": dict(discriminator_condition=False, weight_recon=0.0, **flat),
        "ddpm_50": dict(num_steps=50, **mdm),
        "ddpm_1000": dict(num_steps=1000, **mdm),
        "ddim_10": dict(num_steps=1000, **mdm),
        "no_r1": dict(weight_r1=0.0),
        "no_gan": dict(weight_adversarial=0.0),
        "no_gan_fine": dict(weight_adversarial=0.0, alpha_bar=fine),
        "no_gan_14": dict(
            weight_adversarial=0.0, num_steps=14, alpha_bar=make("no_gan_14").alpha_bar
        ),
        "no_gan_10": dict(
            weight_adversarial=0.0, alpha_bar=make("no_gan_10").alpha_bar
        ),
        "no_condition": dict(discriminator_condition=False),
    }
    learns = dict(
        discriminator_network="temporal",
        discriminator_loss="relativistic",
        discriminator_from=2,
        weight_r1=500.0,
        r1_every=4,
        weigh_levels="posterior",
        fade_geometry=True,
    )
    left = {2: (0.7,), 3: (0.9, 0.5), 5: (0.95, 0.8, 0.6, 0.3)}
    left[10] = (0.99, 0.95, 0.89, 0.81, 0.71, 0.59, 0.45, 0.31, 0.16)
    for steps, shares in left.items():
        changes = dict(num_steps=steps, alpha_bar=(*shares, 4e-5))
        expected[f"few_{steps}"] = changes | learns
    expected["few_1"] = learns | dict(num_steps=1, discriminator_from=1)
    for steps in (1, 2, 3, 5):
        alone = dict(weight_adversarial=0.0, num_steps=steps)
        expected[f"no_gan_{steps}"] = alone
    for weight in (0, 1, 10, 100, 1000):
        expected[f"recon_{weight}"] = dict(weight_recon=float(weight), **flat)
    both = make("no_gan_14").alpha_bar
    published = schedule.vp_schedule(10).alpha_bar[5:]
    assert both[:8] == fine[:8]
    np.testing.assert_allclose(both[8:], published, rtol=1e-5)
    visited = (0, 1, 3, 5, 7, *range(9, 14))
    assert make("no_gan_10").alpha_bar == tuple(both[i] for i in visited)
    assert set(expected) == {*emdm_training.ROWS, *emdm_training.SAMPLERS}
    for row, changes in expected.items():
        assert make(row) == dataclasses.replace(base, **changes)


def test_unknown_rows_are_named_with_the_known_ones(tmp_path):
    emdm_training.check_rows((*emdm_training.ROWS, *emdm_training.SAMPLERS))
    emdm_training.check_rows(())
    for call in (
        lambda: emdm_training.check_rows(("emdm", "emdn", "x")),
        lambda: emdm_training.row_config(CONFIG, "emdn"),
        lambda: load(tmp_path, "emdn"),
        lambda: fit(tmp_path, "emdn"),
    ):
        with pytest.raises(ValueError, match="'emdn': expected.*emdm_5.*ddim_10"):
            call()


# --- training ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run folder with a row of each kind."""
    folder = tmp_path_factory.mktemp("run")
    for row in ("emdm", "few_3", "no_gan", "ddpm_1000"):
        fit(folder, row)
    return folder


def losses(folder):
    lines = (folder / "losses.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


def same(a, b):
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y) for x, y in pairs)


@pytest.mark.parametrize("row", ["emdm", "few_3", "no_gan", "ddpm_1000"])
def test_a_row_leaves_checkpoints_and_losses(trained, row):
    folder = trained / row
    assert checkpoint.latest_step(folder / "checkpoints") == 4
    rows = losses(folder)
    assert [r["step"] for r in rows] == [1, 2, 3, 4]
    terms = {"recon", "position", "velocity", "foot"}
    prefix = "generator/" if row in ("emdm", "few_3") else ""
    assert {f"{prefix}{term}" for term in terms} <= set(rows[0])
    assert ("discriminator/r1" in rows[0]) == bool(prefix)
    config = dataclasses.asdict(emdm_training.row_config(CONFIG, row))
    runs.check_model(run_of(trained), row, config)


@pytest.mark.parametrize("row", ["emdm", "no_gan", "ddpm_1000"])
def test_a_row_is_read_back(trained, row):
    params, config = load(trained, row)
    assert config == emdm_training.row_config(CONFIG, row)
    start = tiny.random_params(emdm_model.init, config)["generator"]
    assert jax.tree.structure(params) == jax.tree.structure(start)
    within = "generator" if row == "emdm" else None
    like = {"params": start, "ema_params": start}
    found = checkpoint.restore_part(trained / row / "checkpoints", like, within=within)
    assert same(params, found["ema_params"])
    assert not same(params, found["params"]) and not same(params, start)


def test_a_sampler_is_another_way_to_use_a_row(trained, monkeypatch):
    params, config = load(trained, "ddim_10")
    plain, same_config = load(trained, "ddpm_1000")
    assert same(params, plain) and config == same_config
    seen, make = [], emdm_model.sampler

    def watched(params, **kind):
        seen.append(kind)
        return make(params, **kind)

    monkeypatch.setattr(emdm_model, "sampler", watched)
    for row in ("ddim_10", "ddpm_1000", "emdm"):
        emdm_training.row_sampler(params, config, row)
    steps = tuple(range(1, 1000, 100))
    assert seen[0] == dict(config=config, step=chain.ddim_step, steps=steps)
    for kind in seen[1:]:
        assert kind == dict(config=config)


@pytest.mark.parametrize("row", ["emdm", "ddpm_1000"])
def test_a_resumed_row_ends_as_one_without_a_break(trained, tmp_path, row):
    fit(tmp_path, row, steps=2)
    assert checkpoint.latest_step(tmp_path / row / "checkpoints") == 2
    fit(tmp_path, row, override=True)
    found, _ = load(tmp_path, row)
    expected, _ = load(trained, row)
    assert same(found, expected)
    # The same numbers in every update, but for how long they took; the third update
    # after the first with a penalty has the next one.
    rows = [losses(path / row) for path in (tmp_path, trained)]
    for one, other in zip(*rows, strict=True):
        assert one | {"steps_per_second": 0} == other | {"steps_per_second": 0}
    if row == "emdm":
        due = [r["discriminator/r1"] > 0 for r in rows[0]]
        assert due == [True, False, False, True]


def test_a_finished_row_is_not_trained_again(trained):
    before = losses(trained / "emdm")
    fit(trained, "emdm")
    assert losses(trained / "emdm") == before


@pytest.mark.parametrize("change", [dict(heads=1), dict(weight_r1=0.5)])
def test_other_sizes_are_refused(trained, change):
    for row in ("emdm", "ddpm_1000"):
        with pytest.raises(
            ValueError, match=f"{row}: of another model: {[*change][0]}"
        ):
            fit(trained, row, config=dataclasses.replace(CONFIG, **change))
        assert checkpoint.latest_step(trained / row / "checkpoints") == 4


def test_other_budgets_are_refused(trained):
    for row, message, change in (
        ("emdm", "discriminator_rate is .*, given 0.5", dict(learning_rate=0.5)),
        ("ddpm_1000", "learning_rate is .*, given 0.5", dict(learning_rate=0.5)),
        ("emdm", "seed is 0, given 3", dict(seed=3)),
        ("emdm", "files.data.npz is '1', given '2'", dict(files="2")),
        ("emdm", "has 4 steps, expected at most the 3", dict(steps=3)),
    ):
        with pytest.raises(ValueError, match=f"{row}: .*{message}"):
            fit(trained, row, **change)
        assert checkpoint.latest_step(trained / row / "checkpoints") == 4


def test_rows_that_are_not_there_or_others_are_named(trained, tmp_path):
    with pytest.raises(checkpoint.CheckpointError, match="emdm_5"):
        load(trained, "emdm_5")
    shutil.copytree(trained / "ddpm_1000", tmp_path / "ddpm_50")
    with pytest.raises(checkpoint.CheckpointError) as error:
        load(tmp_path, "ddpm_50")
    for word in (str(tmp_path / "ddpm_50"), "'ddpm_1000'", "'ddpm_50'"):
        assert word in str(error.value)
    with pytest.raises(checkpoint.CheckpointError, match="another stage"):
        fit(tmp_path, "ddpm_50")


def test_a_row_of_another_system_is_named(tmp_path):
    value = {"system": "aamdm", "stage": "emdm"}
    folder = tmp_path / "emdm"
    checkpoint.save(folder / "checkpoints", 1, {"ema_params": DATA}, value)
    for call in (
        lambda: load(tmp_path, "emdm"),
        lambda: fit(tmp_path, "emdm"),
    ):
        with pytest.raises(
            checkpoint.CheckpointError, match="'aamdm', expected 'emdm'"
        ):
            call()


def test_a_row_without_weights_of_joints_needs_no_geometry(tmp_path, monkeypatch):
    """Its batches may be of features that have no joints."""
    given = []

    def watched(optimizers, *, config, geometry, **_):
        given.append((config, geometry))
        raise KeyboardInterrupt

    monkeypatch.setattr(emdm_training, "gan_update", watched)
    for row in ("recon_10", "emdm"):
        with pytest.raises(KeyboardInterrupt):
            fit(tmp_path, row)
    assert given[0][1] is None and given[1][1] is GEOMETRY
    assert given[0][0].weight_recon == 10.0


def test_a_generator_alone_makes_the_updates_of_a_diffusion_model():
    """And the discriminator, left as it is meanwhile, those of a GAN after them."""
    rate = training.make_optimizer("adam", learning_rate=1e-2)
    params = tiny.random_params(emdm_model.init, CONFIG)
    start = adversarial.GanState(
        generator=training.init_train_state(params["generator"], rate),
        discriminator=training.init_train_state(params["discriminator"], rate),
    )
    make = functools.partial(
        emdm_training.gan_update,
        (rate, rate),
        config=CONFIG,
        geometry=GEOMETRY,
        ema=0.5,
    )
    both, alone = jax.jit(make()), jax.jit(make(alone=2))
    loss = functools.partial(emdm_loss.diffusion_loss, config=CONFIG, geometry=GEOMETRY)
    plain = jax.jit(training.make_update(loss, rate, ema_decay=0.5))
    state, model = start, start.generator
    for i in range(2):
        key, drawn = jax.random.key(i), batch(jax.random.key(9 + i), DATA, 4)
        state, info = alone(state, key, drawn)
        model, expected = plain(model, jax.random.clone(key), drawn)
        assert float(info["loss"]) == pytest.approx(float(expected["loss"]), rel=1e-5)
        assert float(info["discriminator/loss"]) == 0.0
    chex.assert_trees_all_close(state.generator, model, rtol=1e-5, atol=1e-6)
    chex.assert_trees_all_equal(state.discriminator, start.discriminator)
    key, drawn = jax.random.key(5), batch(jax.random.key(6), DATA, 4)
    chex.assert_trees_all_close(
        alone(state, key, drawn),
        both(state, jax.random.clone(key), drawn),
        rtol=1e-5,
        atol=1e-6,
    )


# --- sampling ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def many():
    """A sampler, eight conditions of different lengths, and their program."""
    params = tiny.random_params(emdm_model.init, CONFIG)["generator"]
    conditions = emdm_model.make_condition(
        jnp.eye(2)[jnp.arange(8) % 2], (4, 3, 2, 1, 4, 4, 3, 2), config=CONFIG
    )
    sample = emdm_model.sampler(params, config=CONFIG)
    return sample, conditions, emdm_training.sample_many(sample, chunk=8)


@pytest.mark.parametrize(
    ("scale", "chunk", "number"),
    mostly_slow([(None, 8, 1), (2.5, 3, 8), (2.5, 100, 5)], [(2.5, 3, 8)]),
)
def test_a_motion_does_not_depend_on_how_many_are_made(many, scale, chunk, number):
    sample, conditions, run = many
    scale = None if scale is None else jnp.float32(scale)
    whole = run(jax.random.key(0), conditions, scale)
    assert whole.shape == (8, 8, 3)
    assert all(np.abs(whole[0] - whole[i]).max() > 1e-3 for i in range(1, 8))
    part = jax.tree.map(lambda x: x[:number], conditions)
    found = emdm_training.sample_many(sample, chunk=chunk)(
        jax.random.key(0), part, scale
    )
    np.testing.assert_allclose(found, whole[:number], rtol=1e-4, atol=1e-4)


def test_each_motion_is_one_of_the_sampler_with_its_own_key(many):
    sample, conditions, run = many
    whole = run(jax.random.key(3), conditions, jnp.float32(2.0))
    alone = jax.jit(sample)
    for i in (0, 5):
        key = jax.random.fold_in(jax.random.key(3), i)
        own = jax.tree.map(lambda x, i=i: x[i], conditions)
        found = alone(key, own, scale=jnp.float32(2.0))
        np.testing.assert_allclose(whole[i], found, rtol=1e-4, atol=1e-4)


def test_a_scale_of_one_is_no_guidance(many):
    _, conditions, run = many
    plain = run(jax.random.key(0), conditions, None)
    guided = run(jax.random.key(0), conditions, jnp.float32(1.0))
    np.testing.assert_allclose(guided, plain, rtol=1e-4, atol=1e-4)


# --- whose run it is ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "'settings.task' is None, expected 'action' or 'none'"),
        ({"task": "action", "frames": 60}, "'settings.field' is None, expected a text"),
        ({"task": "action", "field": "a", "frames": "6"}, "expected a whole number"),
        ({"task": "text", "field": "a", "frames": 6}, "'text', expected 'action' or "),
    ],
)
def test_runs_of_another_task_are_named(tmp_path, settings, message):
    run = tiny.run_folder(tmp_path, "emdm", settings=settings)
    with pytest.raises(ValueError, match=f"^{run.config}: field .*{message}"):
        emdm_training.check_task(run, ("action", "none"))
