"""Which tests `make test` runs."""

import json

import costs
import pytest


@pytest.mark.parametrize(
    ("seconds", "expected"), [(0, None), (0.5, None), (0.6, "costly"), (4.0, "costly"), (4.1, "slow")]
)
def test_markers_follow_from_costs(seconds, expected):
    """Expected: a test is marked by its processor time, one that sees a planted bug never is."""
    assert costs.marker("test_a.py::test_b[c]", {"test_a.py::test_b[c]": seconds}, set()) == expected
    assert costs.marker("test_a.py::test_b[c]", {"test_a.py::test_b[c]": seconds}, {"test_a.py::test_b[c]"}) is None


def test_names_do_not_have_folders():
    """Expected: a test that is moved keeps its cost, and parameters keep their slashes."""
    assert costs.name("tests/a/test_a.py::test_b[1/4]") == "test_a.py::test_b[1/4]"


def test_costs_are_above_the_limit():
    """Expected: what `make costs` has recorded are seconds above the limit of quick tests."""
    recorded = json.loads(costs.COSTS.read_text())
    assert recorded
    assert min(recorded.values()) >= costs.QUICK
