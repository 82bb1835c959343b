"""experiments/optimizers.py: curves, and where they cross a level."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxmotion.learning import training

LINE = np.array([3.0, 2.0, 1.0, 1.5])


@pytest.fixture(scope="module")
def script(load):
    return load("optimizers")


def test_where_a_curve_crosses_a_level(script):
    spent = np.array([0.0, 10.0, 30.0, 40.0])
    assert script.crossing(spent, LINE, 1.5) == pytest.approx(20.0)
    assert script.crossing(spent, LINE, 3.0) == 0.0
    assert np.isnan(script.crossing(spent, LINE, 0.9))


def test_the_worst_end_is_the_level_of_each_seed(script):
    def curve(losses, seconds):
        return script.Curve(losses=np.array(losses), seconds=np.array(seconds))

    curves = {
        "slow": [curve([4, 3, 2, 1.0, 1], range(0, 10, 2))] * 2,
        "fast": [curve([4, 1, 0.5, 0.4, 0.3], range(5))] * 2,
    }
    rows = script.rows_of(curves, chunk=10)
    assert [rows["slow"][f"held_out_{x}"].value for x in (25, 50, 75, 100)] == [
        *(3.0, 2.0, 1.0, 1.0)
    ]
    found = {
        name: (row["updates_needed"].value, row["seconds_needed"].value)
        for name, row in rows.items()
    }
    assert found == {"slow": (30.0, 6.0), "fast": (10.0, 1.0)}
    assert rows["slow"]["update_time"].value == pytest.approx(200.0)


def test_rows_share_start_and_batches(script):
    """One step x <- x - 2 rate (x - mean): rows of one batch agree on its mean."""
    rates, start = {"a": 0.1, "b": 0.3}, 4.0

    def loss(params, key, batch):
        del key
        return jnp.mean((params["x"] - batch) ** 2), {}

    def sample(key, data):
        return data[jax.random.randint(key, (2,), 0, len(data))]

    programs, states = {}, {}
    for name, rate in rates.items():
        optimizer = optax.sgd(rate)
        update = training.make_update(loss, optimizer, ema_decay=0.0)
        programs[name] = training.train_chunk(update, sample, num_steps=1)
        states[name] = training.init_train_state({"x": jnp.array(start)}, optimizer)
    data = jnp.arange(50.0)
    given = programs, states, jax.random.key(0), data, lambda x: x["x"]
    curves = script.train_in_turn(*given, chunk=1, rounds=3)
    means = {
        name: curve.losses[:-1] + np.diff(curve.losses) / (2 * rates[name])
        for name, curve in curves.items()
    }
    np.testing.assert_allclose(means["a"], means["b"], rtol=1e-4)
    assert len(np.unique(means["a"].round(2))) == 3  # a batch of its own each round
    for curve in curves.values():
        assert curve.losses[0] == start and curve.seconds[0] == 0.0
        assert (np.diff(curve.seconds) > 0).all()


@pytest.mark.parametrize("text", ["muon", "muon=fast", "sgd=1e-3"])
def test_an_optimizer_that_is_none_is_named(script, text):
    with pytest.raises(ValueError, match=f"--optimizers: '{text}'.*muon, adamw"):
        script.budget_of(text, 10)


def test_a_rate_may_have_a_scale_of_the_first_weights(script):
    found = [script.budget_of(f"muon=1e-3{more}", 10) for more in ("", "@0.58")]
    assert [x.initial_scale for x in found] == [1.0, 0.58]
    assert {x.learning_rate for x in found} == {1e-3}


def test_updates_come_in_whole_chunks(script, tmp_path, monkeypatch):
    line = f"optimizers.py --run {tmp_path} --steps 70 --chunk 50 --out {tmp_path}"
    monkeypatch.setattr("sys.argv", line.split())
    with pytest.raises(ValueError, match="--steps is 70, expected a multiple of.*50"):
        script.main()
