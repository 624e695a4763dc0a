"""The density of directions that photons define, for photon-guided BSDF sampling.

After H. W. Jensen, "Importance Driven Path Tracing Using the Photon Map", 1995. Photons are sorted along a
Morton (Z-order) curve. A query takes a window of photons about the point's place on the curve, dense near it
and sparse farther off, and the nearest rare ones; the density is the mean of their lobes
(docs/method/sds_paths.md, "The density").
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .photon import Photon

# Offsets of a window's photons from the point's place among them; of all lobes, the last among the rare ones.
WINDOW = (-60, -12, *range(-4, 4), 12, 60)
LOBES = (*WINDOW, *range(-2, 2))

_RARE = 4.0  # density of a photon's direction under the others of its window (1 / sr) below which it is rare

# Bits of each coordinate of a place on the curve, and of a subpath's index: 64 together.
_BITS, _LANE_BITS = 15, 19

# Least lobe width (tangent of the half angle that contains half of its directions); width from which on a
# photon has no lobe.
_LEAST, _MOST = 1e-3, 0.5


@dataclass
class Guide:
    """``count`` ``photons`` sorted by ``place`` on the curve, behind them the ``rare`` ones again; the box.

    ``slope`` of each: change of direction per distance (1 / scene unit), see `_slopes`; ``low``: corner of
    the box; ``scale``: places over length; ``offsets``: see `LOBES`; ``rank``: number of rare photons before
    each index up to ``count``.
    """

    photons: Photon
    slope: mi.Float
    place: mi.UInt64
    count: mi.UInt32
    low: mi.Point3f
    scale: mi.Float
    offsets: mi.Int32
    rare: mi.UInt32
    rank: mi.UInt32

    @staticmethod
    def of(photons: Photon, count: int) -> Guide:
        """The guide of the first ``count`` (at least one) of ``photons``."""
        index = dr.arange(mi.UInt32, count)
        found = photons.at(index)
        low = mi.Point3f(*(dr.min(x) for x in found.p))
        extent = dr.max(mi.Vector3f(*(dr.max(x) for x in found.p)) - low)
        scale = dr.select(extent > 0, ((1 << _BITS) - 1) / extent, 0)
        place = _place(found.p, low, scale)
        # By subpath at equal places: independent of the order of threads.
        order = dr.argsort((place << _LANE_BITS) | mi.UInt64(found.lane))
        place, number = dr.gather(mi.UInt64, place, order), dr.opaque(mi.UInt32, count)
        photons, offsets, none = found.at(order), mi.Int32(LOBES), dr.opaque(mi.UInt32, 0)
        slope = _slopes(photons, number, offsets)
        guide = Guide(photons, slope, place, number, low, scale, offsets, none, none)
        dr.make_opaque(guide)
        guide._add_rare(index)
        return guide

    def _add_rare(self, index: mi.UInt32):
        """Add the rare photons; ``index`` of each photon."""
        rare = density(self, self.photons.p, index, self.photons.d, WINDOW) < _RARE
        chosen = dr.compress(rare)
        number = dr.width(chosen)
        self.rank = dr.concat([dr.prefix_sum(dr.select(rare, mi.UInt32(1), 0)), mi.UInt32(number)])
        if number:
            self.rare = dr.opaque(mi.UInt32, number)
            slopes = _slopes(self.photons.at(chosen), self.rare, self.offsets)
            self.photons = self.photons.at(dr.concat([index, chosen]))
            self.slope = dr.concat([self.slope, slopes])
        dr.make_opaque(self)


@dr.syntax
def _slopes(photons: Photon, count: mi.UInt32, offsets: mi.Int32) -> mi.Float:
    """Slope of each photon: the third least to others in its window, as light may come from several sides.

    With fewer others 1 over the length of the last edge.
    """
    index = dr.arange(mi.UInt32, dr.width(photons.lane))
    first, second, third = mi.Float(dr.inf), mi.Float(dr.inf), mi.Float(dr.inf)
    k = mi.UInt32(0)
    while dr.hint(k < len(WINDOW), label="slopes of photons", exclude=[photons, count, offsets, index]):
        other = photons.at(_within(count, index, dr.gather(mi.Int32, offsets, k)))
        distance = dr.norm(other.p - photons.p)
        slope = dr.select(distance > 0, dr.norm(other.d - photons.d) / distance, dr.inf)
        first, slope = dr.minimum(first, slope), dr.maximum(first, slope)
        second, slope = dr.minimum(second, slope), dr.maximum(second, slope)
        third = dr.minimum(third, slope)
        k += 1
    return dr.select(dr.isfinite(third), third, dr.rcp(photons.distance))


def _place(p: mi.Point3f, low: mi.Point3f, scale: mi.Float) -> mi.UInt64:
    """Morton code of ``p``: the interleaved bits of its coordinates."""
    place = mi.UInt64(0)
    for axis in range(3):
        x = dr.clip((p[axis] - low[axis]) * scale, 0, (1 << _BITS) - 1)
        place |= _spread(mi.UInt64(mi.UInt32(x))) << axis
    return place


def _spread(x: mi.UInt64) -> mi.UInt64:
    """Spread the lowest 21 bits of ``x`` to every third bit."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | (x << shift)) & mask
    return x


