"""Free flight along an edge: through media and null surfaces to the next vertex."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..geometry import polarization, rays
from ..sampling.points import Purpose
from ..transport.vacuum import Arrival
from . import tracking
from .media import Media, coefficients, depth_of, interaction, of_depth

if TYPE_CHECKING:
    from ..sampling.points import Stream
    from ..transport.inputs import Kernel
    from ..transport.walk import Side, Vertex, Walk
    from .space import Space


@dataclass
class Edge:
    """State of a subpath along an edge in media; reset at vertices.

    ``medium``: number of the current one; ``maxt``: remaining length of the ray; ``depth``: optical depth of
    T~ so far; ``rest``: optical depth until the next collision (of a grid's majorant: tentative); ``event``:
    count of events, null ones included, which indexes random numbers; ``rays``: traced so far by the subpath;
    ``collisions``: tentative ones (None without grids). In chromatic media ``channel``: the one that flights
    are sampled in, and ``ratio`` (``Spectrum``): the densities over their mean over channels, of all flights
    of the subpath; else None. ``lit``: next-event estimation is allowed at the vertex before, None if
    everywhere.
    """

    medium: mi.UInt32
    maxt: mi.Float
    depth: mi.Float | mi.UnpolarizedSpectrum
    rest: mi.Float
    event: mi.UInt32
    rays: mi.UInt32
    collisions: mi.UInt32 | None = None
    channel: mi.UInt32 | None = None
    ratio: mi.UnpolarizedSpectrum | None = None
    lit: mi.Bool | None = None

    def weight_transmittance(self, further: mi.Float | mi.UnpolarizedSpectrum | int = 0):
        """T~ of the edge so far, and of a ``further`` optical depth."""
        return of_depth(self.depth if isinstance(further, int) else self.depth + further)

    def without_collision(self, throughput: mi.Spectrum, depth) -> mi.Spectrum:
        """Throughput after homogeneous ``depth`` without collision; see `_weighted`."""
        if self.ratio is None:
            return throughput
        transmittance = dr.exp(-depth)
        return polarization.scaled(throughput, transmittance / dr.mean(self.ratio * transmittance))


@dataclass
class Landing:
    """End of a segment of an edge.

    The hit ``pi`` of the ray from ``o``, or (``collided``) a collision at distance ``t``; ``edge`` and
    ``throughput`` at the end.
    """

    o: mi.Point3f
    pi: mi.PreliminaryIntersection3f
    t: mi.Float
    collided: mi.Bool
    edge: Edge
    throughput: mi.Spectrum


def choose_channel(u: mi.Float) -> mi.UInt32:
    count = len(mi.UnpolarizedSpectrum(0))
    return dr.minimum(mi.UInt32(u * count), count - 1)


def begin(space: Space, kernel: Kernel, side: str, stream: Stream, medium: mi.UInt32, ray: mi.Ray3f) -> Edge:
    """First edge of a subpath along ``ray`` from ``medium``; ``side`` and ``stream``: its random numbers."""
    media, points = space.media, kernel.points
    channel = ratio = None
    if not media.gray:
        channel = choose_channel(points.draw_1d(side, stream, Purpose.CHANNEL))
        ratio = mi.UnpolarizedSpectrum(1)
    return Edge(
        medium=mi.UInt32(medium),
        maxt=mi.Float(ray.maxt),
        depth=mi.Float(0) if media.gray else mi.UnpolarizedSpectrum(0),
        rest=tracking.exponential(points.draw_1d(side, stream, Purpose.FLIGHT, 1)),
        event=mi.UInt32(1),
        rays=mi.UInt32(1),
        collisions=mi.UInt32(0) if media.grids else None,
        channel=channel,
        ratio=ratio,
        lit=None if media.all_lit else mi.Bool(True),
    )


def arrive(space: Space, kernel: Kernel, side: Side, walk: Walk) -> Arrival:
    """Follow the edge of a ``walk`` to its end, a surface or a collision."""
    active = walk.active
    ray = mi.Ray3f(walk.o, walk.d, side.shared.time, side.shared.wavelengths)
    word = kernel.points.series(side.stream, Purpose.TRACKING, walk.event)
    hidden = None
    if kernel.plan.hide_emitters and not side.adjoint:
        hidden = walk.edges == 1
    landing = Landing(walk.o, walk.pi, mi.Float(0), mi.Bool(False), walk.edge, walk.throughput)
    if not space.media.see_through and hidden is None:  # no surface to pass
        landing = _segment(space.media, ray, landing, word, active)[1]
    else:
        landing = _through_surfaces(space, ray, landing, word, active, hidden)
    if space.clipped:
        landing = _swallowed(space.media, ray, landing, active)
    ray.o = landing.o
    si = kernel.hits.at(landing.pi, ray, active & ~landing.collided)
    point = dr.zeros(mi.SurfaceInteraction3f)
    point.p, point.t, point.time, point.wavelengths = ray(landing.t), landing.t, ray.time, ray.wavelengths
    point.sh_frame, point.wi = mi.Frame3f(-ray.d), mi.Vector3f(0, 0, 1)
    si, edge = dr.select(landing.collided, point, si), landing.edge
    edge = replace(edge, maxt=edge.maxt - landing.t)
    return Arrival(si, ray, landing.collided, landing.throughput, edge)


def depart(
    space: Space, kernel: Kernel, side: Side, vertex: Vertex, passes: mi.Bool, ray: mi.Ray3f
) -> tuple[Edge, mi.Ray3f]:
    """The edge along ``ray`` after an event, and its ray; the edge goes on where it ``passes``."""
    before, lit = vertex.edge, space.allows_next_event(vertex)
    u = kernel.points.draw_1d(side.name, side.stream, Purpose.FLIGHT, vertex.event + 1)
    edge = replace(
        before,
        medium=space.medium_towards(vertex, ray.d),
        maxt=dr.select(passes, before.maxt, dr.inf),
        depth=dr.select(passes, before.depth, 0),
        rest=dr.select(passes, before.rest, tracking.exponential(u)),
        event=before.event + 1,
        lit=None if lit is None else dr.select(passes, before.lit, lit),
        rays=before.rays + 1,
    )
    return edge, mi.Ray3f(ray.o, ray.d, edge.maxt, ray.time, ray.wavelengths)


def _swallowed(media: Media, ray, landing: Landing, active) -> Landing:
    """Return ``landing``, dark at the far plane in a homogeneous medium.

    The medium continues without end, and the environment is invisible through it, as in ``volpath``.
    """
    number = landing.edge.medium
    endless = active & ~landing.collided & ~landing.pi.is_valid() & media.is_homogeneous(number)
    dark = endless & (mi.UnpolarizedSpectrum(media.extinction(number, ray.d, ray, endless)) > 0)
    return replace(landing, throughput=polarization.darkened(landing.throughput, dark))


@dr.syntax
def _through_surfaces(space: Space, ray, landing: Landing, word, active, hidden) -> Landing:
    going = mi.Bool(active)
    while dr.hint(going, label="segments of an edge", exclude=[space, ray, hidden, active]):
        si, landing, word = _segment(space.media, ray, landing, word, going)
        going &= ~landing.collided & _passes(space.media, si, hidden)
        landing = _onwards(space, ray, si, landing, going)
    return landing


def _segment(media: Media, ray, landing: Landing, word, active):
    """Fly along one segment; returns its end surface, landing, next random word."""
    edge, pi = landing.edge, landing.pi
    segment = mi.Ray3f(landing.o, ray.d, edge.maxt, ray.time, ray.wavelengths)
    si = pi.compute_surface_interaction(segment, mi.RayFlags.Minimal, active)
    end = dr.minimum(dr.select(pi.is_valid(), pi.t, dr.inf), edge.maxt)
    t, depth, rest = _through_homogeneous(media, segment, edge, end, active)
    throughput = landing.throughput
    if media.grids:
        grid = active & (edge.medium != 0) & ~media.is_homogeneous(edge.medium)
        found = tracking.delta(media, edge.medium, segment, end, edge.rest, throughput, word, grid)
        t = dr.select(grid, found.t, t)
        depth, rest = dr.select(grid, found.depth, depth), dr.select(grid, found.rest, rest)
        throughput, word = found.throughput, found.word
        before = 0 if edge.collisions is None else edge.collisions
        edge = replace(edge, collisions=before + found.collisions)
    collided = active & (t < end)
    edge = replace(edge, depth=edge.depth + depth, rest=rest)
    throughput, edge = _weighted(media, segment, t, collided, throughput, edge, depth, active)
    return (
        si,
        replace(landing, t=dr.minimum(t, end), collided=collided, edge=edge, throughput=throughput),
        word,
    )


def _through_homogeneous(media: Media, ray, edge: Edge, end, active):
    """Distance of the collision (infinite if none), optical depths travelled and left."""
    sigma = media.extinction(edge.medium, ray.d, ray, active)
    own = sigma if media.gray else at(sigma, edge.channel)
    t = edge.rest / own
    collides = t < end  # NaN or infinite in vacuum
    travelled = dr.select(collides, t, end)
    depth = depth_of(sigma, travelled)
    rest = dr.select(own > 0, edge.rest - own * travelled, edge.rest)
    return dr.select(collides, t, dr.inf), depth, rest


def at(spectrum: mi.UnpolarizedSpectrum, channel: mi.UInt32):
    value = spectrum[0]
    for i in range(1, len(spectrum)):
        value = dr.select(channel == i, spectrum[i], value)
    return value


def _weighted(media: Media, ray, t, collided, throughput, edge: Edge, depth, active):
    """Throughput and edge after a segment with a collision at ``t``, or none.

    In gray media all but the albedo cancels. In chromatic media the densities of all channels count: the
    balance heuristic over the sampled channel (A. Wilkie et al. 2014).
    """
    if media.gray and not media.scatters:
        return dr.select(collided, 0, throughput), edge
    mei = interaction(ray(dr.select(collided, t, 0)), ray.d, ray)
    sigma_s, sigma_t = media.query(edge.medium, coefficients, mei, collided)
    albedo = sigma_s / dr.mean(sigma_t)
    if media.gray:
        return dr.select(collided, polarization.scaled(throughput, albedo), throughput), edge
    homogeneous = media.is_homogeneous(edge.medium) & active
    transmittance = dr.exp(-depth)
    densities = dr.select(collided, sigma_t, 1) * transmittance
    mean = dr.mean(edge.ratio * densities)
    estimate = dr.select(collided, sigma_s, 1) * transmittance / mean
    estimate = dr.select(homogeneous, estimate, dr.select(collided, albedo, 1))
    ratio = dr.select(homogeneous, edge.ratio * densities / mean, edge.ratio)
    return polarization.scaled(throughput, estimate), replace(edge, ratio=ratio)


def _passes(media: Media, si, hidden) -> mi.Bool:
    """Mask: an edge passes this surface without a vertex.

    It does at plugin ``null`` without emitter and sensor, and at emitters where ``hidden`` (a mask or None),
    as ``path`` does under ``hide_emitters``.
    """
    emits = si.shape.emitter() != dr.zeros(mi.EmitterPtr)
    passes = mi.Bool(False)
    if media.see_through:
        passes = si.is_valid() & media.is_null(si) & ~emits & ~si.is_sensor()
    if hidden is not None:
        passes |= si.is_valid() & emits & hidden
    return passes


def _onwards(space: Space, ray, si, landing: Landing, going) -> Landing:
    """Continue on the other side of the surface ``si`` where ``going``."""
    edge, media = landing.edge, space.media
    segment = mi.Ray3f(landing.o, ray.d, edge.maxt, ray.time, ray.wavelengths)
    onwards = rays.passed(segment, si, space.shape_errors)
    beyond = media.number(si.target_medium(ray.d))
    crossed = replace(
        edge,
        medium=dr.select(si.is_medium_transition(), beyond, edge.medium),
        maxt=edge.maxt - onwards,
        rays=edge.rays + 1,
    )
    o = mi.Point3f(segment(onwards))
    onward = mi.Ray3f(o, ray.d, crossed.maxt, ray.time, ray.wavelengths)
    pi = space.scene.ray_intersect_preliminary(onward, coherent=False, active=going)
    passed = replace(landing, o=o, pi=pi, edge=crossed)
    return dr.select(going, passed, landing)
