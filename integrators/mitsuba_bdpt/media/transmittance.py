"""Transmittance between two points, through media and surfaces with null lobes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi

from ..geometry import rays
from ..geometry.rounding import met
from ..host import renamed
from . import tracking
from .media import Media, depth_of

if TYPE_CHECKING:
    from .space import Space


@dataclass
class Crossing:
    """Unbiased ``transmittance`` of an edge (``Spectrum``), ``depth`` of its T~.

    ``clear``: no surface blocks it; ``segments``: their number; ``collisions``: tentative ones in grids (None
    without any); ``medium``: index at its end, if surfaces were passed.
    """

    transmittance: mi.UnpolarizedSpectrum
    depth: mi.Float | mi.UnpolarizedSpectrum
    clear: mi.Bool
    segments: mi.UInt32
    collisions: mi.UInt32 | None
    medium: Any = None


def between(
    space: Space,
    ray: mi.Ray3f,
    medium: mi.UInt32,
    active: mi.Bool,
    own,
    word: mi.UInt32,
    hidden: bool = False,
) -> Crossing:
    """Transmittance along ``ray``, from ``medium`` to its end; 0 where not ``active``.

    ``own``: see `rays.occluded`; random numbers of tracking follow ``word``; ``hidden``: emitters are passed.
    """
    media = space.media
    if not media.null_lobes and not hidden:
        visible = active & ~rays.occluded(space.scene, ray, active, own)
        transmittance, depth, _, collisions = _along(media, medium, ray, ray.maxt, word, visible)
        traced = dr.select(active, mi.UInt32(1), 0)
        return Crossing(dr.select(visible, transmittance, 0), depth, visible, traced, collisions)
    return through_surfaces(space, ray, medium, active, own, word, hidden)


def depth_along(space: Space, ray: mi.Ray3f, medium: mi.UInt32, active: mi.Bool):
    """Optical depth of T~ along ``ray``, from ``medium`` to its end or what blocks it.

    The end may lie on a surface, which rounding puts before or behind it.
    """
    if not space.media.null_lobes:
        return _along(space.media, medium, ray, ray.maxt, mi.UInt32(0), active)[1]
    return through_surfaces(space, ray, medium, active, None, mi.UInt32(0), False).depth


def _along(media: Media, medium, ray, length, word, active):
    """Segment: transmittance (``Spectrum``), depth of T~, next word, collisions."""
    sigma = media.extinction(medium, ray.d, ray, active)
    depth = depth_of(sigma, length)
    transmittance, collisions = mi.UnpolarizedSpectrum(dr.exp(-depth)), None
    if media.grids:
        grid = active & (medium != 0) & ~media.is_homogeneous(medium)
        estimate, of_mean, word, collisions = tracking.ratio(media, medium, ray, length, word, grid)
        transmittance, depth = dr.select(grid, estimate, transmittance), dr.select(grid, of_mean, depth)
    return transmittance, depth, word, collisions


@dr.syntax
def through_surfaces(space: Space, ray, medium, active, own, word, hidden) -> Crossing:
    """Like `between`, surface by surface."""
    media, scene = space.media, space.scene
    o, left, medium = mi.Point3f(ray.o), mi.Float(ray.maxt), mi.UInt32(medium)
    transmittance, word, going = mi.UnpolarizedSpectrum(1), mi.UInt32(word), mi.Bool(active)
    clear = mi.Bool(active)
    depth = mi.Float(0) if media.gray else mi.UnpolarizedSpectrum(0)
    segments, collisions = mi.UInt32(0), mi.UInt32(0) if media.grids else None
    while dr.hint(
        going, label="segments of a connection", exclude=[space, media, scene, ray, active, own, hidden]
    ):
        segment = mi.Ray3f(o, ray.d, left, ray.time, ray.wavelengths)
        si = scene.ray_intersect(segment, renamed.hit_flags(), coherent=False, active=going)
        hit = going & si.is_valid() & ~_is_end(si, own, ray.maxt - left + si.t)
        length = dr.select(hit, si.t, left)
        passed, of_segment, word, met_here = _along(media, medium, segment, length, word, going)
        segments += dr.select(going, mi.UInt32(1), 0)
        collisions = None if collisions is None or met_here is None else collisions + met_here
        depth = dr.select(going, depth + of_segment, depth)
        onward = dr.select(hit, _onward(space, si, hit, hidden), 1)
        clear &= ~going | ~dr.all(onward == 0)
        transmittance = dr.select(going, transmittance * passed * onward, transmittance)
        crossed = hit & si.is_medium_transition()
        medium = dr.select(crossed, media.number(si.target_medium(ray.d)), medium)
        onwards = dr.select(hit, rays.passed(segment, si, space.shape_errors), 0)
        o, left = mi.Point3f(segment(onwards)), left - onwards
        going = hit & clear & (left > 0)
    return Crossing(dr.select(active, transmittance, 0), depth, clear, segments, collisions, medium)


def _is_end(si, own, t) -> mi.Bool:
    """Mask: the surface ``si`` at distance ``t`` from the ray's origin is its target."""
    if own is None:
        return mi.Bool(False)
    return (met(si.shape, si.instance) == own.number) & (t >= own.t)


def _onward(space: Space, si, active, hidden: bool) -> mi.UnpolarizedSpectrum:
    """Transmission of the surface ``si`` straight through."""
    passed = space.null_transmission(si, active)
    if not hidden:
        return passed
    return dr.select(si.shape.emitter() != dr.zeros(mi.EmitterPtr), 1, passed)
