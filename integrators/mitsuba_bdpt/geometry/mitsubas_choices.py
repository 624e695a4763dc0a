"""Choices of Mitsuba's samplers that are repeated here, and the checks that Mitsuba makes the same ones.

Strategies need densities of points that they have not sampled, and normals that Mitsuba does not give, so
some of what its samplers do inside is known here. Each choice has one home, which also has the check that
runs when a render begins, only for the emitters (and irradiance meters) concerned:

============================================  ===================================  =======================
choice of Mitsuba's                           home                                 check before a render
============================================  ===================================  =======================
face of a mesh: by area, from ``sample.y``,   `smooth_meshes.SmoothMeshes`         points in the planes of
on sums in single precision                                                        their faces, there
points of textured rectangles: by the         `area.AreaEmitters.pdf_a`           `check_densities`, here
texture
texture coordinates of rectangles, disks and  `textured.TexturedPoints`            `check_densities`, here
spheres
spheres seen from inside: by area, up to      `quadrics.Sphere.inner_radius`,      `check_densities`, here
``RayEpsilon`` beyond the radius              `is_sampled_by_direction`, here
spheres seen from outside: a uniform          `quadrics.cone_pdf_w`                none: Mitsuba's formula
direction in their cone                                                            without its cancellation
turned spheres: the point is rotated by       `quadrics.Sphere.turned`,            none: normals follow
``to_world``, the normal is not               `quadrics.sphere_normal`             from points alone
shapes whose ``to_world`` samples other       `to_world.check_to_world`            the matrix alone
points than rays find
============================================  ===================================  =======================

Tests: ``test_lamps.py`` plants other choices and expects the checks to name the emitter
(``test_a_choice_that_is_not_mitsubas_is_noticed``, ``test_another_table_of_faces_is_noticed``), and shows
that they are silent elsewhere; there are also ``test_normals_of_fine_meshes`` (faces),
``test_shapes_that_may_be_sheared`` and ``test_a_sheared_disk_is_found_where_it_is_sampled`` (``to_world``).
``test_emission_densities.py``: ``test_spheres_that_to_world_turns``. ``test_rays.py``:
``test_lamps_on_spheres_however_small`` (cones).
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UnsupportedError
from ..host import renamed
from ..host.introspection import children, named, number

# Shapes whose textured radiance is sampled by the texture. Mitsuba does so on others too, but wrongly: on a
# cylinder the points have other densities than stated (0.4 to 1.6 times), on a mesh all faces with the same
# texture coordinates share one density but only one face is sampled (a cube: a sixth).
TEXTURE_SAMPLED = {kind.value for kind in (mi.ShapeType.Rectangle, mi.ShapeType.Disk, mi.ShapeType.Sphere)}

CHECKED = 4096  # samples of an emitter

# Share of the samples that may differ by rounding; where Mitsuba chooses otherwise most do.
OFF = 0.05

# Texture coordinates on a shape far from the origin are rounded. Where that is more than this part of a
# texel, the density of a point may be that of another one, and nothing is compared.
_TEXEL = 0.05


def spread_points(count: int):
    """``count`` points that fill the unit square evenly, `Point2f`: the sequence R2 in fixed point."""
    index = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, 1)
    x, y = (mi.Float((index * mi.UInt32(step)) >> 8) * 2.0**-24 for step in (3242174889, 2447445414))
    return mi.Point2f(x, y)


def is_textured(emitter) -> bool:
    """Whether an area light has another radiance at each of its points."""
    return mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)


def is_sampled_by_texture(emitter) -> bool:
    """Whether points of a textured area light are chosen by its texture.

    (With a texel that is not finite all densities are NaN.)
    """
    if emitter.get_shape().shape_type() not in TEXTURE_SAMPLED:
        return False
    try:
        return math.isfinite(number(children(emitter)["radiance"].mean()))
    except RuntimeError:  # a texture that knows no mean
        return True


def is_sampled_by_direction(emitter) -> bool:
    """Whether next-event estimation towards an area light on a sphere chooses a direction.

    It does if the light has no texture, which would be sampled wherever the lit point is.
    """
    return not is_textured(emitter)


def check_densities(emitters, emitter, index: int, by_mitsuba: bool = True):
    """Check that the points of an area light have the densities that the group ``emitters`` states.

    These are the densities of emission (area), where rays find the point and its front, and, where points are
    chosen ``by_mitsuba``, those of next-event estimation (solid angle) from places about the emitter, inside
    and outside. ``emitters``: the `area.AreaEmitters` that have ``emitter`` at ``index``. Raises
    ``UnsupportedError``.
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
        some = np.mean(np.array(compared))  # 0: nothing can be compared, and so nothing differs
        off = np.mean(np.array(differ)) / some if some else 0
        if off > OFF:
            raise UnsupportedError(
                f"{off:.1%} of the {what} that Mitsuba {mi.__version__} samples of emitter "
                f"{named(emitter)} have another density than is known here, so that the image would be "
                "wrong; use integrator type 'path', and please report the scene"
            )


def _directions_differ(emitters, emitter, place, u):
    """`_differ` of the densities of next-event estimation."""
    it = dr.zeros(mi.Interaction3f)
    others, _ = emitter.sample_position(0, mi.Point2f(u.y, u.x))
    it.p = _places(emitter.get_shape().bbox(), others.p)
    ds, _ = emitter.sample_direction(it, u)
    in_view = dr.abs(dr.dot(ds.n, ds.d)) > 0.01
    stated = emitters.direct_pdf_w(emitter, place, it, ds, mi.Bool(True))
    return _differ(dr.select(in_view, ds.pdf, 0), stated)


def _is_rounded(emitter) -> bool:
    """Whether a texel of the emitter is little larger than the rounding of its coordinates, see `_TEXEL`."""
    box = emitter.get_shape().bbox()
    far = float(np.abs([box.min, box.max]).max())
    texels = max(children(emitter)["radiance"].resolution())
    return not 2.0**-20 * far * texels < _TEXEL * max(box.extents()) / 2


def _seen(shape, ps):
    """What rays find from before the points ``ps`` of a shape.

    They start so far away that the points' rounding does not decide on which side, and so near that hardly
    any other part of the shape lies between.
    """
    height = dr.opaque(mi.Float, 1e-3 * max(shape.bbox().extents()))
    ray = mi.Ray3f(ps.p + height * ps.n, -mi.Vector3f(ps.n))
    # Shape.ray_intersect fails where the scene has a shapegroup of two kinds of shapes.
    return shape.compute_surface_interaction(ray, shape.ray_intersect_preliminary(ray), renamed.hit_flags())


def _differ(sampled, stated):
    """Masks: two densities are not the same to 1 %; they can be compared."""
    compared = (sampled > 0) & dr.isfinite(sampled)
    return compared & ~(dr.abs(sampled - stated) <= 0.01 * sampled), compared


def _places(box, points):
    """Places on and about a shape: each second one of its ``points``, others on a line.

    The line leads from the middle of its ``box`` to about three times the distance of the corners.
    """
    middle = dr.opaque(mi.Point3f, list(box.center()))
    along = dr.opaque(mi.Vector3f, list(box.extents() * mi.ScalarVector3f(0.61, -0.77, 0.83)))
    index = dr.arange(mi.UInt32, CHECKED)
    # In an order that has nothing to do with that of the sampled points.
    step = mi.Float((index * 34) % 89) + 0.5
    return dr.select(index % 2 == 0, points, middle + along * (step * (2 / 89)))
