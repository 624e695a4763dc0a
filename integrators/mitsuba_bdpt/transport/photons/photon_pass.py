"""The photon pass: traces photon subpaths and stores their vertices."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import drjit as dr
import mitsuba as mi

from ...sampling.points import Points, Purpose
from .. import mis, spectra, subpaths
from ..alternatives import has_lobe, is_sds_vertex, newest_connection
from ..contribution import Counters, one
from ..inputs import Kernel, Observer
from ..near_specular import GUIDED, NARROW
from ..sds import PhotonStrategy, State
from ..walk import random_walk
from .aim import Aim
from .guided_hits import Unguided
from .photon import ConnectedPhoton, MergedPhoton, Photon
from .photon_guide import Guide

# Initial memory, in photons per subpath.
_CAPACITY = 0.5

# Camera samples per photon subpath of a guide; bounds of the number of photon subpaths.
SAMPLES_PER_PHOTON = 4
FEWEST_PHOTONS, MOST_PHOTONS = 1 << 12, 1 << 18


def photons_of(samples: int, each: int = SAMPLES_PER_PHOTON) -> int:
    """Number of photon subpaths for ``samples`` camera samples, one per ``each``."""
    return min(max(samples // each, FEWEST_PHOTONS), MOST_PHOTONS)


class PhotonPolicy(Enum):
    """Vertices of photon subpaths that are stored."""

    MERGED = "all vertices where merges may count"
    GUIDED = "the first vertex of a non-specular event, if s = 0 can sample the path through it"
    UNSAMPLED = "the first non-delta vertex, if no strategy can sample the path through it"
    UNDERSAMPLED = "all vertices with a non-delta lobe behind delta and near-specular events"

    @property
    def estimates(self) -> bool:
        """Whether photons estimate how much light a render lacks, of which emitter."""
        return self in (PhotonPolicy.UNSAMPLED, PhotonPolicy.UNDERSAMPLED)


@dataclass
class Traced:
    """``count`` ``photons`` in the order of threads, and counters.

    ``broken``, if `PhotonPolicy.estimates`: mask by emitter, a subpath ended by a non-finite value.
    """

    photons: Photon
    count: int
    counters: mi.UInt64
    broken: mi.Bool


def trace_guide(kernel: Kernel, aim: Aim, points: Points, count: int) -> tuple[Guide | None, mi.UInt64]:
    """Trace ``count`` photon subpaths; returns their guide and counters.

    The guide is None without photons. ``aim`` samples first directions.
    """
    traced = trace(kernel, None, aim, points, count, PhotonPolicy.GUIDED)
    return Guide.of(traced.photons, traced.count) if traced.count else None, traced.counters


def trace(
    kernel: Kernel, sds: PhotonStrategy | None, aim: Aim, points: Points, count: int, kept: PhotonPolicy
) -> Traced:
    """Trace ``count`` photon subpaths; ``sds``: the strategy that merges them, None for a guide."""
    kernel = kernel.bound(points, 1.0, Observer())
    kernel.sds = sds
    kernel.last_light = kernel.last_merged if kernel.merges else kernel.max_depth
    capacity = max(int(count * _CAPACITY), 1)
    while True:
        out = _kind(kernel, kept).zeros(capacity, kernel.path_layers)
        traced = _traced(kernel, aim, count, kept, out)
        if traced.count <= capacity:
            return traced
        capacity = traced.count  # again, with more memory


def _traced(kernel: Kernel, aim: Aim, count: int, kept: PhotonPolicy, out: Photon) -> Traced:
    """Store photons in ``out``; `Traced.count` may exceed it."""
    capacity = dr.width(out)
    number, most = dr.zeros(mi.UInt32, 1), dr.opaque(mi.UInt32, capacity)
    lanes = dr.arange(mi.UInt32, count)
    stream = kernel.points.stream("light", mi.UInt64(lanes))
    shared = subpaths.shared_by_lane(kernel, stream, mi.UInt64(lanes))
    merges, undersampled = kernel.merges, kept is PhotonPolicy.UNDERSAMPLED
    near_specular = kept is PhotonPolicy.GUIDED and kernel.near_specular
    sds = kernel.sds if merges else Unguided(near_specular=True) if near_specular else None
    e, aimed, finite, walk = _begun(kernel, aim, kept, sds, stream, shared)
    side = subpaths.light_side(kernel, e, stream, shared, walk, sds)
    specular = GUIDED * near_specular + NARROW * undersampled
    only_delta = not merges and not specular
    side = replace(side, connect=None, only_delta=only_delta, only_specular=specular)

    def visit(y, counters, walk):
        older, more = kernel.heuristic.combine(y.partial.d_vc, y.partial.d_vm), ()
        flux = y.throughput
        if merges and sds is not None:
            older, connection = y.partial.d_vc, _connection(kernel, y)
            more = connection, y.partial.d_vm, y.partial.d_vm_newest
            keep = sds.may_merge(kernel, y, connection)
            probability = sds.kept(kernel, y, walk.sds.survived)
            keep &= kernel.points.draw_1d("light", stream, Purpose.CONNECTION, y.event) < probability
            flux = flux / probability
        elif undersampled:
            keep = has_lobe(kernel, y)
        else:
            keep = is_sds_vertex(kernel, kernel.kappa.direct, walk, y)
        # Otherwise all estimates near it would be NaN; the walk counts it.
        keep &= spectra.is_finite(y.throughput)
        if kept is PhotonPolicy.GUIDED and not near_specular:
            keep &= older > 0
        if kept is PhotonPolicy.UNSAMPLED:
            older = dr.select(finite, mi.Float(0), dr.nan)
        if undersampled:
            older = dr.select(finite, mi.Float(older), dr.nan)
            more = _connection(kernel, y), ~e.delta
        distance = dr.norm(y.si.p - y.previous)
        fields = y.si.p, -walk.d, y.si.n, flux, older, aimed, distance, y.edges, lanes, e.index
        found = type(out)(*fields, *more, layer=y.layer)
        place = dr.scatter_inc(number, mi.UInt32(0), keep)
        out.put(found, place, keep & (place < most))
        return counters + Counters(photons=one(keep))

    begun = walk.active
    counters, walk = random_walk(kernel, side, walk, visit, Counters.zeros("photons"))
    counters += Counters(photon=dr.select(begun, walk.traced(), 0), non_finite=one(walk.broken))
    counts = counters.summed()
    broken = mi.Bool(False)
    if kept.estimates:
        broken = dr.zeros(mi.Bool, kernel.emitters.count)
        traced = e.delta | undersampled
        astray = walk.broken | (traced & ~dr.isfinite(dr.sum(e.d)))
        dr.scatter(broken, mi.Bool(True), e.index, astray)
    dr.eval(number, out, counts, broken)
    return Traced(out, int(number[0]), counts, broken)


def _begun(kernel: Kernel, aim: Aim, kept: PhotonPolicy, sds: PhotonStrategy | None, stream, shared):
    """Emissions of photons, `Photon.aim`, a mask of finite emissions, and subpaths on their first edges."""
    e, aimed = aim.emission(
        kernel.emitters,
        kernel.points.draw_2d("light", stream, Purpose.EMISSION_POINT),
        kernel.points.draw_2d("light", stream, Purpose.EMISSION_DIRECTION),
        shared,
    )
    finite = mi.Bool(True)
    if kept.estimates:  # traced, to see where their light arrives
        finite = spectra.is_finite(e.weight)
        e = replace(e, weight=dr.select(finite, e.weight, 1))
    # These weights do not know of the aim, see `merging.merging`.
    unaimed = kernel.merges or kept is PhotonPolicy.UNDERSAMPLED
    start = replace(e, pdf_second=e.pdf_second * aimed) if unaimed else e
    walk = subpaths.light_walk(kernel, start, stream, shared, sds)
    if kernel.merges:
        walk = replace(walk, sds=State(survived=mi.Float(1)))
    elif kept is PhotonPolicy.UNSAMPLED or (kept.estimates and kernel.plan.guided):
        # s = 0 samples the others, guided if need be.
        walk = replace(walk, active=walk.active & e.delta)
    return e, aimed, finite, walk


def _kind(kernel: Kernel, kept: PhotonPolicy) -> type[Photon]:
    """The record of its photons."""
    if kernel.merges:
        return MergedPhoton
    return ConnectedPhoton if kept is PhotonPolicy.UNDERSAMPLED else Photon


def _connection(kernel: Kernel, y) -> mis.PartialSum:
    """`ConnectedPhoton.connection` at ``y``."""
    return kernel.heuristic.present(newest_connection(kernel, kernel.kappa.direct, y))
