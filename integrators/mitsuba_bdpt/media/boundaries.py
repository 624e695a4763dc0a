"""Which medium a ray is in, found from the boundaries that it meets."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..geometry import rays
from ..host import renamed
from .media import Space


@dr.syntax
def behind(space: Space, ray: mi.Ray3f, medium: mi.UInt32) -> tuple[mi.UInt32, mi.Bool]:
    """The number of the medium at the end of ``ray``, which starts in ``medium``, and whether it gets there.

    Surfaces that let something pass straight on are passed.
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
    """The first boundary that rays meet: the ``number`` of the medium before it.

    Masks: ``found``, there is one; ``escaped``, the ray has left the scene without meeting one. Neither holds
    for a ray that stays among opaque surfaces.
    """

    number: mi.UInt32
    found: mi.Bool
    escaped: mi.Bool


# Reflections at opaque surfaces after which a ray is given up: among walls without a boundary it never ends.
_REFLECTIONS = 16


@dr.syntax
def near_side(space: Space, ray: mi.Ray3f, active: mi.Bool, target: mi.Point3f | None = None) -> NearSide:
    """Find the first boundary along ``ray`` of whose side light may leave.

    Scenes leave the medium of other sides unstated: that within a wall, at the back of a lamp. Such sides,
    and surfaces that bound no medium, are passed straight on if they transmit light. Opaque ones reflect the
    ray as mirrors do, so that it stays where light can go; every other one towards the ``target``.
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
    """Rays from the boundary on each ``line`` that is nearest to the point ``through``.

    ``local`` their directions in a frame about the boundary's normal.
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
    """A point on each ``line`` just before its boundary nearest to ``through``, and whether there is one."""
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

    ``medium`` the number of the one that each ``ray`` starts in. Mask ``reflected``: opaque surfaces reflect
    the line towards its ``target``, as often as light may go on there; other lines go through. Boundaries
    count in the box from ``low`` to ``high``.
    """

    ray: mi.Ray3f
    medium: mi.UInt32
    reflected: mi.Bool
    target: mi.Point3f
    low: mi.Point3f
    high: mi.Point3f


# Reflections of such a line, which among walls would never end either.
_AIMED = 4


@dr.syntax
def disagreements(space: Space, lines: Lines) -> tuple[mi.UInt32, mi.UInt32]:
    """Number of boundaries along ``lines`` that are compared with the one before, and how many disagree.

    Of two boundaries that follow each other, the far side of the first has to be the near side of the second,
    where light may leave both into the segment between them. Behind an opaque surface that bounds no medium
    the medium is not known until the next boundary.
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
    """Mask: the BSDF of the surface ``si`` has lobes through which light gets to the other side."""
    return (si.bsdf().flags() & int(mi.BSDFFlags.Transmission)) != 0


def _may_leave(si, d) -> mi.Bool:
    """Mask: light may leave the surface ``si`` along ``d``, by emission or by its BSDF.

    A BSDF that states no side may scatter to both.
    """
    front = dr.dot(si.sh_frame.n, d) > 0
    sides = mi.UInt32(int(mi.BSDFFlags.FrontSide)), mi.UInt32(int(mi.BSDFFlags.BackSide))
    flags = si.bsdf().flags()
    scatters = (flags & dr.select(front, *sides)) != 0
    unstated = (flags & (sides[0] | sides[1])) == 0
    return scatters | unstated | (front & (si.shape.emitter() != dr.zeros(mi.EmitterPtr)))


def _mirrored(d, n) -> mi.Vector3f:
    return d - n * (2 * dr.dot(d, n))


# Cosine below which rounding decides on which side of a plane a direction within it goes.
_GRAZING = 1e-3


def _towards(target, si, d) -> mi.Vector3f:
    """Direction from ``si`` to ``target``, that of a mirror where this is not on the side of ``-d``."""
    aimed = dr.normalize(target - si.p)
    return dr.select(dr.dot(si.n, aimed) * -dr.sign(dr.dot(si.n, d)) > _GRAZING, aimed, _mirrored(d, si.n))


def _onwards(space: Space, segment, si, d, turned) -> mi.Point3f:
    """Start of the ray that goes on from ``si`` along ``d``, on the same side where it is ``turned``."""
    straight = segment(rays.passed(segment, si, space.shape_errors))
    return dr.select(turned, rays.surface_anchor(si, segment, space.shape_errors).towards(d), straight)
