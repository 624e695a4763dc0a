"""The one place where rays start.

Mitsuba offsets ray origins by 8.9e-5 (1 + max|p|), which swallows small scenes whole and leaves
gaps in large ones. Here the offset along the geometric normal follows from the rounding error of
the hit itself: ``OFFSET_ULPS * 2^-24 * max(|p|, |o|, t)`` with maximum norms, where ``o`` and ``t``
belong to the ray that found ``p``. It scales with the scene. Visibility rays end short of their
target by the target's own offset, not by a fraction of the distance. Towards spheres and cylinders they
have to end earlier; where these are so small that this would pass by what stands before them, the ray asks
which shape it meets first (`sight`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .objects import own_parameters

# Measured: from 16 on, no hit on any of Mitsuba's shapes finds its own start (4 fails on up to
# 1 % of hits on cylinders); 32 keeps a factor of two in hand.
OFFSET_ULPS = 32


# Mitsuba solves for hits on spheres and cylinders in single precision: measured error of t up to
# 8 * 2^-24 * t^2 / radius (with 4, one visibility ray in a thousand is blocked by its own target).
QUADRIC_ULPS = 8

# Seen from afar, one point of a sphere in a hundred is closer to its outline than this cosine. A ray may
# still meet the sphere before such a point: measured, 1e-5 of the light of a radius of 0.05 at distance 7.
LEAST_COSINE = 0.1

# Diameters of a scene, in radii of its smallest sphere or cylinder, from which on rays ask what they meet:
# those that end early would do so by more than two radii (2 LEAST_COSINE / (QUADRIC_ULPS 2^-24) = 650^2).
SMALL = 650


@dataclass
class Anchor:
    """A point that rays may start from or end at.

    ``p`` position, ``n`` geometric normal of unit length (zero for a point in free space),
    ``offset`` distance in scene units by which a ray leaves the surface along ``n``, ``curvature``
    1 / radius on spheres and cylinders, 0 elsewhere.
    """

    p: object
    n: object
    offset: object
    curvature: object

    def towards(self, d):
        """The start of a ray that leaves into direction ``d`` (any length)."""
        return self.p + self.n * dr.mulsign(self.offset, dr.dot(self.n, d))


def rounding_offset(p, o, t):
    """Offset that clears the rounding error of a hit ``p`` found from ``o`` at distance ``t``."""
    magnitude = dr.maximum(dr.max(dr.abs(p)), dr.max(dr.abs(o)))
    return (OFFSET_ULPS * 2.0**-24) * dr.maximum(magnitude, t)


class Quadrics:
    """Curvature of the scene's spheres and cylinders, by shape pointer. ``small``: one of them is so small
    that rays ask what they meet, see `SMALL`."""

    def __init__(self, scene):
        shapes = scene.shapes()
        rows = [_curvatures(s) for s in shapes]
        self._size = 0
        self.any = any(any(row) for row in rows)
        extent = 2 * scene.bbox().bounding_sphere().radius if self.any else 0
        # Not `>`: the extent may be NaN.
        self.small = any(row[0] and not row[0] * extent <= SMALL for row in rows)
        if self.any:
            ids = dr.reinterpret_array(mi.UInt32, scene.shapes_dr()).numpy().tolist()
            self._size = max(ids) + 1
            table = [(0.0, 0.0)] * self._size
            for number, row in zip(ids, rows, strict=True):
                table[number] = row
            self._ends, self._starts = (mi.Float(column) for column in zip(*table, strict=True))
            dr.make_opaque(self._ends, self._starts)

    def ends(self, shape, active=True):
        """1 / radius where ``shape`` is a sphere or cylinder, else 0."""
        return self._look_up("_ends", shape, active)

    def starts(self, shape, active=True):
        """1 / radius where ``shape`` is a cylinder (hits on spheres are exact), else 0."""
        return self._look_up("_starts", shape, active)

    def _look_up(self, column, shape, active):
        if not self.any:
            return mi.Float(0)
        number = dr.reinterpret_array(mi.UInt32, shape)
        known = mi.Bool(active) & (number < self._size)  # shapes inside instances are not
        return dr.gather(mi.Float, getattr(self, column), number, known)


def _curvatures(shape) -> tuple[float, float]:
    if shape.shape_type() == mi.ShapeType.Sphere.value:
        box = shape.bbox()
        return 2 / max(float(box.max.x - box.min.x), 1e-30), 0.0
    if shape.shape_type() == mi.ShapeType.Cylinder.value:
        to_world = own_parameters(shape)["to_world"]
        across = dr.norm(mi.Vector3f(to_world @ mi.Vector3f(1, 0, 0)))
        inverse = 1 / max(float(dr.slice(across)), 1e-30)
        return inverse, inverse
    return 0.0, 0.0


def surface_anchor(si, ray, quadrics: Quadrics) -> Anchor:
    """Anchor of the hit ``si`` that ``ray`` found."""
    offset = rounding_offset(si.p, ray.o, si.t)
    offset += (QUADRIC_ULPS * 2.0**-24) * dr.square(si.t) * quadrics.starts(si.shape, si.is_valid())
    curvature = quadrics.ends(si.shape, si.is_valid())
    return Anchor(mi.Point3f(si.p), mi.Normal3f(si.n), offset, curvature)


def sampled_anchor(p, n, reference, curvature) -> Anchor:
    """Anchor of a point sampled on a surface, to be joined with the point ``reference``."""
    offset = rounding_offset(p, reference, dr.norm(p - reference))
    return Anchor(mi.Point3f(p), mi.Normal3f(n), offset, mi.Float(curvature))


def free_anchor(p) -> Anchor:
    """Anchor of a point without surface: a point light, a pinhole, a point of a lens."""
    return Anchor(mi.Point3f(p), mi.Normal3f(0), mi.Float(0), mi.Float(0))


def spawn(anchor: Anchor, d, like) -> mi.Ray3f:
    """Unbounded ray from ``anchor`` along unit ``d``; time and wavelengths as in ``like``."""
    return mi.Ray3f(anchor.towards(d), d, like.time, like.wavelengths)


def end_point(a: Anchor, b: Anchor):
    """Where a visibility ray from ``a`` to ``b`` ends: just before ``b``'s surface."""
    end = b.towards(a.p - b.p)
    # Known while the kernel is recorded: a scene without spheres and cylinders does none of what follows.
    if b.curvature.state == dr.VarState.Literal and b.curvature[0] == 0:
        return end
    back = a.p - end
    return end + back * dr.minimum(_early(back, b), 0.01)


