"""Cells of a table."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from jaxmotion.evaluation import columns, table


def test_a_row_holds_means_and_students_intervals_in_the_declared_order():
    values = np.array([1.0, 2.0, 4.0, 5.0])
    scores = [
        {"a": jnp.float32(v), "jerk": jnp.float32(2 * v), "fid": v} for v in values
    ]
    found = table.row(scores)
    assert list(found) == ["fid", "jerk", "a"]
    half = scipy.stats.t.ppf(0.975, 3) * values.std(ddof=1) / 2
    assert found["a"].value == pytest.approx(3.0)
    assert found["a"].high - 3.0 == pytest.approx(half, rel=1e-4)
    assert found["jerk"].value == pytest.approx(6.0) and found["jerk"].samples == 4


def test_columns_are_declared_once_and_named_apart():
    headers = [column.header for column in columns.COLUMNS.values()]
    assert len(set(headers)) == len(headers)
    for name, column in columns.COLUMNS.items():
        assert column.id == name and re.fullmatch("[a-z0-9_]+", name)
    assert columns.header("foot_slide") == "foot slide, m/s"
    assert columns.header("not declared") == "not declared"
