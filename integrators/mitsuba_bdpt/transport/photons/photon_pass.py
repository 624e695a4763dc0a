"""The photon pass: traces photon subpaths and stores their vertices."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ...emitters.records import Emission
from ...sampling.points import Points, Purpose, Stream
from .. import spectra, subpaths
from ..alternatives import is_sds_vertex, newest_connection
from ..contribution import Counters, one
from ..inputs import TraceContext
from ..near_specular import SPECULAR
from ..sds import PhotonStrategy, begun_near_specular
from ..walk import Vertex, Walk, random_walk
from .aim import Aim
from .photon import Photon
from .photon_guide import Guide

_CAPACITY = 2.0  # initial memory, in photons per subpath

# Bounds of the number of photon subpaths: of all, of a guide, of a pass of merging.
FEWEST_PHOTONS, MOST_OF_GUIDE, MOST_OF_PASS = 1 << 12, 1 << 19, 1 << 18


def photons_of(samples: int, each: int = 1, most: int = MOST_OF_GUIDE) -> int:
    """Number of photon subpaths for ``samples`` camera samples, one per ``each``."""
    return min(max(samples // each, FEWEST_PHOTONS), most)


class PhotonPolicy:
    """Which photon subpaths are followed, and which of their vertices are stored.

    ``only_specular``: see `Side`; ``balls``: photons in media fill some, see `inside`.
    """

    only_specular: float = math.inf
    balls: Any = None

    def emission(self, e: Emission, aim: mi.Float) -> tuple[Emission, mi.Float]:
        """The emission with which a subpath begins, and `Photon.aim`, given what `Aim` sampled."""
        return e, aim

    def begin(self, kernel: TraceContext, e: Emission, walk: Walk) -> Walk:
        """The subpath ``walk`` on its first edge."""
        return walk

    def stored(self, kernel: TraceContext, y: Vertex, stream: Stream) -> tuple:
        """Mask: ``y`` is stored; the probability of that."""
        raise NotImplementedError

    def inside(self, y: Vertex, *planes: tuple[mi.Point3f, mi.Normal3f]) -> mi.Float:
        """Part of the photon's ball on its side of all ``planes`` (point; normal, or 0); 1 of a disc."""
        raise NotImplementedError


class GuidePhotons(PhotonPolicy):
    """Stores vertices with a lobe up to the first non-specular event, if s = 0 can sample the path."""

    def __init__(self, near_specular: bool):
        self.only_specular = SPECULAR if near_specular else math.inf

    def begin(self, kernel, e, walk):
        return begun_near_specular(walk, light=True) if kernel.near_specular else walk

    def stored(self, kernel, y, stream):
        keep = is_sds_vertex(kernel, y, adjoint=True)
        return keep & (kernel.heuristic.present(y.partial.d_vc) > 0), 1.0


@dataclass
class Traced:
    """``count`` ``photons`` in the order of threads, and counters.

    ``broken``: mask by emitter, a subpath ended by a non-finite value.
    """

    photons: Photon
    count: int
    counters: mi.UInt64
    broken: mi.Bool


def trace_guide(kernel: TraceContext, aim: Aim, points: Points, count: int) -> tuple[Guide | None, mi.UInt64]:
    """Trace ``count`` photon subpaths; returns their guide (None without photons) and counters."""
    kernel = kernel.replaced(sds=PhotonStrategy(), last_light=kernel.max_depth)
    traced = trace(kernel, GuidePhotons(kernel.near_specular), aim, points, count)
    return Guide.of(traced.photons, traced.count) if traced.count else None, traced.counters


def trace(kernel: TraceContext, policy: PhotonPolicy, aim: Aim, points: Points, count: int) -> Traced:
    """Trace ``count`` photon subpaths of up to ``kernel.last_light`` edges; ``kernel.sds`` in weights."""
    kernel = kernel.bound(points)
    capacity = max(int(count * _CAPACITY), 1)
    while True:
        traced = _traced(kernel, policy, aim, count, Photon.zeros(capacity, kernel.space.phase is not None))
        if traced.count <= capacity:
            return traced
        capacity = traced.count  # again, with more memory


