"""Scores of rollouts among modes, on rollouts with planted faults."""

import numpy as np
import pytest

from jaxmotion.evaluation import modes

CENTERS = np.stack(np.meshgrid(*2 * [[-1.0, 0.0, 1.0]]), axis=-1).reshape(9, 2)


def points(choose, *, number=4000, steps=6, sigma=0.1):
    rng = np.random.default_rng(0)
    mode = choose(rng, (number, steps))
    return CENTERS[mode] + sigma * rng.normal(size=(number, steps, 2))


def uniform(rng, shape):
    return rng.integers(0, 9, shape)


def test_the_data_score_full():
    scores = modes.mode_scores(points(uniform), CENTERS, sigma=0.1)
    assert scores["least_modes_covered"] == 9
    # A plane Gaussian has 1 - exp(-9/2) within 3 sigma.
    assert scores["within_3_sigma"] == pytest.approx(1 - np.exp(-4.5), abs=0.003)
    assert scores["kl_to_uniform"] < 1e-3
    assert scores["transition_distance"] < 0.03
    assert scores["spread"] == pytest.approx(0.975, abs=0.02)


def test_points_that_are_all_on_one_side_are_spread_about_the_center():
    x = np.broadcast_to(CENTERS[None, :, :] + [0.1, 0.0], (50, 9, 2))
    assert modes.mode_scores(x, CENTERS, sigma=0.1)["spread"] == pytest.approx(0.5**0.5)


def test_a_lost_mode_is_counted_at_its_step():
    def choose(rng, shape):
        mode = uniform(rng, shape)
        mode[:, 3] %= 8  # mode 8 is missing at step 3
        return mode

    scores = modes.mode_scores(points(choose), CENTERS, sigma=0.1)
    assert scores["least_modes_covered"] == 8


def test_a_mode_with_just_its_share_is_covered():
    x = np.tile(CENTERS[0], (64, 2, 1))
    x[0] = CENTERS[1]
    for share, number in ((1 / 64, 2), (1.5 / 64, 1)):
        scores = modes.mode_scores(x, CENTERS, sigma=0.1, share=share)
        assert scores["least_modes_covered"] == number


def test_stray_points_cost_their_share():
    x = points(uniform)
    x[: len(x) // 4, 2] = 0.5  # between the modes
    scores = modes.mode_scores(x, CENTERS, sigma=0.1)
    assert scores["least_within_3_sigma"] == pytest.approx(0.75 * 0.989, abs=0.01)


def test_a_frozen_rollout_has_wrong_transitions():
    frozen = lambda rng, shape: np.repeat(uniform(rng, (shape[0], 1)), 6, 1)  # noqa: E731
    scores = modes.mode_scores(points(frozen), CENTERS, sigma=0.1)
    assert scores["least_modes_covered"] == 9
    assert scores["transition_distance"] == pytest.approx(8 / 9, abs=0.02)


def test_a_collapsed_rollout():
    scores = modes.mode_scores(np.full((50, 4, 2), 0.5), CENTERS, sigma=0.1)
    assert scores["least_modes_covered"] == scores["within_3_sigma"] == 0
    assert scores["spread"] == 0
    assert scores["kl_to_uniform"] == pytest.approx(np.log(9))
