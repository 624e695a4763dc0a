"""Transmittance between two points, through media and surfaces with null lobes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi

from ..geometry import rays
from ..geometry.rounding import met
from ..transport.contribution import Counters, one
from . import tracking
from .media import Media, depth_of

if TYPE_CHECKING:
    from ..sensors.records import SensorHit
    from ..transport.walk import Vertex, Walk
    from .space import Space

_ROUNDING = 1e-4  # relative rounding error of distances


@dataclass
class Crossing:
    """Unbiased ``transmittance`` of an edge (``Spectrum``), ``depth`` of its T~.

    ``clear``: no surface blocks it; `Counters` of its segments; ``medium``: index at its end, if surfaces
    were passed.
    """

    transmittance: mi.UnpolarizedSpectrum
    depth: mi.Float | mi.UnpolarizedSpectrum
    clear: mi.Bool
    counted: Counters
    medium: Any = None


def between(space: Space, ray, medium, active, own=None, word: mi.UInt32 | int = 0, hidden=False) -> Crossing:
    """Transmittance along ``ray``, from ``medium`` to its end; 0 where not ``active``.

    ``own``: see `rays.occluded`; random numbers of tracking follow ``word``; ``hidden``: emitters are passed.
    """
    media = space.media
    if not media.null_lobes and not hidden:
        visible = active & ~rays.occluded(space.scene, space.shape_errors, ray, active, own)
        transmittance, depth, _, collisions = _along(media, medium, ray, ray.maxt, word, visible)
        counted = Counters(segments=one(active), collisions=collisions)
        return Crossing(dr.select(visible, transmittance, 0), depth, visible, counted)
    return through_surfaces(space, ray, medium, active, own, word, hidden)


def up_to_sensor(space: Space, walk: Walk, y: Vertex, z: SensorHit, active):
    distance = dr.sqrt(z.dist2) - z.near
    length = distance - dr.norm(walk.o - walk.previous)
    ray = mi.Ray3f(walk.o, walk.d, dr.maximum(length, 0), y.si.time, y.si.wavelengths)
    edge = walk.edge
    if space.media.null_lobes:
        depth = through_surfaces(space, ray, edge.medium, active).depth
    else:
        depth = _along(space.media, edge.medium, ray, ray.maxt, mi.UInt32(0), active)[1]
    # Up to rounding: y may be on the sensor's own surface.
    before_end = ~y.hit | (distance <= dr.norm(y.si.p - walk.previous) * (1 + _ROUNDING))
    throughput, tr = edge.without_collision(walk.throughput, depth), edge.weight_transmittance(depth)
    return (length > 0) & before_end, throughput, tr


def _along(media: Media, medium, ray, length, word, active):
    """Segment: transmittance (``Spectrum``), depth of T~, next word, collisions."""
    sigma = media.extinction(medium, ray, active)
    depth = depth_of(sigma, length)
    transmittance, collisions = mi.UnpolarizedSpectrum(dr.exp(-depth)), None
    if media.grids:
        grid = active & (medium != 0) & ~media.is_homogeneous(medium)
        estimate, of_mean, word, collisions = tracking.ratio(media, medium, ray, length, word, grid)
        transmittance, depth = dr.select(grid, estimate, transmittance), dr.select(grid, of_mean, depth)
    return transmittance, depth, word, collisions


@dr.syntax
def through_surfaces(space: Space, ray, medium, active, own=None, word=0, hidden=False) -> Crossing:
    """Like `between`, surface by surface."""
    media, scene = space.media, space.scene
    o, left, medium = mi.Point3f(ray.o), mi.Float(ray.maxt), mi.UInt32(medium)
    transmittance, word, going = mi.UnpolarizedSpectrum(1), mi.UInt32(word), mi.Bool(active)
    clear = mi.Bool(active)
    depth = mi.Float(0) if media.gray else mi.UnpolarizedSpectrum(0)
    counted = Counters.zeros(*space.counters)
    while dr.hint(
        going, label="segments of a connection", exclude=[space, media, scene, ray, active, own, hidden]
    ):
        segment = mi.Ray3f(o, ray.d, left, ray.time, ray.wavelengths)
        si = scene.ray_intersect(segment, mi.RayFlags.All, coherent=False, active=going)
        hit = going & si.is_valid() & ~_is_end(si, own, ray.maxt - left + si.t)
        length = dr.select(hit, si.t, left)
        passed, of_segment, word, collisions = _along(media, medium, segment, length, word, going)
        counted = counted + Counters(segments=one(going), collisions=collisions)
        depth = dr.select(going, depth + of_segment, depth)
        solid = hit & (si.shape.emitter() == dr.zeros(mi.EmitterPtr)) if hidden else hit
        onward = dr.select(solid, space.null_transmission(si, hit), 1)
        clear &= ~going | ~dr.all(onward == 0)
        transmittance = dr.select(going, transmittance * passed * onward, transmittance)
        medium = media.beyond(si, ray.d, medium)
        onwards = rays.passed(segment, si, space.shape_errors)
        o, left = mi.Point3f(segment(onwards)), left - onwards
        going = hit & clear & (left > 0)
    return Crossing(dr.select(active, transmittance, 0), depth, clear, counted, medium)


def _is_end(si, own, t) -> mi.Bool:
    """Mask: the surface ``si`` at distance ``t`` from the ray's origin is its target."""
    if own is None:
        return mi.Bool(False)
    return (met(si.shape, si.instance) == own.number) & (t >= own.t)
