"""The one place where rays start and end.

Mitsuba offsets ray origins by 8.9e-5 (1 + max|p|), which exceeds small scenes and leaves gaps in large ones.
Here the offset along the geometric normal follows from the rounding error of the hit:
``OFFSET_ULPS * 2^-24 * max(|p|, |o|, t, reach)`` with maximum norms, where ``o`` and ``t`` belong to the ray
that found ``p``, and ``reach`` is that of its shape (`reaches`).

Shadow rays end short of their target by its offset, and by more if their own length errs more (`_before`).
Towards spheres and cylinders they end earlier still; where these are so small that occluders in front would
be missed, the ray tests what it meets first (`shadow_ray`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from .rounding import FAR, LEAST_COSINE, QUADRIC_ULPS, Errors, ShapeErrors, met, offset_at, rounding_offset


@dataclass
class Anchor:
    """A point that rays may start from or end at.

    ``p`` position; ``n`` unit geometric normal (zero for a point in free space); ``offset`` distance in scene
    units by which a ray leaves the surface along ``n``; ``curvature`` 1 / radius on spheres and cylinders,
    negative where normals point inwards, 0 elsewhere.
    """

    p: mi.Point3f
    n: mi.Normal3f
    offset: mi.Float
    curvature: mi.Float

    def towards(self, d: mi.Vector3f) -> mi.Point3f:
        """Origin of a ray that leaves into direction ``d`` (any length)."""
        return self.p + self.n * dr.mulsign(self.offset, dr.dot(self.n, d))


def surface_anchor(si: mi.SurfaceInteraction3f, ray: mi.Ray3f, shape_errors: ShapeErrors) -> Anchor:
    errors = shape_errors.at(si.shape, si.is_valid(), si.instance, si.prim_index)
    offset = rounding_offset(si.p, ray.o, si.t, errors.reach)
    offset += (QUADRIC_ULPS * 2.0**-24) * dr.square(si.t) * errors.starts
    return Anchor(mi.Point3f(si.p), mi.Normal3f(si.n), offset, errors.ends)


_STEEPEST = 0.05  # lower bound of the cosine that divides an anchor's offset


def passed(ray: mi.Ray3f, si: mi.SurfaceInteraction3f, shape_errors: ShapeErrors) -> mi.Float:
    """Distance along ``ray`` just beyond ``si``: on the ray, so that many surfaces do not shift it."""
    anchor = surface_anchor(si, ray, shape_errors)
    cos = dr.maximum(dr.abs(dr.dot(anchor.n, ray.d)), _STEEPEST)
    return si.t + anchor.offset / cos


def sampled_anchor(p: mi.Point3f, n: mi.Normal3f, errors: Errors | None) -> Anchor:
    """Anchor of a point sampled on a shape with ``errors`` (None: not on a shape)."""
    offset = rounding_offset(p, p, 0, errors.reach if errors else 0)
    return Anchor(mi.Point3f(p), mi.Normal3f(n), offset, mi.Float(errors.ends if errors else 0))


def free_anchor(p: mi.Point3f) -> Anchor:
    """Anchor of a point without surface: a point light, a pinhole, a point of a lens."""
    return Anchor(mi.Point3f(p), mi.Normal3f(0), mi.Float(0), mi.Float(0))


def spawn(anchor: Anchor, d: mi.Vector3f, shared) -> mi.Ray3f:
    """Unbounded ray from ``anchor`` along unit ``d``; ``shared``: time, wavelengths."""
    return mi.Ray3f(anchor.towards(d), d, shared.time, shared.wavelengths)


def _before(a: Anchor, b: Anchor) -> mi.Point3f:
    """End of the shadow ray from ``a`` to a flat surface at ``b``; its offset grows with the length."""
    offset = dr.maximum(b.offset, offset_at(dr.norm(b.p - a.p)))
    return replace(b, offset=offset).towards(a.p - b.p)


def end_point(a: Anchor, b: Anchor) -> mi.Point3f:
    """End of a shadow ray from ``a`` to ``b``, just before ``b``'s surface."""
    end = _before(a, b)
    # Known when the kernel is recorded: scenes without spheres and cylinders record nothing below.
    if b.curvature.state == dr.VarState.Literal and b.curvature[0] == 0:
        return end
    back = a.p - end
    return end + back * dr.minimum(_early(back, b), 0.01)


