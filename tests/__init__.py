"""The suite, and how a test has most of its cases among the slow ones."""

import pytest


def mostly_slow(cases, default):
    """Cases of a parametrized test, of which the default suite runs but a few."""
    missing = [case for case in default if case not in cases]
    assert not missing, f"no such cases: {missing}"
    return [
        case
        if case in default
        else pytest.param(
            *(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow
        )
        for case in cases
    ]
