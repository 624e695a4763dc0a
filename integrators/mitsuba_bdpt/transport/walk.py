"""One random walk for both subpaths; which side it serves is data.

A walk knows no strategy: at each vertex it calls ``visit``, which may build paths from it.
Vertices are numbered as in the field: y_0 / z_0 is the endpoint, ``edges`` the index of the vertex.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..emitters.records import Direct
from ..geometry import polarization, rays
from ..host import renamed
from ..media import flight
from ..sampling.points import Purpose
from ..sensors.records import CameraJoin
from . import bsdf, mis, scattering, spectra
from .contribution import Counters
from .inputs import Kernel, Shared
from .mis import choose


@dataclass
class Walk:
    """State of a subpath between two vertices.

    ``pi`` the next hit, ``o`` and ``d`` of the ray that finds it; ``previous`` position of the last vertex
    (for a camera subpath the pinhole or lens point, not the near plane where the ray starts);
    ``throughput`` f cos / pdf, the edge to the next vertex included; ``partial`` partial sums in the
    measure before that edge; ``eta`` product of relative indices of refraction (1 where nothing
    refracts); ``edges`` number of edges up to the next vertex; ``seen``: an event other than null
    happened; ``broken``: it ended for want of a finite throughput or shading frame; ``edge`` what it carries
    along an edge in scenes with media, else None; ``isolated``: none of its edges is joined by a strategy in
    use, see `merging` (None where vertices are neither merged nor s = 0 guided). Where s = 0 is guided (see
    `guided_hits`), camera subpaths have in ``guided`` the other density of their last direction that was not
    delta over its own, and light subpaths in ``only_delta`` whether all their events were delta.

    What stays the same along a subpath is in `Side`: Dr.Jit records a loop twice whose state holds it.
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
    edge: Any = None  # a `flight.Edge`
    isolated: mi.Bool | None = None
    guided: mi.Float | None = None
    only_delta: mi.Bool | None = None

    @staticmethod
    def begin(kernel: Kernel, pi, ray, previous, throughput, partial, active, edge=None) -> Walk:
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
            isolated=None if mis.is_absent(partial.d_vm) else mi.Bool(True),
        )

    @property
    def event(self) -> mi.UInt32:
        """What names the random numbers of its next event: with media null events are counted too."""
        return self.edges if self.edge is None else self.edge.event

    def traced(self) -> mi.UInt32:
        """Closest-hit rays of a walk that has ended: its last step counts an edge but traces no ray."""
        return dr.maximum(self.edges if self.edge is None else self.edge.rays, 2) - 1

    def counted(self, active: mi.Bool) -> Counters:
        """What the edges of a walk that has ended count, in lanes that were ``active`` at its start."""
        if self.edge is None:
            return Counters()
        segments, collisions = dr.select(active, self.traced(), 0), self.edge.collisions
        return Counters(
            segments=segments, collisions=None if collisions is None else dr.select(active, collisions, 0)
        )


@dataclass
class Vertex:
    """A vertex that a walk has reached.

    ``partial`` is in the area measure (camera subpaths that left the scene: solid angle). ``cos`` absolute
    geometric cosine of the edge to it; ``anchor`` starts rays; ``hit`` is false in the surroundings;
    ``endpoint`` with which it is to be joined and ``f`` the BSDF towards it (a `bsdf.Evaluation`), where
    ``endpoint_active``, see `Side`; ``event`` names its random numbers. In scenes with media ``volume`` tells
    whether it lies in one, ``landing`` how its edge ended; else they are None.
    """

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    cos: mi.Float
    anchor: rays.Anchor
    throughput: mi.Spectrum
    partial: mis.Partial
    edges: mi.UInt32
    previous: mi.Point3f
    seen: mi.Bool
    hit: mi.Bool
    active: mi.Bool
    event: mi.UInt32
    volume: mi.Bool | None = None
    landing: Any = None  # a `flight.Landing`
    # Set where there is a `Side.join`, and nowhere else asked for: what it returns, and an `Evaluation`.
    endpoint: Any = None
    endpoint_active: Any = None
    f: Any = None
    # Set where s = 0 is guided: `Walk.guided` on arrival, and a `guided_hits.Advice`.
    guided: Any = None
    advice: Any = None

    @property
    def edge(self) -> Any:
        """The edge to it as it arrives, None in scenes without media."""
        return None if self.landing is None else self.landing.edge

    def cosine(self, d: mi.Vector3f) -> mi.Float:
        """Absolute geometric cosine of ``d``, 1 in volumes."""
        return volume_cosine(self.si, d, self.volume)

    def connectible(self):
        """Mask: its distribution of directions is not a delta distribution alone."""
        of_surface = bsdf.connectible(self.bsdf)
        return of_surface if self.volume is None else of_surface | self.volume

    @property
    def medium(self) -> Any:
        """The number of the medium in which it was reached."""
        return self.edge.medium

    def medium_towards(self, kernel: Kernel, d: mi.Vector3f) -> mi.UInt32 | None:
        """The number of the medium in which ``d`` leaves it; None in scenes without media."""
        if self.landing is None:
            return None
        beyond = kernel.space.media.number(self.si.target_medium(d))
        return dr.select(self.si.is_medium_transition(), beyond, self.edge.medium)


