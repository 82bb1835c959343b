"""Decisions whose first run is known, and random ones against loops."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import transitions

STARTS = jnp.arange(13) / 3.0  # 0, 1/3 .. 4 seconds


def change_of(text, **options):
    """Transition of decisions as text, one character per window: 1 is recognized."""
    recognized = jnp.asarray([x == "1" for x in text])
    return transitions.transition(recognized, STARTS[: len(text)], **options)


def test_planted_changes():
    for text, seconds, succeeded in (
        ("1111111111111", 0.0, True),
        ("0000001111111", 2.0, True),
        ("0000000000001", 4.0, True),
        ("0000000000000", 4.0, False),
    ):
        found = change_of(text)
        np.testing.assert_allclose(found.seconds, seconds, rtol=1e-6)
        assert bool(found.succeeded) == succeeded


def test_a_flicker_is_no_change_if_it_must_hold():
    text = "0100110111111"
    for hold, seconds in ((1, 1 / 3), (2, 4 / 3), (3, 7 / 3), (6, 7 / 3)):
        found = change_of(text, hold=hold)
        np.testing.assert_allclose(found.seconds, seconds, rtol=1e-6)
    failed = change_of(text, hold=7)
    assert not failed.succeeded and failed.seconds == 4.0


def test_what_comes_behind_the_limit_is_a_failure():
    found = change_of("0000001111111", limit=1.5)
    assert not found.succeeded and found.seconds == 1.5
    assert change_of("0000001111111", limit=2.0).succeeded


@pytest.mark.parametrize("hold", [1, 2, 4])
def test_random_decisions_are_counted_as_by_loops(hold):
    rng = np.random.default_rng(hold)
    recognized = rng.uniform(size=(5, 20, 13)) < 0.4
    starts = np.sort(rng.uniform(0, 5, 13)).astype(np.float32)
    found = transitions.transition(
        jnp.asarray(recognized), jnp.asarray(starts), limit=3.0, hold=hold
    )
    assert found.seconds.shape == (5, 20)
    for index in np.ndindex(5, 20):
        seconds, succeeded = 3.0, False
        for i in range(13 - hold + 1):
            if starts[i] <= 3.0 and all(recognized[index][i : i + hold]):
                seconds, succeeded = starts[i], True
                break
        assert found.seconds[index] == seconds
        assert bool(found.succeeded[index]) == succeeded
    assert 0 < np.mean(found.succeeded) <= 1


@pytest.mark.parametrize("hold", [0, 4])
def test_a_hold_that_no_rollout_can_show_is_refused(hold):
    with pytest.raises(ValueError, match=f"hold is {hold}, expected 1..3"):
        change_of("010", hold=hold)
