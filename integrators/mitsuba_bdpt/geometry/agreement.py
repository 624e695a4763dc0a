"""Choices of Mitsuba's samplers that are repeated here, compared with what Mitsuba samples.

A face of a mesh is compared where its table is made (`SmoothMeshes`), shapes by their ``to_world`` alone
(`to_world`); here the densities of points that a texture chooses, and of spheres seen from inside. Only the
emitters that need it are sampled, each a few thousand times: some milliseconds.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UnsupportedError
from ..host.introspection import children, named

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


def check_densities(emitters, index: int):
    """Raise ``NotImplementedError`` unless the points of the emitter ``index`` have the densities that
    ``emitters`` states: those of emission, over the area, where rays find the point and its front; and those
    of next-event estimation from places about the emitter, inside and outside."""
    emitter = emitters.scene.emitters()[index]
    if _is_rounded(emitter):
        return
    u, number = spread_points(CHECKED), dr.opaque(mi.UInt32, index)
    ps, _ = emitter.sample_position(0, u)
    ps = emitters.upright(ps, number, mi.Bool(True))
    seen = _seen(emitter.get_shape(), ps)
    stated = emitters.area_density(emitter, number, seen, seen.n, mi.Bool(True))
    of_points = _differ(ps.pdf, dr.select(dr.dot(seen.sh_frame.n, ps.n) > 0, stated, 0))
    it = dr.zeros(mi.Interaction3f)
    others, _ = emitter.sample_position(0, mi.Point2f(u.y, u.x))
    it.p = _places(emitter.get_shape().bbox(), others.p)
    ds, _ = emitter.sample_direction(it, u)
    in_view = dr.abs(dr.dot(ds.n, ds.d)) > 0.01
    stated = emitters.density_of_direction(emitter, number, it, ds, mi.Bool(True))
    of_directions = _differ(dr.select(in_view, ds.pdf, 0), stated)
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


def _is_rounded(emitter) -> bool:
    """Whether a texel of the emitter is little larger than the rounding of its coordinates, see `_TEXEL`."""
    box = emitter.get_shape().bbox()
    far = float(np.abs([box.min, box.max]).max())
    texels = max(children(emitter)["radiance"].resolution())
    return not 2.0**-20 * far * texels < _TEXEL * max(box.extents()) / 2


def _seen(shape, ps):
    """What a ray finds from before the points ``ps`` of a shape: from so far that their rounding does not
    decide on which side it starts, and so near that hardly any other part of the shape lies between."""
    height = dr.opaque(mi.Float, 1e-3 * max(shape.bbox().extents()))
    return shape.ray_intersect(mi.Ray3f(ps.p + height * ps.n, -mi.Vector3f(ps.n)), mi.RayFlags.All)


def _differ(sampled, stated):
    """Masks: two densities are not the same to 1 %; they can be compared."""
    compared = (sampled > 0) & dr.isfinite(sampled)
    return compared & ~(dr.abs(sampled - stated) <= 0.01 * sampled), compared


def _places(box, points):
    """Places about a shape: each second one of its ``points``, others on a line from the middle of its
    ``box`` to twice the distance of the corners."""
    middle = dr.opaque(mi.Point3f, list(box.center()))
    along = dr.opaque(mi.Vector3f, list(box.extents() * mi.ScalarVector3f(0.61, -0.77, 0.83)))
    index = dr.arange(mi.UInt32, CHECKED)
    # In an order that has nothing to do with that of the sampled points.
    step = mi.Float((index * 34) % 89) + 0.5
    return dr.select(index % 2 == 0, points, middle + along * (step * (2 / 89)))
