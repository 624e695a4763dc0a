"""Bounding boxes of shapes and scenes, also where Mitsuba's own are invalid.

Mitsuba merges rectangles and meshes of one BSDF into a mesh when it loads a scene. ``bbox`` of that mesh, and
the scene's, lack the rectangles; it is invalid if there is nothing else. A mesh with a vertex that is not
finite has an invalid box too, though rays meet its other triangles.
"""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi
import numpy as np

from ..host import renamed
from ..host.introspection import own_parameters


def box_of(shape: mi.Shape) -> mi.ScalarBoundingBox3f | None:
    """The bounding box of a shape, of a mesh that of its finite vertices; None if there is none."""
    box = mi.ScalarBoundingBox3f(shape.bbox())
    params = own_parameters(shape) if shape.is_mesh() else {}
    if renamed.holds_a_mesh(params):
        vertices = np.array(renamed.positions(params)).reshape(-1, 3)
        vertices = vertices[np.isfinite(vertices).all(axis=1)]
        box = mi.ScalarBoundingBox3f()
        for corner in (vertices.min(axis=0), vertices.max(axis=0)) if len(vertices) else ():
            box.expand(mi.ScalarPoint3f(corner.tolist()))
    return box if is_finite(box) else None


def boxes(scene: mi.Scene) -> list[mi.ScalarBoundingBox3f]:
    """The bounding boxes of all shapes that have one."""
    found = (box_of(shape) for shape in scene.shapes())
    return [box for box in found if box is not None]


def scene_box(scene: mi.Scene) -> mi.ScalarBoundingBox3f:
    """The bounding box of a scene, those of shapes included that Mitsuba leaves out of its own."""
    whole = mi.ScalarBoundingBox3f(scene.bbox())
    for shape in scene.shapes():
        partial = shape.class_name() == "Mesh" or not is_finite(mi.ScalarBoundingBox3f(shape.bbox()))
        if partial and (box := box_of(shape)) is not None:
            whole.expand(box)
    return whole


def corners(boxes: Sequence[mi.ScalarBoundingBox3f], which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The lower and upper corners (n, 3) of the boxes with the indices ``which``, in double precision."""
    low, high = (
        np.array([np.array(corner, dtype=np.float64).ravel() for corner in of_all])
        for of_all in ([box.min for box in boxes], [box.max for box in boxes])
    )
    return low[which], high[which]


def points_in(boxes: Sequence[mi.ScalarBoundingBox3f], which: np.ndarray, u: np.ndarray) -> mi.Point3f:
    """Points of the boxes with the indices ``which``, at the places ``u`` (n, 3) of the unit cube."""
    low, high = corners(boxes, which)
    return mi.Point3f((low + u * (high - low)).T)


def is_finite(box: mi.ScalarBoundingBox3f) -> bool:
    """Whether there is something in a box, and its corners are finite."""
    return box.valid() and bool(np.isfinite([box.min, box.max]).all())
