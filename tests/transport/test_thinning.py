"""Which vertices of long light subpaths are kept in scenes with media."""

import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba_bdpt.transport.inputs import KEPT
from mitsuba_bdpt.transport.light_path import Thinning

COUNT = 400


def places(offsets):
    """Place, whether kept and probability of the first `COUNT` vertices, a row for each offset."""
    thinning = Thinning.begin(mi.Float(offsets))
    rows = [thinning.place(mi.UInt32(i)) for i in range(COUNT)]
    dr.eval(rows)
    place, kept, probability = (
        np.array([np.broadcast_to(np.array(x), len(offsets)) for x in column]).T
        for column in zip(*rows, strict=True)
    )
    return place, kept, probability


def test_probabilities_are_those_stated():
    """Expected: over 2^14 even offsets the share that keeps a vertex is its probability, to the 2^-14 of one
    offset; the first half all are kept, the i-th later one with (KEPT / 2)^2 / (i (i - 1)), to 1e-4."""
    n = 2**14
    _, kept, probability = places((np.arange(n) + 0.5) / n)
    assert (probability == probability[:1]).all()
    np.testing.assert_allclose(kept.mean(0), probability[0], atol=1.1 / n)
    assert kept[:, : KEPT // 2].all()
    i = np.arange(KEPT // 2 + 1, COUNT + 1)
    np.testing.assert_allclose(
        probability[0, KEPT // 2 :], (KEPT / 2) ** 2 / (i * (i - 1)), rtol=1e-4, atol=1e-6
    )


def test_places_fill_memory_without_holes():
    """A hole would be read as a vertex."""
    offsets = np.concatenate([[0, 1 - 2**-24], np.random.default_rng(0).random(200)])
    place, kept, _ = places(offsets)
    for of_path, keeps in zip(place, kept, strict=True):
        found = of_path[keeps]
        np.testing.assert_array_equal(found, np.arange(len(found)))
        assert len(found) <= KEPT
