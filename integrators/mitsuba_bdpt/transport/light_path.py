"""Stored vertices of a light subpath, for inner connections."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from ..geometry import polarization, rays
from . import mis
from .contribution import one
from .inputs import KEPT, TraceContext
from .proxy_vertices import Diffuse, Lobe, ProxyVertex
from .sds import State
from .walk import PathVertex, Vertex


@dataclass
class Thinning:
    """Stochastic thinning of the stored vertices of a long light subpath in media.

    Keeps the first `KEPT` / 2, and of later ones the i-th with probability (`KEPT` / 2)^2 / (i (i - 1)) by
    systematic sampling: if an integer lies in (C(i - 1) + u, C(i) + u], C(i) = `KEPT` - (`KEPT` / 2)^2 / i
    the sum of the first i probabilities. In integer units of 1 / `_UNIT`, so that they include rounding.

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
    """Vertices y_{s-1}, s >= 2, of a lane's light subpath in local memory.

    ``entries``: what does not follow from others, by name: of throughputs f cos / pdf over |n.wi|, the
    constant part of the adjoint factor |n.wo| / |n.wi|; of anchors offset and curvature (``rounding``); of
    ``sds`` bits; ``medium``: 0 on surfaces; with several light subpaths also proxies. ``count``: of stored
    vertices; ``light_group`` (see `Contribution`) of the newest subpath; ``thinning``: in scenes with media.
    """

    entries: dict[str, dr.Local]
    count: mi.UInt32
    light_group: mi.UInt32 | None = None
    thinning: Any = None  # a `Thinning`

    @property
    def guesses(self) -> bool:
        """Whether it has proxies, for draws by approximation."""
        return "proxy" in self.entries


def allocate_light_path(kernel: TraceContext, lanes: int) -> LightPath:
    """Local memory for stored vertices; without Bool (LLVM code generation aborts)."""
    several, groups = kernel.plan.joined > 1, kernel.light_groups is not None
    types = {
        "si": (mi.SurfaceInteraction3f, True),
        "d_vcm": (mi.Float, True),
        "d_vc": (type(kernel.heuristic.zero()), True),
        "d_vm": (mi.Float, kernel.sds.merges),
        "d_vm_newest": (mi.Float, kernel.sds.merges),
        "rounding": (mi.Vector2f, True),
        "edges": (mi.UInt32, True),
        "medium": (mi.UInt32, kernel.has_media),
        "light_group": (mi.UInt32, several and groups),
        "layer": (mi.UInt32, kernel.path_layers),
        "flags": (mi.UInt32, kernel.sds.near_specular),
        "proxy": (Diffuse, several),
        "lobe": (Lobe, several and kernel.traits.glossy),
        **{f"stokes_{i}": (kind, True) for i, kind in enumerate(polarization.stokes_types())},
    }
    size = kernel.store_size
    return LightPath(
        {name: dr.alloc_local(kind, size) for name, (kind, used) in types.items() if used},
        # As wide as the lanes: Dr.Jit treats an index of width 1 as equal in all lanes.
        count=dr.zeros(mi.UInt32, lanes),
        light_group=dr.zeros(mi.UInt32, lanes) if groups else None,
    )


def store_light_vertex(kernel: TraceContext, vertex: Vertex, path: LightPath):
    """Store a light vertex if inner connections can use it."""
    keep = vertex.hit & (vertex.edges + 2 <= kernel.reach) & vertex.connectible()
    throughput, slot = mi.Spectrum(vertex.throughput / vertex.cos), path.count
    if (thinning := path.thinning) is not None:
        slot, kept, probability = thinning.place(thinning.tried)
        path.thinning = replace(thinning, tried=thinning.tried + dr.select(keep, mi.UInt32(1), 0))
        throughput, keep = throughput / probability, keep & kept
    entries = {
        "si": vertex.si,
        **vars(vertex.partial),
        "rounding": mi.Vector2f(vertex.anchor.offset, vertex.anchor.curvature),
        "edges": vertex.edges,
        "light_group": path.light_group,
        "layer": vertex.layer,
        **{f"stokes_{i}": value for i, value in enumerate(polarization.stokes(throughput))},
    }
    if kernel.has_media:
        entries["medium"] = dr.select(vertex.volume, vertex.medium, 0)
    if kernel.sds.near_specular:
        entries["flags"] = one(vertex.sds.isolated) + 2 * one(vertex.sds.specular)
    if path.guesses:
        proxy = ProxyVertex.of(kernel, vertex, keep, adjoint=True)
        entries |= {"proxy": proxy.diffuse, "lobe": proxy.lobe}
    for name, local in path.entries.items():
        local.write(entries[name], slot, keep)
    path.count = path.count + dr.select(keep, mi.UInt32(1), mi.UInt32(0))


def read_light_vertex(
    kernel: TraceContext, path: LightPath, slot: mi.UInt32, active: mi.Bool | bool = True
) -> PathVertex:
    """Stored vertex ``slot``; zeros where not ``active``, since slots may be unset."""
    e = {name: local.read(slot, active) for name, local in path.entries.items()}
    si, rounding, medium, flags = e["si"], e["rounding"], e.get("medium"), e.get("flags")
    curvature = rounding.y if kernel.shape_errors.any else mi.Float(0)
    return PathVertex(
        si=si,
        bsdf=si.bsdf(),
        cos=mi.Float(1),
        anchor=rays.Anchor(si.p, si.n, rounding.x, curvature),
        throughput=polarization.of_stokes([e[name] for name in e if name.startswith("stokes")]),
        partial=mis.Partial(**{name: e[name] for name in e if name.startswith("d_")}),
        edges=e["edges"],
        volume=mi.Bool(False) if medium is None else medium != 0,
        medium=medium,
        light_group=e.get("light_group", path.light_group),
        layer=e.get("layer"),
        sds=flags if flags is None else State(isolated=(flags & 1) != 0, specular=(flags & 2) != 0),
    )


def read_proxy(path: LightPath, slot: mi.UInt32) -> tuple[ProxyVertex, mi.UInt32]:
    """Proxy of the stored vertex ``slot``, and the number of edges up to it."""
    at = path.entries
    lobe = at["lobe"][slot] if "lobe" in at else None
    return ProxyVertex(at["si"][slot].p, at["proxy"][slot], lobe), at["edges"][slot]