def volume_cosine(si, d: mi.Vector3f, volume: mi.Bool | None) -> mi.Float:
    """D of the geometry term: the absolute geometric cosine of ``d``, 1 where ``volume`` holds."""
    cos = dr.abs(dr.dot(si.n, d))
    return cos if volume is None else dr.select(volume, 1, cos)


@dataclass(frozen=True)
class Side:
    """What distinguishes the two kinds of subpath, and what stays the same along one.

    ``shared`` has its time and wavelengths, roulette compares the throughput with ``reference``.

    ``adjoint``: light travels with the walk. ``coefficient``: kappa of the class to which the newest
    alternative at vertex 1 belongs (next-event estimation on the light side, t = 1 on the camera side).
    ``complete``: called with the first vertex of a light subpath, returns the density of next-event
    estimation that completes ``d_vcm`` there. ``alpha``: the film asks whether an event other than null
    happened. ``parallel``: the first edge has one direction, its density is one across it. ``join``: called
    with each vertex, returns the endpoint of the other side with which it is to be joined (`emitters.Direct`,
    or what `Sensor.join` returns) and the `bsdf.Target` in which that lies; None where no strategy does so.
    ``isolated``, ``only_delta``: the subpath ends as soon as it is not, see `Walk`. ``guide``: called with
    each vertex, the walk before it and the step after it, returns its `guided_hits.Advice`.
    """

    name: str
    shared: Shared
    reference: mi.Float
    adjoint: bool
    last_edge: mi.UInt32
    coefficient: mi.Float | mi.Vector4f | int
    complete: Callable[[mi.SurfaceInteraction3f, mi.Bool], mi.Float] | None = None
    alpha: bool = False
    parallel: bool = False
    join: Callable[[Vertex], tuple[Direct | CameraJoin, bsdf.Target]] | None = None
    isolated: bool = False
    only_delta: bool = False
    guide: Callable[[Vertex, Walk, Any], Any] | None = None


def not_finite(active: mi.Bool, throughput: mi.Spectrum, *directions: mi.Vector3f) -> mi.Bool:
    """The walk's gate. Mask: active subpaths that end because ``throughput`` or a direction is not finite.

    Whatever finds a density from which no weight follows makes the throughput NaN (`bsdf._step`, `_vertex`).
    """
    finite = spectra.is_finite(throughput)
    for direction in directions:
        finite &= dr.isfinite(dr.sum(direction))
    return active & ~finite


@dr.syntax
def random_walk(kernel: Kernel, side: Side, walk: Walk, stream, visit, state):
    """Follow ``walk`` to its end; returns ``state`` and the walk as it ended.

    ``visit(vertex, state, walk)`` returns the new state; ``walk`` as it was before it arrived.
    """
    kernel.observer.started(kernel, side, walk, stream)
    while dr.hint(
        walk.active,
        # Dr.Jit's kernel cache does not tell sizes of local memory apart; the label does.
        label=f"{side.name} subpath, {kernel.store_size} stored",
        exclude=[kernel, side, stream, visit],  # what stays the same, see `Walk`
    ):
        vertex = _vertex(kernel, side, walk, stream)
        step = _interact(kernel, side, walk, vertex, stream)
        kernel.observer.vertex(side, walk, vertex, step)
        state = visit(vertex, state, walk)
        walk = _leave(kernel, side, walk, vertex, step, stream)
    return state, walk


