"""Shapes that images lack, or whose faces are too close to each other for single precision."""

from __future__ import annotations

import math
from enum import Enum

import mitsuba as mi
import numpy as np

from ..host import renamed
from ..host.introspection import is_instance, own_parameters
from .boxes import box_of
from .quadrics import ROUND
from .rounding import offset_at

# Least share of a thin mesh's area that faces either way: a flat one that is rounded faces one way.
_EITHER = 0.1

_FLAT = (mi.ShapeType.Rectangle.value, mi.ShapeType.Disk.value)


class Flaw(Enum):
    """A flaw of a shape: what it is, what it means for the image, and what to do."""

    NOT_FINITE = (
        "has NaN or infinity in its parameters; rays miss it, or parts of it, and the image is without "
        "them; correct the numbers"
    )
    NO_AREA = (
        "is a point or a line; no ray hits it, and the image is without it; give it a scale or radius that "
        "is not 0"
    )
    THIN = (
        "lets light through and is thinner than the ray offset at its place; a ray that has passed one face "
        "does not meet the other, as if there were none; move the scene to the origin, make the shape "
        "thicker, or replace it by a single surface (thindielectric)"
    )

    @staticmethod
    def of(shape: mi.Shape) -> Flaw | None:
        """Return the flaw of ``shape``, judged by its bounding box, or None."""
        kind, box = shape.shape_type(), shape.bbox()
        extent, offset = _extent(box)
        if extent and extent[0] > offset:
            return None
        if not extent and not _has_finite_vertices(shape):
            return Flaw.NOT_FINITE
        if shape.is_mesh():  # with the rectangles that Mitsuba has merged into it
            box = box_of(shape)
            extent, offset = _extent(box) if box is not None else ([], 0.0)
        if not extent:
            return None
        if extent[1] == 0 or (extent[0] == 0 and kind in ROUND):
            return Flaw.NO_AREA
        thin = extent[0] <= offset and kind not in _FLAT and _lets_through(shape)
        return Flaw.THIN if thin and _has_two_faces(shape) else None


def _extent(box) -> tuple[list[float], float]:
    """Extents of a box, the least first (none if it is not finite), and the ray offset at its corners."""
    low, high = list(box.min), list(box.max)
    extent = sorted(b - a for a, b in zip(low, high, strict=True))
    if not (math.isfinite(sum(extent)) and extent[0] >= 0):
        return [], 0.0
    return extent, offset_at(max(map(abs, low + high)))


def _has_finite_vertices(shape: mi.Shape) -> bool:
    params = own_parameters(shape) if shape.is_mesh() else {}
    return renamed.holds_a_mesh(params) and bool(np.isfinite(np.array(renamed.positions(params))).all())


def _lets_through(shape: mi.Shape) -> bool:
    bsdf = None if is_instance(shape) else shape.bsdf()
    flags = mi.BSDFFlags.Transmission, mi.BSDFFlags.Null
    return bsdf is not None and any(mi.has_flag(bsdf.flags(), flag) for flag in flags)


def _has_two_faces(shape: mi.Shape) -> bool:
    """Whether a thin shape has faces towards both sides; meshes may be flat, but for rounding."""
    if not shape.is_mesh():
        return True
    params = own_parameters(shape)
    p = np.array(renamed.positions(params), dtype=np.float64).reshape(-1, 3)
    faces = np.array(renamed.faces(params)).reshape(-1, 3)
    a, b, c = (p[corners] for corners in faces[(faces < len(p)).all(axis=1)].T)
    n = np.cross(b - a, c - a)[:, np.ptp(p, axis=0).argmin()]
    return bool(min(n.clip(0).sum(), -n.clip(max=0).sum()) > _EITHER * np.abs(n).sum())
