"""First directions of photon subpaths: half of them are aimed at specular surfaces.

They are uniform in cones about bounding spheres of the shapes with specular lobes (over all directions from
within one). Light from infinity is not aimed: its emission disks cover details (`emitters.disks`). Uniform
environments emit no photons, but for merging: s = 0 samples their light well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ...emitters.disks import BoundingSphere
from ...emitters.emitters import Emitters
from ...emitters.infinite import contrast
from ...emitters.records import Emission
from ...geometry.boxes import box_of
from ...host.introspection import grouped_shapes, is_instance

MOST_SPHERES = 8  # most spheres; a scene with more shapes has one around all of them

# Largest ratio of maximum to mean radiance of an environment that emits no photons: light that s = 0 does not
# find by itself must be brighter. (`budget.EVEN` is of light subpaths, `configuration.UNIFORM` of weights.)
EVEN_SKY = 16

_MARGIN = 1e-3  # relative enlargement of the spheres, for rounding


@dataclass
class Aim:
    """``spheres`` at which photons are aimed; ``no_sky``: the environment emits none."""

    spheres: tuple[BoundingSphere, ...]
    no_sky: bool

    @staticmethod
    def of(scene: mi.Scene, emitters: Emitters, near_specular: Sequence[mi.BSDF] = ()) -> Aim:
        """The aim of a ``scene`` and its ``emitters``; also at shapes with one of these BSDFs."""
        boxes = [] if not emitters.connectible_nearby else _specular_boxes(scene, near_specular)
        if len(boxes) > MOST_SPHERES:
            whole = mi.ScalarBoundingBox3f()
            for box in boxes:
                whole.expand(box)
            boxes = [whole]
        environment = scene.environment()
        no_sky = environment is not None and contrast(environment) <= EVEN_SKY
        return Aim(tuple(BoundingSphere.about(box.bounding_sphere(), _MARGIN) for box in boxes), no_sky)

    def emission(self, emitters: Emitters, u_point, u_direction, shared) -> tuple[Emission, mi.Float]:
        """Sample emissions of photons; also the emitter's own density over the mixture's.

        ``pdf_second`` of the emissions is the emitter's own: weights leave the aim out.
        """
        number = None
        if self.spheres:
            aimed = u_direction.x >= 0.5
            u_x = dr.minimum(2 * u_direction.x - dr.select(aimed, 1, 0), 1 - 2**-24)
            u_direction = mi.Point2f(u_x, u_direction.y)
        e = emitters.sample_emission(u_point, u_direction, shared, mi.Bool(True))
        if self.spheres:
            aimed &= _aimable(e)
            number, d = self._sample(e.si.p, u_direction)
            number = dr.select(aimed, number, len(self.spheres))
            e = _towards(emitters, e, d, aimed)
        mixed = self.density(e, number)
        ratio = dr.select(mixed == 0, 0, e.pdf_second / mixed)
        return replace(e, weight=e.weight * ratio, pdf_second=mixed * ratio), ratio

    def density(self, e: Emission, number: mi.UInt32 | None = None) -> mi.Float:
        """Density of emitting a photon as ``e``, in the measure of its ``pdf_second``.

        ``number``: the sphere for which it was sampled, whose cone contains it in spite of rounding.
        """
        mixed, aimed = e.pdf_second, mi.Float(0)
        for i, sphere in enumerate(self.spheres):
            axis, width = sphere.cone(e.si.p)
            # 1 - cos of the angle between unit vectors, precise also where it is small.
            inside = (width == 2) | (dr.squared_norm(e.d - axis) <= 2 * width)
            if number is not None:
                inside |= number == i
            aimed += dr.select(inside, dr.inv_two_pi / width, 0)
        if self.spheres:
            mixed = dr.select(_aimable(e), (mixed + aimed / len(self.spheres)) / 2, mixed)
        return dr.select(e.infinite & ~e.delta, 0, mixed) if self.no_sky else mixed

    def _sample(self, p, u: mi.Point2f) -> tuple[mi.UInt32, mi.Vector3f]:
        """Sample a direction in one of the cones from ``p``; index of the sphere, direction."""
        scaled = u.x * len(self.spheres)
        number = dr.minimum(mi.UInt32(scaled), len(self.spheres) - 1)
        axis, width = self.spheres[0].cone(p)
        for i, sphere in enumerate(self.spheres[1:]):
            other_axis, other_width = sphere.cone(p)
            axis = dr.select(number == i + 1, other_axis, axis)
            width = dr.select(number == i + 1, other_width, width)
        down = (scaled - mi.Float(number)) * width
        sin = dr.safe_sqrt(down * (2 - down))
        s, c = dr.sincos(dr.two_pi * u.y)
        return number, mi.Frame3f(axis).to_world(mi.Vector3f(sin * c, sin * s, 1 - down))


def _aimable(e: Emission) -> mi.Bool:
    return ~(e.infinite | e.beam)


def _towards(emitters: Emitters, e: Emission, d, active: mi.Bool) -> Emission:
    """``e``, with the direction ``d`` in place of its own where ``active``."""
    to = replace(e, d=d, cos=dr.select(e.delta, 1, dr.abs(dr.dot(e.anchor.n, d))))
    pdf_second = emitters.direction_density(to, e.si.p + d, d, active)
    radiance = emitters.radiance_towards(e, d, active)
    density = e.pdf_first * pdf_second
    black = (density == 0) | ~emitters.traces(e.index, active)
    weight = dr.select(black, 0, radiance * (to.cos / density))
    return dr.select(active, replace(to, pdf_second=pdf_second, weight=weight), e)


def _specular_boxes(scene: mi.Scene, near_specular: Sequence[mi.BSDF]) -> list:
    """Boxes of shapes with delta lobes or one of these BSDFs; of all instances if a group has some."""
    near = {id(bsdf) for bsdf in near_specular}

    def chosen(shape: mi.Shape) -> bool:
        found = shape.bsdf()
        delta = int(mi.BSDFFlags.Delta) & ~int(mi.BSDFFlags.Null)
        return found is not None and (bool(found.flags() & delta) or id(found) in near)

    grouped = any(chosen(shape) for shape in grouped_shapes(scene))
    found = (box_of(s) for s in scene.shapes() if (grouped if is_instance(s) else chosen(s)))
    # By place: Mitsuba's order of meshes differs between loads.
    return sorted((box for box in found if box is not None), key=lambda box: [*box.min, *box.max])
