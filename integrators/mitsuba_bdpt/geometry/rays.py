"""The one place where rays start.

Mitsuba offsets ray origins by 8.9e-5 (1 + max|p|), which swallows small scenes whole and leaves
gaps in large ones. Here the offset along the geometric normal follows from the rounding error of
the hit itself: ``OFFSET_ULPS * 2^-24 * max(|p|, |o|, t, reach)`` with maximum norms, where ``o`` and ``t``
belong to the ray that found ``p``, and ``reach`` is how far the numbers go that hits on its shape are
computed from, as far as their rounding moves hits along the normal (`reaches`). It scales with the scene.
Visibility rays end short of their target by its offset, not by a fraction of the distance; by more where they
are so long that they err more than the ray that found the target (`_before`).
Towards spheres and cylinders they have to end earlier; where these are so small that this would pass by what
stands before them, the ray asks what it meets first (`sight`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from .rounding import FAR, LEAST_COSINE, QUADRIC_ULPS, Errors, ShapeErrors, met, offset_at, rounding_offset


@dataclass
class Anchor:
    """A point that rays may start from or end at.

    ``p`` position, ``n`` geometric normal of unit length (zero for a point in free space),
    ``offset`` distance in scene units by which a ray leaves the surface along ``n``, ``curvature``
    1 / radius on spheres and cylinders, negative where normals point inwards, 0 elsewhere.
    """

    p: mi.Point3f
    n: mi.Normal3f
    offset: mi.Float
    curvature: mi.Float

    def towards(self, d: mi.Vector3f) -> mi.Point3f:
        """The start of a ray that leaves into direction ``d`` (any length)."""
        return self.p + self.n * dr.mulsign(self.offset, dr.dot(self.n, d))


def surface_anchor(si: mi.SurfaceInteraction3f, ray: mi.Ray3f, shape_errors: ShapeErrors) -> Anchor:
    """Anchor of the hit ``si`` that ``ray`` found."""
    errors = shape_errors.at(si.shape, si.is_valid(), si.instance, si.prim_index)
    offset = rounding_offset(si.p, ray.o, si.t, errors.reach)
    offset += (QUADRIC_ULPS * 2.0**-24) * dr.square(si.t) * errors.starts
    return Anchor(mi.Point3f(si.p), mi.Normal3f(si.n), offset, errors.ends)


# Least cosine by which a ray's way through an anchor's offset is lengthened.
_STEEPEST = 0.05


def passed(ray: mi.Ray3f, si: mi.SurfaceInteraction3f, shape_errors: ShapeErrors) -> mi.Float:
    """How far along ``ray`` it is beyond the surface ``si``, at its anchor's offset from it.

    On the ray's own line: many surfaces do not move it aside, past what it is to end at.
    """
    anchor = surface_anchor(si, ray, shape_errors)
    cos = dr.maximum(dr.abs(dr.dot(anchor.n, ray.d)), _STEEPEST)
    return si.t + anchor.offset / cos


def sampled_anchor(p: mi.Point3f, n: mi.Normal3f, errors: Errors | None) -> Anchor:
    """Return the anchor of a point sampled on a shape of these ``errors``, None off shapes."""
    offset = rounding_offset(p, p, 0, errors.reach if errors else 0)
    return Anchor(mi.Point3f(p), mi.Normal3f(n), offset, mi.Float(errors.ends if errors else 0))


def free_anchor(p: mi.Point3f) -> Anchor:
    """Anchor of a point without surface: a point light, a pinhole, a point of a lens."""
    return Anchor(mi.Point3f(p), mi.Normal3f(0), mi.Float(0), mi.Float(0))


def spawn(anchor: Anchor, d: mi.Vector3f, shared) -> mi.Ray3f:
    """Unbounded ray from ``anchor`` along unit ``d``; time and wavelengths as in ``shared``."""
    return mi.Ray3f(anchor.towards(d), d, shared.time, shared.wavelengths)


def _before(a: Anchor, b: Anchor) -> mi.Point3f:
    """The end of the visibility ray from ``a`` to ``b``, if the surface of ``b`` is flat.

    The offset of ``b`` clears the error of the hit that found it, and that of its coordinates. The ray from
    ``a`` errs in proportion to its own length too. (No coordinate of ``a`` is larger than that length plus
    the largest of ``b``. Measured: a quarter of the offset suffices.)
    """
    offset = dr.maximum(b.offset, offset_at(dr.norm(b.p - a.p)))
    return replace(b, offset=offset).towards(a.p - b.p)


def end_point(a: Anchor, b: Anchor) -> mi.Point3f:
    """Where a visibility ray from ``a`` to ``b`` ends: just before ``b``'s surface."""
    end = _before(a, b)
    # Known while the kernel is recorded: a scene without spheres and cylinders does none of what follows.
    if b.curvature.state == dr.VarState.Literal and b.curvature[0] == 0:
        return end
    back = a.p - end
    return end + back * dr.minimum(_early(back, b), 0.01)


def _early(back, b: Anchor):
    """Return the share of a ray's length in which it may meet the sphere or cylinder of its end too early.

    ``b`` is the end, ``back`` the direction against the ray. On the far side of a shape so small that the ray
    would pass its front this is half the chord at most: the front is in the way, the open end of a cylinder
    is not.
    """
    dist = dr.norm(back)
    along = dr.dot(b.n, back)
    curvature = dr.abs(b.curvature)
    # The error of t grows towards the outline, as 1 / cos.
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
    """Ray from ``a`` that ends just before ``b``; time and wavelengths as in ``shared``."""
    return segment_to(a, end_point(a, b), shared)


@dataclass
class Own:
    """The surface that a visibility ray ends at.

    Its number (see `met`), and the distance ``t`` from which on the ray may meet it.
    """

    number: mi.UInt32
    t: mi.Float


def sight(
    shape_errors: ShapeErrors, a: Anchor, b: Anchor, number: mi.UInt32, shared
) -> tuple[mi.Ray3f, Own | None]:
    """Return the visibility ray from ``a`` to ``b``, and an `Own` for `occluded`.

    ``b`` is on the shape of this ``number``. The `Own` is None unless ``shape_errors`` are small.
    """
    if not shape_errors.small:
        return segment(a, b, shared), None
    end = _before(a, b)
    ray = segment_to(a, end, shared)
    return ray, Own(number, ray.maxt * (1 - _early(a.p - end, b)))


def occluded(scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool, own: Own | None = None):
    """Return whether any surface blocks ``ray``, null surfaces included (as in ``path``).

    ``own`` is what the ray ends at, where it can be met too early.
    """
    if own is None:
        return scene.ray_test(ray, active=active)
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    return pi.is_valid() & ~((met(pi.shape, pi.instance) == own.number) & (pi.t >= own.t))


def intersect_past_emitters(
    scene: mi.Scene, shape_errors: ShapeErrors, ray: mi.Ray3f, active: mi.Bool, coherent: bool
) -> tuple[mi.PreliminaryIntersection3f, mi.Ray3f]:
    """First hit along ``ray`` on a shape that does not emit, and the ray that found it.

    This is how ``path`` treats camera rays under ``hide_emitters``.
    """

    def body(ray, pi, active):
        si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)
        onward = mi.Ray3f(ray)
        onward.o = surface_anchor(si, ray, shape_errors).towards(ray.d)
        # maxt bounds a segment: what was travelled is taken off (infinity stays infinity).
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
