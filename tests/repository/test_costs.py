"""Which tests `make test` runs."""

import json

import costs
import pytest


@pytest.mark.parametrize(
    ("seconds", "expected"), [(0, None), (0.3, None), (0.4, "costly"), (3.0, "costly"), (3.1, "slow")]
)
def test_markers_follow_from_costs(seconds, expected):
    """Expected: a test is marked by its processor time, one that sees a planted bug never is."""
    test = "test_a.py::test_b[c]"
    assert costs.marker(test, {test: seconds}, set()) == expected
    for planted in (test, "test_a.py::test_b"):
        assert costs.marker(test, {test: seconds}, {planted}) is None


def test_names_do_not_have_folders():
    """Expected: a test that is moved keeps its cost, and parameters keep their slashes."""
    assert costs.name("tests/a/test_a.py::test_b[1/4]") == "test_a.py::test_b[1/4]"


def test_costs_are_above_the_limit():
    """Expected: what `make costs` has recorded are seconds above the limit of quick tests."""
    recorded = json.loads(costs.COSTS.read_text())
    assert recorded
    assert min(recorded.values()) >= costs.QUICK
