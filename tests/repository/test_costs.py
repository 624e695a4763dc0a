"""Which tests `make test` runs."""

import costs
import pytest


@pytest.mark.parametrize(
    ("seconds", "expected"), [(0, None), (0.3, None), (0.4, "costly"), (3.0, "costly"), (3.1, "slow")]
)
def test_markers_follow_from_costs(seconds, expected):
    test = "test_a.py::test_b[c]"
    assert costs.marker(test, {test: seconds}, set()) == expected
    for planted in (test, "test_a.py::test_b"):
        assert costs.marker(test, {test: seconds}, {planted}) is None
