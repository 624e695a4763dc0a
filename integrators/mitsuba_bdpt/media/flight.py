"""Free flight along an edge: through media and null surfaces to the next vertex."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..geometry import polarization, rays
from ..sampling.points import Purpose
from . import tracking
from .media import OTHER_LOBES, Media, coefficients, depth_of, interaction, of_depth

if TYPE_CHECKING:
    from ..sampling.points import Stream
    from ..transport.inputs import TraceContext
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
        return of_depth(self.depth + further)

    def without_collision(self, throughput: mi.Spectrum, depth) -> mi.Spectrum:
        """Throughput after homogeneous ``depth`` without collision."""
        return throughput if self.ratio is None else polarization.scaled(throughput, self.flown(depth)[0])

    def flown(self, depth, sigma_s=1, sigma_t=1) -> tuple[mi.UnpolarizedSpectrum, mi.UnpolarizedSpectrum]:
        """Estimate f / p after homogeneous ``depth`` in a chromatic medium, and `ratio`.

        The coefficients are those of a collision there, if any. The densities of all channels count: the
        balance heuristic over the sampled channel (A. Wilkie et al. 2014).
        """
        transmittance = dr.exp(-depth)
        densities = self.ratio * (sigma_t * transmittance)
        mean = dr.mean(densities)
        return sigma_s * transmittance / mean, densities / mean


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


def begin(space: Space, kernel: TraceContext, side: str, stream: Stream, ray, emission=None) -> Edge:
    media, points = space.media, kernel.points
    medium = kernel.sensor_medium if emission is None else kernel.light_media.at(emission)
    channel = ratio = None
    if not media.gray:
        ratio = mi.UnpolarizedSpectrum(1)
        u = points.draw_1d(side, stream, Purpose.CHANNEL)
        channel = dr.minimum(mi.UInt32(u * len(ratio)), len(ratio) - 1)
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


def arrive(space: Space, kernel: TraceContext, side: Side, walk: Walk) -> tuple:
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
    return si, ray, landing.collided, landing.throughput, edge


def depart(
    space: Space, kernel: TraceContext, side: Side, vertex: Vertex, passes: mi.Bool, ray: mi.Ray3f
) -> tuple[Edge, mi.Ray3f]:
    """The edge along ``ray`` after an event, and its ray; the edge goes on where it ``passes``."""
    before = vertex.edge
    u = kernel.points.draw_1d(side.name, side.stream, Purpose.FLIGHT, vertex.event + 1)
    edge = replace(
        before,
        medium=space.media.beyond(vertex.si, ray.d, vertex.medium),
        maxt=dr.select(passes, before.maxt, dr.inf),
        depth=dr.select(passes, before.depth, 0),
        rest=dr.select(passes, before.rest, tracking.exponential(u)),
        event=before.event + 1,
        lit=None if before.lit is None else dr.select(passes, before.lit, space.allows_next_event(vertex)),
        rays=before.rays + 1,
    )
    return edge, mi.Ray3f(ray.o, ray.d, edge.maxt, ray.time, ray.wavelengths)


def _swallowed(media: Media, ray, landing: Landing, active) -> Landing:
    """Return ``landing``, dark at the far plane in a homogeneous medium.

    The medium continues without end, and the environment is invisible through it, as in ``volpath``.
    """
    number = landing.edge.medium
    endless = active & ~landing.collided & ~landing.pi.is_valid() & media.is_homogeneous(number)
    dark = endless & (mi.UnpolarizedSpectrum(media.extinction(number, ray, endless)) > 0)
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
        *found, throughput, word, collisions = tracking.delta(
            media, edge.medium, segment, end, edge.rest, throughput, word, grid
        )
        t, depth, rest = (dr.select(grid, a, b) for a, b in zip(found, (t, depth, rest), strict=True))
        edge = replace(edge, collisions=collisions + edge.collisions)
    collided = active & (t < end)
    edge = replace(edge, depth=edge.depth + depth, rest=rest)
    throughput, edge = _weighted(media, segment, t, collided, throughput, edge, depth, active)
    t = dr.minimum(t, end)
    return si, replace(landing, t=t, collided=collided, edge=edge, throughput=throughput), word


def _through_homogeneous(media: Media, ray, edge: Edge, end, active):
    """Distance of the collision (infinite if none), optical depths travelled and left."""
    sigma = media.extinction(edge.medium, ray, active)
    own = sigma if media.gray else sum(dr.select(edge.channel == i, s, 0) for i, s in enumerate(sigma))
    t = edge.rest / own
    collides = t < end  # NaN or infinite in vacuum
    travelled = dr.select(collides, t, end)
    depth = depth_of(sigma, travelled)
    rest = dr.select(own > 0, edge.rest - own * travelled, edge.rest)
    return dr.select(collides, t, dr.inf), depth, rest


def _weighted(media: Media, ray, t, collided, throughput, edge: Edge, depth, active):
    """Throughput and edge after a segment with a collision at ``t``, or none.

    In gray media, and grids, all but the albedo cancels.
    """
    if media.gray and not media.scatters:
        return dr.select(collided, 0, throughput), edge
    mei = interaction(ray(dr.select(collided, t, 0)), ray.d, ray)
    sigma_s, sigma_t = media.query(edge.medium, coefficients, mei, collided)
    albedo = sigma_s / dr.mean(sigma_t)
    if media.gray:
        return dr.select(collided, polarization.scaled(throughput, albedo), throughput), edge
    homogeneous = media.is_homogeneous(edge.medium) & active
    estimate, ratio = edge.flown(depth, dr.select(collided, sigma_s, 1), dr.select(collided, sigma_t, 1))
    estimate = dr.select(homogeneous, estimate, dr.select(collided, albedo, 1))
    ratio = dr.select(homogeneous, ratio, edge.ratio)
    return polarization.scaled(throughput, estimate), replace(edge, ratio=ratio)


def _passes(media: Media, si, hidden) -> mi.Bool:
    """Mask: an edge passes this surface without a vertex.

    It does at plugin ``null`` without emitter and sensor, and at emitters where ``hidden`` (a mask or None),
    as ``path`` does under ``hide_emitters``.
    """
    emits = si.shape.emitter() != dr.zeros(mi.EmitterPtr)
    passes = mi.Bool(False)
    if media.see_through:
        null = (si.bsdf().flags() & mi.UInt32(OTHER_LOBES | int(mi.BSDFFlags.Null))) == int(mi.BSDFFlags.Null)
        passes = si.is_valid() & null & ~emits & ~si.is_sensor()
    if hidden is not None:
        passes |= si.is_valid() & emits & hidden
    return passes


def _onwards(space: Space, ray, si, landing: Landing, going) -> Landing:
    """Continue on the other side of the surface ``si`` where ``going``."""
    edge = landing.edge
    segment = mi.Ray3f(landing.o, ray.d, edge.maxt, ray.time, ray.wavelengths)
    onwards = rays.passed(segment, si, space.shape_errors)
    onward = mi.Ray3f(segment(onwards), ray.d, edge.maxt - onwards, ray.time, ray.wavelengths)
    pi = space.scene.ray_intersect_preliminary(onward, coherent=False, active=going)
    beyond = space.media.beyond(si, ray.d, edge.medium)
    edge = replace(edge, medium=beyond, maxt=mi.Float(onward.maxt), rays=edge.rays + 1)
    return dr.select(going, replace(landing, o=mi.Point3f(onward.o), pi=pi, edge=edge), landing)