@dr.syntax
def find(guide: Guide, p: mi.Point3f) -> mi.UInt32:
    """Index of the first photon at or behind the place of ``p``; `dr.binary_search` is slower."""
    place = _place(p, guide.low, guide.scale)
    low, high = mi.UInt32(0), mi.UInt32(guide.count)
    while dr.hint(low < high, label="place among photons", exclude=[guide, place]):
        middle = (low + high) >> 1
        before = dr.gather(mi.UInt64, guide.place, middle) < place
        low = dr.select(before, middle + 1, low)
        high = dr.select(before, high, middle)
    return low


def _within(count: mi.UInt32, index: mi.UInt32, offset: mi.Int32) -> mi.UInt32:
    """The index at ``offset`` from ``index``, or the closest one of ``count``."""
    return mi.UInt32(dr.clip(mi.Int32(index) + offset, 0, mi.Int32(count) - 1))


def _lobe(guide: Guide, p: mi.Point3f, found: mi.UInt32, k: mi.UInt32) -> tuple[mi.Vector3f, mi.Float]:
    """Axis of the ``k``-th photon's lobe at ``p``, and width^2 / 2 (0 without a lobe)."""
    rare = (k >= len(WINDOW)) & (guide.rare > 0)
    start = dr.select(rare, dr.gather(mi.UInt32, guide.rank, found, rare), found)
    index = _within(dr.select(rare, guide.rare, guide.count), start, dr.gather(mi.Int32, guide.offsets, k))
    index += dr.select(rare, guide.count, 0)
    photon = guide.photons.at(index)
    distance = dr.norm(photon.p - p)
    width = distance * dr.gather(mi.Float, guide.slope, index)
    exists = (width < _MOST) & (distance > 0)  # none of a photon at itself
    return photon.d, dr.square(dr.select(exists, dr.maximum(width, _LEAST), 0)) / 2


def draw(guide: Guide, p: mi.Point3f, found: mi.UInt32, u1: mi.Float, u2: mi.Point2f):
    """Sample a unit direction at ``p``; returns it, and a mask: the photon has a lobe."""
    k = dr.minimum(mi.UInt32(u1 * len(LOBES)), len(LOBES) - 1)
    axis, a = _lobe(guide, p, found, k)
    m = dr.minimum(2 * u2.x * a / (a + 2 * (1 - u2.x)), 2)  # 1 - cos of the angle
    sin, cos = dr.sincos(2 * dr.pi * u2.y)
    across = dr.sqrt(dr.maximum(m * (2 - m), 0))
    local = mi.Vector3f(across * cos, across * sin, 1 - m)
    return mi.Frame3f(axis).to_world(local), a > 0


@dr.syntax
def density(guide: Guide, p: mi.Point3f, found: mi.UInt32, d: mi.Vector3f, lobes: tuple = LOBES) -> mi.Float:
    """Density (solid angle) of sampling the unit direction ``d`` at ``p`` with `draw`, by ``lobes`` alone."""
    k, total = mi.UInt32(0), mi.Float(0)
    while dr.hint(k < len(lobes), label="photons of a window", exclude=[guide, p, found, d, lobes]):
        axis, a = _lobe(guide, p, found, k)
        m = dr.squared_norm(d - axis) / 2
        total += a * (a + 2) / dr.square(dr.select(a > 0, a + m, 1))
        k += 1
    return total / (4 * dr.pi * len(lobes))
