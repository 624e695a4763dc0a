"""Points on the shapes of emitters, and their normals, which Mitsuba does not give everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi

from ..errors import UsageError
from ..geometry import rays
from ..geometry.quadrics import Sphere, sphere_normal
from ..geometry.smooth_meshes import SmoothMeshes
from ..geometry.to_world import check_to_world, is_reversed
from ..host.introspection import named
from .group import Context
from .tables import Mask, look_up, rows, switch, table
from .textured import TexturedPoints


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
    are (`Sphere` or None), ``by_shape``: those that Mitsuba samples by their texture, but are sampled by
    their shape here (a list of flags, None where no lamp is of the group), and the ``textured`` points of
    others. ``own``: the `Mask` of both. ``inv_area`` of each shape, by its emitter's index; ``smooth``:
    whether one has interpolated normals. Raises ``UsageError`` for shapes that Mitsuba samples wrongly.
    """

    def __init__(self, emitters, context: Context, spheres, by_shape=None, textured=None):
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
        self._emitters, self._shape_errors = emitters, context.shape_errors
        by_shape = by_shape or rows(emitters, None, lambda _: False)
        self._textured = textured or TexturedPoints(emitters, spheres, rows(emitters, None, lambda _: False))
        mapped = self._textured.chosen
        self.own = Mask(
            [
                None if e is None else context.ask_shapes or s or m
                for e, s, m in zip(emitters, by_shape, mapped, strict=True)
            ]
        )
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
        index = chosen.index
        if self.own.all:
            ps = self._own_point(index, shared.time, u, active)
        else:
            mask = self.own.at(index, active)
            asked = active & ~mask if self.own.any else active
            ps, _ = chosen.emitter.sample_position(shared.time, u, asked)
            if self.own.any:
                ps = dr.select(mask, self._own_point(index, shared.time, u, mask), ps)
        ps = self._upright(ps, index, active)
        return ps, self.geometric_normal(ps, index, u, active)

    def sample_own(self, index, time, u, active):
        """Sample a point of the emitter ``index``, by the map of its texture if it has one, else by shape."""
        return self._upright(self._own_point(index, time, u, active), index, active)

    def _own_point(self, index, time, u, active):
        mapped = self._textured.mask
        if mapped.all:
            return self._textured.sample(index, time, u, active)
        ps = self._point(index, time, u, active)
        if not mapped.any:
            return ps
        mask = mapped.at(index, active)
        return dr.select(mask, self._textured.sample(index, time, u, mask), ps)

    def _point(self, index, time, u, active):
        """A point that the shape of the emitter ``index`` samples uniformly.

        Of these shapes alone: Mitsuba's call on shapes visits all of the process, and instances, curves and
        grids have no ``sample_position``.
        """
        shapes = [emitter and emitter.get_shape() for emitter in self._emitters]
        return switch(shapes, "sample_position", index, time, u, active)

    def _upright(self, ps, index, active):
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

    def anchor(self, chosen, p, n, active) -> rays.Anchor:
        """Where rays start or end at the point ``p`` with the normal ``n``."""
        errors = self._shape_errors.at(chosen.emitter.get_shape(), active)
        return rays.sampled_anchor(p, n, errors)


def spheres_of(emitters, context: Context) -> list[Sphere | None]:
    """The shapes of ``emitters`` that are spheres."""

    def sphere(emitter: mi.Emitter) -> Sphere | None:
        shape = emitter.get_shape()
        return context.facts.about("sphere", shape, lambda: Sphere.of(shape))

    return rows(emitters, None, sphere)


def _check_to_world(emitter: mi.Emitter) -> None:
    check_to_world(emitter.get_shape(), f"emitter {named(emitter)}")
