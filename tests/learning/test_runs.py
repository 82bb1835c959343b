"""Run folders and stages: made, resumed, told apart, refused and read back."""

import dataclasses
import json
import shutil
import typing

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxmotion.learning import adversarial, checkpoint, runs, training
from tests import tiny

# Orbax abandons its other reads when one fails.
pytestmark = [
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

# --- folders -----------------------------------------------------------------------

SETTINGS = {"fraction": 0.5, "names": ["a"], "sizes": {"width": 3}}


def begin(folder, *, data, settings=SETTINGS, system="camdm", write=None):
    def make():
        text = b"".join(path.read_bytes() for path in data)
        return runs.Content(
            model={"width": 3},
            source="made in the tests",
            split={"train": ["a"], "held_out": ["b"]},
            files={"x.npz": write or (lambda path: written(path, text))},
        )

    return runs.begin(folder, system=system, data=data, settings=settings, make=make)


def written(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


@pytest.fixture
def source(tmp_path):
    path = tmp_path / "clips.npz"
    path.write_bytes(b"clips")
    return path


@pytest.fixture
def made(source, tmp_path):
    return begin(tmp_path / "run", data=[source])


def contents(folder):
    return {x: x.read_bytes() for x in folder.rglob("*") if x.is_file()}


def test_a_run_is_whole_without_its_data(made, source):
    assert made.model == {"width": 3} and made.settings == SETTINGS
    assert made.split == {"train": ["a"], "held_out": ["b"]}
    assert made.file("x.npz").read_bytes() == b"clips"
    value = json.loads(made.config.read_text())
    assert list(value["data"]) == [str(source)]
    assert value["versions"]["jax"] == jax.__version__ and value["command"]
    source.unlink()
    found = runs.load(made.folder, system="camdm")
    assert found == made == runs.load(made.folder)
    with pytest.raises(ValueError, match=r"config.json: .*\['x.npz'\], expected 'y'"):
        made.file("y")


def test_what_is_there_is_not_made_again(made, source, tmp_path):
    before = contents(made.folder)
    moved = tmp_path / "moved.npz"
    moved.write_bytes(b"clips")
    for path in (source, moved):
        again = begin(made.folder, data=[path], write=lambda _: pytest.fail("made"))
        assert again == made
    source.unlink()  # taken to be the file of that name
    assert begin(made.folder, data=[source]) == made
    assert contents(made.folder) == before


def test_other_data_settings_and_systems_are_refused(made, source, tmp_path):
    other, before = tmp_path / "other.npz", contents(made.folder)
    other.write_bytes(b"others")
    changes = {
        "'data' is .*clips.npz .*, given .*other.npz .*: other data; use an": dict(
            data=[other]
        ),
        "'data' is .*: other data": dict(data=[source, other]),
        "given .*gone.npz .gone.": dict(data=[tmp_path / "gone.npz"]),
        "made otherwise: fraction is 0.5, given 0.1; sizes.width is 3, given 4": dict(
            settings=SETTINGS | {"fraction": 0.1, "sizes": {"width": 4}}
        ),
        "'system' is 'camdm', expected 'emdm'": dict(system="emdm"),
    }
    for message, change in changes.items():
        with pytest.raises(ValueError, match=f"^{made.config}: .*{message}"):
            begin(made.folder, **dict(data=[source]) | change)
        assert contents(made.folder) == before


def test_a_start_that_fails_leaves_nothing_that_looks_whole(source, tmp_path):
    folder = tmp_path / "run"

    def half(path):
        written(path, b"ha")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        begin(folder, data=[source], write=half)
    assert not (folder / "config.json").exists()
    with pytest.raises(FileNotFoundError, match="config.json: no such file: expe"):
        runs.load(folder, system="camdm")
    assert begin(folder, data=[source]).file("x.npz").read_bytes() == b"clips"
    with pytest.raises(OSError, match="gone"):
        begin(tmp_path / "none", data=[tmp_path / "gone"])
    assert not (tmp_path / "none").exists()


def changed(**fields):
    def change(run):
        value = json.loads(run.config.read_text()) | fields
        kept = {name: x for name, x in value.items() if x is not None}
        run.config.write_text(json.dumps(kept))

    return change


DAMAGED = {
    "field 'format' is 2, expected 1: a newer version": changed(format=2),
    "field 'format' is None, expected 1: expected a run folder": changed(format=None),
    "field 'system' is 'emdm', expected 'camdm'": changed(system="emdm"),
    "field 'model' is missing, expected an object": changed(model=None),
    "field 'source' is 3, expected a text": changed(source=3),
    "field 'split' is .*, expected lists of names": changed(split={"train": [1]}),
    "field 'files' is .*, expected fingerprints": changed(files={"../x": "1"}),
    "not JSON": lambda run: run.config.write_bytes(b'{"system": "cam'),
    "a JSON list, expected an object": lambda run: run.config.write_bytes(b"[]"),
}


@pytest.mark.parametrize("message", DAMAGED)
def test_a_config_that_is_wrong_is_named(made, message):
    DAMAGED[message](made)
    with pytest.raises(ValueError, match=f"^{made.config}: .*{message}"):
        runs.load(made.folder, system="camdm")


def test_data_that_are_wrong_are_named(made):
    path = made.file("x.npz")
    path.write_bytes(b"clipt")
    with pytest.raises(ValueError, match=f"^{path}: fingerprint is .*, expected "):
        runs.load(made.folder)
    path.unlink()
    with pytest.raises(FileNotFoundError, match=f"^{path}: no such file: .*config"):
        runs.load(made.folder)


# --- training ----------------------------------------------------------------------

BUDGET = runs.Budget(
    steps=4, batch=4, learning_rate=0.1, ema=0.5, chunk=2, save_every=2
)
DATA = jnp.arange(24.0).reshape(12, 2)


def init(size=3):
    return {"w": jnp.arange(2.0 * size).reshape(size, 2), "b": jnp.ones(2)}


def loss(params, key, batch):
    noise = jax.random.normal(key, params["b"].shape)
    gap = batch - params["w"][:1] - (params["b"] + noise).reshape(1, 2)
    return jnp.mean(gap**2), {}


def sample(key, data):
    return data[jax.random.randint(key, (BUDGET.batch,), 0, data.shape[0])]


def run_of(folder, files="1"):
    return tiny.run_folder(folder, files={"train.npz": files})


def fit(folder, *, steps=4, stage="polisher", width=3, files="1", **changes):
    """A stage up to some of the steps of the whole budget."""
    budget = dataclasses.replace(BUDGET, steps=4)
    optimizer = runs.make_optimizer(budget)
    return runs.fit(
        run_of(folder, files),
        stage,
        training.init_train_state(init(), optimizer),
        training.make_update(loss, optimizer, ema_decay=BUDGET.ema),
        sample,
        DATA,
        budget=dataclasses.replace(BUDGET, steps=steps, **changes),
        model={"width": width},
    )


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with a stage of four updates, and the state that it returned."""
    folder = tmp_path_factory.mktemp("run")
    return folder, fit(folder)


def assert_same(found, expected):
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    for a, b in pairs:
        np.testing.assert_array_equal(a, b)


def test_a_resumed_stage_ends_as_one_without_a_break(trained, tmp_path):
    half = fit(tmp_path, steps=2)
    assert int(half.step) == 2
    whole = fit(tmp_path, override=True)
    assert_same(whole, trained[1])
    assert np.abs(whole.params["w"] - init()["w"]).max() > 0
    rows = [
        json.loads(x)
        for x in (tmp_path / "polisher" / "losses.jsonl").read_text().splitlines()
    ]
    assert [row["step"] for row in rows] == [2, 4]


def test_any_number_of_updates_can_be_made_and_gone_on_from(trained, tmp_path):
    """Three are not a multiple of the chunk of two."""
    assert int(fit(tmp_path, steps=3).step) == 3
    assert checkpoint.latest_step(tmp_path / "polisher" / "checkpoints") == 3
    assert_same(fit(tmp_path, override=True), trained[1])


def test_a_finished_stage_is_not_trained_again(trained):
    folder, state = trained
    before = (folder / "polisher" / "losses.jsonl").read_text()
    again = fit(folder)
    assert_same(again, state)
    assert (folder / "polisher" / "losses.jsonl").read_text() == before
    assert checkpoint.latest_step(folder / "polisher" / "checkpoints") == 4


def test_other_settings_are_refused_and_named(trained):
    folder, state = trained
    before = contents(folder)
    changes = {
        "of another model: width is 3, given 5": dict(width=5),
        "at step 4, .*: batch is 4, given 5; seed is .*--override": dict(
            batch=5, seed=8
        ),
        "learning_rate is .*, given 0.5": dict(learning_rate=0.5),
        "ema is 0.5, given 0.25": dict(ema=0.25),
        "optimizer is .*, given 'radam'": dict(optimizer="radam"),
        "initial_scale is not recorded, given 0.5": dict(initial_scale=0.5),
        "steps is 4, given 6": dict(steps=6),
        "files.train.npz is '1', given '2'": dict(files="2"),
        "has 4 steps, expected at most the 3 to train": dict(steps=3),
    }
    for message, change in changes.items():
        with pytest.raises(ValueError, match=f"^{folder}/polisher: .*{message}"):
            fit(folder, **change)
        assert contents(folder) == before
    with pytest.raises(ValueError, match="has 4 steps"):
        fit(folder, steps=3, override=True)
    # How often it is saved changes nothing that is trained.
    assert_same(fit(folder, chunk=1, save_every=1), state)
    assert contents(folder) == before


def test_a_stage_is_not_taken_for_another(trained, tmp_path):
    shutil.copytree(trained[0] / "polisher", tmp_path / "generator")
    run = run_of(tmp_path)
    for read in (
        lambda: fit(tmp_path, stage="generator"),
        lambda: runs.check_stage(run, "generator"),
        lambda: runs.load_params(run, "generator", init),
    ):
        with pytest.raises(checkpoint.CheckpointError) as error:
            read()
        for word in (str(tmp_path / "generator"), "'polisher'", "'generator'"):
            assert word in str(error.value)


def test_linear_layers_may_begin_smaller():
    """Not their biases, norms, or what labels are looked up in."""
    layer = {"kernel": jnp.ones((2, 3)), "bias": jnp.ones(3)}
    params = {"a": {"b": layer}, "norm": {"scale": jnp.ones(3)}, "e": jnp.ones((4, 3))}
    found = runs.initial(params, dataclasses.replace(BUDGET, initial_scale=0.25))
    wanted = params | {"a": {"b": layer | {"kernel": 0.25 * layer["kernel"]}}}
    assert_same(found, wanted)
    assert_same(runs.initial(params, BUDGET), params)


def test_more_devices_than_there_are(tmp_path):
    with pytest.raises(ValueError, match="devices is 64, "):
        fit(tmp_path, devices=64)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", typing.get_args(training.OptimizerName))
def test_every_optimizer_lowers_a_bowl(name):
    budget = dataclasses.replace(BUDGET, optimizer=name, steps=40, learning_rate=0.1)
    optimizer = runs.make_optimizer(budget)
    params = {"w": jnp.full((2, 2), 3.0), "b": jnp.full(2, 3.0)}
    bowl = lambda p: sum(jnp.sum(x**2) for x in jax.tree.leaves(p))  # noqa: E731

    def one(carry, _):
        params, state = carry
        changes, state = optimizer.update(jax.grad(bowl)(params), state, params)
        return (optax.apply_updates(params, changes), state), bowl(params)

    start = params, optimizer.init(params)
    values = jax.jit(lambda c: jax.lax.scan(one, c, None, 40)[1])(start)
    assert np.all(np.isfinite(values)) and values[-1] < 0.7 * values[0]


def test_warmup_clipping_and_decay_are_fields_of_the_budget():
    """Against optax's own, on a gradient longer than the clipping."""
    budget = dataclasses.replace(
        BUDGET, steps=40, optimizer="adamw", warmup=4, final=0.2, max_norm=1.0
    )
    rate = optax.warmup_cosine_decay_schedule(0.0, 0.1, 4, 40, 0.02)
    expected = optax.chain(
        optax.clip_by_global_norm(1.0), optax.adamw(rate, weight_decay=0)
    )
    params, grads = {"w": jnp.ones(2)}, {"w": jnp.array([3.0, 4.0])}
    found = runs.make_optimizer(budget)
    states = found.init(params), expected.init(params)
    for _ in range(6):
        moves = []
        moves = [
            o.update(grads, s, params)
            for o, s in zip((found, expected), states, strict=True)
        ]
        states = tuple(state for _, state in moves)
        assert_same(moves[0][0], moves[1][0])


# --- what it leaves behind ---------------------------------------------------------


def test_averaged_parameters_are_read_back(trained):
    folder, state = trained
    found = runs.load_params(run_of(folder), "polisher", init)
    assert_same(found, state.ema_params)
    assert np.abs(state.ema_params["w"] - state.params["w"]).max() > 0
    runs.check_model(run_of(folder), "polisher", {"width": 3})
    with pytest.raises(ValueError, match="polisher: of another model: width is 3, giv"):
        runs.check_model(run_of(folder), "polisher", {"width": 4})


def test_a_checkpoint_of_another_system_is_named(trained):
    run = tiny.run_folder(trained[0], system="camdm")
    with pytest.raises(checkpoint.CheckpointError, match="polisher: .*'tests'.*camdm"):
        runs.check_stage(run, "polisher")


def test_a_folder_without_checkpoints_is_named(tmp_path):
    for read in (runs.check_stage, lambda run, x: runs.load_params(run, x, init)):
        with pytest.raises(checkpoint.CheckpointError, match=str(tmp_path)):
            read(run_of(tmp_path), "polisher")


def test_parameters_of_another_size_are_refused(trained):
    folder, _ = trained
    for options in (dict(init=lambda: init(size=4)), dict(init=init, adversarial=True)):
        with pytest.raises(
            checkpoint.CheckpointError, match=f"{folder}.*another model"
        ):
            runs.load_params(run_of(folder), "polisher", **options)


def test_of_two_players_the_generator_is_read(tmp_path):
    optimizer = runs.make_optimizer(BUDGET)

    def player(factor):
        params = jax.tree.map(lambda x: factor * x, init())
        return training.init_train_state(params, optimizer)

    players = adversarial.GanState(generator=player(2.0), discriminator=player(3.0))
    runs.store(run_of(tmp_path), "generator", players, model={})
    found = runs.load_params(run_of(tmp_path), "generator", init, adversarial=True)
    assert_same(found, jax.tree.map(lambda x: 2.0 * x, init()))
    with pytest.raises(ValueError, match="'generator' exists; use another folder"):
        runs.store(run_of(tmp_path), "generator", players, model={})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    width: int
    steps: int


def test_the_configuration_of_a_stage_is_checked(trained):
    run = run_of(trained[0])
    found = runs.stage_config(run, "polisher", Config, steps=2)
    assert found == Config(width=3, steps=2)
    with pytest.raises(ValueError, match="polisher: field 'model': steps is missing"):
        runs.stage_config(run, "polisher", Config)
