"""The photon pass: traces SDS paths from the light and stores their vertices."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

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
    traced = _all(_kernel(kernel, points, merging), merging.aim, count, Kept.MERGED)
    return replace(merging, photons=_sorted(merging, traced.photons, traced.count)), traced.counters


def trace_unsampled(kernel: Kernel, merging: Merging, points: Points, count: int) -> tuple[Merging, mi.Bool]:
    """Trace ``count`` photon subpaths; returns ``merging`` with those that no strategy samples.

    Also a mask by emitter: a photon subpath ended by a non-finite value.
    """
    kernel = _kernel(kernel, points, merging)
    traced = _all(kernel, merging.aim, count, Kept.UNSAMPLED)
    return replace(merging, photons=_sorted(merging, traced.photons, traced.count)), traced.broken


def trace_guide(kernel: Kernel, aim: Aim, points: Points, count: int) -> tuple[Guide | None, mi.UInt64]:
    """Trace ``count`` photon subpaths; returns their guide and counters.

    The guide is None without photons. ``aim`` samples first directions.
    """
    traced = _all(_kernel(kernel, points, None), aim, count, Kept.GUIDED)
    return Guide.of(traced.photons, traced.count) if traced.count else None, traced.counters


def _kernel(kernel: Kernel, points: Points, merging: Merging | None) -> Kernel:
    kernel = kernel.bound(points, 1.0, Observer())
    kernel.merging, kernel.guide = merging, None
    kernel.last_light = kernel.max_depth
    return kernel


class Kept(Enum):
    """Vertices of photon subpaths that are stored."""

    MERGED = "all diffuse vertices of SDS paths"
    GUIDED = "the first non-delta vertex, if s = 0 can sample the path through it"
    UNSAMPLED = "the first non-delta vertex, if no strategy can sample the path through it"


@dataclass
class _Traced:
    """``count`` ``photons`` in the order of threads; ``broken``: see `trace_unsampled`."""

    photons: Photon
    count: int
    counters: mi.UInt64
    broken: mi.Bool


def _all(kernel: Kernel, aim: Aim, count: int, kept: Kept) -> _Traced:
    """Like `_traced`, again with more memory if the photons exceed it."""
    capacity = max(int(count * _CAPACITY), 1)
    while True:
        traced = _traced(kernel, aim, count, kept, Photon.zeros(capacity))
        if traced.count <= capacity:
            return traced
        capacity = traced.count


def _traced(kernel: Kernel, aim: Aim, count: int, kept: Kept, out: Photon) -> _Traced:
    """Store photons in ``out``; `_Traced.count` may exceed it."""
    capacity = dr.width(out)
    number, most = dr.zeros(mi.UInt32, 1), dr.opaque(mi.UInt32, capacity)
    lanes = dr.arange(mi.UInt32, count)
    stream = kernel.points.stream("light", mi.UInt64(lanes))
    shared = subpaths.shared_by_lane(kernel, stream, mi.UInt64(lanes))
    e, aimed = aim.emission(
        kernel.emitters,
        kernel.points.draw_2d("light", stream, Purpose.EMISSION_POINT),
        kernel.points.draw_2d("light", stream, Purpose.EMISSION_DIRECTION),
        shared,
    )
    merges, finite = kept is Kept.MERGED, mi.Bool(True)
    if kept is Kept.UNSAMPLED:  # traced, to see where their light arrives
        finite = spectra.is_finite(e.weight)
        e = replace(e, weight=dr.select(finite, e.weight, 1))
    walk = subpaths.light_walk(kernel, e, stream, shared, merges)
    if kept is Kept.UNSAMPLED:  # s = 0 samples the others
        walk = replace(walk, active=walk.active & e.delta)
    side = subpaths.light_side(kernel, e, stream, shared, walk)
    side = replace(side, join=None, isolated=merges, only_delta=not merges)

    def visit(y, counters, walk):
        older = kernel.heuristic.combine(y.partial.d_vc, y.partial.d_vm)
        keep = is_sds_vertex(kernel, kernel.kappa.direct, walk, y)
        # Otherwise all estimates near it would be NaN; the walk counts it.
        keep &= spectra.is_finite(y.throughput)
        if kept is Kept.GUIDED:
            keep &= older > 0
        if kept is Kept.UNSAMPLED:
            older = dr.select(finite, mi.Float(0), dr.nan)
        distance = dr.norm(y.si.p - y.previous)
        found = Photon(y.si.p, -walk.d, y.si.n, y.throughput, older, aimed, distance, y.edges, lanes, e.index)
        place = dr.scatter_inc(number, mi.UInt32(0), keep)
        dr.scatter(out, found, place, keep & (place < most))
        return counters + Counters(photons=one(keep))

    begun = walk.active
    counters, walk = random_walk(kernel, side, walk, stream, visit, Counters.zeros("photons"))
    counters += Counters(photon=dr.select(begun, walk.traced(), 0), non_finite=one(walk.broken))
    counts = counters.summed()
    broken = dr.zeros(mi.Bool, len(kernel.scene.emitters()))
    if kept is Kept.UNSAMPLED:
        astray = walk.broken | (e.delta & ~dr.isfinite(dr.sum(e.d)))
        dr.scatter(broken, mi.Bool(True), e.index, astray)
    dr.eval(number, out, counts, broken)
    return _Traced(out, int(number[0]), counts, broken)


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
