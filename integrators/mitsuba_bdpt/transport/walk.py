"""One random walk for both subpaths; their differences are data (`Side`).

A walk has no strategies: at each vertex it calls ``visit``, which may connect it. y_0 / z_0 is the endpoint,
``edges`` the index of a vertex.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..emitters.records import Direct
from ..geometry import polarization, rays
from ..sampling.points import Purpose, Stream
from ..sensors.records import CameraConnection
from . import bsdf, mis, path_layers, scattering, spectra
from .alternatives import newest_coefficient
from .contribution import Counters, one
from .inputs import Shared, TraceContext
from .near_specular import is_narrow
from .sds import PhotonStrategy, State, is_diffuse


@dataclass
class Walk:
    """State of a subpath between two vertices.

    * ``pi``: the next hit; ``o``, ``d`` of its ray; ``previous``: position of the last vertex (of a camera
      subpath the lens point or pinhole, not the near plane); ``edges`` up to the next vertex.
    * ``throughput`` f cos / pdf, including the edge to the next vertex; ``partial``: partial sums before that
      edge; ``eta``: product of relative indices of refraction (1 if nothing refracts).
    * ``seen``: a non-null event happened; ``broken``: ended by a non-finite throughput or shading frame;
      ``edge``: its state along an edge, None without media.
    * ``sds``: None where the strategy for SDS paths needs none; ``layer``: see `path_layers`, None without.

    Constants along a subpath are in `Side`: Dr.Jit records a loop twice if its state contains them.
    """

    pi: mi.PreliminaryIntersection3f
    o: mi.Point3f
    d: mi.Vector3f
    previous: mi.Point3f
    throughput: mi.Spectrum
    partial: mis.Partial
    eta: mi.Float | int
    edges: mi.UInt32
    seen: mi.Bool
    broken: mi.Bool
    active: mi.Bool
    edge: Any = None  # a `media.flight.Edge`
    sds: State | None = None
    layer: mi.UInt32 | None = None

    @staticmethod
    def begin(kernel: TraceContext, pi, ray, previous, throughput, partial, active, edge=None) -> Walk:
        """A subpath on its first edge."""
        return Walk(
            pi=pi,
            o=mi.Point3f(ray.o),
            d=mi.Vector3f(ray.d),
            previous=mi.Point3f(previous),
            throughput=throughput,
            partial=partial,
            eta=mi.Float(1) if kernel.refracts else 1,
            edges=mi.UInt32(1),
            seen=mi.Bool(False),
            broken=mi.Bool(False),
            active=active,
            edge=edge,
            # As wide as the lanes: Dr.Jit treats an index of local memory of width 1 as equal in all lanes.
            layer=dr.full(mi.UInt32, path_layers.EMISSION, dr.width(pi)) if kernel.path_layers else None,
        )

    @property
    def event(self) -> mi.UInt32:
        """Index of the random numbers of its next event; with media includes null events."""
        return self.edges if self.edge is None else self.edge.event

    def traced(self) -> mi.UInt32:
        """Closest-hit rays of an ended walk, whose last step traces no ray."""
        return dr.maximum(self.edges if self.edge is None else self.edge.rays, 2) - 1

    def counted(self, name: str, active: mi.Bool) -> Counters:
        """Counters of an ended walk, in lanes ``active`` at its start; ``name``: of its closest-hit rays."""
        rays = dr.select(active, self.traced(), 0)
        counters = Counters(**{name: rays}, non_finite=one(self.broken))
        if self.edge is None:
            return counters
        collisions = self.edge.collisions
        collisions = None if collisions is None else dr.select(active, collisions, 0)
        return counters + Counters(segments=rays, collisions=collisions)


@dataclass(kw_only=True)
class PathVertex:
    """A vertex that an inner connection may use, reached by a walk or stored.

    ``cos``: absolute geometric cosine of the edge to it (1 in a ``volume``); ``anchor``: starts rays;
    ``partial``: in the area measure (camera subpaths that left the scene: solid angle); ``medium``: index of
    that of the edge, None without media; ``light_group``: see `Contribution`; ``layer`` and ``sds``: those of
    `Walk` on arrival.
    """

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    cos: mi.Float
    anchor: rays.Anchor
    throughput: mi.Spectrum
    partial: mis.Partial
    edges: mi.UInt32
    volume: mi.Bool
    medium: mi.UInt32 | None = None
    light_group: mi.UInt32 | None = None
    layer: mi.UInt32 | None = None
    sds: Any = None  # an `sds.State`

    def cosine(self, d: mi.Vector3f) -> mi.Float:
        """Absolute geometric cosine of ``d``, 1 in volumes."""
        return volume_cosine(self.si, d, self.volume)

    def connectible(self):
        """Mask: its distribution of directions is not purely delta."""
        return bsdf.connectible(self.bsdf) | self.volume


@dataclass(kw_only=True)
class Vertex(PathVertex):
    """A vertex that a walk has reached.

    ``hit``: false in the environment; ``endpoint`` of its connection and the BSDF ``f`` towards it (a
    `bsdf.Evaluation`), where ``endpoint_active``, see `Side`; ``event``: index of its random numbers;
    ``edge``: see `Vacuum.arrive`.
    """

    previous: mi.Point3f
    seen: mi.Bool
    hit: mi.Bool
    active: mi.Bool
    event: mi.UInt32
    edge: Any = None
    # Set with a `Side.connect`.
    endpoint: Any = None  # a `Direct`, or a `CameraConnection`
    endpoint_active: Any = None
    f: Any = None  # a `bsdf.Evaluation`
    advice: Any = None  # an `sds.Advice`, with guiding


def volume_cosine(si, d: mi.Vector3f, volume: mi.Bool) -> mi.Float:
    """Factor D of the geometry term: absolute geometric cosine, 1 in a ``volume``."""
    return dr.select(volume, 1, dr.abs(dr.dot(si.n, d)))


@dataclass(frozen=True)
class Side:
    """Constants of a subpath, which distinguish the two kinds.

    ``stream`` of its random numbers; ``shared``: time and wavelengths; ``adjoint``: light travels with the
    walk; ``last_edge``: most edges; ``sds``: hooks; ``alpha``: the film stores whether a non-null event
    happened; ``isolated``: the subpath ends once an edge is connectible, see `sds.State`; ``only_specular``:
    it ends at an event that is not delta and has a density below this from one side (1 / sr; 0: at none,
    infinity: at each). Functions:

    * ``complete``, of the first vertex of a light subpath: density of next-event estimation in ``d_vcm``.
    * ``connect``, of each vertex: the endpoint to connect it with (`emitters.Direct`, or the result of
      `Sensor.connect`) and its `bsdf.Target`; None if no strategy does so.
    """

    name: str
    stream: Stream
    shared: Shared
    adjoint: bool
    last_edge: mi.UInt32
    sds: PhotonStrategy
    complete: Callable[[mi.SurfaceInteraction3f, mi.Bool], mi.Float] | None = None
    alpha: bool = False
    connect: Callable[[Vertex], tuple[Direct | CameraConnection, bsdf.Target]] | None = None
    isolated: bool = False
    only_specular: float = 0.0


def not_finite(active: mi.Bool, throughput: mi.Spectrum, *directions: mi.Vector3f) -> mi.Bool:
    """Mask: active subpaths that end with a non-finite ``throughput`` or direction."""
    finite = spectra.is_finite(throughput)
    for direction in directions:
        finite &= dr.isfinite(dr.sum(direction))
    return active & ~finite


@dr.syntax
def random_walk(kernel: TraceContext, side: Side, walk: Walk, visit, state):
    """Follow ``walk`` to its end; returns ``state`` and the ended walk.

    ``visit(vertex, state, walk)`` returns the new state; ``walk`` as before its arrival.
    """
    kernel.observer.started(kernel, side, walk)
    first = spectra.brightest(walk.throughput)
    while dr.hint(
        walk.active,
        # Dr.Jit's kernel cache does not distinguish sizes of local memory; the label does.
        label=f"{side.name} subpath, {kernel.store_size} stored",
        exclude=[kernel, side, visit, first],  # constants, see `Walk`
    ):
        vertex = _vertex(kernel, side, walk)
        step = _interact(kernel, side, walk, vertex)
        kernel.observer.vertex(side, walk, vertex, step)
        state = visit(vertex, state, walk)
        walk = _scatter(kernel, side, walk, vertex, step, first)
    return state, walk


def _vertex(kernel: TraceContext, side: Side, walk: Walk) -> Vertex:
    """The vertex at the end of the edge; converts densities to the area measure."""
    h = kernel.heuristic
    si, ray, volume, throughput, edge = kernel.space.arrive(kernel, side, walk)
    hit = walk.active & (si.is_valid() | volume)
    tr = None if edge is None else edge.weight_transmittance()
    cos = volume_cosine(si, walk.d, volume)
    dist2 = dr.squared_norm(si.p - walk.previous)
    partial = walk.partial
    if side.complete is not None:
        first = hit & (walk.edges == 1)
        pdf_connect = dr.select(first, side.complete(si, first), 1)
        # No weight follows from a non-finite density.
        throughput = dr.select(dr.isfinite(pdf_connect), throughput, dr.nan)
        partial = replace(partial, d_vcm=h.scale(partial.d_vcm, pdf_connect))
        dist2 = dr.select(walk.edges == 1, 1, dist2)  # the density contains it
    elif kernel.camera.parallel:
        dist2 = dr.select(walk.edges == 1, 1, dist2)
    # A hit at exactly zero cosine has probability zero; its densities would be infinite.
    hit &= cos > 0
    in_area = mis.to_area(h, partial, dist2, cos, tr)
    if tr is not None:  # the environment is also the other end of a strategy
        partial = replace(partial, d_vcm=h.scale(partial.d_vcm, dr.rcp(tr)))
    on_surface = rays.surface_anchor(si, ray, kernel.shape_errors)
    return Vertex(
        si=si,
        bsdf=si.bsdf(),
        cos=cos,
        anchor=dr.select(volume, rays.free_anchor(si.p), on_surface),
        throughput=throughput,
        partial=mis.choose(hit, in_area, partial),
        edges=walk.edges,
        previous=walk.previous,
        seen=walk.seen,
        hit=hit,
        active=walk.active,
        event=walk.event,
        volume=volume,
        edge=edge,
        medium=None if edge is None else edge.medium,
        layer=walk.layer,
        sds=walk.sds,
    )


def _interact(kernel: TraceContext, side: Side, walk: Walk, vertex: Vertex):
    """Sample the next direction, and connect ``vertex`` with an endpoint."""
    if not kernel.surfaces and kernel.space.phase is None:  # a virtual call needs a target
        return None
    points = kernel.points
    target = None
    if side.connect is not None:
        vertex.endpoint, target = side.connect(vertex)
        vertex.endpoint_active = target.active
    u1 = points.draw_1d(side.name, side.stream, Purpose.LOBE, walk.event)
    u2 = points.draw_2d(side.name, side.stream, Purpose.BSDF, walk.event)
    sampled = _is_sampled(kernel, side, vertex)
    step, vertex.f = scattering.sample(kernel, vertex, side.adjoint, u1, u2, sampled, target)
    vertex.advice = side.sds.advise(kernel, side.adjoint, vertex, walk, step)
    return step


def _is_sampled(kernel: TraceContext, side: Side, vertex: Vertex):
    """Mask: a direction is sampled at ``vertex``; at the last one as in `path` and `volpath`, for alpha."""
    # With media null events are no edges, so that subpaths go on after them.
    at_last = ~vertex.volume if side.alpha or kernel.has_media else mi.Bool(False)
    return vertex.hit & (at_last | (vertex.edges < side.last_edge))


def _scatter(kernel: TraceContext, side: Side, walk: Walk, vertex: Vertex, step, first: mi.Float) -> Walk:
    """Take the ``step``, play roulette and trace the next edge; ``first``: size of the first throughput."""
    if step is None:
        return replace(walk, edges=walk.edges + 1, active=mi.Bool(False))
    h, si = kernel.heuristic, vertex.si
    sampled = _is_sampled(kernel, side, vertex)
    # Null events are no edges, with media.
    passes = step.null & sampled if kernel.has_media else mi.Bool(False)
    active = vertex.hit & (walk.edges < side.last_edge) | passes
    coefficient = newest_coefficient(kernel, vertex, side.adjoint)
    partial = mis.scatter(h, vertex.partial, coefficient, step)
    sds, partial.d_vm, partial.d_vm_newest = _sds(kernel, side, vertex, coefficient, step)
    partial = mis.choose(passes, walk.partial, partial)

    throughput = polarization.extended(vertex.throughput, step.weight, side.adjoint)
    eta = walk.eta * step.eta if kernel.refracts else 1
    brightest = spectra.brightest(throughput)
    # BSDFs take a non-finite shading frame (vertex normals) for a wrong side, which is black.
    broken = walk.broken | not_finite(active, throughput, si.wi)
    active &= (brightest > 0) & ~broken
    useful = None
    if sds is not None and sds.survived is not None:
        useful, sds = side.sds.survival(sds, partial, vertex)
    elif side.isolated and sds is not None:
        active &= sds.isolated
    if side.only_specular:
        active &= is_narrow(step, side.only_specular) | step.delta
    survive = dr.minimum(brightest / first * (1 if side.adjoint else eta * eta), 0.95)
    throughput, goes_on = _roulette(kernel, side, walk, throughput, survive, useful)
    active &= goes_on

    ray = rays.spawn(vertex.anchor, si.to_world(step.wo), side.shared)
    edge, ray = kernel.space.depart(kernel, side, vertex, passes, ray)
    return Walk(
        pi=kernel.scene.ray_intersect_preliminary(ray, coherent=False, active=active),
        o=ray.o,
        d=ray.d,
        previous=dr.select(passes, walk.previous, mi.Point3f(si.p)),
        throughput=throughput,
        partial=partial,
        eta=eta,
        edges=walk.edges + dr.select(passes, mi.UInt32(0), 1),
        seen=walk.seen | (sampled & ~step.null),
        broken=broken,
        active=active,
        edge=edge,
        sds=sds,
        layer=path_layers.sampled(walk.layer, step, side.adjoint),
    )


def _roulette(kernel: TraceContext, side: Side, walk: Walk, throughput, survive: mi.Float, useful):
    """Russian roulette of a subpath: its throughput, and whether it goes on.

    With probability ``survive``, from ``rr_depth`` on as in `path`, with media as in `volpath`; ``useful``:
    times `PhotonStrategy.survival`, or None. Weights ignore it.
    """
    u = kernel.points.draw_1d(side.name, side.stream, Purpose.ROULETTE, walk.event)
    playing = walk.edges > kernel.rr_depth if kernel.has_media else walk.edges >= kernel.rr_depth
    if useful is not None:
        survive, playing = useful * dr.select(playing, survive, 1), mi.Bool(True)
    return dr.select(playing, throughput / survive, throughput), ~playing | (u < survive)


def _sds(kernel: TraceContext, side: Side, vertex: Vertex, coefficient: mis.Coefficient, step):
    """`Walk.sds`, and the partial sums ``d_vm`` and ``d_vm_newest``, after the event at ``vertex``.

    ``coefficient``: that of the class that connects the edge to it.
    """
    state, h = vertex.sds, kernel.heuristic
    if side.sds.merges:
        kappa_prime = newest_coefficient(kernel, vertex, side.adjoint, prime=True)
        kappa_eta = side.sds.kappa_eta(vertex)
        d_vm, newest = mis.scattered_merges(h, vertex.partial, step, kappa_eta, kappa_prime)
        diffuse = is_diffuse(kernel, step) & ~step.delta
        if side.adjoint:
            d_vm = dr.select(diffuse, 0, d_vm)
        else:
            state = replace(state, behind_diffuse=state.behind_diffuse | diffuse)
        return state, d_vm, newest
    if state is None:
        return None, 0, 0
    state = state.after(h, vertex, coefficient, step)
    if mis.is_absent(vertex.partial.d_vm):
        return state, 0, 0
    guided = h.scale(vertex.partial.d_vc, vertex.advice.other)
    return state, mis.scattered_guided(h, vertex.partial, step, guided, state.isolated), 0
