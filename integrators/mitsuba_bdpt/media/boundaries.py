"""Finds the medium along a ray from the boundaries that it meets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..geometry import rays
from ..host import renamed
from . import transmittance

if TYPE_CHECKING:
    from .space import Space


def behind(space: Space, ray: mi.Ray3f, medium: mi.UInt32) -> tuple[mi.UInt32, mi.Bool]:
    """Trace ``ray`` from ``medium`` through transmitting surfaces.

    Returns the number of the medium at its end, and whether it arrives there.
    """
    number = mi.UInt32(medium) + dr.zeros(mi.UInt32, dr.width(ray.o))
    end = transmittance.through_surfaces(space, ray, number, mi.Bool(True), None, mi.UInt32(0), False)
    return end.medium, end.clear


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
_REFLECTIONS = 64


@dr.syntax
def near_side(space: Space, ray: mi.Ray3f, active: mi.Bool) -> NearSide:
    """Find the first boundary along ``ray`` whose near side light may leave.

    Scenes leave other sides undeclared, such as that within a wall or at the back of a light. Rays pass
    straight through such sides and surfaces that bound no medium if they transmit. Opaque ones reflect the
    ray as a mirror, so that it stays where light can go.
    """
    o, d, number = mi.Point3f(ray.o), mi.Vector3f(ray.d), mi.UInt32(0)
    found, escaped, reflections = mi.Bool(False), mi.Bool(False), mi.UInt32(0)
    going = mi.Bool(active)
    while dr.hint(going, label="the first boundary", exclude=[space, ray, active]):
        segment = mi.Ray3f(o, d, ray.time, ray.wavelengths)
        si = space.scene.ray_intersect(segment, renamed.hit_flags(), coherent=False, active=going)
        hit = going & si.is_valid()
        bounds = hit & si.is_medium_transition() & _may_leave(si, -d)
        number = dr.select(bounds, space.media.number(si.target_medium(-d)), number)
        found |= bounds
        escaped |= going & ~hit
        opaque = hit & ~bounds & ~_transmits(si)
        d = dr.select(opaque, d - si.n * (2 * dr.dot(d, si.n)), d)
        straight = segment(rays.passed(segment, si, space.shape_errors))
        mirrored = rays.surface_anchor(si, segment, space.shape_errors).towards(d)
        o = dr.select(opaque, mirrored, straight)
        reflections += dr.select(opaque, mi.UInt32(1), 0)
        going = hit & ~bounds & (reflections < _REFLECTIONS)
    return NearSide(number, found, escaped)


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
