"""First directions of photons' subpaths: half of them go towards what begins an isolated path.

Most isolated paths begin with delta events, and few of the subpaths that an emitter's own density chooses
meet a small thing of glass. So half of the first directions are uniform in the cones about spheres around the
shapes with delta lobes (in all directions from within a sphere); the density is that of the mixture, by
whichever half a direction was made. Light from infinity is not aimed: its disks cover details by themselves
(`emitters.disks`). From an even sky there are no photons: s = 0 finds its light well.

Light subpaths are not aimed: of the strategies merges alone have `Aim.density` in the place of the emitter's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ...emitters.emitters import Emitters
from ...emitters.infinite import contrast
from ...emitters.records import Emission
from ...geometry.boxes import box_of
from ...host.introspection import grouped_shapes, is_instance

# Spheres; one for all where they would be more.
MOST_SPHERES = 8

# Largest radiance of a sky over its mean up to which there are no photons of it.
EVEN_SKY = 16

# Spheres are so much larger than boxes: rounding, and a sphere's box is that of a cube.
_MARGIN = 1.001


@dataclass
class Sphere:
    """Opaque; from within it a direction may be any."""

    center: mi.Point3f
    radius: mi.Float

    def cone(self, p: mi.Point3f) -> tuple[mi.Vector3f, mi.Float]:
        """From ``p`` the direction to the centre, and 1 - cos of the angle about it; 2 from within."""
        between = self.center - p
        dist2 = dr.squared_norm(between)
        sin2 = dr.square(self.radius) / dist2
        # Small angles have no digits in 1 - cos.
        width = dr.select(sin2 < 1, sin2 / (1 + dr.safe_sqrt(1 - sin2)), 2)
        axis = dr.select(dist2 > 0, mi.Vector3f(between) * dr.rsqrt(dist2), mi.Vector3f(0, 0, 1))
        return axis, width


@dataclass
class Aim:
    """Where photons' subpaths of a scene set out to: ``spheres``; ``no_sky``: none start from its sky."""

    spheres: tuple[Sphere, ...]
    no_sky: bool

    @staticmethod
    def of(scene: mi.Scene, emitters: Emitters) -> Aim:
        """That of a ``scene``."""
        boxes = [] if not emitters.connectible_nearby else _delta_boxes(scene)
        if len(boxes) > MOST_SPHERES:
            whole = mi.ScalarBoundingBox3f()
            for box in boxes:
                whole.expand(box)
            boxes = [whole]
        environment = scene.environment()
        no_sky = environment is not None and contrast(environment) <= EVEN_SKY
        return Aim(tuple(_sphere(box) for box in boxes), no_sky)

    def emission(self, emitters: Emitters, u_point, u_direction, shared) -> tuple[Emission, mi.Float]:
        """Emissions of photons, whose ``pdf_second`` is the mixture's, and the emitter's own over that."""
        number = None
        if self.spheres:
            aimed, u_x = _halved(u_direction.x)
            u_direction = mi.Point2f(u_x, u_direction.y)
        e = emitters.sample_emission(u_point, u_direction, shared, mi.Bool(True))
        if self.spheres:
            aimed &= _aimable(e)
            number, d = self._sample(e.si.p, u_direction)
            number = dr.select(aimed, number, len(self.spheres))
            e = _towards(emitters, e, d, aimed)
        mixed = self.density(e, number)
        ratio = dr.select(mixed == 0, 0, e.pdf_second / mixed)
        return replace(e, weight=e.weight * ratio, pdf_second=mixed), ratio

    def density(self, e: Emission, number: mi.UInt32 | None = None) -> mi.Float:
        """Density with which photons are emitted as ``e``, in the measure of its ``pdf_second``.

        ``number`` of the sphere for which it was sampled, in whose cone it is, whatever rounding says.
        """
        mixed = dr.select(_aimable(e), self._mixed(e.si.p, e.d, e.pdf_second, number), e.pdf_second)
        return dr.select(e.infinite & ~e.delta, 0, mixed) if self.no_sky else mixed

    def density_at(self, hit: mi.Bool, p, d, pdf_second: mi.Float) -> mi.Float:
        """The same of a point that camera subpaths have ``hit``, else of the surroundings; ``d`` from it."""
        return dr.select(hit, self._mixed(p, d, pdf_second), mi.Float(0) if self.no_sky else pdf_second)

    def _mixed(self, p, d, pdf_second, number=None):
        if not self.spheres:
            return pdf_second
        aimed = mi.Float(0)
        for i, sphere in enumerate(self.spheres):
            axis, width = sphere.cone(p)
            # 1 - cos of the angle between unit vectors, precise also where it is small.
            inside = (width == 2) | (dr.squared_norm(d - axis) <= 2 * width)
            if number is not None:
                inside |= number == i
            aimed += dr.select(inside, dr.inv_two_pi / width, 0)
        return (pdf_second + aimed / len(self.spheres)) / 2

    def _sample(self, p, u: mi.Point2f) -> tuple[mi.UInt32, mi.Vector3f]:
        """A direction into one of the cones from ``p``, and the number of its sphere."""
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


def _halved(u: mi.Float) -> tuple[mi.Bool, mi.Float]:
    """Whether ``u`` is in the upper half of [0, 1), and its place there."""
    upper = u >= 0.5
    return upper, dr.minimum(2 * u - dr.select(upper, 1, 0), 1 - 2**-24)


def _aimable(e: Emission) -> mi.Bool:
    return ~(e.infinite | e.beam)


def _towards(emitters: Emitters, e: Emission, d, active: mi.Bool) -> Emission:
    """``e``, where ``active`` into the direction ``d`` instead of its own."""
    to = replace(e, d=d, cos=dr.select(e.delta, 1, dr.abs(dr.dot(e.anchor.n, d))))
    pdf_second = emitters.direction_density(to, e.si.p + d, d, active)
    radiance = emitters.radiance_towards(e, d, active)
    density = e.pdf_first * pdf_second
    black = (density == 0) | ~emitters.traces(e.index, active)
    weight = dr.select(black, 0, radiance * (to.cos / density))
    return replace(
        e,
        d=dr.select(active, d, e.d),
        cos=dr.select(active, to.cos, e.cos),
        pdf_second=dr.select(active, pdf_second, e.pdf_second),
        weight=dr.select(active, weight, e.weight),
    )


def _sphere(box) -> Sphere:
    around = box.bounding_sphere()
    sphere = Sphere(mi.Point3f(around.center), mi.Float(around.radius * _MARGIN))
    dr.make_opaque(sphere)
    return sphere


def _delta_boxes(scene: mi.Scene) -> list:
    """The boxes of shapes with delta lobes; of all instances if one of the shapes in groups has some."""
    grouped = any(_is_delta(shape) for shape in grouped_shapes(scene))
    found = (box_of(s) for s in scene.shapes() if (grouped if is_instance(s) else _is_delta(s)))
    return [box for box in found if box is not None]


def _is_delta(shape: mi.Shape) -> bool:
    found = shape.bsdf()
    return found is not None and bool(found.flags() & (int(mi.BSDFFlags.Delta) & ~int(mi.BSDFFlags.Null)))
