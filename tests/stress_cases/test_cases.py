"""Cases that are not yet functions of pytest."""

import pytest

from . import cases


@pytest.mark.parametrize("case", cases(), ids=lambda case: case.name)
def test_case(case):
    """A case of the earlier form.

    Expected: what it says.
    """
    outcome = case.run()
    if outcome.ok is None:
        pytest.skip(outcome.happened)
    print(outcome.happened)
    assert outcome.ok, outcome.happened