def is_lit(kernel: Kernel, vertex):
    """Mask: next-event estimation is allowed at ``vertex``; None where it is everywhere."""
    if kernel.space is None or kernel.space.media.all_lit:
        return None
    return ~vertex.volume | kernel.space.media.is_lit(vertex.medium)


def where_lit(kernel: Kernel, direct: mis.Coefficient, lit) -> mis.Coefficient:
    """The coefficient ``direct`` of next-event estimation where it is allowed, see `is_lit`; else 0."""
    return direct if lit is None else choose(lit, direct, kernel.heuristic.zero())


def newest_coefficient(kernel: Kernel, first: mis.Coefficient, edges: mi.UInt32) -> mis.Coefficient:
    """kappa of the newest alternative's class at vertex ``edges``, for all s >= 1.

    s = 0 differs, see `techniques.hit_emitter`. ``first`` is that at vertex 1, see `Side`.
    """
    return choose(edges == 1, first, kernel.kappa.inner)


def _vertex(kernel: Kernel, side: Side, walk: Walk, stream) -> Vertex:
    """The vertex at the end of the walk's edge; densities go over to the area measure."""
    h = kernel.heuristic
    ray = mi.Ray3f(walk.o, walk.d, side.shared.time, side.shared.wavelengths)
    landing = tr = volume = None
    if kernel.space is None:
        si = walk.pi.compute_surface_interaction(ray, renamed.hit_flags(), walk.active)
        hit = walk.active & si.is_valid()
        throughput = walk.throughput
    else:
        landing = _landing(kernel, side, walk, ray, stream)
        ray.o, volume, throughput = landing.o, landing.collided, landing.throughput
        si = _landed(landing, ray, walk.active)
        hit = walk.active & (si.is_valid() | volume)
        tr = landing.edge.weight_transmittance()
    cos = volume_cosine(si, walk.d, volume)
    dist2 = dr.squared_norm(si.p - walk.previous)
    partial = walk.partial
    if side.complete is not None:
        first = hit & (walk.edges == 1)
        pdf_connect = dr.select(first, side.complete(si, first), 1)
        # No weight follows from such a density.
        throughput = dr.select(dr.isfinite(pdf_connect), throughput, dr.nan)
        partial = replace(partial, d_vcm=h.scale(partial.d_vcm, pdf_connect))
        dist2 = dr.select(walk.edges == 1, 1, dist2)  # the density contains it
    if side.parallel:
        dist2 = dr.select(walk.edges == 1, 1, dist2)
    # A hit at exactly zero cosine has probability zero; its densities would be infinite.
    hit &= cos > 0
    in_area = mis.to_area(h, partial, dist2, cos, tr)
    d_vcm = partial.d_vcm
    if tr is not None:  # the surroundings are a strategy's other end too
        d_vcm = h.scale(d_vcm, dr.rcp(tr))
    partial = mis.Partial(
        choose(hit, in_area.d_vcm, d_vcm),
        choose(hit, in_area.d_vc, partial.d_vc),
        choose(hit, in_area.d_vm, partial.d_vm),
    )
    return Vertex(
        si=si,
        bsdf=si.bsdf(),
        cos=cos,
        anchor=_anchor(kernel, si, ray, volume),
        throughput=throughput,
        partial=partial,
        edges=walk.edges,
        previous=walk.previous,
        seen=walk.seen,
        hit=hit,
        active=walk.active,
        event=walk.event,
        volume=volume,
        landing=landing,
        guided=walk.guided,
    )


def _anchor(kernel: Kernel, si, ray, volume: mi.Bool | None) -> rays.Anchor:
    anchor = rays.surface_anchor(si, ray, kernel.shape_errors)
    return anchor if volume is None else dr.select(volume, rays.free_anchor(si.p), anchor)


def _landing(kernel: Kernel, side: Side, walk: Walk, ray, stream) -> flight.Landing:
    """Where the walk's edge ends in a scene with media."""
    start = flight.Landing(walk.o, walk.pi, mi.Float(0), mi.Bool(False), walk.edge, walk.throughput)
    word = kernel.points.series(stream, Purpose.TRACKING, walk.event)
    hidden = None
    if kernel.plan.hide_emitters and not side.adjoint:
        hidden = walk.edges == 1
    return flight.advance(kernel.space, ray, start, word, walk.active, hidden)