def _traced(kernel: TraceContext, policy: PhotonPolicy, aim: Aim, count: int, out: Photon) -> Traced:
    """Store photons in ``out``; `Traced.count` may exceed it."""
    number, most = dr.zeros(mi.UInt32, 1), dr.opaque(mi.UInt32, dr.width(out))
    lanes = dr.arange(mi.UInt32, count)
    stream, shared = subpaths.begin_lane(kernel, mi.UInt64(lanes))
    u_point = kernel.points.draw_2d("light", stream, Purpose.EMISSION_POINT)
    u_direction = kernel.points.draw_2d("light", stream, Purpose.EMISSION_DIRECTION)
    e, aimed = policy.emission(*aim.emission(kernel.emitters, u_point, u_direction, shared))
    walk, side = subpaths.light_subpath(kernel, e, stream, shared, kernel.sds)
    begun = policy.begin(kernel, e, walk)
    side = replace(side, connect=None, only_specular=policy.only_specular)
    present = kernel.heuristic.present

    # Normal of the surface where the edge starts; 0 in volumes, at null BSDFs; None without balls.
    boundary = None if policy.balls is None else mi.Normal3f(e.anchor.n)

    def visit(y, state, walk):
        counters, boundary = state
        keep, probability = policy.stored(kernel, y, stream)
        # Otherwise all estimates near it would be NaN; the walk counts it.
        keep &= spectra.is_finite(y.throughput)
        arriving, medium = kernel.space.before_event(y, walk.d)
        inside = 1.0 if boundary is None else policy.inside(y, (walk.o, boundary), _ahead(kernel, walk, y))
        found = Photon(
            p=y.si.p,
            d=-walk.d,
            n=y.si.n,
            flux=arriving / (probability * inside),
            connection=present(newest_connection(kernel, y, adjoint=True)),
            d_vc=present(y.partial.d_vc),
            d_vm=present(y.partial.d_vm),
            d_vm_newest=present(y.partial.d_vm_newest),
            aim=aimed,
            distance=dr.norm(y.si.p - y.previous),
            edges=y.edges,
            lane=lanes,
            emitter=e.index,
            layer=y.layer if kernel.path_layers else mi.UInt32(0),
            medium=medium,
        )
        place = dr.scatter_inc(number, mi.UInt32(0), keep)
        out.put(found, place, keep & (place < most))
        if boundary is not None:
            boundary = _normal(y.si, y.bsdf)
        return counters + Counters(photons=one(keep)), boundary

    state = Counters.zeros("photons"), boundary
    (counters, _), walk = random_walk(kernel, side, begun, visit, state)
    rays = dr.select(begun.active, walk.traced(), 0)
    counts = (counters + Counters(photon=rays, non_finite=one(walk.broken))).summed()
    broken = dr.zeros(mi.Bool, kernel.emitters.count)
    astray = walk.broken | (begun.active & ~dr.isfinite(dr.sum(e.d)))
    dr.scatter(broken, mi.Bool(True), e.index, astray)
    dr.eval(number, out, counts, broken)
    return Traced(out, int(number[0]), counts, broken)


def _normal(si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr) -> mi.Normal3f:
    """Normal of a surface that may bound a medium; 0 in volumes and at null BSDFs."""
    return dr.select(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null), 0, si.n)


def _ahead(kernel: TraceContext, walk: Walk, y: Vertex) -> tuple[mi.Point3f, mi.Normal3f]:
    """The first surface on or behind the edge to ``y``, in a volume: a point and `_normal`."""
    si = kernel.hits.at(walk.pi, mi.Ray3f(walk.o, walk.d), y.volume & walk.pi.is_valid())
    return si.p, dr.select(si.is_valid(), _normal(si, si.bsdf()), 0)
