"""Points of disks, spheres and flipped rectangles, sampled by their texture.

Mitsuba samples the texture too, but finds the point by a ray from one unit above the surface: in a small
scene the point is off the surface by more than the ray offsets, or the ray misses a disk at its rim. It also
turns spheres wrongly and ignores ``flip_normals`` of rectangles. Here the point is computed from its texture
coordinates and ``to_world``.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..geometry.quadrics import Sphere, sphere_normal
from ..geometry.shape_facts import ShapeFacts
from ..host.introspection import children, matrix_of
from .tables import Mask, look_up, switch, table

# Half a step of the random numbers; replaces coordinates of 0, where the density is infinite.
_LEAST = 2.0**-25

_KINDS = mi.ShapeType.Rectangle, mi.ShapeType.Disk, mi.ShapeType.Sphere
_RECTANGLE, _DISK, _SPHERE = (float(kind.value) for kind in _KINDS)


@dataclass
class _Map:
    """Map from texture coordinates to a surface.

    ``x``, ``y``, ``z``, ``origin``: columns of ``to_world``; ``n``: normal of a flat shape; ``outward``: see
    `Sphere`; ``area``: of a unit square of a flat shape's own coordinates, or a sphere's squared radius.
    """

    kind: mi.Float | float = _RECTANGLE
    x: mi.Vector3f | tuple = (0, 0, 0)
    y: mi.Vector3f | tuple = (0, 0, 0)
    z: mi.Vector3f | tuple = (0, 0, 0)
    origin: mi.Vector3f | tuple = (0, 0, 0)
    n: mi.Vector3f | tuple = (0, 0, 0)
    outward: mi.Float | float = 0.0
    area: mi.Float | float = 1.0

    @staticmethod
    def of(shape: mi.Shape, sphere: Sphere | None) -> _Map:
        matrix = matrix_of(shape)
        x, y, z, origin = (tuple(column) for column in matrix[:3].T)
        if sphere is not None:
            return _Map(_SPHERE, x, y, z, origin, outward=sphere.outward, area=sphere.radius**2)
        n = tuple(dr.slice(shape.sample_position(0, mi.Point2f(0.5)).n))
        area = float(np.linalg.norm(np.cross(x, y)))
        return _Map(float(shape.shape_type()), x, y, z, origin, n=n, area=area)


class TexturedPoints:
    """The lights among ``emitters`` (see `surfaces.Surfaces`) that ``chosen`` flags."""

    def __init__(self, emitters, spheres, chosen, facts: ShapeFacts):
        self.chosen, self.mask = chosen, Mask(chosen)
        if not self.mask.any:
            return

        def map_of(emitter: mi.Emitter, sphere: Sphere | None) -> _Map:
            shape = emitter.get_shape()
            return facts.about("map", lambda: _Map.of(shape, sphere), shape)

        found = list(zip(emitters, spheres, chosen, strict=True))
        self._textures = [children(e)["radiance"] if c else None for e, _, c in found]
        self._maps = table([map_of(e, s) if c else _Map() for e, s, c in found])

    def sample(self, index, time, u, active):
        """Sample a ``PositionSample3f`` (density over area) of the light ``index``."""
        uv, pdf = switch(self._textures, "sample_position", index, u, active)
        known = look_up(self._maps, index, active)
        a, b, c, stretch = _local(known.kind, uv)
        ps = dr.zeros(mi.PositionSample3f)
        ps.p = mi.Point3f(known.origin + known.x * a + known.y * b + known.z * c)
        round_normal = sphere_normal(ps.p, known.origin, known.outward)
        ps.n = dr.select(known.kind == _SPHERE, round_normal, mi.Normal3f(known.n))
        ps.uv, ps.time = uv, time
        ps.pdf = dr.select(active, pdf / (known.area * stretch), 0)
        return ps

    def pdf_a(self, index, uv, active):
        """Density (area measure) of the point of the light ``index`` at ``uv``."""
        pdf = switch(self._textures, "pdf_position", index, uv, active)
        known = look_up(self._maps, index, active)
        return pdf / (known.area * _local(known.kind, uv)[-1])


def _local(kind, uv):
    """Point at ``uv`` in the shape's own coordinates, and its area per area of ``uv``."""
    disk, sphere = kind == _DISK, kind == _SPHERE
    r = dr.maximum(uv.x, _LEAST)
    sin_phi, cos_phi = dr.sincos(dr.two_pi * dr.select(disk, uv.y, uv.x))
    # From the nearer pole: 1 - v is exact there.
    theta = dr.pi * dr.maximum(dr.minimum(uv.y, 1 - uv.y), _LEAST)
    sin_theta, cos_theta = dr.sincos(theta)
    across = dr.select(disk, r, sin_theta)
    flat = kind == _RECTANGLE
    a = dr.select(flat, 2 * uv.x - 1, across * cos_phi)
    b = dr.select(flat, 2 * uv.y - 1, across * sin_phi)
    c = dr.select(sphere, dr.select(uv.y < 0.5, cos_theta, -cos_theta), 0)
    stretch = dr.select(flat, 4, dr.two_pi * across * dr.select(sphere, dr.pi, 1))
    return a, b, c, stretch


def is_mapped(shape: mi.Shape) -> bool:
    """Whether `TexturedPoints` samples ``shape`` if it is sampled by a texture."""
    return shape.shape_type() != mi.ShapeType.Rectangle.value or shape.has_flipped_normals()