def _landed(landing: flight.Landing, ray, active) -> mi.SurfaceInteraction3f:
    """The surface at the end of an edge, or a point in the medium as one without normal and shape."""
    si = landing.pi.compute_surface_interaction(ray, renamed.hit_flags(), active & ~landing.collided)
    point = dr.zeros(mi.SurfaceInteraction3f)
    point.p, point.t, point.time, point.wavelengths = ray(landing.t), landing.t, ray.time, ray.wavelengths
    point.sh_frame, point.wi = mi.Frame3f(-ray.d), mi.Vector3f(0, 0, 1)
    return dr.select(landing.collided, point, si)


def _interact(kernel: Kernel, side: Side, walk: Walk, vertex: Vertex, stream):
    """Sample the direction of the next edge, and put into ``vertex`` what joins it with an endpoint."""
    if not kernel.scatters:  # a virtual call needs somebody to call
        return None
    points = kernel.points
    target = None
    if side.join is not None:
        vertex.endpoint, target = side.join(vertex)
        vertex.endpoint_active = target.active
    u1 = points.draw_1d(side.name, stream, Purpose.LOBE, walk.event)
    u2 = points.draw_2d(side.name, stream, Purpose.BSDF, walk.event)
    sampled = _is_sampled(side, walk, vertex)
    step, vertex.f = scattering.sample(kernel, vertex, side.adjoint, u1, u2, sampled, target)
    if side.guide is not None:
        vertex.advice = side.guide(vertex, walk, step)
    return step


def _goes_on(side: Side, walk: Walk, vertex: Vertex):
    return vertex.hit & (walk.edges < side.last_edge)


def _is_sampled(side: Side, walk: Walk, vertex: Vertex):
    """`path` samples at the last vertex too: alpha is 1 unless that event is null.

    In scenes with media null events are no edges, so that subpaths go on after them. `volpath` has alpha 1
    where something in a medium may scatter again.
    """
    if vertex.volume is not None:
        return vertex.hit & (~vertex.volume | (walk.edges < side.last_edge))
    return vertex.hit if side.alpha else _goes_on(side, walk, vertex)


def _leave(kernel: Kernel, side: Side, walk: Walk, vertex: Vertex, step, stream) -> Walk:
    """Take the sampled ``step`` and trace the next edge."""
    if step is None:
        return replace(walk, edges=walk.edges + 1, active=mi.Bool(False))
    points, h, si = kernel.points, kernel.heuristic, vertex.si
    active = _goes_on(side, walk, vertex)
    passes = None
    if vertex.volume is not None:
        passes = step.null & _is_sampled(side, walk, vertex)
        active |= passes
    first = side.coefficient
    if side.adjoint:
        first = where_lit(kernel, first, is_lit(kernel, vertex))
    coefficient = newest_coefficient(kernel, first, walk.edges)
    isolated, only_delta = _isolated(walk, vertex, coefficient, step), None
    merge = _merge(kernel, walk, vertex, isolated)
    partial = mis.scatter(h, vertex.partial, coefficient, step, merge)

    throughput = polarization.extended(vertex.throughput, step.weight, side.adjoint)
    eta = walk.eta * step.eta if kernel.refracts else 1
    brightest = spectra.brightest(throughput)
    # To BSDFs a shading frame that is not finite (vertex normals) is a wrong side, which is black.
    broken = walk.broken | not_finite(active, throughput, si.wi)
    active &= (brightest > 0) & ~broken
    if side.isolated and isolated is not None:
        active &= isolated
    if side.only_delta:
        active &= step.delta
    if walk.only_delta is not None:
        only_delta = walk.only_delta & step.delta
    # Roulette as in `path`; the weights ignore it (it is not part of any density).
    survive = dr.minimum(brightest / side.reference * (1 if side.adjoint else eta * eta), 0.95)
    u = points.draw_1d(side.name, stream, Purpose.ROULETTE, walk.event)
    # In scenes with media as in `volpath`.
    playing = walk.edges >= kernel.rr_depth if passes is None else walk.edges > kernel.rr_depth
    throughput = dr.select(playing, throughput / survive, throughput)
    active &= ~playing | (u < survive)

    seen = walk.seen | (_is_sampled(side, walk, vertex) & ~step.null)
    ray = rays.spawn(vertex.anchor, si.to_world(step.wo), side.shared)
    after = Walk(
        pi=walk.pi,
        o=ray.o,
        d=ray.d,
        previous=si.p,
        throughput=throughput,
        partial=partial,
        eta=eta,
        edges=walk.edges,
        seen=seen,
        broken=broken,
        active=active,
        isolated=isolated,
        guided=_guided(h, walk, vertex, step),
        only_delta=only_delta,
    )
    if passes is not None:
        after, ray = _past_null(kernel, side, walk, vertex, after, passes, stream)
    return _traced(kernel, after, ray, passes)


