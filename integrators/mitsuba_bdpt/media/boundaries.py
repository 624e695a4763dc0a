"""Finds the medium along a ray from the boundaries that it meets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..geometry import rays
from ..host import renamed

if TYPE_CHECKING:
    from .space import Space


@dr.syntax
def behind(space: Space, ray: mi.Ray3f, medium: mi.UInt32) -> tuple[mi.UInt32, mi.Bool]:
    """Trace ``ray`` from ``medium`` through transmitting surfaces.

    Returns the number of the medium at its end, and whether it arrives there.
    """
    o, left = mi.Point3f(ray.o), mi.Float(ray.maxt)
    number = mi.UInt32(medium) + dr.zeros(mi.UInt32, dr.width(ray.o))
    going, arrived = mi.Bool(True), mi.Bool(False)
    while dr.hint(going, label="media up to the end of a ray", exclude=[space, ray, medium]):
        segment = mi.Ray3f(o, ray.d, left, ray.time, ray.wavelengths)
        si = space.scene.ray_intersect(segment, renamed.hit_flags(), coherent=False, active=going)
        hit = going & si.is_valid()
        arrived |= going & ~hit
        passed = hit & ~dr.all(space.null_transmission(si, hit) == 0)
        crossed = passed & si.is_medium_transition()
        number = dr.select(crossed, space.media.number(si.target_medium(ray.d)), number)
        onwards = rays.passed(segment, si, space.shape_errors)
        o, left = mi.Point3f(segment(onwards)), left - onwards
        going = mi.Bool(passed)
    return number, arrived


@dataclass
class NearSide:
    """The first boundary along rays: the ``number`` of the medium before it.

    Masks: ``found``, there is one; ``escaped``, the ray left the scene without meeting one. Neither holds for
    a ray that stays among opaque surfaces.
    """

    number: mi.UInt32
    found: mi.Bool
    escaped: mi.Bool


# Most reflections at opaque surfaces; among walls without a boundary a ray would never end.
_REFLECTIONS = 16


@dr.syntax
def near_side(space: Space, ray: mi.Ray3f, active: mi.Bool, target: mi.Point3f | None = None) -> NearSide:
    """Find the first boundary along ``ray`` whose near side light may leave.

    Scenes leave other sides undeclared, such as that within a wall or at the back of a light. Rays pass
    straight through such sides and surfaces that bound no medium if they transmit. Opaque ones reflect the
    ray as a mirror, so that it stays where light can go; every other reflection goes towards the ``target``.
    """
    aims = mi.Bool(target is not None)
    aim = mi.Point3f(0) if target is None else target
    o, d, number = mi.Point3f(ray.o), mi.Vector3f(ray.d), mi.UInt32(0)
    found, escaped, reflections = mi.Bool(False), mi.Bool(False), mi.UInt32(0)
    going = mi.Bool(active)
    while dr.hint(going, label="the first boundary", exclude=[space, ray, active, aims, aim]):
        segment = mi.Ray3f(o, d, ray.time, ray.wavelengths)
        si = space.scene.ray_intersect(segment, renamed.hit_flags(), coherent=False, active=going)
        hit = going & si.is_valid()
        bounds = hit & si.is_medium_transition() & _may_leave(si, -d)
        number = dr.select(bounds, space.media.number(si.target_medium(-d)), number)
        found |= bounds
        escaped |= going & ~hit
        opaque = hit & ~bounds & ~_transmits(si)
        aimed = aims & ((reflections & 1) == 0)
        d = dr.select(opaque, dr.select(aimed, _towards(aim, si, d), _mirrored(d, si.n)), d)
        o = _onwards(space, segment, si, d, opaque)
        reflections += dr.select(opaque, mi.UInt32(1), 0)
        going = hit & ~bounds & (reflections < _REFLECTIONS)
    return NearSide(number, found, escaped)


@dataclass
class Leaving:
    """Rays that leave boundaries: each ``ray`` starts in the medium ``number``.

    Mask ``known``: there is a boundary, and light may leave it along the ray.
    """

    ray: mi.Ray3f
    number: mi.UInt32
    known: mi.Bool


def leaving(space: Space, line: mi.Ray3f, through: mi.Point3f, local: mi.Vector3f) -> Leaving:
    """Rays from the boundary on each ``line`` nearest to the point ``through``.

    ``local``: their directions in a frame about the boundary's normal.
    """
    start, found = _before_the_nearest(space, line, through)
    segment = mi.Ray3f(start, line.d, line.time, line.wavelengths)
    si = space.scene.ray_intersect(segment, renamed.hit_flags(), coherent=False, active=found)
    d = mi.Frame3f(si.n).to_world(local)
    known = found & si.is_valid() & si.is_medium_transition() & _may_leave(si, d)
    ray = rays.spawn(rays.surface_anchor(si, segment, space.shape_errors), d, line)
    return Leaving(ray, space.media.number(si.target_medium(d)), known)


@dr.syntax
def _before_the_nearest(space: Space, line: mi.Ray3f, through: mi.Point3f) -> tuple[mi.Point3f, mi.Bool]:
    """Point on each ``line`` just before the boundary nearest to ``through``; if any."""
    o, start = mi.Point3f(line.o), mi.Point3f(line.o)
    best, going = dr.full(mi.Float, dr.inf, dr.width(line.o)), mi.Bool(True)
    while dr.hint(going, label="boundaries near a point", exclude=[space, line, through]):
        segment = mi.Ray3f(o, line.d, line.time, line.wavelengths)
        si = space.scene.ray_intersect(segment, renamed.hit_flags(), coherent=False, active=going)
        hit = going & si.is_valid()
        distance = dr.select(hit & si.is_medium_transition(), dr.norm(si.p - through), dr.inf)
        start = dr.select(distance < best, o, start)
        best = dr.minimum(best, distance)
        o = segment(rays.passed(segment, si, space.shape_errors))
        going = mi.Bool(hit)
    return start, best < dr.inf


@dataclass
class Lines:
    """Lines along which boundaries are compared.

    ``medium``: number of the medium at each ``ray``'s origin. Mask ``reflected``: opaque surfaces reflect the
    line towards its ``target``, as often as light may leave there; other lines go straight through.
    Boundaries count in the box from ``low`` to ``high``.
    """

    ray: mi.Ray3f
    medium: mi.UInt32
    reflected: mi.Bool
    target: mi.Point3f
    low: mi.Point3f
    high: mi.Point3f


# Most reflections of such a line.
_AIMED = 4


@dr.syntax
def disagreements(space: Space, lines: Lines) -> tuple[mi.UInt32, mi.UInt32]:
    """Count compared pairs of boundaries along ``lines``, and those that disagree.

    The far side of a boundary must be the near side of the next one, if light may leave both into the segment
    between. Behind an opaque surface that bounds no medium, the medium is unknown until the next boundary.
    """
    ray = lines.ray
    o, d, current = mi.Point3f(ray.o), mi.Vector3f(ray.d), mi.UInt32(lines.medium)
    width = dr.width(ray.o)
    known, reflections = dr.full(mi.Bool, True, width), dr.zeros(mi.UInt32, width)
    compared, wrong = dr.zeros(mi.UInt32, width), dr.zeros(mi.UInt32, width)
    going = mi.Bool(True)
    while dr.hint(going, label="boundaries along a line", exclude=[space, lines, ray, width]):
        segment = mi.Ray3f(o, d, ray.time, ray.wavelengths)
        si = space.scene.ray_intersect(segment, renamed.hit_flags(), coherent=False, active=going)
        hit = going & si.is_valid()
        bounds = hit & si.is_medium_transition()
        near, beyond = (space.media.number(si.target_medium(side)) for side in (-d, d))
        back, onwards = _may_leave(si, -d), _may_leave(si, d)
        counts = dr.all((si.p >= lines.low) & (si.p <= lines.high))
        both = bounds & known & back & counts
        compared += dr.select(both, mi.UInt32(1), 0)
        wrong += dr.select(both & (near != current), mi.UInt32(1), 0)
        opaque = hit & ~_transmits(si)
        turned = opaque & lines.reflected
        current = dr.select(bounds, dr.select(turned, near, beyond), current)
        known = dr.select(bounds, dr.select(turned, back, onwards), known & (turned | ~opaque))
        d = dr.select(turned, _towards(lines.target, si, d), d)
        o = _onwards(space, segment, si, d, turned)
        reflections += dr.select(turned, mi.UInt32(1), 0)
        going = hit & (~turned | (back & (reflections < _AIMED)))
    return compared, wrong


def _transmits(si) -> mi.Bool:
    return (si.bsdf().flags() & int(mi.BSDFFlags.Transmission)) != 0


def _may_leave(si, d) -> mi.Bool:
    """Mask: light may leave the surface ``si`` along ``d``, by emission or scattering.

    A BSDF without side flags may scatter to both sides.
    """
    front = dr.dot(si.sh_frame.n, d) > 0
    sides = mi.UInt32(int(mi.BSDFFlags.FrontSide)), mi.UInt32(int(mi.BSDFFlags.BackSide))
    flags = si.bsdf().flags()
    scatters = (flags & dr.select(front, *sides)) != 0
    unstated = (flags & (sides[0] | sides[1])) == 0
    return scatters | unstated | (front & (si.shape.emitter() != dr.zeros(mi.EmitterPtr)))


def _mirrored(d, n) -> mi.Vector3f:
    return d - n * (2 * dr.dot(d, n))


# Cosine below which rounding decides the side of a direction.
_GRAZING = 1e-3


def _towards(target, si, d) -> mi.Vector3f:
    """Direction from ``si`` to ``target``; the mirror's if that is on the other side."""
    aimed = dr.normalize(target - si.p)
    return dr.select(dr.dot(si.n, aimed) * -dr.sign(dr.dot(si.n, d)) > _GRAZING, aimed, _mirrored(d, si.n))


def _onwards(space: Space, segment, si, d, turned) -> mi.Point3f:
    """Origin of the ray from ``si`` along ``d``; ``turned``: on the same side."""
    straight = segment(rays.passed(segment, si, space.shape_errors))
    return dr.select(turned, rays.surface_anchor(si, segment, space.shape_errors).towards(d), straight)
