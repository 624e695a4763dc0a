"""The one place where rays start.

Mitsuba offsets ray origins by 8.9e-5 (1 + max|p|), which swallows small scenes whole and leaves
gaps in large ones. Here the offset along the geometric normal follows from the rounding error of
the hit itself: ``OFFSET_ULPS * 2^-24 * max(|p|, |o|, t, reach)`` with maximum norms, where ``o`` and ``t``
belong to the ray that found ``p``, and ``reach`` is how far the numbers go that hits on its shape are
computed from (`reach_of`). It scales with the scene. Visibility rays end short of their
target by the target's own offset, not by a fraction of the distance. Towards spheres and cylinders they
have to end earlier; where these are so small that this would pass by what stands before them, the ray asks
which shape it meets first (`sight`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .objects import children, number, own_parameters

# Measured: from 21 on, no hit on any of Mitsuba's shapes finds its own start (4 fails on up to 1 % of hits on
# cylinders), whether they are as large as the distances to them or 10^6 times larger.
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


def rounding_offset(p, o, t, reach):
    """Offset that clears the rounding error of a hit ``p`` found from ``o`` at distance ``t``, on a shape of
    this ``reach``."""
    magnitude = dr.maximum(dr.max(dr.abs(p)), dr.max(dr.abs(o)))
    return (OFFSET_ULPS * 2.0**-24) * dr.maximum(dr.maximum(magnitude, t), reach)


@dataclass
class Errors:
    """What rounding does to hits on a shape: ``ends``, the curvature 1 / radius on spheres and cylinders,
    which visibility rays that end there meet too early; ``starts``, the same of cylinders alone (hits on
    spheres are moved to their surface); ``reach``, see `reach_of`."""

    ends: object
    starts: object
    reach: object


class ShapeErrors:
    """`Errors` of the scene's shapes, by pointer. ``any``: one of them is a sphere or cylinder; ``small``:
    one of these is so small that rays ask what they meet, see `SMALL`."""

    def __init__(self, scene):
        shapes = scene.shapes()
        grouped = [_curvatures(s) for group in groups(scene) for s in children(group).values()]
        # An instance does not tell of which group it is: it has the largest curvatures of all of them.
        within = tuple(max((row[i] for row in grouped), default=0.0) for i in (0, 1))
        rows = [Errors(*_curvatures(s, within), reach_of(s)) for s in shapes]
        self.any = any(row.ends for row in rows)
        extent = 2 * scene.bbox().bounding_sphere().radius if self.any else 0
        # Not `>`: the extent may be NaN.
        self.small = any(row.ends and not row.ends * extent <= SMALL for row in rows)
        ids = dr.reinterpret_array(mi.UInt32, scene.shapes_dr()).numpy().tolist()
        self._size = max(ids, default=0) + 1
        table = [Errors(0.0, 0.0, 0.0)] * self._size
        for index, row in zip(ids, rows, strict=True):
            table[index] = row
        self._table = Errors(*(mi.Float([getattr(row, n) for row in table]) for n in vars(table[0])))
        dr.make_opaque(self._table)

    def at(self, shape, active=True, instance=None) -> Errors:
        """The `Errors` of hits on ``shape``, or on the ``instance`` in which it was met."""
        index = dr.reinterpret_array(mi.UInt32, shape)
        if instance is not None:
            met = dr.reinterpret_array(mi.UInt32, instance)
            index = dr.select(met != 0, met, index)
        known = mi.Bool(active) & (index < self._size)
        found = Errors(mi.Float(0), mi.Float(0), dr.gather(mi.Float, self._table.reach, index, known))
        if self.any:  # else nothing of what follows from curvatures is recorded
            found.ends = dr.gather(mi.Float, self._table.ends, index, known)
            found.starts = dr.gather(mi.Float, self._table.starts, index, known)
        return found


def groups(scene) -> list:
    """The scene's shape groups."""
    return [c for c in children(scene).values() if isinstance(c, mi.Shape) and c.class_name() == "ShapeGroup"]


