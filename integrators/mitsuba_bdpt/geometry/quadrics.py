"""Spheres that emit or measure, where Mitsuba's own calls are wrong about them."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..host.introspection import matrix_of, number

# Square of the sine of the half angle of cones below which `cone_density` is asked. Above, the rounding of
# the cosine, 2^-24, puts Mitsuba's own density off by 1.2e-4 at most.
NARROW = 1e-3


@dataclass
class Sphere:
    """A sphere: ``center``, ``radius``, and ``outward``, 1 or -1, whether its normals point outwards.
    ``turned``: Mitsuba's ``sample_position`` rotates the point, but not its normal (and
    ``eval_parameterization``, by which it samples a texture, does not rotate the point)."""

    center: object
    radius: float
    outward: float
    turned: bool

    @staticmethod
    def of(shape) -> Sphere | None:
        """Of a shape of Mitsuba's; None if it is not a sphere."""
        if shape.shape_type() != mi.ShapeType.Sphere.value:
            return None
        matrix = matrix_of(shape)
        radius = float(np.sqrt(number(shape.surface_area()) / (4 * np.pi)))
        # The point may be rounded to the center, and Mitsuba's normal is not turned with it: it is the local
        # one, or its opposite.
        u = mi.Point2f(0.3, 0.2)
        local = dr.dot(shape.sample_position(0, u).n, mi.warp.square_to_uniform_sphere(u))
        off = np.abs(matrix[:3, :3] - radius * np.eye(3)).max()
        turned = not off <= 1e-6 * radius  # also if it is not finite
        outward = 1.0 if number(local) > 0 else -1.0
        return Sphere(mi.ScalarPoint3f(matrix[:3, 3]), radius, outward, turned)


def sphere_normal(p, center, outward):
    """Normal at the point ``p`` of a sphere, see `Sphere`."""
    return mi.Normal3f(dr.normalize(p - center) * outward)


def is_turned_sphere(shape) -> bool:
    """Whether ``shape`` is a sphere that Mitsuba samples wrongly, see `Sphere`."""
    sphere = Sphere.of(shape)
    return sphere is not None and sphere.turned


def may_light_itself(shape) -> bool:
    """Whether ``shape`` is a sphere that shines outwards and lets light through: no point of it lights
    another, but rounding puts some outside, and Mitsuba samples the cone from there into the sphere."""
    flags = shape.bsdf().flags()
    through = (mi.BSDFFlags.DiffuseTransmission, mi.BSDFFlags.GlossyTransmission)
    if not any(mi.has_flag(flags, flag) for flag in through):  # of nearly all lamps: no kernel runs for them
        return False
    sphere = Sphere.of(shape)
    return sphere is not None and sphere.outward > 0


def is_small(sphere: Sphere, extent) -> bool:
    """Whether a sphere may be `NARROW` as seen from a point at most ``extent`` away."""
    # Not `<`: the extent of a scene with a vertex at infinity is NaN.
    return sphere.outward > 0 and not sphere.radius**2 >= NARROW * extent**2


def cone_density(center, radius, p):
    """Density (solid angle) of a uniform direction in the cone from ``p`` to a sphere; 0 where the cone is
    not `NARROW` or ``radius`` is 0.

    Mitsuba has 1 / (2 pi (1 - cos)) for it, which cancels: off by up to 0.4 % where the distance is 200 times
    the radius, 5.8 % at 800, by factors of 2 to 4 from 4096 times on, infinite from 5793 = 2^12.5 times on.
    1 - cos = sin^2 / (1 + cos) does not.
    """
    sin_2 = dr.square(radius) / dr.squared_norm(p - center)
    narrow = (sin_2 > 0) & (sin_2 < NARROW)
    return dr.select(narrow, (1 + dr.sqrt(1 - sin_2)) / (dr.two_pi * sin_2), 0)
