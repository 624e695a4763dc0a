"""The photon pass: traces SDS paths from the light and stores their vertices."""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ...sampling.points import Points, Purpose
from .. import spectra, subpaths
from ..contribution import Counters, one
from ..inputs import Kernel, Observer
from ..walk import is_sds_vertex, random_walk
from .aim import Aim
from .merging import BUCKET_BITS, Merging, Photons, bucket_of, cell_at, level_of
from .photon import Photon
from .photon_guide import Guide

# Initial memory, in photons per subpath.
_CAPACITY = 0.5

# Camera samples per photon subpath of a guide and of a merging pass; bounds of the number of photon subpaths.
SAMPLES_PER_PHOTON, SAMPLES_PER_MERGED = 4, 8
FEWEST_PHOTONS, MOST_PHOTONS = 1 << 12, 1 << 18

# Most photon subpaths of a pass per disc of its radius on the film: bounds the cost of a merge.
_PER_DISC = 64

# Bits of the edges and of the subpath's index in the sort key of photons.
_EDGES_BITS, _LANE_BITS = 12, 32


def photons_of(samples: int, each: int = SAMPLES_PER_PHOTON) -> int:
    """Number of photon subpaths for ``samples`` camera samples, one per ``each``."""
    return min(max(samples // each, FEWEST_PHOTONS), MOST_PHOTONS)


def photons_of_pass(samples: int, pixels: int, radius: float) -> int:
    """Number of photon subpaths of a pass with merging; ``radius`` in pixels."""
    most = max(int(_PER_DISC * pixels / (math.pi * radius**2)), 64)
    return min(photons_of(samples, SAMPLES_PER_MERGED), most)


def trace(kernel: Kernel, merging: Merging, points: Points, count: int) -> tuple[Merging, mi.UInt64]:
    """Trace ``count`` photon subpaths; returns ``merging`` with photons, and counters."""
    photons, found, counters = _all(_kernel(kernel, points, merging), merging.aim, count)
    return replace(merging, photons=_sorted(merging, photons, found)), counters


def trace_guide(kernel: Kernel, aim: Aim, points: Points, count: int) -> tuple[Guide | None, mi.UInt64]:
    """Trace ``count`` photon subpaths; returns their guide and counters.

    The guide is None without photons. ``aim`` samples first directions.
    """
    photons, found, counters = _all(_kernel(kernel, points, None), aim, count)
    return Guide.of(photons, found) if found else None, counters


def _kernel(kernel: Kernel, points: Points, merging: Merging | None) -> Kernel:
    kernel = kernel.bound(points, 1.0, Observer())
    kernel.merging, kernel.guide = merging, None
    kernel.last_light = kernel.max_depth
    return kernel


def _all(kernel: Kernel, aim: Aim, count: int) -> tuple[Photon, int, mi.UInt64]:
    """Like `_traced`, again with more memory if the photons exceed it."""
    capacity = max(int(count * _CAPACITY), 1)
    while True:
        photons, found, counters = _traced(kernel, aim, count, Photon.zeros(capacity))
        if found <= capacity:
            return photons, found, counters
        capacity = found


def _traced(kernel: Kernel, aim: Aim, count: int, out: Photon) -> tuple[Photon, int, mi.UInt64]:
    """Store photons in ``out``; returns it, their number (may exceed it), counters.

    With merging all diffuse vertices of SDS paths; for a guide the first non-delta vertex of a subpath, if s
    = 0 can sample the path through it.
    """
    capacity = dr.width(out)
    kept, most = dr.zeros(mi.UInt32, 1), dr.opaque(mi.UInt32, capacity)
    lanes = dr.arange(mi.UInt32, count)
    stream = kernel.points.stream("light", mi.UInt64(lanes))
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
        older = kernel.heuristic.combine(y.partial.d_vc, y.partial.d_vm)
        keep = is_sds_vertex(kernel, kernel.kappa.direct, walk, y)
        # Otherwise all estimates near it would be NaN; the walk counts it.
        keep &= spectra.is_finite(y.throughput)
        if not merges:
            keep &= older > 0
        distance = dr.norm(y.si.p - y.previous)
        found = Photon(y.si.p, -walk.d, y.si.n, y.throughput, older, aimed, distance, y.edges, lanes)
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
    """Sort the first ``count`` photons by bucket, subpath and edge: deterministic."""
    index = dr.arange(mi.UInt32, max(count, 1))  # without photons one in no bucket
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
