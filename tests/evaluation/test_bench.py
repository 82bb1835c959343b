"""Times of programs."""

import jax
import pytest

from jaxmotion.evaluation import bench, timing


def test_time_is_that_of_a_call_by_its_parts_and_keys_are_new(monkeypatch):
    """On a clock by which every counted call takes 30, 40, 50, ... milliseconds."""
    seen, now = [], [0.0]

    def run(key):
        seen.append(jax.random.key_data(key).tolist())
        now[0] += 0.01 * (1 + len(seen))
        return key

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])
    found = bench.call_time(run, parts=10, seconds=0.0, least=5)
    assert found.samples == 5 and len(seen) == len({str(x) for x in seen}) == 6
    assert found.value == pytest.approx(5.0)
    assert (found.low, found.high) == pytest.approx((4.0, 6.0))
    assert bench.call_time(run, seconds=1.0, least=1).samples > 1