def _early(back, b: Anchor):
    """The share of a ray's length, against the direction ``back``, in which it may meet the sphere or
    cylinder of its end ``b`` already."""
    dist = dr.norm(back)
    # The error of t grows towards the outline, as 1 / cos.
    cos = dr.maximum(dr.abs(dr.dot(b.n, back)) / dist, LEAST_COSINE)
    return (QUADRIC_ULPS * 2.0**-24) * dist * b.curvature / cos


def segment_to(a: Anchor, end, like) -> mi.Ray3f:
    """Ray from ``a`` to the point ``end``; time and wavelengths as in ``like``."""
    o = a.towards(end - a.p)
    between = end - o
    dist = dr.norm(between)
    return mi.Ray3f(o, between / dist, dist, like.time, like.wavelengths)


def segment(a: Anchor, b: Anchor, like) -> mi.Ray3f:
    """Ray from ``a`` that ends just before ``b``; time and wavelengths as in ``like``."""
    return segment_to(a, end_point(a, b), like)


@dataclass
class Own:
    """The ``shape`` that a visibility ray ends at, and the distance ``t`` from which on it may meet it."""

    shape: object
    t: object


def sight(quadrics: Quadrics, a: Anchor, b: Anchor, shape, like):
    """Ray from ``a`` to ``b`` on ``shape``, and an `Own` for `occluded`: None unless ``quadrics`` are
    small."""
    if not quadrics.small:
        return segment(a, b, like), None
    end = b.towards(a.p - b.p)
    ray = segment_to(a, end, like)
    return ray, Own(shape, ray.maxt * (1 - _early(a.p - end, b)))


def occluded(scene, ray, active, own: Own | None = None):
    """Whether any surface, null surfaces included (as in ``path``), blocks ``ray``; ``own`` is what it ends
    at, where it can be met too early."""
    if own is None:
        return scene.ray_test(ray, active=active)
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    return pi.is_valid() & ~((pi.shape == own.shape) & (pi.t >= own.t))


def intersect_past_emitters(scene, quadrics, ray, active, coherent):
    """First hit along ``ray`` on a shape that does not emit, and the ray that found it.

    This is how ``path`` treats camera rays under ``hide_emitters``.
    """

    def body(ray, pi, active):
        si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)
        onward = mi.Ray3f(ray)
        onward.o = surface_anchor(si, ray, quadrics).towards(ray.d)
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
