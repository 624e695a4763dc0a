"""Spheres and cylinders: their curvature and sides, and spheres that emit or measure.

Where Mitsuba's own calls are wrong about spheres, what stands here repeats the choice that its samplers make;
`mitsubas_choices` says which tests show that it does.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..host.introspection import matrix_of, number

# Square of the sine of the half angle of cones below which `cone_pdf_w` is asked. Above, the rounding of
# the cosine, 2^-24, puts Mitsuba's own density off by 1.2e-4 at most.
NARROW_SIN2 = 1e-3

# As in ``Sphere::sample_direction``: from points up to the radius times 1 + this, a sphere is sampled by
# area, as from inside.
RAY_EPSILON = 1500 * 2.0**-24

# Spheres and cylinders, with the height of their middle in their own coordinates.
ROUND = {mi.ShapeType.Sphere.value: 0.0, mi.ShapeType.Cylinder.value: 0.5}


@dataclass
class Sphere:
    """A sphere: ``center``, ``radius``, and ``outward``, 1 or -1, whether its normals point outwards.

    ``turned``: Mitsuba's ``sample_position`` rotates the point, but not its normal (and
    ``eval_parameterization``, by which it samples a texture, does not rotate the point).
    """

    center: mi.ScalarPoint3f
    radius: float
    outward: float
    turned: bool

    @property
    def inner_radius(self) -> float:
        """Distance from the center up to which Mitsuba samples the sphere by area, as from inside.

        0 for one whose normals point outwards: from its inside it lights nothing. (Its ``pdf_direction``
        knows nothing of `RAY_EPSILON`.)
        """
        return self.radius * (1 + RAY_EPSILON) if self.outward < 0 else 0.0

    @staticmethod
    def of(shape: mi.Shape) -> Sphere | None:
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


def may_light_itself(shape: mi.Shape, sphere: Sphere | None) -> bool:
    """Whether ``shape``, which is this ``sphere`` or none, shines outwards and lets light through.

    No point of it lights another, but rounding puts some outside, and Mitsuba samples the cone from there
    into the sphere.
    """
    if sphere is None or sphere.outward < 0:
        return False
    flags = shape.bsdf().flags()
    through = (mi.BSDFFlags.DiffuseTransmission, mi.BSDFFlags.GlossyTransmission)
    return any(mi.has_flag(flags, flag) for flag in through)


def is_small(sphere: Sphere, extent: float) -> bool:
    """Whether a sphere may be narrow (`NARROW_SIN2`) as seen from a point at most ``extent`` away."""
    # Not `<`: the extent of a scene with a vertex at infinity is NaN.
    return sphere.outward > 0 and not sphere.radius**2 >= NARROW_SIN2 * extent**2


def cone_pdf_w(center, radius, p):
    """Density (solid angle) of a uniform direction in the narrow cone from ``p`` to a sphere.

    0 where the cone is not narrow (`NARROW_SIN2`) or ``radius`` is 0.

    Mitsuba has 1 / (2 pi (1 - cos)) for it, which cancels: off by up to 0.4 % where the distance is 200 times
    the radius, 5.8 % at 800, by factors of 2 to 4 from 4096 times on, infinite from 5793 = 2^12.5 times on. 1
    - cos = sin^2 / (1 + cos) does not.
    """
    sin_2 = dr.square(radius) / dr.squared_norm(p - center)
    narrow = (sin_2 > 0) & (sin_2 < NARROW_SIN2)
    return dr.select(narrow, (1 + dr.sqrt(1 - sin_2)) / (dr.two_pi * sin_2), 0)


def outward_sign(shape: mi.Shape, matrix: np.ndarray) -> float:
    """1 if the normals of a sphere or cylinder point outwards, else -1: of a hit from its middle."""
    middle = matrix[:3] @ [0, 0, ROUND[shape.shape_type()], 1]
    radius = float(np.linalg.norm(matrix[:3, 0]))
    pi = dr.zeros(mi.PreliminaryIntersection3f)
    pi.t, pi.shape = dr.opaque(mi.Float, radius), mi.ShapePtr(shape)
    d = dr.opaque(mi.Vector3f, (matrix[:3, 0] / radius).tolist())
    si = shape.compute_surface_interaction(mi.Ray3f(dr.opaque(mi.Point3f, middle.tolist()), d), pi)
    return 1.0 if number(dr.dot(si.n, d)) >= 0 else -1.0
