"""Checks of ``to_world`` of emitters, irradiance meters and their shapes.

With some matrices Mitsuba samples other points, normals or densities than its rays find. Environments, spots
and projectors transform directions but keep the densities of the untransformed angles, which a matrix that
distorts angles makes wrong.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..errors import UsageError
from ..host.introspection import inverse_of, is_instance, matrix_of, named, plugin_name

# Relative tolerance, far above single-precision rounding.
_TOLERANCE = 1e-3
# Relative tolerance for shapes that only reflect: a half-turn about (0.71, 0.71, 0), rounded to two figures,
# is off by 0.023.
_OF_REFLECTORS = 0.04

_FLAT = 1e5  # condition number above which a single-precision inverse cannot be judged


def check_to_world(shape, owner: str):
    """Raise ``UsageError`` if Mitsuba samples ``shape`` wrongly with its ``to_world``.

    That is, other points or normals than rays find, or another density than stated: `path` is wrong too.
    ``owner``: the emitter or sensor on the shape. Meshes are right with every matrix.
    """
    check = _CHECKS.get(shape.shape_type())
    if check is None:
        return
    matrix, inverse = matrix_of(shape)[:3, :3], inverse_of(shape)[:3, :3]
    # Non-finite matrices are counted as such.
    reason = check(matrix, inverse) if np.isfinite([matrix, inverse]).all() else None
    if reason is not None:
        kind = shape.class_name().lower()
        raise UsageError(f"{owner} is on a {kind} ({named(shape)}) whose to_world {reason}")


def is_reversed(shape: mi.Shape) -> bool:
    """Whether sampled normals are opposite to those of hits (``si.n``): on mirrored rectangles."""
    is_rectangle = shape.shape_type() == mi.ShapeType.Rectangle.value
    return is_rectangle and bool(np.linalg.det(matrix_of(shape)[:3, :3]) < 0)


def _disk(matrix, inverse):
    """Check that Mitsuba's inverse is right: rays use it, samples the matrix."""
    if np.linalg.det(matrix) == 0:
        return None  # no area: checked elsewhere
    if not _differs(inverse, np.linalg.inv(matrix), _TOLERANCE):
        return None
    return (
        "has another inverse than Mitsuba takes it to have, so that rays find the shape elsewhere than its "
        "sampled points are: rotate about an axis that is not of length 1 makes such a matrix, and shears; "
        "give rotate an axis of length 1"
    )


def _rectangle(matrix, inverse):
    """Check the normal: rays use the corners of a rectangle, its normal the inverse."""
    normal, true = inverse[2], np.cross(matrix[:, 0], matrix[:, 1])
    across = np.linalg.norm(np.cross(normal, true))
    if across <= _TOLERANCE * np.linalg.norm(normal) * np.linalg.norm(true):
        return None
    return (
        "turns its normal out of the right angle to its plane: rotate about an axis that is not of length 1 "
        "does; give rotate an axis of length 1"
    )


def _sphere(matrix, inverse):
    size = np.linalg.norm(matrix[:, 0])
    if np.allclose(matrix.T @ matrix, size**2 * np.eye(3), rtol=0, atol=_TOLERANCE * size**2):
        return None
    return (
        f"stretches or shears it (the lengths of its columns are {_lengths(matrix)}): Mitsuba finds a sphere "
        "and samples an ellipsoid; use one scale, give rotate an axis of length 1, or use a mesh"
    )


def _cylinder(matrix, inverse):
    if np.linalg.det(matrix) < 0:
        return (
            "mirrors it, which turns the normals of half of Mitsuba's calls, so that one lets the light out "
            "and the other in; leave out the negative scale (flip_normals turns normals)"
        )
    lengths = np.linalg.norm(matrix, axis=0)
    angles = matrix.T @ matrix - np.diag(lengths**2)
    round_ = abs(lengths[0] - lengths[1]) <= _TOLERANCE * lengths[0]
    if round_ and np.all(np.abs(angles) <= _TOLERANCE * np.outer(lengths, lengths)):
        return None
    return (
        f"squashes or shears it (the lengths of its columns are {_lengths(matrix)}): Mitsuba takes its "
        "points to be evenly spread and its area to be that of a round one; give rotate an axis of length 1, "
        "and x and y the same scale, or use a mesh"
    )


def check_inverse(shape: mi.Shape):
    """Raise ``UsageError`` if points, normals and rays of ``shape`` disagree.

    Mitsuba takes ``rotate`` about an axis of length other than 1 for a rotation, with a wrong inverse, and
    uses the matrix for some and the inverse for others on cylinders, ``sdfgrid`` and instances. Path tracing
    is unaffected, but densities per area would be of another surface.
    """
    if not is_instance(shape) and shape.shape_type() not in _USES_BOTH:
        return
    matrix, inverse = matrix_of(shape)[:3, :3], inverse_of(shape)[:3, :3]
    if not np.isfinite([matrix, inverse]).all() or np.linalg.cond(matrix) > _FLAT:
        return  # counted as non-finite, or with hardly any area
    if _differs(inverse, np.linalg.inv(matrix), _OF_REFLECTORS):
        kind = shape.class_name().lower()
        raise UsageError(
            f"to_world of {kind} {named(shape)} has another inverse than Mitsuba takes it to have, so that "
            "its points, normals and rays are of different surfaces: rotate about an axis that is not of "
            "length 1 makes such a matrix; give rotate an axis of length 1"
        )


def _differs(inverse, true, tolerance: float) -> bool:
    return bool(np.any(np.linalg.norm(inverse - true, axis=1) > tolerance * np.linalg.norm(true, axis=1)))


def check_rotation(emitter: mi.Emitter):
    """Raise ``UsageError`` unless the ``to_world`` of an environment is a rotation."""
    columns = matrix_of(emitter)[:3, :3]
    if not np.allclose(columns.T @ columns, np.eye(3), atol=1e-3):
        raise UsageError(
            f"to_world of {plugin_name(emitter)} {named(emitter)} is not a rotation (the lengths of its "
            f"columns are {_lengths(columns)}); leave out scaling, and give rotate an axis of length 1"
        )


def check_angles(emitter: mi.Emitter):
    """Raise ``UsageError`` unless ``to_world`` of a projector or spot keeps angles (up to scale)."""
    columns = matrix_of(emitter)[:3, :3]
    scale = np.linalg.norm(columns, axis=0).mean()
    with np.errstate(invalid="ignore"):  # non-finite is not close
        keeps = np.allclose(columns.T @ columns, np.eye(3) * scale**2, rtol=0, atol=1e-3 * scale**2)
    if not keeps:
        plugin = plugin_name(emitter)
        angle = {"projector": "fov", "spot": "cutoff_angle"}[plugin]
        raise UsageError(
            f"to_world of {plugin} {named(emitter)} distorts angles (the lengths of its columns are "
            f"{_lengths(columns)}); leave out scaling and shear, and set {angle} instead"
        )


def _lengths(matrix) -> str:
    return ", ".join(f"{x:.4g}" for x in np.linalg.norm(matrix, axis=0))


# Shapes that use both matrix and inverse for points, normals and rays. (Disks and spheres, if they only
# reflect, use the inverse alone, rectangles their corners, and meshes keep no matrix.)
_USES_BOTH = {mi.ShapeType.Cylinder.value, mi.ShapeType.SDFGrid.value}

_CHECKS = {
    mi.ShapeType.Rectangle.value: _rectangle,
    mi.ShapeType.Disk.value: _disk,
    mi.ShapeType.Sphere.value: _sphere,
    mi.ShapeType.Cylinder.value: _cylinder,
}
