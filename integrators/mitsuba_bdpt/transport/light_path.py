"""Stored vertices of a light subpath, for inner connections."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from ..geometry import polarization, rays
from . import mis
from .alternatives import newest_coefficient
from .inputs import KEPT, Kernel
from .proxy_vertices import ProxyVertex, ProxyVertices
from .sds import State
from .walk import Vertex, volume_cosine


@dataclass
class StoredVertex:
    """A light vertex y_{s-1}, s >= 2, for inner connections.

    ``throughput_over_cos``: f cos / pdf of all events before this vertex, including the edge to it, over the
    geometric cosine of incidence |n.wi|, the constant part of the adjoint factor |n.wo| / |n.wi| (in volumes
    both are 1); ``partial``: partial sums in the area measure; ``edges`` up to it, s - 1; ``anchor``: starts
    rays; ``medium``: index of its medium, 0 on surfaces, None in scenes without media; ``light_group``: see
    `Contribution`; ``layer``: see `Vertex`, None where connections do not need it; ``sds``: see `Vertex`.
    """

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    anchor: rays.Anchor
    throughput_over_cos: mi.Spectrum
    partial: mis.Partial
    edges: mi.UInt32
    medium: mi.UInt32 | None = None
    light_group: mi.UInt32 | None = None
    layer: mi.UInt32 | None = None
    sds: Any = None  # a `State`

    @property
    def volume(self) -> mi.Bool:
        """Mask: in a medium."""
        return mi.Bool(False) if self.medium is None else self.medium != 0

    def cosine(self, d: mi.Vector3f) -> mi.Float:
        """Absolute geometric cosine of ``d``, 1 in volumes."""
        return volume_cosine(self.si, d, self.volume)

    @staticmethod
    def of(vertex: Vertex) -> StoredVertex:
        """The stored form of a ``vertex`` of a light subpath."""
        return StoredVertex(
            si=vertex.si,
            bsdf=vertex.bsdf,
            anchor=vertex.anchor,
            throughput_over_cos=mi.Spectrum(vertex.throughput / vertex.cos),
            partial=vertex.partial,
            edges=vertex.edges,
            medium=None if vertex.edge is None else dr.select(vertex.volume, vertex.edge.medium, 0),
            layer=vertex.layer,
            sds=vertex.sds,
        )


@dataclass
class Thinning:
    """Stochastic thinning of the stored vertices of a long light subpath in media.

    Keeps the first `KEPT` / 2, and of later ones the i-th with probability (`KEPT` / 2)^2 / (i (i - 1)) by
    systematic sampling: with C(i) the sum of the first i probabilities and u in [0, 1), the i-th is kept if
    an integer lies in (C(i - 1) + u, C(i) + u]. C(i) = `KEPT` - (`KEPT` / 2)^2 / i bounds the number of kept
    vertices. Computed in integer units of 1 / `_UNIT`, so that the probability includes rounding.

    ``tried``: vertices so far; ``offset``: u.
    """

    tried: mi.UInt32
    offset: mi.UInt32

    _UNIT: ClassVar = 2**22

    @staticmethod
    def begin(u: mi.Float) -> Thinning:
        """Thinning of a new subpath; ``u`` in [0, 1)."""
        return Thinning(mi.UInt32(0), mi.UInt32(u * Thinning._UNIT))

    def place(self, tried: mi.UInt32) -> tuple[mi.UInt32, mi.Bool, mi.Float]:
        """Slot of the vertex after ``tried``, whether it is kept, and the probability."""
        before, after = self._sum(tried), self._sum(tried + 1)
        place = (before + self.offset) // self._UNIT
        kept = (after + self.offset) // self._UNIT > place
        return place, kept, mi.Float(after - before) / self._UNIT

    def _sum(self, i: mi.UInt32) -> mi.UInt32:
        """C(i) in units of 1 / `_UNIT`."""
        half = KEPT // 2
        late = KEPT * self._UNIT - (half * half * self._UNIT - 1) // dr.maximum(i, 1)
        return dr.select(i <= half, i * self._UNIT, late)


@dataclass
class LightPath:
    """The `StoredVertex` objects of a lane's light subpath in local memory.

    ``throughput_over_cos`` as `polarization.stokes`; ``d_vcm`` and ``d_vc``: ``partial``; ``rounding``:
    offset and curvature of anchors, whose rest is in ``si``; ``merges``: ``d_vm`` and ``d_vm_newest``, where
    vertices are merged; ``s``: light vertices up to and including each; ``count``: of stored vertices;
    ``medium``: None in scenes without media; ``light_group`` (see `Contribution`) of the newest subpath,
    ``light_groups`` of each vertex if there are several; ``layers``: `StoredVertex.layer`; ``flags``: of its
    ``sds``, where near-specular events count as specular.
    """

    si: dr.Local[mi.SurfaceInteraction3f]
    throughput_over_cos: list[dr.Local]
    d_vcm: dr.Local[mi.Float]
    d_vc: dr.Local[mi.Float] | dr.Local[mi.Vector4f]
    merges: list[dr.Local]
    rounding: dr.Local[mi.Vector2f]
    s: dr.Local[mi.UInt32]
    count: mi.UInt32
    medium: dr.Local[mi.UInt32] | None = None
    light_group: mi.UInt32 | None = None
    light_groups: dr.Local[mi.UInt32] | None = None
    layers: dr.Local[mi.UInt32] | None = None
    thinning: Any = None  # a `Thinning`, in scenes with media
    proxies: Any = None  # `ProxyVertices`, for draws by approximation
    flags: dr.Local[mi.UInt32] | None = None


def allocate_light_path(kernel: Kernel, lanes: int) -> LightPath:
    """Local memory for stored vertices; without Bool (LLVM code generation aborts)."""
    size, several = kernel.store_size, kernel.plan.joined > 1
    return LightPath(
        si=dr.alloc_local(mi.SurfaceInteraction3f, size),
        throughput_over_cos=[dr.alloc_local(kind, size) for kind in polarization.stokes_types()],
        d_vcm=dr.alloc_local(mi.Float, size),
        d_vc=dr.alloc_local(type(kernel.heuristic.zero()), size),
        merges=[dr.alloc_local(mi.Float, size) for _ in range(2 if kernel.merges else 0)],
        rounding=dr.alloc_local(mi.Vector2f, size),
        s=dr.alloc_local(mi.UInt32, size),
        # As wide as the lanes: Dr.Jit treats an index of width 1 as equal in all lanes.
        count=dr.zeros(mi.UInt32, lanes),
        medium=dr.alloc_local(mi.UInt32, size) if kernel.has_media else None,
        light_group=dr.zeros(mi.UInt32, lanes) if kernel.light_groups is not None else None,
        light_groups=dr.alloc_local(mi.UInt32, size) if several and kernel.light_groups is not None else None,
        layers=dr.alloc_local(mi.UInt32, size) if kernel.path_layers else None,
        proxies=ProxyVertices.allocate(kernel, size) if several else None,
        flags=dr.alloc_local(mi.UInt32, size) if kernel.guides_near_specular else None,
    )


def _flags(sds: State) -> mi.UInt32:
    """The flags of a light vertex, as bits."""
    bits = enumerate((sds.isolated, sds.specular))
    return sum((dr.select(flag, mi.UInt32(1 << i), 0) for i, flag in bits), mi.UInt32(0))


def _of_flags(bits: mi.UInt32) -> State:
    """The inverse of `_flags`."""
    isolated, specular = ((bits & (1 << i)) != 0 for i in range(2))
    return State(isolated=isolated, specular=specular)


def store_light_vertex(kernel: Kernel, vertex: Vertex, path: LightPath):
    """Store a light vertex if inner connections can use it."""
    keep = vertex.hit & (vertex.edges <= kernel.last_stored) & vertex.connectible()
    y, slot = StoredVertex.of(vertex), path.count
    if path.thinning is not None:
        y, slot, keep = _thinned(path, y, keep)
    path.si.write(y.si, slot, keep)
    for local, entry in zip(
        path.throughput_over_cos, polarization.stokes(y.throughput_over_cos), strict=True
    ):
        local.write(entry, slot, keep)
    path.d_vcm.write(y.partial.d_vcm, slot, keep)
    path.d_vc.write(y.partial.d_vc, slot, keep)
    for local, entry in zip(path.merges, (y.partial.d_vm, y.partial.d_vm_newest), strict=False):
        local.write(entry, slot, keep)
    path.rounding.write(mi.Vector2f(y.anchor.offset, y.anchor.curvature), slot, keep)
    path.s.write(y.edges + 1, slot, keep)
    if path.medium is not None:
        path.medium.write(y.medium, slot, keep)
    if path.flags is not None:
        path.flags.write(_flags(y.sds), slot, keep)
    if path.light_groups is not None:
        path.light_groups.write(path.light_group, slot, keep)
    if path.layers is not None:
        path.layers.write(y.layer, slot, keep)
    if path.proxies is not None:
        newest = newest_coefficient(kernel, kernel.kappa.direct, vertex.edges)
        path.proxies.write(ProxyVertex.of(kernel, vertex, newest, keep, alone=True), slot, keep)
    path.count = path.count + dr.select(keep, mi.UInt32(1), mi.UInt32(0))


def _thinned(path: LightPath, y: StoredVertex, keep):
    """``y`` reweighted, its slot, and whether it is kept; counts it as tried."""
    thinning = path.thinning
    place, kept, probability = thinning.place(thinning.tried)
    path.thinning = replace(thinning, tried=thinning.tried + dr.select(keep, mi.UInt32(1), 0))
    return replace(y, throughput_over_cos=y.throughput_over_cos / probability), place, keep & kept


def read_light_vertex(
    kernel: Kernel, path: LightPath, slot: mi.UInt32, active: mi.Bool | bool = True
) -> StoredVertex:
    """Stored vertex ``slot``; zeros where not ``active``, since slots may be unset."""
    si = path.si.read(slot, active)
    rounding = path.rounding.read(slot, active)
    s = path.s.read(slot, active)
    curvature = rounding.y if kernel.shape_errors.any else mi.Float(0)
    groups = path.light_groups
    return StoredVertex(
        si=si,
        bsdf=si.bsdf(),
        anchor=rays.Anchor(si.p, si.n, rounding.x, curvature),
        throughput_over_cos=polarization.of_stokes(
            [local.read(slot, active) for local in path.throughput_over_cos]
        ),
        partial=mis.Partial(
            path.d_vcm.read(slot, active),
            path.d_vc.read(slot, active),
            *(local.read(slot, active) for local in path.merges),
        ),
        edges=s - 1,
        medium=None if path.medium is None else path.medium.read(slot, active),
        light_group=path.light_group if groups is None else groups.read(slot, active),
        layer=None if path.layers is None else path.layers.read(slot, active),
        sds=None if path.flags is None else _of_flags(path.flags.read(slot, active)),
    )
