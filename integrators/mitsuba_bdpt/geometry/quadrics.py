"""Spheres and cylinders: curvature, orientation, emitting and measuring spheres.

Where Mitsuba's calls are wrong about spheres, its samplers' choices are replicated; see `mitsubas_choices`.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..host.introspection import matrix_of, number

# sin^2 of the half angle below which `cone_pdf_w` is used; above, rounding of the cosine (2^-24) changes
# Mitsuba's density by at most 1.2e-4.
NARROW_SIN2 = 1e-3

# As in ``Sphere::sample_direction``, which samples by area from up to radius (1 + RAY_EPSILON).
RAY_EPSILON = 1500 * 2.0**-24

ROUND = {mi.ShapeType.Sphere.value, mi.ShapeType.Cylinder.value}  # spheres and cylinders


@dataclass
class Sphere:
    """A sphere: ``center``, ``radius``, ``outward`` (1 or -1: orientation of normals).

    ``turned``: Mitsuba's ``sample_position`` rotates the point but not its normal (and
    ``eval_parameterization``, which samples a texture, does not rotate the point).
    """

    center: mi.ScalarPoint3f | tuple
    radius: float
    outward: float
    turned: bool

    @property
    def inner_radius(self) -> float:
        """Distance from the center up to which Mitsuba samples by area; 0 if normals point outwards."""
        return self.radius * (1 + RAY_EPSILON) if self.outward < 0 else 0.0

    @staticmethod
    def of(shape: mi.Shape) -> Sphere | None:
        if not is_sphere(shape):
            return None
        matrix = matrix_of(shape)
        radius = float(np.sqrt(number(shape.surface_area()) / (4 * np.pi)))
        off = np.abs(matrix[:3, :3] - radius * np.eye(3)).max()
        turned = not off <= 1e-6 * radius  # also if it is not finite
        return Sphere(mi.ScalarPoint3f(matrix[:3, 3]), radius, outward_sign(shape, matrix), turned)


def is_sphere(shape: mi.Shape) -> bool:
    return shape.shape_type() == mi.ShapeType.Sphere.value


def sphere_normal(p, center, outward):
    return mi.Normal3f(dr.normalize(p - center) * outward)


def may_light_itself(shape: mi.Shape, sphere: Sphere | None) -> bool:
    """Whether a shape emits outwards and transmits: rounding puts some of its points outside it."""
    if sphere is None or sphere.outward < 0:
        return False
    flags = shape.bsdf().flags()
    through = (mi.BSDFFlags.DiffuseTransmission, mi.BSDFFlags.GlossyTransmission)
    return any(mi.has_flag(flags, flag) for flag in through)


def is_small(sphere: Sphere, extent: float) -> bool:
    """Whether a sphere may be narrow (`NARROW_SIN2`) from up to ``extent`` away."""
    # Not `<`: the extent of a scene with a vertex at infinity is NaN.
    return sphere.outward > 0 and not sphere.radius**2 >= NARROW_SIN2 * extent**2


def cone_pdf_w(center, radius, p):
    """Density (solid angle) of a uniform direction in the narrow cone to a sphere.

    0 where the cone from ``p`` is not narrow (`NARROW_SIN2`) or ``radius`` is 0.

    Mitsuba's 1 / (2 pi (1 - cos)) cancels (off by 0.4 % at 200 radii, infinite from 2^12.5 radii on);
    1 - cos = sin^2 / (1 + cos) does not.
    """
    sin_2 = dr.square(radius) / dr.squared_norm(p - center)
    narrow = (sin_2 > 0) & (sin_2 < NARROW_SIN2)
    return dr.select(narrow, (1 + dr.sqrt(1 - sin_2)) / (dr.two_pi * sin_2), 0)


def outward_sign(shape: mi.Shape, matrix: np.ndarray) -> float:
    """1 if hits on a sphere or cylinder have outward normals, else -1."""
    # Mitsuba's flag includes the mirroring of spheres, not of cylinders.
    mirrors = not is_sphere(shape) and bool(np.linalg.det(matrix[:3, :3]) < 0)
    return -1.0 if shape.has_flipped_normals() != mirrors else 1.0
