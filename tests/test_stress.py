"""The quick cases of the stress table (`make stress` runs all of them)."""

import pytest
import stress
from stress_cases import cases


@pytest.mark.parametrize("name", [case.name for case in cases() if case.quick])
def test_what_is_expected_happens(name):
    """Rationale, expectation and the reason of each tolerance: see the case of that name in
    scripts/stress_cases. (In a process of its own: a crash is an outcome, too.)"""
    outcome = stress.apart(name)
    assert outcome.ok, outcome.happened
