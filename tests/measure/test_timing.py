"""Renders in turns, and the records made of them."""

from functools import partial

import numpy as np
import pytest
from mitsuba_bdpt.measure.compare import measured
from mitsuba_bdpt.measure.reference import Reference
from mitsuba_bdpt.measure.timing import Timed, alternating


def recorder(calls, name, seed):
    """A render of a side, which is noted."""
    calls.append((name, seed))
    return Timed(np.full((1, 1, 3), float(seed)), len(name), 0.5)


@pytest.mark.parametrize("is_warm", [False, True])
def test_sides_take_turns(is_warm):
    """Seed 0 for a start, unless everything is warm; then every other round in reversed order; what a round
    returns is in the order of the sides."""
    calls, seen = [], []
    sides = [partial(recorder, calls, name) for name in ("a", "bb", "ccc")]
    rounds = list(alternating(sides, 2, seen.append, is_warm=is_warm))
    first = [("a", 1), ("bb", 1), ("ccc", 1)]
    assert calls[-6:] == [*first, ("ccc", 2), ("bb", 2), ("a", 2)]
    assert [seed for _, seed in calls[:-6]] == ([] if is_warm else [0, 0, 0])
    assert seen == [seed for _, seed in calls]
    assert [[found.seconds for found in turn] for turn in rounds] == [[1, 2, 3]] * 2
    assert [turn[0].image[0, 0, 0] for turn in rounds] == [1, 2]


def test_records_of_a_comparison():
    """Two renders with values 1 and 2 of a reference of 1, whose halves differ by twice 0.1: relative errors
    of 0 and 1 / 1.01, and 0.01 / 1.01 of the reference's own."""
    one = np.ones((1, 1, 3))
    target = Reference(one, 0.1 * one, None, {})
    (rows,) = measured([partial(recorder, [], "ab")], target, 2)
    assert rows["rel_mse"].tolist() == pytest.approx([0, 1 / 1.01]) and (rows["seconds"] == 2).all()
    assert (rows["rel_mse_trimmed"] == rows["rel_mse"]).all() and (rows["cpu_seconds"] == 0.5).all()
    assert rows["reference_rel_mse"].tolist() == pytest.approx([0.01 / 1.01] * 2)
