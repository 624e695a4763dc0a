"""Which medium a ray is in, found from the boundaries that it meets."""

from __future__ import annotations

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


@dr.syntax
def near_side(space: Space, ray: mi.Ray3f, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
    """The number of the medium before the first boundary that ``ray`` meets, and whether it meets one.

    Surfaces that bound no medium are passed, opaque ones too.
    """
    o, number, found = mi.Point3f(ray.o), mi.UInt32(0), mi.Bool(False)
    going = mi.Bool(active)
    while dr.hint(going, label="the first boundary", exclude=[space, ray, active]):
        segment = mi.Ray3f(o, ray.d, ray.time, ray.wavelengths)
        si = space.scene.ray_intersect(segment, mi.RayFlags.Minimal, coherent=False, active=going)
        hit = going & si.is_valid()
        bounds = hit & si.is_medium_transition()
        number = dr.select(bounds, space.media.number(si.target_medium(-ray.d)), number)
        found |= bounds
        o = mi.Point3f(segment(rays.passed(segment, si, space.shape_errors)))
        going = hit & ~bounds
    return number, found


@dr.syntax
def disagreements(space: Space, ray: mi.Ray3f, medium: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
    """Crossings of boundaries along ``ray``, which starts in ``medium``, and how many of them disagree.

    Of two boundaries that follow each other, the far side of the first has to be the near side of the second.
    """
    o, current = mi.Point3f(ray.o), mi.UInt32(medium) + dr.zeros(mi.UInt32, dr.width(ray.o))
    crossings, wrong = dr.zeros(mi.UInt32, dr.width(ray.o)), dr.zeros(mi.UInt32, dr.width(ray.o))
    going = mi.Bool(True)
    while dr.hint(going, label="boundaries along a line", exclude=[space, ray]):
        segment = mi.Ray3f(o, ray.d, ray.time, ray.wavelengths)
        si = space.scene.ray_intersect(segment, mi.RayFlags.Minimal, coherent=False, active=going)
        hit = going & si.is_valid()
        bounds = hit & si.is_medium_transition()
        near = space.media.number(si.target_medium(-ray.d))
        crossings += dr.select(bounds, mi.UInt32(1), 0)
        wrong += dr.select(bounds & (near != current), mi.UInt32(1), 0)
        current = dr.select(bounds, space.media.number(si.target_medium(ray.d)), current)
        o = mi.Point3f(segment(rays.passed(segment, si, space.shape_errors)))
        going = mi.Bool(hit)
    return crossings, wrong
