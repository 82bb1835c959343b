"""Cells of a table."""

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


def test_intervals_of_proportions_stay_within_them():
    scores = [{"skill accuracy": jnp.float32(x), "fid": x} for x in (0.9, 1.0, 1.0)]
    scores = [{k: jnp.float32(v) for k, v in one.items()} for one in scores]
    row = columns.row(scores)
    assert row["skill accuracy"].high == 1.0
    assert row["fid"].high == pytest.approx(1.11, abs=1e-2)
