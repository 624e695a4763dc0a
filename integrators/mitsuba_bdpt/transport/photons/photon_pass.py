"""Tracing the photons of a pass: light subpaths as far as their paths are isolated, kept in memory."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ...sampling.points import Points, Purpose
from .. import mis, spectra, subpaths
from ..counters import Counters, one
from ..inputs import Kernel
from ..observer import Observer
from ..walk import may_merge, newest_coefficient, random_walk
from .aim import Aim
from .merging import BUCKET_BITS, Merging, Photon, Photons, bucket_of, cell_at, level_of
from .photon_guide import Guide, GuidePhoton

# Photons that memory is taken for at first, over the number of subpaths: few subpaths have more.
_CAPACITY = 0.5

# Photons' subpaths of a render's guide, and of a pass with merging: one for so many of its samples, within
# these limits. Twice as many make merges hardly less noisy (the noise is that of the camera's subpaths), and
# in `pool_floor` take half as much time again.
SAMPLES_PER_PHOTON, SAMPLES_PER_MERGED = 4, 8
FEWEST_PHOTONS, MOST_PHOTONS = 1 << 12, 1 << 18

# So many of a pass at most for each disc of its radius that the film has room for: merges of more are slow.
_PER_DISC = 64

# Bits of a path's edges, and of the number of its subpath, in the key by which photons are sorted.
_EDGES_BITS, _LANE_BITS = 12, 32


def photons_of(samples: int, each: int = SAMPLES_PER_PHOTON) -> int:
    """Photons' subpaths of so many ``samples``, one for ``each`` so many."""
    return min(max(samples // each, FEWEST_PHOTONS), MOST_PHOTONS)


def photons_of_pass(samples: int, pixels: int, radius: float) -> int:
    """The same of a pass with merging on so many ``pixels``, in discs of this ``radius`` (pixels)."""
    most = max(int(_PER_DISC * pixels / (math.pi * radius**2)), 64)
    return min(photons_of(samples, SAMPLES_PER_MERGED), most)


def trace(kernel: Kernel, merging: Merging, points: Points, count: int) -> tuple[Merging, mi.UInt64]:
    """``merging`` with the photons of ``count`` light subpaths, which these ``points`` make.

    Also `Counters.summed`. Traced again if they are more than there was memory for: none is dropped.
    """
    kernel = _kernel(kernel, points)
    kernel.merging = merging

    def photon(y, walk, lanes, aimed):
        keep = may_merge(kernel, kernel.kappa.direct, walk, y) & (y.edges < kernel.max_depth)
        older = kernel.heuristic.combine(y.partial.d_vc, y.partial.d_vm)
        return keep, Photon(y.si.p, -walk.d, y.si.n, y.throughput, older, aimed, y.edges, lanes)

    photons, found, counters = _all(kernel, merging.aim, count, Photon, photon)
    return replace(merging, photons=_sorted(merging, photons, found)), counters


def trace_guide(kernel: Kernel, aim: Aim, points: Points, count: int) -> tuple[Guide | None, mi.UInt64]:
    """The guide that ``count`` light subpaths make, which set out as ``aim`` says; `Counters.summed`.

    None if they give no photon. Photons are those that s = 0 might find, at the first vertex that is not
    delta.
    """
    kernel = _kernel(kernel, points)
    kernel.guide = None

    def photon(y, walk, lanes, aimed):
        joined = mis.is_joined(y.partial, newest_coefficient(kernel, kernel.kappa.direct, y.edges))
        keep = y.hit & y.connectible() & ~joined & (y.edges < kernel.max_depth)
        keep &= y.partial.d_vc > 0
        slope = dr.rcp(dr.norm(y.si.p - y.previous))
        return keep, GuidePhoton(y.si.p, -walk.d, slope, y.si.n, y.throughput, y.partial.d_vc, y.edges, lanes)

    photons, found, counters = _all(kernel, aim, count, GuidePhoton, photon)
    return Guide.of(photons, found) if found else None, counters


def _kernel(kernel: Kernel, points: Points) -> Kernel:
    kernel = kernel.bound(points, 1.0, Observer())
    kernel.last_light = kernel.max_depth
    return kernel


def _all(kernel: Kernel, aim: Aim, count: int, kind, photon) -> tuple[Any, int, mi.UInt64]:
    """As `_traced`; none is left out."""
    capacity = max(int(count * _CAPACITY), 1)
    while True:
        photons, found, counters = _traced(kernel, aim, count, kind.zeros(capacity), photon)
        if found <= capacity:
            return photons, found, counters
        capacity = found


def _traced(kernel: Kernel, aim: Aim, count: int, out, photon) -> tuple[Any, int, mi.UInt64]:
    """Photons in the order of their arrival, how many there are, maybe more than fit into ``out``; counts.

    ``photon(y, walk, lanes, aimed)`` says whether there is one at a vertex, and which.
    """
    capacity = dr.width(out)
    kept, most = dr.zeros(mi.UInt32, 1), dr.opaque(mi.UInt32, capacity)
    lanes = dr.arange(mi.UInt32, count)
    stream = kernel.points.stream("light", mi.UInt64(lanes), lanes)
    shared = subpaths.shared_by_lane(kernel, stream, mi.UInt64(lanes))
    e, aimed = aim.emission(
        kernel.emitters,
        kernel.points.draw_2d("light", stream, Purpose.EMISSION_POINT),
        kernel.points.draw_2d("light", stream, Purpose.EMISSION_DIRECTION),
        shared,
    )
    walk = subpaths.light_walk(kernel, e, stream, shared, True)
    merges = kernel.merging is not None
    side = subpaths.light_side(kernel, e, stream, shared, walk)
    side = replace(side, join=None, isolated=merges, only_delta=not merges)

    def visit(y, counters, walk):
        keep, found = photon(y, walk, lanes, aimed)
        keep &= spectra.is_finite(
            y.throughput
        )  # else all that are drawn with it would be NaN; the walk counts it
        place = dr.scatter_inc(kept, mi.UInt32(0), keep)
        dr.scatter(out, found, place, keep & (place < most))
        return counters + Counters(photons=one(keep))

    begun = walk.active
    counters, walk = random_walk(kernel, side, walk, stream, visit, Counters.zeros("photons"))
    counters += Counters(photon=dr.select(begun, walk.traced(), 0), non_finite=one(walk.broken))
    counts = counters.summed()
    dr.eval(kept, out, counts)
    return out, int(kept[0]), counts


def _sorted(merging: Merging, photons: Photon, count: int) -> Photons:
    """The first ``count`` by bucket, subpath and edge, an order that does not depend on threads."""
    index = dr.arange(mi.UInt32, max(count, 1))  # one that is in no bucket where there is none
    found = photons.at(index)
    radius = merging.radius
    sets = merging.wavelengths
    number = None if sets is None else sets.number(found.lane)
    cell = cell_at(radius, found.p, level_of(radius, radius.at(found.p)), number)
    bucket = bucket_of(cell)
    key = (mi.UInt64(bucket) << (_LANE_BITS + _EDGES_BITS)) | (mi.UInt64(found.lane) << _EDGES_BITS)
    order = dr.argsort(key | mi.UInt64(dr.minimum(found.edges, (1 << _EDGES_BITS) - 1)))
    counts = dr.zeros(mi.UInt32, (1 << BUCKET_BITS) + 1)
    dr.scatter_add(counts, mi.UInt32(1), bucket + 1, index < dr.opaque(mi.UInt32, count))
    starts = dr.cumsum(counts)
    result = Photons(found.at(order), dr.gather(mi.UInt64, cell, order), starts)
    dr.eval(result)
    return result