def _curvatures(shape, within=(0.0, 0.0)) -> tuple[float, float]:
    """Columns of `Errors`; ``within``: those of the shapes in groups."""
    if shape.shape_type() == mi.ShapeType.Sphere.value:
        box = shape.bbox()
        return 2 / max(float(box.max.x - box.min.x), 1e-30), 0.0
    if shape.shape_type() == mi.ShapeType.Cylinder.value:
        to_world = own_parameters(shape)["to_world"]
        across = dr.norm(mi.Vector3f(to_world @ mi.Vector3f(1, 0, 0)))
        inverse = 1 / max(float(dr.slice(across)), 1e-30)
        return inverse, inverse
    if shape.class_name() == "Instance" and any(within):
        scale = np.linalg.norm(_matrix(shape)[:3, :3], axis=0).min()
        return tuple(inverse / max(scale, 1e-30) for inverse in within)
    return 0.0, 0.0


def _matrix(shape) -> np.ndarray:
    return np.array(own_parameters(shape)["to_world"].matrix, dtype=np.float64).reshape(4, 4)


def reach_of(shape) -> float:
    """Magnitude of the coordinates that hits on a shape are computed from, beyond that of the hits: corners
    of rectangles, centers and radii of spheres and cylinders, vertices of a triangle (of a mesh the longest
    finite edge, from any point of the triangle), coordinates within an instance. 0 for others: disks, curves
    and grids are as exact near by as far away."""
    if shape.class_name() == "Instance":
        return _reach_within(shape)
    if shape.shape_type() in _WHOLE:
        return _largest(shape.bbox())
    params = own_parameters(shape) if shape.is_mesh() else {}
    if "vertex_positions" not in params or not len(params["faces"]):
        return 0.0
    p = dr.unravel(mi.Point3f, mi.Float(params["vertex_positions"]))
    faces = dr.unravel(mi.Vector3u, mi.UInt32(params["faces"]))
    a, b, c = (dr.gather(mi.Point3f, p, index) for index in faces)
    edges = dr.max(dr.maximum(dr.maximum(dr.abs(a - b), dr.abs(b - c)), dr.abs(c - a)))
    return number(dr.max(dr.select(dr.isfinite(dr.sum(a + b + c)), edges, 0)))


_WHOLE = {kind.value for kind in (mi.ShapeType.Rectangle, mi.ShapeType.Sphere, mi.ShapeType.Cylinder)}


def _largest(box) -> float:
    return _finite(np.abs([box.min, box.max]).max())


def _finite(x) -> float:
    """0 for a shape without a size, which is somebody else's business."""
    return float(x) if np.isfinite(x) else 0.0


def _reach_within(instance) -> float:
    matrix, box = _matrix(instance), instance.bbox()
    corners = np.array([[x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
    low, high = np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)
    corners[:, :3] = low + corners[:, :3] * (high - low)
    if not (np.isfinite(corners).all() and abs(np.linalg.det(matrix[:3, :3])) > 0):
        return 0.0
    local = np.abs(corners @ np.linalg.inv(matrix).T)[:, :3].max()
    scale = np.linalg.norm(matrix[:3, :3], axis=0).max()
    return _finite(max(local * scale, np.abs(matrix[:3, 3]).max()))


def surface_anchor(si, ray, shape_errors: ShapeErrors) -> Anchor:
    """Anchor of the hit ``si`` that ``ray`` found."""
    errors = shape_errors.at(si.shape, si.is_valid(), si.instance)
    offset = rounding_offset(si.p, ray.o, si.t, errors.reach)
    offset += (QUADRIC_ULPS * 2.0**-24) * dr.square(si.t) * errors.starts
    return Anchor(mi.Point3f(si.p), mi.Normal3f(si.n), offset, errors.ends)


def sampled_anchor(p, n, reference, errors: Errors | None) -> Anchor:
    """Anchor of a point sampled on a shape of these ``errors``, None off shapes, to be joined with the point
    ``reference``."""
    offset = rounding_offset(p, reference, dr.norm(p - reference), errors.reach if errors else 0)
    return Anchor(mi.Point3f(p), mi.Normal3f(n), offset, mi.Float(errors.ends if errors else 0))


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


def sight(shape_errors: ShapeErrors, a: Anchor, b: Anchor, shape, like):
    """Ray from ``a`` to ``b`` on ``shape``, and an `Own` for `occluded`: None unless ``shape_errors`` are
    small."""
    if not shape_errors.small:
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


def intersect_past_emitters(scene, shape_errors, ray, active, coherent):
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
