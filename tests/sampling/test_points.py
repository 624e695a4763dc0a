"""Which numbers a path draws: `mitsuba_bdpt.sampling.points` with Sobol' points."""

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.sampling.points import STRATIFIED, Points, Purpose
from mitsuba_bdpt.transport import batch

FILM, LENS, LIGHT, BSDF = (Purpose.FILM, 0), (Purpose.APERTURE, 0), (Purpose.EMITTER, 1), (Purpose.BSDF, 1)
POINT, DIRECTION = (Purpose.EMISSION_POINT, 0), (Purpose.EMISSION_DIRECTION, 0)


def drawn(side, draws, samples: int, seeds: int) -> np.ndarray:
    """One pixel's samples under many seeds, of variance 1: (draws, seeds, samples, 2)."""
    seed = dr.repeat(dr.arange(mi.UInt32, seeds), samples)
    index = dr.tile(dr.arange(mi.UInt32, samples), seeds)
    points = Points("sobol", seed)
    stream = points.stream(side, mi.UInt64(index))
    found = []
    for purpose, vertex in draws:
        u = points.draw_2d(side, stream, purpose, mi.UInt32(vertex))
        found.append(np.stack([c.numpy().astype(float).reshape(seeds, samples) for c in u], axis=-1))
    return (np.stack(found) - 0.5) * np.sqrt(12)


@pytest.mark.parametrize(
    ("side", "first", "second"),
    [
        ("camera", FILM, LIGHT),
        ("camera", FILM, LENS),
        ("camera", LENS, LIGHT),
        ("camera", FILM, BSDF),
        ("camera", BSDF, (Purpose.EMITTER, 2)),
        ("camera", FILM, (Purpose.EMITTER, 2)),
        ("camera", (Purpose.BSDF, 2), (Purpose.EMITTER, 3)),
        ("camera", (Purpose.BSDF, 5), (Purpose.EMITTER, 6)),
        ("light", POINT, DIRECTION),
        ("light", POINT, BSDF),
        ("light", DIRECTION, BSDF),
    ],
)
def test_draws_of_one_contribution_are_joint(side, first, second):
    """n Var of the mean of z z' over n = 64 samples, averaged over the coordinates, below 0.4 (independent
    draws have 1, own shuffles 1.58). Over 2,000 seeds one has a relative deviation of 3 %."""
    a, b = drawn(side, [first, second], 64, 2000)
    products = [((a[..., i] * b[..., j]).mean(axis=1) ** 2).mean() * 64 for i in (0, 1) for j in (0, 1)]
    assert np.mean(products) < 0.4, products


@pytest.mark.parametrize("side", ["camera", "light"])
def test_draws_of_one_sample_are_independent(side):
    """Joint draws share digits. Tolerance: 5 / sqrt(40,000), with 2,016 pairs a chance of 1e-3."""
    draws = [(purpose, vertex) for purpose in STRATIFIED[side] for vertex in (0, 1, 2, 3)]
    z = drawn(side, draws, 1, 40000)[:, :, 0].transpose(0, 2, 1).reshape(2 * len(draws), -1)
    for values in (z, np.sign(z)):
        correlation = values @ values.T / values.shape[1]
        np.fill_diagonal(correlation, 0)
        assert np.abs(correlation).max() < 0.025


def test_samples_beyond_the_range_of_32_bits():
    """1920x1080 pixels at 4,096 samples are 2^33 (mitsuba3 #1353, #1335, #432): none is drawn again 2^32
    samples before, one in each cell of 64 x 64."""
    pixels, spp = 1920 * 1080, 4096
    place = batch.Places(SimpleNamespace(camera=None), batch.Batch(pixels - 1, 1, 0, spp), spp)
    slot = dr.arange(mi.UInt32, spp)
    index = place.index(slot)
    expected = (pixels - 1) * spp + np.arange(spp, dtype=np.uint64)
    assert expected.max() > 2**32 and np.array_equal(index.numpy(), expected)

    def points_at(index):
        points = Points("sobol", mi.UInt32(3))
        u = points.draw_2d("camera", points.stream("camera", index), Purpose.FILM)
        return np.stack([c.numpy() for c in u], axis=-1)

    here = points_at(index)
    assert (here != points_at(index - (1 << 32))).any(axis=1).mean() > 0.99
    cells = np.floor(here * 64).astype(int) @ [64, 1]
    assert np.array_equal(np.sort(cells), np.arange(spp))
