"""Cylinders that emit or measure, where Mitsuba's own calls are wrong about them."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from .objects import matrix_of


def check_not_mirrored(shape, owner: str):
    """Raise ``ValueError`` if ``shape``, on which ``owner`` is, is a cylinder that its ``to_world`` mirrors:
    the normals of the points that Mitsuba samples on it are opposite to those that rays find, so that one
    call lets the light out and the other in."""
    if shape.shape_type() != mi.ShapeType.Cylinder.value:
        return
    if np.linalg.det(matrix_of(shape)[:3, :3]) < 0:
        raise ValueError(
            f"bdpt: {owner} is on a cylinder ('{shape.id()}') whose to_world mirrors it, which turns the "
            "normals of half of Mitsuba's calls; leave out the negative scale (flip_normals turns normals)"
        )
