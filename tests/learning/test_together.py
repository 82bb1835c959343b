"""Several trainings as one program are what each is alone."""

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxmotion.learning import adversarial, checkpoint, loop, together, training
from tests import mostly_slow


def fitted(folder, seed, *, scale=2.0, num_steps=5, shift=None, stages=("a",)):
    """A line of its own start, fitted to points; `shift` is an array it closes over."""

    def loss(params, key, batch):
        noise = 0.01 * jax.random.normal(key, batch.shape)
        target = scale * batch + (0.0 if shift is None else shift.sum())
        error = params["w"] * batch + params["b"] + noise - target
        return jnp.mean(error**2), {"other": jnp.max(error)}

    optimizer = optax.adam(0.1)
    update = training.make_update(loss, optimizer)

    def sample(key, data):
        return data[jax.random.randint(key, (4,), 0, data.shape[0])]

    params = {"w": jnp.float32(seed), "b": jnp.zeros((2,)).sum()}
    for stage in stages:
        chunk = training.train_chunk(update, sample, num_steps=2)
        lengths = loop.Loop(
            num_steps=num_steps,
            chunk=2,
            save_every=2,
            folder=folder / stage,
            config={"seed": seed},
        )
        state = training.init_train_state(params, optimizer)
        if checkpoint.latest_step(folder / stage / "checkpoints") is not None:
            state = checkpoint.restore(folder / stage / "checkpoints", state)
        key, data = jax.random.key(seed), jnp.linspace(-1.0, 1.0, 32)
        state = loop.train(chunk, state, key, data, loop=lengths)
        params = state.params  # what the next stage begins with
    return state


def rows(folder):
    found = [json.loads(line) for line in (folder / "losses.jsonl").open()]
    return [{k: v for k, v in row.items() if k != "steps_per_second"} for row in found]


@pytest.mark.slow
@pytest.mark.parametrize("shifts", mostly_slow([False, True], [True]))
def test_each_is_what_it_is_alone(tmp_path, shifts):
    """States, losses, checkpoints of two stages; with constants of their own, too."""
    seeds = (3, 0, 7)

    def start(place, seed):
        shift = jnp.arange(3.0) + seed if shifts else None
        stages, folder = ("a", "b"), tmp_path / place / str(seed)
        return functools.partial(fitted, folder, seed, shift=shift, stages=stages)

    found = together.run([start("together", seed) for seed in seeds])
    for seed, state in zip(seeds, found, strict=True):
        alone = start("alone", seed)()
        jax.tree.map(
            functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6),
            state,
            alone,
        )
        for stage in ("a", "b"):
            own, other = (
                tmp_path / x / str(seed) / stage for x in ("together", "alone")
            )
            assert len(rows(own)) == 3
            for one, two in zip(rows(own), rows(other), strict=True):
                assert one == pytest.approx(two, rel=1e-4, abs=1e-6)
            where = own / "checkpoints"
            assert checkpoint.latest_step(where) == 5
            assert checkpoint.load_config(where) == {"seed": seed}
            stored = checkpoint.restore(where, alone)
            if stage == "b":
                np.testing.assert_array_equal(stored.params["w"], state.params["w"])
    assert found[0].params["w"] != found[2].params["w"]


@pytest.mark.slow
def test_what_is_equal_is_there_once(tmp_path, monkeypatch):
    """Data are not copied; what functions close over is, where it differs."""
    shapes, train_all = [], loop.train_all

    def look(one, loops, part):
        (key, data), constants = one.data
        kept = [x.shape for x in constants]
        shapes.append((key.shape, data.shape, one.state.params["w"].shape, kept))
        return train_all(one, loops, part)

    monkeypatch.setattr(loop, "train_all", look)
    together.run([functools.partial(fitted, tmp_path / str(s), s) for s in (1, 2)])
    assert shapes == [((2,), (32,), (2,), [])]
    together.run(
        [
            functools.partial(fitted, tmp_path / f"s{s}", s, shift=jnp.ones(2) * s)
            for s in (1, 2)
        ]
    )
    assert shapes[1][-1] == [(2, 2)]


@pytest.mark.slow
def test_they_go_on_from_their_checkpoints(tmp_path):
    def both(folder, **more):
        starts = [
            functools.partial(fitted, tmp_path / folder / str(s), s, **more)
            for s in (1, 2)
        ]
        return together.run(starts)

    both("halves", num_steps=4)
    for one, other in zip(
        both("halves", num_steps=7), both("whole", num_steps=7), strict=True
    ):
        jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.slow
def test_two_players_are_trained_together(tmp_path):
    """An update with a branch by its count, which is the same for all."""

    def loss(params, other, key, batch):
        value = (params["w"] - other["w"]) ** 2 + params["w"] * jax.random.normal(key)
        return value, {}

    def fit(folder, seed):
        optimizer = optax.adam(0.1)
        both = adversarial.make_gan_update(loss, loss, (optimizer, optimizer))

        def update(state, key, batch):
            def rest(state, key, batch):
                shapes = jax.eval_shape(both, state, key, batch)[1]
                return state, {
                    k: jnp.zeros(x.shape, x.dtype) for k, x in shapes.items()
                }

            return jax.lax.cond(state.step < 4, both, rest, state, key, batch)

        players = {
            name: training.init_train_state({"w": jnp.float32(seed + i)}, optimizer)
            for i, name in enumerate(("generator", "discriminator"))
        }
        chunk = training.train_chunk(update, lambda key, data: data, num_steps=2)
        lengths = loop.Loop(
            num_steps=4, chunk=2, save_every=4, folder=folder / str(seed), config={}
        )
        state = adversarial.GanState(**players)
        key = jax.random.key(seed)
        return loop.train(chunk, state, key, jnp.zeros(2), loop=lengths)

    found = together.run(
        [functools.partial(fit, tmp_path / "all", seed) for seed in (1, 5)]
    )
    for seed, state in zip((1, 5), found, strict=True):
        alone = fit(tmp_path / "alone", seed)
        jax.tree.map(
            functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6),
            state,
            alone,
        )


@pytest.mark.parametrize(
    "other, what",
    [
        (dict(num_steps=6), "num_steps is 6, expected 5"),
        (dict(stages=("a", "b")), "1 of 2 trainings do not train this stage"),
        (dict(scale=3.0, shift=jnp.ones(2)), "is computed otherwise|code"),
    ],
    ids=["length", "stage", "code"],
)
def test_trainings_that_part_ways_are_refused(tmp_path, other, what):
    first = functools.partial(fitted, tmp_path / "1", 1)
    second = functools.partial(fitted, tmp_path / "2", 2, **other)
    with pytest.raises(ValueError, match=what):
        together.run([first, second])


def test_an_error_of_one_ends_all(tmp_path):
    def broken():
        raise FileNotFoundError("no such clips")

    with pytest.raises(FileNotFoundError, match="no such clips"):
        together.run([functools.partial(fitted, tmp_path / "1", 1), broken])


def test_one_alone_is_trained_as_ever(tmp_path):
    found = together.run([functools.partial(fitted, tmp_path / "one", 4)])
    alone = fitted(tmp_path / "alone", 4)
    jax.tree.map(np.testing.assert_array_equal, found[0], alone)


def test_one_that_diverges_is_named(tmp_path):
    start = functools.partial
    trainings = [
        start(fitted, tmp_path / "good", 1, shift=jnp.zeros(3)),
        start(fitted, tmp_path / "bad", 1, shift=jnp.full(3, jnp.nan, jnp.float32)),
    ]
    with pytest.raises(loop.TrainingDiverged, match="bad/a/checkpoints"):
        together.run(trainings)