def _merge(kernel: Kernel, walk: Walk, vertex: Vertex, isolated):
    """The `mis.Merge` at ``vertex``; ``isolated``: `Walk.isolated` after its event.

    Where s = 0 is guided, on light subpaths what stands for it: the density of the direction they came from.
    """
    if mis.is_absent(walk.partial.d_vm):
        return None
    if kernel.merging is not None:
        return mis.Merge(kernel.heuristic.start(kernel.merging.weighed(vertex.si.p)), isolated)
    return mis.Merge(kernel.heuristic.scale(vertex.partial.d_vc, vertex.advice.other), isolated)


def _isolated(walk: Walk, vertex: Vertex, coefficient: mis.Coefficient, step):
    """`Walk.isolated` after the event at ``vertex``; ``coefficient`` of what joins the edge to it."""
    if walk.isolated is None:
        return None
    return walk.isolated & (step.delta | ~mis.is_joined(vertex.partial, coefficient))


def _guided(h: mis.Heuristic, walk: Walk, vertex: Vertex, step):
    """`Walk.guided` after the event at ``vertex``: delta events are made alike whatever led to them."""
    if walk.guided is None or vertex.advice is None:  # guided subpaths follow delta events only
        return walk.guided
    other = dr.select(vertex.advice.other > 0, vertex.advice.other / step.pdf_fwd_w, 0)
    return dr.select(step.delta, walk.guided, h.start(other))


def is_sds_vertex(kernel: Kernel, first: mis.Coefficient, walk: Walk, vertex: Vertex) -> mi.Bool:
    """Mask: an SDS path may have its diffuse ``vertex`` here, if the other subpath ends likewise.

    No edge up to the vertex is connected by a strategy in use, its event is not delta, and the path may have
    a further edge. ``first`` as of `newest_coefficient`; ``walk`` as it was before it arrived.
    """
    joined = mis.is_joined(vertex.partial, newest_coefficient(kernel, first, vertex.edges))
    possible = vertex.hit & vertex.connectible() & ~joined & (vertex.edges < kernel.max_depth)
    return possible if walk.isolated is None else possible & walk.isolated


def _traced(kernel: Kernel, walk: Walk, ray, passes) -> Walk:
    """``walk`` on its next edge, along ``ray``; null events (``passes``, or None) are no edges."""
    return replace(
        walk,
        pi=kernel.scene.ray_intersect_preliminary(ray, coherent=False, active=walk.active),
        previous=mi.Point3f(walk.previous),
        edges=walk.edges + (1 if passes is None else dr.select(passes, mi.UInt32(0), 1)),
    )


def _past_null(kernel: Kernel, side: Side, walk: Walk, vertex: Vertex, after: Walk, passes, stream):
    """``after`` in a scene with media, and its ray: where it ``passes``, the edge goes on."""
    medium = vertex.medium_towards(kernel, after.d)
    u = kernel.points.draw_1d(side.name, stream, Purpose.FLIGHT, walk.event + 1)
    edge = vertex.edge.onwards(passes, vertex.landing.t, medium, is_lit(kernel, vertex), u)
    partial = mis.Partial(
        choose(passes, walk.partial.d_vcm, after.partial.d_vcm),
        choose(passes, walk.partial.d_vc, after.partial.d_vc),
    )
    previous = dr.select(passes, walk.previous, after.previous)
    shared = side.shared
    ray = mi.Ray3f(after.o, after.d, edge.maxt, shared.time, shared.wavelengths)
    return replace(after, previous=previous, partial=partial, edge=edge), ray
