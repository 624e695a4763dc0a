"""Choices of Mitsuba's samplers that are replicated for the densities of strategies, and checks of them.

============================================  ===================================  =======================
choice of Mitsuba                             home                                 check before a render
============================================  ===================================  =======================
face of a mesh: by area, from ``sample.y``,   `smooth_meshes.SmoothMeshes`         points in the planes of
on sums in single precision                                                        their faces, there
points of textured rectangles: by the         `area.AreaEmitters.pdf_a`           `check_densities`, here
texture
texture coordinates of rectangles, disks and  `textured.TexturedPoints`            `check_densities`, here
spheres
spheres seen from inside: by area, up to      `quadrics.Sphere.inner_radius`,      `check_densities`, here
``RayEpsilon`` beyond the radius              `area._Sphere`
spheres seen from outside: a uniform          `quadrics.cone_pdf_w`                none: Mitsuba's formula
direction in their cone                                                            without its cancellation
turned spheres: the point is rotated by       `quadrics.Sphere.turned`,            none: normals follow
``to_world``, the normal is not               `quadrics.sphere_normal`             from points alone
shapes whose ``to_world`` samples other       `to_world.check_to_world`            the matrix alone
points than rays hit
============================================  ===================================  =======================
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UnsupportedError
from ..host import renamed
from ..host.introspection import children, named, number

# Shapes that are sampled by the texture of their radiance. Mitsuba does so on others too, but wrongly: on
# cylinders the densities are off by factors of 0.4 to 1.6, on meshes all faces that share texture coordinates
# share one density but only one face is sampled.
TEXTURE_SAMPLED = {kind.value for kind in (mi.ShapeType.Rectangle, mi.ShapeType.Disk, mi.ShapeType.Sphere)}

CHECKED = 4096  # samples of an emitter

# Largest share of samples that may differ by rounding; most differ if Mitsuba's choice is another.
OFF = 0.05

# Largest rounding error of texture coordinates, in texels, that still allows a comparison of densities.
_TEXEL = 0.05


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


def check_densities(emitters, emitter, index: int, by_mitsuba: bool = True):
    """Check the densities of an area light's points in the group ``emitters``.

    Compares densities of emission (area) where rays hit the point's front, and, if points are sampled
    ``by_mitsuba``, of next-event estimation (solid angle) from positions inside and outside of the emitter.
    ``emitters``: an `area.AreaEmitters`. Raises ``UnsupportedError``.
    """
    if _is_rounded(emitter):
        return
    u, place = spread_points(CHECKED), dr.opaque(mi.UInt32, index)
    ps = emitters.points(emitter, place, u)
    seen = _seen(emitter.get_shape(), ps)
    stated = emitters.pdf_a(emitter, place, seen, seen.n, mi.Bool(True))
    of_points = _differ(ps.pdf, dr.select(dr.dot(seen.sh_frame.n, ps.n) > 0, stated, 0))
    of_directions = _directions_differ(emitters, emitter, place, u) if by_mitsuba else of_points
    dr.eval(of_points, of_directions)  # one kernel
    for what, (differ, compared) in (("points", of_points), ("directions", of_directions)):
        some = np.mean(np.array(compared))  # 0: nothing can be compared
        off = np.mean(np.array(differ)) / some if some else 0
        if off > OFF:
            raise UnsupportedError(
                f"{off:.1%} of the {what} that Mitsuba {mi.__version__} samples of emitter "
                f"{named(emitter)} have another density than is known here, so that the image would be "
                "wrong; use integrator type 'path', and please report the scene"
            )


def _directions_differ(emitters, emitter, place, u):
    it = dr.zeros(mi.Interaction3f)
    others, _ = emitter.sample_position(0, mi.Point2f(u.y, u.x))
    it.p = _places(emitter.get_shape().bbox(), others.p)
    ds, _ = emitter.sample_direction(it, u)
    in_view = dr.abs(dr.dot(ds.n, ds.d)) > 0.01
    stated = emitters.direct_pdf_w(emitter, place, it, ds, mi.Bool(True))
    return _differ(dr.select(in_view, ds.pdf, 0), stated)


def _is_rounded(emitter) -> bool:
    """Whether rounding of coordinates is of a texel's order (`_TEXEL`)."""
    box = emitter.get_shape().bbox()
    far = float(np.abs([box.min, box.max]).max())
    texels = max(children(emitter)["radiance"].resolution())
    return not 2.0**-20 * far * texels < _TEXEL * max(box.extents()) / 2


def _seen(shape, ps):
    """Hits of rays towards the points ``ps`` of a shape from their front.

    From far enough for rounding not to change the side, with hardly any other part of the shape between.
    """
    height = dr.opaque(mi.Float, 1e-3 * max(shape.bbox().extents()))
    ray = mi.Ray3f(ps.p + height * ps.n, -mi.Vector3f(ps.n))
    # Shape.ray_intersect fails if the scene has a shapegroup of two kinds of shapes.
    return shape.compute_surface_interaction(ray, shape.ray_intersect_preliminary(ray), renamed.hit_flags())


def _differ(sampled, stated):
    """Masks: the densities differ by more than 1 %; they can be compared."""
    compared = (sampled > 0) & dr.isfinite(sampled)
    return compared & ~(dr.abs(sampled - stated) <= 0.01 * sampled), compared


def _places(box, points):
    """Reference positions on and around a shape: alternately ``points`` and a line.

    The line leads from the middle of its ``box`` to about three times the distance of the corners.
    """
    middle = dr.opaque(mi.Point3f, list(box.center()))
    along = dr.opaque(mi.Vector3f, list(box.extents() * mi.ScalarVector3f(0.61, -0.77, 0.83)))
    index = dr.arange(mi.UInt32, CHECKED)
    # An order uncorrelated with that of the sampled points.
    step = mi.Float((index * 34) % 89) + 0.5
    return dr.select(index % 2 == 0, points, middle + along * (step * (2 / 89)))
