"""Bounding boxes of shapes and scenes, also where Mitsuba's own are invalid.

Mitsuba merges rectangles and meshes of one BSDF into a mesh at loading. The ``bbox`` of that mesh and of the
scene lack the rectangles, and are invalid if there is nothing else. A mesh with a non-finite vertex has an
invalid box too, though rays hit its other triangles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import mitsuba as mi
import numpy as np

from ..host.introspection import own_parameters

Found = TypeVar("Found")


def asked_anew(kind: str, find: Callable[[], Found], *shapes) -> Found:
    """Stand-in for `ShapeFacts.about` without a cache."""
    return find()


def box_of(shape: mi.Shape) -> mi.ScalarBoundingBox3f | None:
    """Bounding box of a shape, of a mesh's finite vertices; or None."""
    box = mi.ScalarBoundingBox3f(shape.bbox())
    params = own_parameters(shape) if shape.is_mesh() else {}
    if "vertex_positions" in params:
        vertices = np.array(params["vertex_positions"]).reshape(-1, 3)
        vertices = vertices[np.isfinite(vertices).all(axis=1)]
        box = mi.ScalarBoundingBox3f()
        for corner in (vertices.min(axis=0), vertices.max(axis=0)) if len(vertices) else ():
            box.expand(mi.ScalarPoint3f(corner.tolist()))
    return box if is_finite(box) else None


def known_box(shape: mi.Shape, about: Callable[..., Any]) -> mi.ScalarBoundingBox3f | None:
    """`box_of` a shape, computed once; ``about``: caches facts, see `ShapeFacts.about`."""
    return about("box", partial(box_of, shape), shape)


def scene_box(scene: mi.Scene, about: Callable[..., Any] = asked_anew) -> mi.ScalarBoundingBox3f:
    """Bounding box of a scene, including shapes that Mitsuba leaves out; ``about`` as in `known_box`."""
    whole = mi.ScalarBoundingBox3f(scene.bbox())
    for shape in scene.shapes():
        is_partial = shape.class_name() == "Mesh" or not is_finite(mi.ScalarBoundingBox3f(shape.bbox()))
        if is_partial and (box := known_box(shape, about)) is not None:
            whole.expand(box)
    return whole


def points_in(boxes: Sequence[mi.ScalarBoundingBox3f], which: np.ndarray, u: np.ndarray) -> mi.Point3f:
    """Points in the boxes ``which`` at the positions ``u`` (n, 3) of the unit cube."""
    corners = [[np.array(corner, dtype=np.float64).ravel() for corner in (box.min, box.max)] for box in boxes]
    low, high = np.array(corners)[which].swapaxes(0, 1)
    return mi.Point3f((low + u * (high - low)).T)


def is_finite(box: mi.ScalarBoundingBox3f) -> bool:
    """Whether a box is not empty and has finite corners."""
    return box.valid() and all(map(math.isfinite, (*box.min, *box.max)))
