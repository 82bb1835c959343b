"""Evidence after every sample: densities of t, errors at any stopping, intervals."""

import numpy as np
import pytest
import scipy.stats

from jaxmotion.evaluation import sequential


def evidence_by_densities(samples):
    count = len(samples)
    t = np.mean(samples) / scipy.stats.sem(samples)
    densities = [
        scipy.stats.nct.pdf(t, count - 1, effect * np.sqrt(count))
        for effect in sequential.EFFECTS
    ]
    return np.log(np.mean(densities) / scipy.stats.t.pdf(t, count - 1))


@pytest.mark.parametrize("shift", [-1.0, 0.0, 0.3, 2.0])
def test_evidence_is_the_ratio_of_the_densities_of_t(shift):
    samples = np.random.default_rng(0).normal(shift, 0.7, (5, 12))
    found = sequential.log_evidence(samples)
    for row, own in zip(found, samples, strict=True):
        expected = [evidence_by_densities(own[:n]) for n in range(2, 13)]
        np.testing.assert_allclose(row[1:], expected, atol=4e-3)
        assert row[0] == 0.0


def test_evidence_does_not_depend_on_the_unit():
    samples = np.random.default_rng(1).normal(0.5, 1.0, (20, 6))
    found = sequential.log_evidence(samples)
    for unit in (1e-200, 1e-9, 1e200):  # whose squares are no numbers
        np.testing.assert_allclose(
            sequential.log_evidence(unit * samples), found, atol=1e-6
        )


@pytest.mark.parametrize("mean", [0.0, -0.5])
def test_evidence_without_an_effect_is_rarely_large_at_any_count(mean):
    samples = np.random.default_rng(2).normal(mean, 1.0, (20_000, 12))
    worst = sequential.log_evidence(samples).max(axis=1)
    for alpha in (0.1, 0.05, 0.01):
        error = 3 * np.sqrt(alpha * (1 - alpha) / len(samples))
        assert np.mean(worst >= -np.log(alpha)) < alpha + error


def test_zeros_are_no_evidence_and_what_is_no_number_spreads():
    np.testing.assert_array_equal(sequential.log_evidence(np.zeros(4)), np.zeros(4))
    finite = sequential.log_evidence(np.array([1.0, 2.0]))
    for none in (np.nan, np.inf, -np.inf):
        found = sequential.log_evidence(np.array([1.0, 2.0, none, 1.0]))
        np.testing.assert_array_equal(found[:2], finite)
        assert np.isnan(found[2:]).all()


def test_intervals_hold_the_mean_at_all_counts_at_once():
    samples = np.random.default_rng(3).normal(3.0, 2.0, (60, 8))
    missed = 0
    for own in samples:
        ends = [sequential.interval(own[:n]) for n in (3, 5, 8)]
        missed += any(not x.low <= 3.0 <= x.high for x in ends)
        t = scipy.stats.t.interval(0.95, 7, own.mean(), scipy.stats.sem(own))
        assert ends[-1].low < t[0] and t[1] < ends[-1].high
    assert missed / len(samples) < 0.05 + 2 * np.sqrt(0.05 * 0.95 / len(samples))


@pytest.mark.parametrize("level", [0.8, 0.95])
def test_at_the_ends_of_an_interval_the_evidence_is_that_of_one_side(level):
    """Each side errs with half of the rest: evidence is 2 / (1 - level) there."""
    samples = np.random.default_rng(4).normal(3.0, 2.0, 9)
    found = sequential.interval(samples, level=level)
    ends = [
        evidence_by_densities(x) for x in (samples - found.low, found.high - samples)
    ]
    np.testing.assert_allclose(ends, np.log(2.0 / (1.0 - level)), atol=4e-3)


def test_intervals_of_too_few_samples():
    assert sequential.interval(np.array([1.0]))[1:] == (-np.inf, np.inf)
    found = sequential.interval(np.ones(5))
    np.testing.assert_allclose(found, [1.0, 1.0, 1.0], atol=1e-6)
