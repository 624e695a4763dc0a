"""Shapes that images lack, or whose faces are too close to each other for single precision."""

from __future__ import annotations

import math
from enum import Enum

import mitsuba as mi
import numpy as np

from ..host.introspection import is_instance, own_parameters
from .boxes import box_of
from .quadrics import ROUND
from .rounding import offset_at

# Most triangles of a mesh that are inspected; share of rims above which it is one of panes (2/3 in a box).
_INSPECTED, _RIMS = 1 << 16, 0.25

_SLENDER = 1 / 16  # largest ratio of the edges of a rim's triangle, the shortest over the next

_FLAT = (mi.ShapeType.Rectangle.value, mi.ShapeType.Disk.value)


class Flaw(Enum):
    """What a flaw of a shape is, what it means for the image, and what to do."""

    NOT_FINITE = (
        "has NaN or infinity in its parameters; rays miss it, or parts of it, and the image is without "
        "them; correct the numbers"
    )
    NO_AREA = (
        "is a point or a line; no ray hits it, and the image is without it; give it a scale or radius that "
        "is not 0"
    )
    THIN = (
        "lets light through and is thinner than single precision resolves at its distance from the origin; "
        "rays miss its second face, so light through it is wrong; move the scene to the origin, make the "
        "shape thicker, or replace it by a single surface (thindielectric)"
    )

    @staticmethod
    def of(shape: mi.Shape) -> Flaw | None:
        """Return the flaw of ``shape``, judged by its bounding box and the edges of meshes, or None."""
        extent, offset = _extent(shape.bbox())
        if not extent and not _has_finite_vertices(shape):
            return Flaw.NOT_FINITE
        if shape.is_mesh() and not (extent and extent[1]):  # without the rectangles that Mitsuba has merged
            box = box_of(shape)
            extent, offset = _extent(box) if box is not None else ([], 0.0)
        if not extent:
            return None
        kind = shape.shape_type()
        if extent[1] == 0 or (extent[0] == 0 and kind in ROUND):
            return Flaw.NO_AREA
        if kind in _FLAT or not lets_through(shape):
            return None
        is_within = extent[0] <= offset and (not shape.is_mesh() or extent[0] > offset / 8)  # flat ones round
        return Flaw.THIN if is_within or (shape.is_mesh() and _is_thin_mesh(shape)) else None


def _extent(box) -> tuple[list[float], float]:
    """Extents of a box, the least first (none if it is not finite), and the ray offset at its corners."""
    low, high = list(box.min), list(box.max)
    extent = sorted(b - a for a, b in zip(low, high, strict=True))
    if not (math.isfinite(sum(extent)) and extent[0] >= 0):
        return [], 0.0
    return extent, offset_at(max(map(abs, low + high)))


def _has_finite_vertices(shape: mi.Shape) -> bool:
    params = own_parameters(shape) if shape.is_mesh() else {}
    return "vertex_positions" in params and bool(np.isfinite(np.array(params["vertex_positions"])).all())


def lets_through(shape: mi.Shape) -> bool:
    """Whether the BSDF of a shape transmits light; not of instances."""
    bsdf = None if is_instance(shape) else shape.bsdf()
    flags = mi.BSDFFlags.Transmission, mi.BSDFFlags.Null
    return bsdf is not None and any(mi.has_flag(bsdf.flags(), flag) for flag in flags)


def _is_thin_mesh(shape: mi.Shape) -> bool:
    """Whether many triangles are slender with an edge within the ray offset, as the rims of panes."""
    params = own_parameters(shape)
    p = np.array(params["vertex_positions"]).reshape(-1, 3)
    faces = np.array(params["faces"]).reshape(-1, 3)
    faces = faces[:: len(faces) // _INSPECTED + 1]
    corners = p[faces[(faces < len(p)).all(axis=1)]].astype(np.float64)
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    edge, other, _ = np.sort(edges, axis=1).T
    thin = (edge > 0) & (edge <= offset_at(np.abs(corners).max(axis=(1, 2)))) & (edge <= _SLENDER * other)
    return thin.sum() > _RIMS * len(thin)
