"""Cells of a table."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from jaxmotion.evaluation import columns


def test_a_row_holds_means_and_students_intervals_in_the_asked_order():
    values = np.array([1.0, 2.0, 4.0, 5.0])
    scores = [{"a": jnp.float32(v), "b": jnp.float32(2 * v), "c": v} for v in values]
    found = columns.row(scores, order=("b", "unknown", "c"))
    assert list(found) == ["b", "c", "a"]
    half = scipy.stats.t.ppf(0.975, 3) * values.std(ddof=1) / 2
    assert found["a"].value == pytest.approx(3.0)
    assert found["a"].high - 3.0 == pytest.approx(half, rel=1e-4)
    assert found["b"].value == pytest.approx(6.0) and found["b"].samples == 4


def test_time_is_that_of_a_call_by_its_parts_and_keys_are_new(monkeypatch):
    """On a clock by which every call takes 30, 40, 50, ... milliseconds."""
    seen, now = [], [0.0]

    def run(key):
        seen.append(jax.random.key_data(key).tolist())
        now[0] += 0.01 * (1 + len(seen))
        return key

    monkeypatch.setattr(columns.time, "perf_counter", lambda: now[0])
    found = columns.milliseconds(run, parts=10, seconds=0.0, least=5)
    assert found.samples == 5 and len(seen) == 6
    assert found.value == pytest.approx(5.0)
    assert (found.low, found.high) == pytest.approx((4.0, 6.0))
    assert columns.milliseconds(run, seconds=1.0, least=1).samples > 1


def test_intervals_of_proportions_stay_within_them():
    scores = [{"skill accuracy": jnp.float32(x), "fid": x} for x in (0.9, 1.0, 1.0)]
    scores = [{k: jnp.float32(v) for k, v in one.items()} for one in scores]
    row = columns.row(scores)
    assert row["skill accuracy"].high == 1.0
    assert row["fid"].high == pytest.approx(1.11, abs=1e-2)
