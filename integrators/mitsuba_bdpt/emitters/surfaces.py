"""Points on the shapes of emitters, with the normals that hits report."""

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
from ..host.introspection import named, number
from .group import Context
from .tables import Mask, look_up, rows, switch, table
from .textured import TexturedPoints


@dataclass
class _Turned:
    """A sphere whose sampled normals are turned; ``outward``: see `Sphere` (0: none)."""

    center: mi.Vector3f | tuple = (0, 0, 0)
    outward: mi.Float | float = 0.0


class Surfaces:
    """The shapes of a group of emitters.

    ``emitters`` of the group (None for other groups), ``spheres`` their shapes (`Sphere` or None),
    ``by_shape`` flags (None for other groups): sampled by shape here, by texture in Mitsuba; ``textured``
    points of others. ``own``: the `Mask` of both. ``inv_area`` of each shape, by emitter index; ``smooth``:
    one has interpolated normals. Raises ``UsageError`` for shapes that Mitsuba samples wrongly.
    """

    def __init__(self, emitters, context: Context, spheres, by_shape=None, textured=None):
        for emitter in filter(None, emitters):
            context.facts.about("to_world", partial(_check_to_world, emitter), emitter.get_shape())
        # First: the area of a mesh whose faces have invalid vertices is arbitrary.
        shapes = (emitter and emitter.get_shape() for emitter in emitters)
        look = partial(SmoothMeshes.of, emitters)
        self._smooth_meshes = context.facts.about("smooth meshes", look, *shapes)
        self.smooth = self._smooth_meshes is not None
        areas = rows(emitters, 1.0, partial(_area, context))
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
        none = rows(emitters, None, lambda _: False)
        self._textured = textured or TexturedPoints(emitters, spheres, none, context.facts)
        mapped = self._textured.chosen
        self.own = Mask(
            [
                None if e is None else context.by_shapes or s or m
                for e, s, m in zip(emitters, by_shape, mapped, strict=True)
            ]
        )
        turned = [s is not None and s.turned for s in spheres]
        self._turned = None
        if any(turned):
            pairs = zip(spheres, turned, strict=True)
            self._turned = table([_Turned(s.center, s.outward) if t else _Turned() for s, t in pairs])
        self._reversed = Mask(rows(emitters, None, partial(_is_reversed, context)))

    def sample(self, chosen, u, shared, active):
        """Sample a ``PositionSample3f`` (density over area) and its geometric normal."""
        index = chosen.index
        if self.own.all:
            ps = self._own_point(index, shared.time, u, active)
        else:
            mask = self.own.at(index, active)
            sampled = active & ~mask if self.own.any else active
            ps, _ = chosen.emitter.sample_position(shared.time, u, sampled)
            if self.own.any:
                ps = dr.select(mask, self._own_point(index, shared.time, u, mask), ps)
        ps = self._upright(ps, index, active)
        return ps, self.geometric_normal(ps, index, u, active)

    def sample_own(self, index, time, u, active):
        """Sample a point of the emitter ``index``, by its mapped texture or else by shape."""
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
        """Sample a point uniformly on the shape of the emitter ``index``.

        Calls these shapes alone: a virtual call visits all shapes in the process, and instances, curves and
        grids have no ``sample_position``.
        """
        shapes = [emitter and emitter.get_shape() for emitter in self._emitters]
        return switch(shapes, "sample_position", index, time, u, active)

    def _upright(self, ps, index, active):
        """Turn the sampled normal of a turned sphere; see `Sphere`."""
        if self._turned is not None:
            sphere = look_up(self._turned, index, active)
            n = sphere_normal(ps.p, sphere.center, sphere.outward)
            ps.n = dr.select(sphere.outward != 0, n, ps.n)
        return ps

    def geometric_normal(self, ps, index, u, active):
        """Geometric normal (sign of a hit's ``si.n``) at the point sampled from ``u``.

        Mitsuba samples the interpolated normal on meshes, and the opposite normal on mirrored rectangles.
        """
        n = ps.n
        if self._reversed.any:
            n = dr.select(self._reversed.at(index, active), -n, n)
        return n if self._smooth_meshes is None else self._smooth_meshes.normal(n, index, u.y, active)

    def anchor(self, chosen, p, n, active) -> rays.Anchor:
        errors = self._shape_errors.at(chosen.emitter.get_shape(), active)
        return rays.sampled_anchor(p, n, errors)


def spheres_of(emitters, context: Context) -> list[Sphere | None]:
    """Return the `Sphere` of each emitter's shape, None for other shapes."""

    def sphere(emitter: mi.Emitter) -> Sphere | None:
        shape = emitter.get_shape()
        return context.facts.about("sphere", lambda: Sphere.of(shape), shape)

    return rows(emitters, None, sphere)


def _is_reversed(context: Context, emitter: mi.Emitter) -> bool:
    shape = emitter.get_shape()
    return context.facts.about("reversed", partial(is_reversed, shape), shape)


def _area(context: Context, emitter: mi.Emitter) -> float:
    shape = emitter.get_shape()
    return context.facts.about("area", lambda: number(shape.surface_area()), shape)


def _check_to_world(emitter: mi.Emitter) -> None:
    check_to_world(emitter.get_shape(), f"emitter {named(emitter)}")
