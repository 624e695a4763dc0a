"""Points on the shapes of emitters, and their normals, which Mitsuba does not give everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import accumulate

import drjit as dr
import mitsuba as mi

from ..errors import UsageError
from ..geometry import rays
from ..geometry.quadrics import Sphere, sphere_normal
from ..geometry.smooth_meshes import SmoothMeshes
from ..geometry.to_world import check_to_world, is_reversed
from ..host.introspection import named
from .group import Context
from .tables import Mask, look_up, rows, table


@dataclass
class _Turned:
    """A sphere whose sampled normals are turned with its points.

    ``outward``: see `Sphere`; 0 where normals are right as they are.
    """

    center: mi.Vector3f | tuple = (0, 0, 0)
    outward: mi.Float | float = 0.0


class Surfaces:
    """The shapes of a group of emitters.

    Made of the group's ``emitters`` (None where one is of another group), the ``spheres`` that their shapes
    are (`Sphere` or None), and ``by_shape``: those that Mitsuba samples by their texture, but are sampled by
    their shape here. ``inv_area`` of each shape, by its emitter's index; ``smooth``: whether one has
    interpolated normals. Raises ``UsageError`` for shapes that Mitsuba samples wrongly.
    """

    def __init__(self, emitters, context: Context, spheres, by_shape: Mask | None = None):
        for emitter in filter(None, emitters):
            context.facts.about("to_world", emitter.get_shape(), partial(_check_to_world, emitter))
        # Before areas are asked for: of a mesh whose faces have vertices that do not exist it is any number.
        self._smooth_meshes = SmoothMeshes.of(emitters)
        self.smooth = self._smooth_meshes is not None
        areas = rows(emitters, 1.0, lambda emitter: dr.slice(emitter.get_shape().surface_area()))
        if 0 in areas:
            emitter = emitters[areas.index(0)]
            raise UsageError(
                f"emitter {named(emitter)} is on a shape without area ({named(emitter.get_shape())}); "
                "remove it, or give it some"
            )
        self.inv_area = dr.rcp(mi.Float(areas))
        dr.make_opaque(self.inv_area)
        self._by_shape, self._context, self._emitters = by_shape, context, emitters
        turned = [s is not None and s.turned for s in spheres]
        self._turned = None
        if any(turned):
            pairs = zip(spheres, turned, strict=True)
            self._turned = table([_Turned(s.center, s.outward) if t else _Turned() for s, t in pairs])
        self._reversed = Mask([e and is_reversed(e.get_shape()) for e in emitters])

    def sample(self, chosen, u, shared, active):
        """A point on the shape of each emitter, and its geometric normal, the one that a hit reports.

        The point is a ``PositionSample3f``, its density over area.
        """
        emitter, index = chosen.emitter, chosen.index
        if self._context.ask_shapes:
            ps = self._point(index, shared.time, u, active)
        else:
            ps, _ = emitter.sample_position(shared.time, u, active)
            if self._by_shape is not None and self._by_shape.any:
                mask = self._by_shape.at(index, active)
                ps = dr.select(mask, self._point(index, shared.time, u, mask), ps)
        ps = self.upright(ps, index, active)
        return ps, self.geometric_normal(ps, index, u, active)

    def sample_shape(self, chosen, u, time, active):
        """A point that the shape of each emitter samples, whatever the emitter would."""
        return self.upright(self._point(chosen.index, time, u, active), chosen.index, active)

    def _point(self, index, time, u, active):
        """A point that the shape of the emitter ``index`` samples uniformly.

        Of these shapes alone: Mitsuba's call on shapes visits all of the process, and instances, curves and
        grids have no ``sample_position``.
        """
        shapes = [emitter.get_shape() for emitter in filter(None, self._emitters)]
        if len(shapes) == 1:
            return shapes[0].sample_position(time, u, active)
        # How many are before each; the last, of all, belongs to no emitter.
        numbers = accumulate((emitter is not None for emitter in self._emitters), initial=0)
        number = dr.gather(mi.UInt32, mi.UInt32(list(numbers)), index, active)
        return dr.switch(number, [shape.sample_position for shape in shapes], time, u, active)

    def upright(self, ps, index, active):
        """A point that a shape has sampled, with its normal as it should be, see `Sphere`."""
        if self._turned is not None:
            sphere = look_up(self._turned, index, active)
            n = sphere_normal(ps.p, sphere.center, sphere.outward)
            ps.n = dr.select(sphere.outward != 0, n, ps.n)
        return ps

    def geometric_normal(self, ps, index, u, active):
        """Geometric normal, with the sign of ``si.n`` of a hit, at the point that a shape sampled from ``u``.

        Meshes sample the interpolated vertex normal there, mirrored rectangles the opposite of the geometric
        normal; all other shapes the geometric normal.
        """
        n = ps.n
        if self._reversed.any:
            n = dr.select(self._reversed.at(index, active), -n, n)
        return n if self._smooth_meshes is None else self._smooth_meshes.normal(n, index, u.y, active)

    def anchor(self, chosen, p, n, reference, active) -> rays.Anchor:
        """Where rays to or from ``reference`` end or start at the point ``p`` with the normal ``n``."""
        errors = self._context.shape_errors.at(chosen.emitter.get_shape(), active)
        return rays.sampled_anchor(p, n, reference, errors)


def spheres_of(emitters, context: Context) -> list[Sphere | None]:
    """The shapes of ``emitters`` that are spheres."""

    def sphere(emitter: mi.Emitter) -> Sphere | None:
        shape = emitter.get_shape()
        return context.facts.about("sphere", shape, lambda: Sphere.of(shape))

    return rows(emitters, None, sphere)


def _check_to_world(emitter: mi.Emitter) -> None:
    check_to_world(emitter.get_shape(), f"emitter {named(emitter)}")
