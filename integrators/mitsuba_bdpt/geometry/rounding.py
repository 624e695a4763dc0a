"""Rounding errors of hits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from ..host.introspection import grouped_shapes, is_instance, matrix_of, own_parameters
from .boxes import asked_anew, scene_box
from .quadrics import ROUND, outward_sign

# Ray offset in ulps, so that no hit finds its own start (this and the next: experiments, section Rounding).
OFFSET_ULPS = 32

# Bound of the error of t on spheres and cylinders, in units of 2^-24 t^2 / radius.
QUADRIC_ULPS = 8

# Cosine at a sphere's point below which that error is taken not to grow (1 % of the points seen from afar).
LEAST_COSINE = 0.1

# Diameter of a scene in radii of its smallest sphere or cylinder, above which shadow rays test what they hit:
# they would end more than two radii early (2 LEAST_COSINE / (QUADRIC_ULPS 2^-24) = 650^2).
SMALL = 650

# Distance in radii of a sphere or cylinder above which rays to its back would end before its front: the chord
# is 2 LEAST_COSINE radii (2 LEAST_COSINE^2 / (QUADRIC_ULPS 2^-24) = 205^2).
FAR = 200


def rounding_offset(p, o, t, reach):
    """Offset that covers the rounding error of a hit ``p`` found from ``o`` at ``t``."""
    magnitude = dr.maximum(dr.max(dr.abs(p)), dr.max(dr.abs(o)))
    return offset_at(dr.maximum(dr.maximum(magnitude, t), reach))


def offset_at(magnitude):
    """Offset that covers the rounding error of a hit computed from such numbers."""
    return (OFFSET_ULPS * 2.0**-24) * magnitude


@dataclass
class Errors:
    """Rounding errors of hits on a shape.

    ``ends``: curvature 1 / radius of spheres and cylinders (negative if normals point inwards, where needed,
    see `FAR`); ``starts``: the same for shapes whose hits lie off their surface, cylinders and all round
    shapes within instances; ``reach``: largest of `reaches`.
    """

    ends: mi.Float | float
    starts: mi.Float | float
    reach: mi.Float | float


class ShapeErrors:
    """`Errors` of the scene's shapes, by pointer; ``about`` caches facts, see `ShapeFacts.about`.

    ``any``: one of them is a sphere or cylinder, or an instance of a group with one; ``small``: one of these
    is so small that shadow rays test what they hit, see `SMALL`.
    """

    def __init__(self, scene: mi.Scene, about: Callable = asked_anew):
        shapes = scene.shapes()
        extent = 2 * scene_box(scene, about).bounding_sphere().radius
        with np.errstate(all="ignore"):  # non-finite values are checked elsewhere
            # An instance does not expose its group: it gets the largest curvature of all groups.
            within = (_curvatures(s, 0.0, np.inf)[0] for s in grouped_shapes(scene))
            grouped = max(within, key=abs, default=0.0)
            rows = [Errors(*_curvatures(s, grouped, extent), 0.0) for s in shapes]
            all_reaches = [about("reaches", partial(reaches, s), s) for s in shapes]
        self.any = any(row.ends for row in rows)
        # Not `>`: the extent may be NaN.
        self.small = any(row.ends and not abs(row.ends) * extent <= SMALL for row in rows)
        ids = dr.reinterpret_array(mi.UInt32, scene.shapes_dr()).numpy().tolist()
        self._size = max(ids, default=0) + 1
        table, first = [Errors(0.0, 0.0, 0.0)] * self._size, [0] * self._size
        triangles, count = [np.zeros(1)], 1  # entry 0: shapes without triangles
        for index, row, reach in zip(ids, rows, all_reaches, strict=True):
            row.reach = float(reach.max(initial=0))
            if len(reach) > 1 and reach.min() < row.reach:
                first[index], count = count, count + len(reach)
                triangles.append(reach)
            table[index] = row
        self._table = Errors(*(mi.Float([getattr(row, n) for row in table]) for n in vars(table[0])))
        self._triangles = None
        if len(triangles) > 1:
            self._triangles = mi.UInt32(first), mi.Float(np.concatenate(triangles).astype(np.float32))
        dr.make_opaque(self._table, self._triangles)

    def at(self, shape, active=True, instance=None, triangle=None) -> Errors:
        """`Errors` of hits on ``shape`` or ``instance``; on one ``triangle`` if given."""
        index = met(shape, instance)
        known = mi.Bool(active) & (index < self._size)
        found = Errors(mi.Float(0), mi.Float(0), dr.gather(mi.Float, self._table.reach, index, known))
        if triangle is not None and self._triangles is not None:
            first, reach = self._triangles
            place = dr.gather(mi.UInt32, first, index, known)
            apart = known & (place > 0)
            found.reach = dr.select(apart, dr.gather(mi.Float, reach, place + triangle, apart), found.reach)
        if self.any:  # else nothing that depends on curvature is recorded
            found.ends = dr.gather(mi.Float, self._table.ends, index, known)
            found.starts = dr.gather(mi.Float, self._table.starts, index, known)
        return found


def met(shape, instance=None):
    """Index of the ``instance`` that a ray meets, or else of the ``shape``."""
    index = dr.reinterpret_array(mi.UInt32, shape)
    if instance is None:
        return index
    instance = dr.reinterpret_array(mi.UInt32, instance)
    return dr.select(instance != 0, instance, index)


def _curvatures(shape, grouped, extent) -> tuple[float, float]:
    """``ends`` and ``starts`` of `Errors`; ``grouped``: largest ``ends`` in groups."""
    kind = shape.shape_type()
    if kind in ROUND:
        matrix = matrix_of(shape)
        # Across the axis of a cylinder; any axis of a sphere.
        inverse = 1 / max(float(np.linalg.norm(matrix[:3, 0])), 1e-30)
        far = not inverse * extent <= FAR  # the extent may be NaN
        sign = outward_sign(shape, matrix) if far else 1.0
        return sign * inverse, inverse if kind == mi.ShapeType.Cylinder.value else 0.0
    if is_instance(shape):
        within = grouped / max(_stretch(shape)[-1], 1e-30)
        return within, abs(within)
    return 0.0, 0.0


def _stretch(shape) -> np.ndarray:
    """Singular values of ``to_world``, largest first; zeros if it is not finite."""
    linear = matrix_of(shape)[:3, :3]
    return np.linalg.svd(linear, compute_uv=False) if np.isfinite(linear).all() else np.zeros(3)


def reaches(shape: mi.Shape) -> np.ndarray:
    """Magnitude of the coordinates, beyond a hit's, that hits on a shape are computed from.

    One number, or one per triangle of a mesh (one for an ``ellipsoidsmesh``). Coordinates whose rounding
    moves hits within the surface do not count: corners of rectangles and edges of triangles are weighted by
    |n_i| / max |n|, so that an axis-aligned floor has 0 (with CUDA they all count: experiments, "CUDA"). For
    spheres, cylinders and grids all count, for instances all of their shapes. 0 for disks and curves, whose
    accuracy does not depend on their size.
    """
    kind = shape.shape_type()
    if is_instance(shape):
        return np.array([_reach_within(shape)])
    if kind == mi.ShapeType.Rectangle.value:
        matrix = matrix_of(shape)
        corner = np.abs(matrix[:3, 3]) + np.abs(matrix[:3, :2]).sum(1)
        n = np.abs(np.cross(matrix[:3, 0], matrix[:3, 1]))
        weights = n / n.max() if _uses_embree() else 1
        return np.array([_finite((weights * corner).max())])
    if kind in _WHOLE:
        return np.array([_finite(np.abs([shape.bbox().min, shape.bbox().max]).max())])
    params = own_parameters(shape) if shape.is_mesh() else {}
    if "vertex_positions" not in params or not len(params["faces"]):
        return np.zeros(1)
    found = _reaches_of_triangles(params["vertex_positions"], params["faces"])
    # Hits on ellipsoids report the index of the ellipsoid, not of the triangle.
    return found.max(keepdims=True) if kind == mi.ShapeType.EllipsoidsMesh.value else found


def _uses_embree() -> bool:
    """Whether Embree intersects rays; OptiX blocks rays that leave large axis-aligned floors."""
    return dr.backend_v(mi.Float) == dr.JitBackend.LLVM


_WHOLE = {*ROUND, mi.ShapeType.SDFGrid.value}


def _reaches_of_triangles(positions, faces) -> np.ndarray:
    p = dr.unravel(mi.Point3f, mi.Float(positions))
    faces = dr.unravel(mi.Vector3u, mi.UInt32(faces))
    # Faces may refer to vertices that do not exist.
    known = dr.all(faces < dr.width(p))
    a, b, c = (dr.gather(mi.Point3f, p, index, known) for index in faces)
    edges = dr.maximum(dr.maximum(dr.abs(a - b), dr.abs(b - c)), dr.abs(c - a))
    n = dr.abs(dr.cross(b - a, c - a))
    found = dr.max(n / dr.max(n) * edges) if _uses_embree() else dr.max(edges)
    return dr.select(dr.isfinite(found), found, 0).numpy().astype(np.float64)


def _finite(x) -> float:
    return float(x) if np.isfinite(x) else 0.0


def _reach_within(instance) -> float:
    matrix, box = matrix_of(instance), instance.bbox()
    corners = np.array([[x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
    low, high = np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)
    corners[:, :3] = low + corners[:, :3] * (high - low)
    if not (np.isfinite(corners).all() and abs(np.linalg.det(matrix[:3, :3])) > 0):
        return 0.0
    local = np.abs(corners @ np.linalg.inv(matrix).T)[:, :3].max()
    return _finite(max(local * _stretch(instance)[0], np.abs(matrix[:3, 3]).max()))
