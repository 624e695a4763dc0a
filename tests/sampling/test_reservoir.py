"""Weighted reservoir sampling."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.sampling.reservoir import offer

SIZES = (0.0, 1.0, 0.0, 2.0, 5.0, 0.0)


def test_candidates_are_drawn_in_proportion_to_their_size():
    """And what is left of the numbers is uniform, in 16 bins. To 1e-3: most pass four decisions in single
    precision."""
    count = 1 << 16
    u = (dr.arange(mi.Float, count) + 0.5) / count
    total, chosen = mi.Float(0), dr.full(mi.UInt32, len(SIZES), count)
    for i, size in enumerate(SIZES):
        total, take, u = offer(total, mi.Float(size), u)
        chosen = dr.select(take, mi.UInt32(i), chosen)
    chosen, u = np.array(chosen), np.array(u)
    for i, size in enumerate(SIZES):
        drawn = u[chosen == i]
        assert abs(len(drawn) / count - size / sum(SIZES)) < 1e-3
        if size:
            shares = np.histogram(drawn, 16, (0, 1))[0] / len(drawn)
            np.testing.assert_allclose(shares, 1 / 16, atol=1e-3)


@pytest.mark.parametrize("unit", [2.0**-120, 2.0**-99, 2.0**100])
def test_draws_do_not_depend_on_the_unit(unit):
    """Rationale: products with faint sizes underflowed, numbers became 0, and the last candidate was drawn:
    4e-4 of a room's light was missing. Expected: the same to the bit, also after fainter candidates."""
    count = 1 << 12
    for first in (1.0, 2.0**-24):
        found = []
        for scale in (1.0, unit):
            u, total, taken = (dr.arange(mi.Float, count) + 0.5) / count, mi.Float(0), []
            for size in (first, *SIZES):
                total, take, u = offer(total, mi.Float(size * scale), u)
                taken += [np.array(mi.Bool(take) & dr.full(mi.Bool, True, count)), np.array(u)]
            found.append(taken)
        np.testing.assert_array_equal(*found)


def test_nothing_is_drawn_of_nothing():
    total, take, u = offer(mi.Float(0), mi.Float(0), mi.Float(0.25))
    assert total[0] == 0 and not take[0] and u[0] == 0.25