def _early(back, b: Anchor):
    """Share of a ray's length in which it may hit its end ``b``, on a sphere or cylinder, too early.

    ``back``: direction against the ray. Behind a shape so small that the ray would pass its front, at most
    half the chord, so that the front still occludes (the open end of a cylinder does not).
    """
    dist = dr.norm(back)
    along = dr.dot(b.n, back)
    curvature = dr.abs(b.curvature)
    # The error of t grows towards the silhouette, as 1 / cos.
    cos = dr.maximum(dr.abs(along) / dist, LEAST_COSINE)
    early = (QUADRIC_ULPS * 2.0**-24) * dist * curvature / cos
    behind = (along * b.curvature < -2) & (dist * curvature > FAR)
    return dr.select(behind, dr.minimum(early, dr.abs(along) / (dist * dist * curvature)), early)


def segment_to(a: Anchor, end: mi.Point3f, shared) -> mi.Ray3f:
    """Ray from ``a`` to the point ``end``; time and wavelengths as in ``shared``."""
    o = a.towards(end - a.p)
    between = end - o
    dist = dr.norm(between)
    return mi.Ray3f(o, between / dist, dist, shared.time, shared.wavelengths)


def segment(a: Anchor, b: Anchor, shared) -> mi.Ray3f:
    """Ray from ``a`` that ends just before ``b``; ``shared``: time, wavelengths."""
    return segment_to(a, end_point(a, b), shared)


@dataclass
class Own:
    """Surface ``number`` (`met`) at a shadow ray's end, hit from ``t`` on."""

    number: mi.UInt32
    t: mi.Float


def shadow_ray(
    shape_errors: ShapeErrors, a: Anchor, b: Anchor, number: mi.UInt32, shared
) -> tuple[mi.Ray3f, Own | None]:
    """Shadow ray from ``a`` to ``b`` on the shape ``number``, and `Own` if ``shape_errors`` are small."""
    if not shape_errors.small:
        return segment(a, b, shared), None
    end = _before(a, b)
    ray = segment_to(a, end, shared)
    return ray, Own(number, ray.maxt * (1 - _early(a.p - end, b)))


def occluded(
    scene: mi.Scene, shape_errors: ShapeErrors, ray: mi.Ray3f, active: mi.Bool, own: Own | None = None
):
    """Whether any surface (also null, as in ``path``) but ``own`` blocks ``ray``."""
    if not shape_errors.small:
        return scene.ray_test(ray, active=active)
    # `ray_test` errs by t^2 2^-23 in the squared radius of a sphere, which the first hit does not.
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    if own is None:
        return pi.is_valid()
    return pi.is_valid() & ~((met(pi.shape, pi.instance) == own.number) & (pi.t >= own.t))


def intersect_past_emitters(
    scene: mi.Scene, shape_errors: ShapeErrors, ray: mi.Ray3f, active: mi.Bool, coherent: bool
) -> tuple[mi.PreliminaryIntersection3f, mi.Ray3f]:
    """First hit that does not emit, and its ray (``hide_emitters``, as in ``path``)."""

    def body(ray, pi, active):
        si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)
        onward = mi.Ray3f(ray)
        onward.o = surface_anchor(si, ray, shape_errors).towards(ray.d)
        # maxt bounds a segment: subtract the distance travelled (infinity stays infinity).
        onward.maxt = ray.maxt - dr.dot(onward.o - ray.o, ray.d)
        onward = dr.select(active, onward, ray)
        found = scene.ray_intersect_preliminary(onward, coherent=coherent, active=active)
        pi = dr.select(active, found, pi)
        return onward, pi, active & on_emitter(pi)

    def on_emitter(pi):
        return pi.is_valid() & (pi.shape.emitter() != dr.zeros(mi.EmitterPtr))

    pi = scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)
    ray, pi, _ = dr.while_loop(
        (mi.Ray3f(ray), pi, active & on_emitter(pi)),
        lambda ray, pi, active: active,
        body,
        label="past emitters",
    )
    return pi, ray
