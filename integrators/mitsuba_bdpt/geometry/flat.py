"""Detects shapes with a single normal."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..host import renamed
from ..host.introspection import own_parameters

# Largest 1 - cos between unit normals that count as one; rounding of vertices causes about 1e-14.
_SAME = 1e-10


def is_flat(shape: mi.Shape) -> bool:
    """Whether a shape has one normal, shading normals included; false if unknown."""
    if shape.shape_type() in (mi.ShapeType.Rectangle.value, mi.ShapeType.Disk.value):
        return True
    if shape.shape_type() != mi.ShapeType.Mesh.value:
        return False
    # By parameters: a shape that Python first met as an emitter's has no mesh methods.
    params = own_parameters(shape)
    faces = np.array(renamed.faces(params), dtype=np.int64).reshape(-1, 3)
    vertices, normals = (
        np.array(of(params), dtype=float).reshape(-1, 3) for of in (renamed.positions, renamed.normals)
    )
    if not len(faces) or faces.max() >= len(vertices):
        return False
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return _are_one(np.cross(b - a, c - a)) and (not len(normals) or _are_one(normals[faces].reshape(-1, 3)))


def _are_one(normals: np.ndarray) -> bool:
    length = np.linalg.norm(normals, axis=1)
    if not (length > 0).any():
        return False
    unit = normals[length > 0] / length[length > 0, None]
    return bool((unit @ unit[0] > 1 - _SAME).all())
