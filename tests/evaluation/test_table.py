import json

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxmotion.evaluation import table


def test_windows_are_averaged_within_their_clip():
    values = jnp.array([1.0, 3.0, 10.0, 2.0, 6.0, 4.0])
    groups = jnp.array([0, 0, 3, 5, 5, 5])
    np.testing.assert_allclose(table.group_means(values, groups), [2.0, 10.0, 4.0])


def test_weights_weight_and_clips_without_weight_are_left_out():
    values = jnp.array([1.0, 4.0, 7.0, 9.0])
    groups = jnp.array([1, 1, 0, 2])
    weights = jnp.array([3.0, 1.0, 0.0, 0.5])
    found = table.group_means(values, groups, weights)
    np.testing.assert_allclose(found, [(3 * 1 + 4) / 4, 9.0])


def test_means_of_random_groups_agree_with_numpy():
    rng = np.random.default_rng(0)
    values = rng.normal(size=200).astype(np.float32)
    weights = rng.uniform(0.1, 2.0, 200).astype(np.float32)
    groups = rng.integers(0, 12, 200)
    expected = [
        np.average(values[groups == g].astype(float), weights=weights[groups == g])
        for g in np.unique(groups)
    ]
    found = table.group_means(
        jnp.asarray(values), jnp.asarray(groups), jnp.asarray(weights)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_a_cell_is_the_mean_with_students_interval():
    samples = np.array([1.0, 2.0, 4.0, 4.5, 7.0])
    found = table.cell(jnp.asarray(samples, jnp.float32), scale=100.0)
    low, high = stats.t.interval(
        0.95, 4, loc=samples.mean(), scale=samples.std(ddof=1) / np.sqrt(5)
    )
    assert found.value == pytest.approx(370.0, rel=1e-5)
    assert (found.low, found.high) == pytest.approx((100 * low, 100 * high), rel=1e-4)
    assert found.samples == 5


def test_intervals_of_proportions_stay_within_them():
    # Student's interval of 0.9, 1 and 1 runs from 0.82 to 1.11.
    high = jnp.array([0.9, 1.0, 1.0])
    free = table.cell(high, scale=100.0)
    assert free.high == pytest.approx(111.009, abs=1e-2)
    found = table.cell(high, scale=100.0, bounds=(0.0, 1.0))
    assert (found.low, found.high, found.value) == (free.low, 100.0, free.value)
    low = table.cell(1.0 - high, scale=100.0, bounds=(0.0, 1.0))
    assert low.low == 0.0 and low.high == pytest.approx(100.0 - free.low, abs=1e-3)


def test_one_sample_has_no_interval_and_none_has_no_value():
    assert table.cell(jnp.array([2.0])) == table.Cell(value=2.0)
    nothing = table.cell(jnp.zeros(0))
    assert np.isnan(nothing.value) and nothing.samples == 0 and nothing.low is None


ROWS = {
    "truth": {
        "error": table.Cell(value=1.25, low=1.0, high=1.5, samples=9),
        "fid": table.Cell(value=0.5),
    },
    "made": {
        "error": table.Cell(value=float("nan"), samples=0),
        "extra": table.Cell(value=3.0, low=2.0, high=4.0, samples=2),
    },
}


def test_json_is_strict_json_and_holds_the_numbers():
    text = json.dumps(table.to_json(ROWS), allow_nan=False)
    found = json.loads(text)
    assert found["truth"]["error"] == dict(value=1.25, low=1.0, high=1.5, samples=9)
    assert found["truth"]["fid"] == dict(value=0.5, low=None, high=None, samples=1)
    assert found["made"]["error"] == dict(value=None, low=None, high=None, samples=0)


def test_markdown_has_a_column_for_each_metric_and_dashes_for_gaps():
    lines = table.to_markdown(ROWS).splitlines()
    grid = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert grid[0] == ["row", "error", "FID", "extra"]
    assert set(lines[1]) == {"|", "-"} and lines[1].count("|") == 5
    assert grid[2] == ["truth", "1.25 [1, 1.5] (n=9)", "0.5 (n=1)", "–"]
    assert grid[3] == ["made", "– (n=0)", "–", "3 [2, 4] (n=2)"]
