"""Vertices of a light subpath that inner connections can use."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..geometry import rays
from . import bsdf, mis
from .walk import Vertex


@dataclass
class LightPath:
    """Connectible vertices of a lane's light subpath in local memory, ``count`` of them.

    ``throughput`` is that of the vertex over its cosine of incidence (the constant part of the adjoint
    factor); ``newest`` and ``older`` are its `mis.Partial`; ``s`` the number of light vertices up to and
    including it.
    """

    si: object
    throughput: object
    newest: object
    older: object
    anchor: object
    s: object
    count: object


def allocate_light_path(kernel, lanes: int) -> LightPath:
    """Local memory for stored vertices; no field is a Bool (these abort LLVM code generation)."""
    size = kernel.store_size
    return LightPath(
        si=dr.alloc_local(mi.SurfaceInteraction3f, size),
        throughput=dr.alloc_local(mi.Spectrum, size),
        newest=dr.alloc_local(mi.Float, size),
        older=dr.alloc_local(type(kernel.heuristic.zero()), size),
        anchor=dr.alloc_local(mi.Vector2f, size),
        s=dr.alloc_local(mi.UInt32, size),
        # As wide as the lanes: Dr.Jit takes an index of width 1 for the same in all lanes.
        count=dr.zeros(mi.UInt32, lanes),
    )


def store_light_vertex(kernel, vertex: Vertex, path: LightPath):
    """Keep a light vertex that inner connections can use."""
    keep = vertex.hit & (vertex.edges <= kernel.last_stored) & bsdf.connectible(vertex.bsdf)
    slot = path.count
    path.si.write(vertex.si, slot, keep)
    path.throughput.write(mi.Spectrum(vertex.throughput / vertex.cos), slot, keep)
    path.newest.write(vertex.partial.d_vcm, slot, keep)
    path.older.write(vertex.partial.d_vc, slot, keep)
    path.anchor.write(mi.Vector2f(vertex.anchor.offset, vertex.anchor.curvature), slot, keep)
    path.s.write(vertex.edges + 1, slot, keep)
    path.count = path.count + dr.select(keep, mi.UInt32(1), mi.UInt32(0))


def read_light_vertex(kernel, path: LightPath, slot) -> Vertex:
    """The stored vertex ``slot``, the same in all lanes that use it."""
    si = path.si[slot]
    anchor = path.anchor[slot]
    s = path.s[slot]
    return Vertex(
        si=si,
        bsdf=si.bsdf(),
        cos=mi.Float(1),
        anchor=rays.Anchor(si.p, si.n, anchor.x, anchor.y if kernel.shape_errors.any else mi.Float(0)),
        throughput=path.throughput[slot],
        partial=mis.Partial(path.newest[slot], path.older[slot]),
        edges=s - 1,
        previous=None,
        seen=None,
        hit=mi.Bool(True),
        active=mi.Bool(True),
    )
