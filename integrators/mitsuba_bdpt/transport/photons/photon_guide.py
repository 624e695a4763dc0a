"""Photons as a guide of directions: from where light that glass focuses arrives at a point.

Source of the idea: H. W. Jensen, "Importance Driven Path Tracing Using the Photon Map", 1995. The photons are
the vertices of light subpaths on the first surface that is not delta. Sorted along a space-filling curve
(Morton's, "Z-order"), those next to a point's place on it are near it, however few there are: a window of
them, dense around that place and sparse farther off, is a mixture of lobes about the photons' directions. The
density is a function of the point and of photons that do not depend on the samples that use it, so that
whatever it is nothing is biased.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import drjit as dr
import mitsuba as mi

from .columns import Columns

# Places of the photons of a window, from that of the point on.
_NEAR = 4
_FAR = (6, 12, 25, 60)
WINDOW = (*(-far for far in reversed(_FAR)), *range(-_NEAR, _NEAR), *_FAR)

# How many places each stands for.
_BETWEEN = [b - a for a, b in pairwise(WINDOW)]
STANDS_FOR = tuple((a + b) / 2 for a, b in pairwise([_BETWEEN[0], *_BETWEEN, _BETWEEN[-1]]))

# Bits of each coordinate of a place on the curve, and of the number of a subpath: 64 together.
_BITS, _LANE_BITS = 15, 19

# Width of a lobe (tangent of half its directions' angle) over the photon's slope times its distance from the
# point; the least one, and the largest, beyond which a photon says nothing.
_WIDTH, _LEAST, _MOST = 1.0, 1e-3, 0.5


@dataclass
class GuidePhoton(Columns):
    """A photon: ``p`` position, ``d`` unit direction towards the light's side.

    ``slope``: by how much directions change over a distance; one over the length of its last edge, until a
    `Guide` knows better.
    For `guiding_benefit` also ``n`` geometric normal, ``flux`` the throughput of its subpath, ``hit`` the
    partial sum of s = 0, in the area measure, and ``edges`` of its path. ``lane`` of its subpath, which has
    no other photon.
    """

    p: mi.Point3f
    d: mi.Vector3f
    slope: mi.Float
    n: mi.Normal3f
    flux: mi.Spectrum
    hit: mi.Float
    edges: mi.UInt32
    lane: mi.UInt32

    @staticmethod
    def types():
        return mi.Point3f, mi.Vector3f, mi.Float, mi.Normal3f, mi.Spectrum, mi.Float, mi.UInt32, mi.UInt32


@dataclass
class Guide:
    """``photons`` in the order of their ``place`` on the curve, so many as ``count``; and its box.

    ``low`` corner of the box, ``scale`` places over length; ``offsets`` see `WINDOW`, ``stands_for`` see
    `STANDS_FOR`.
    """

    photons: GuidePhoton
    place: mi.UInt64
    count: mi.UInt32
    low: mi.Point3f
    scale: mi.Float
    offsets: mi.Int32
    stands_for: mi.Float

    @staticmethod
    def of(photons: GuidePhoton, count: int) -> Guide:
        """The guide of the first ``count`` of these ``photons``, one at least."""
        index = dr.arange(mi.UInt32, count)
        found = photons.at(index)
        low = mi.Point3f(*(dr.min(x) for x in found.p))
        extent = dr.max(mi.Vector3f(*(dr.max(x) for x in found.p)) - low)
        scale = dr.select(extent > 0, ((1 << _BITS) - 1) / extent, 0)
        place = _place(found.p, low, scale)
        # By the subpath where places are the same, an order that does not depend on threads.
        order = dr.argsort((place << _LANE_BITS) | mi.UInt64(found.lane))
        guide = Guide(
            found.at(order),
            dr.gather(mi.UInt64, place, order),
            dr.opaque(mi.UInt32, count),
            low,
            scale,
            mi.Int32(WINDOW),
            mi.Float(STANDS_FOR),
        )
        guide.photons.slope = _slopes(guide)
        dr.make_opaque(guide)
        return guide


@dr.syntax
def _slopes(guide: Guide) -> mi.Float:
    """The slope of each photon: of the least to others in its window the third; where fewer, what it has.

    Where light is focused from several sides the others are of several kinds, of which the nearest in
    direction are of its own.
    """
    index = dr.arange(mi.UInt32, dr.width(guide.place))
    own = guide.photons.at(index)
    first, second, third = mi.Float(dr.inf), mi.Float(dr.inf), mi.Float(dr.inf)
    k = mi.UInt32(0)
    while dr.hint(k < len(WINDOW), label="slopes of photons", exclude=[guide, index, own]):
        other = photon(guide, index, k, True)
        distance = dr.norm(other.p - own.p)
        slope = dr.select(distance > 0, dr.norm(other.d - own.d) / distance, dr.inf)
        first, slope = dr.minimum(first, slope), dr.maximum(first, slope)
        second, slope = dr.minimum(second, slope), dr.maximum(second, slope)
        third = dr.minimum(third, slope)
        k += 1
    return dr.select(dr.isfinite(third), third, own.slope)


def _place(p: mi.Point3f, low: mi.Point3f, scale: mi.Float) -> mi.UInt64:
    """The place of ``p`` on the curve: the bits of its coordinates by turns."""
    place = mi.UInt64(0)
    for axis in range(3):
        x = dr.clip((p[axis] - low[axis]) * scale, 0, (1 << _BITS) - 1)
        place |= _spread(mi.UInt64(mi.UInt32(x))) << axis
    return place


def _spread(x: mi.UInt64) -> mi.UInt64:
    """The lowest 21 bits of ``x``, each at three times its place."""
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
    """The number of the first photon at or behind the place of ``p``."""
    place = _place(p, guide.low, guide.scale)
    low, high = mi.UInt32(0), mi.UInt32(guide.count)
    while dr.hint(low < high, label="place among photons", exclude=[guide, place]):
        middle = (low + high) >> 1
        before = dr.gather(mi.UInt64, guide.place, middle) < place
        low = dr.select(before, middle + 1, low)
        high = dr.select(before, high, middle)
    return low


def photon(guide: Guide, found: mi.UInt32, k: mi.UInt32, active) -> GuidePhoton:
    """The ``k``-th photon of the window about the number ``found``."""
    number = mi.Int32(found) + dr.gather(mi.Int32, guide.offsets, k, active)
    number = dr.clip(number, 0, mi.Int32(guide.count) - 1)
    return guide.photons.at(mi.UInt32(number), active)


def exists(guide: Guide, found: mi.UInt32, k: mi.UInt32) -> mi.Bool:
    """Mask: the window has a photon of this number; beyond the first and last of all it repeats them."""
    number = mi.Int32(found) + dr.gather(mi.Int32, guide.offsets, k)
    return (number >= 0) & (number < mi.Int32(guide.count))


def _width(photon: GuidePhoton, p: mi.Point3f) -> mi.Float:
    """The width of its lobe at ``p``, 0 if it has none."""
    width = _WIDTH * dr.norm(photon.p - p) * photon.slope
    return dr.select(width < _MOST, dr.maximum(width, _LEAST), 0)


def draw(guide: Guide, p: mi.Point3f, found: mi.UInt32, u1: mi.Float, u2: mi.Point2f):
    """A unit direction of the density at ``p``, and a mask: whether there is one."""
    k = dr.minimum(mi.UInt32(u1 * len(WINDOW)), len(WINDOW) - 1)
    chosen = photon(guide, found, k, True)
    a = dr.square(_width(chosen, p)) / 2
    m = dr.minimum(2 * u2.x * a / (a + 2 * (1 - u2.x)), 2)  # 1 - cos of the angle
    sin, cos = dr.sincos(2 * dr.pi * u2.y)
    across = dr.sqrt(dr.maximum(m * (2 - m), 0))
    local = mi.Vector3f(across * cos, across * sin, 1 - m)
    return mi.Frame3f(chosen.d).to_world(local), a > 0


@dr.syntax
def density(guide: Guide, p: mi.Point3f, found: mi.UInt32, d: mi.Vector3f) -> mi.Float:
    """The density (solid angle) with which `draw` makes the unit direction ``d`` at ``p``."""
    k, total = mi.UInt32(0), mi.Float(0)
    while dr.hint(k < len(WINDOW), label="photons of a window", exclude=[guide, p, found, d]):
        near = photon(guide, found, k, True)
        a = dr.square(_width(near, p)) / 2
        m = dr.squared_norm(d - near.d) / 2
        total += a * (a + 2) / dr.square(dr.select(a > 0, a + m, 1))
        k += 1
    return total / (4 * dr.pi * len(WINDOW))
