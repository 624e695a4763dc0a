"""Choices of Mitsuba's samplers that are replicated for the densities of strategies.

* Face of a mesh: by area, from ``sample.y``, on sums in single precision: `smooth_meshes.SmoothMeshes`, which
  checks that sampled points are in the planes of their faces.
* Points of textured rectangles: by the texture: `area.AreaEmitters.pdf_a`. Texture coordinates of rectangles,
  disks and spheres: `textured.TexturedPoints`.
* Spheres seen from inside: by area, up to ``RayEpsilon`` beyond the radius: `quadrics.Sphere.inner_radius`.
  From outside: a uniform direction in their cone, here without Mitsuba's cancellation: `quadrics.cone_pdf_w`.
* Turned spheres: ``to_world`` rotates the point, not the normal: `quadrics.sphere_normal`.
* Shapes whose ``to_world`` samples other points than rays hit raise errors: `to_world.check_to_world`.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from ..host.introspection import children, number

# Shapes that are sampled by the texture of their radiance. Mitsuba does so on others too, but wrongly: on
# cylinders the densities are off by factors of 0.4 to 1.6, on meshes all faces that share texture coordinates
# share one density but only one face is sampled.
TEXTURE_SAMPLED = {kind.value for kind in (mi.ShapeType.Rectangle, mi.ShapeType.Disk, mi.ShapeType.Sphere)}


def spread_points(count: int):
    """Low-discrepancy points in the unit square, `Point2f` (R2, fixed point)."""
    index = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, 1)
    x, y = (mi.Float((index * mi.UInt32(step)) >> 8) * 2.0**-24 for step in (3242174889, 2447445414))
    return mi.Point2f(x, y)


def is_textured(emitter) -> bool:
    return mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)


def is_sampled_by_texture(emitter) -> bool:
    """Whether points of a textured area light are chosen by its texture (whose texels are finite)."""
    if emitter.get_shape().shape_type() not in TEXTURE_SAMPLED:
        return False
    try:
        return math.isfinite(number(children(emitter)["radiance"].mean()))
    except RuntimeError:  # a texture without a mean
        return True
