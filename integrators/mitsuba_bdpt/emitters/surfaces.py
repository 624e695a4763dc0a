"""Points on the shapes of emitters, with the normals that hits report."""

from __future__ import annotations

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


class Surfaces:
    """The shapes of a group of emitters (None for other groups), and their ``spheres`` (`Sphere` or None).

    ``redraws`` flags shapes whose points are sampled here, not by Mitsuba's emitter; ``mapped`` flags those
    of ``textured`` points. ``inv_area`` of each shape, by emitter index; ``smooth``: one has interpolated
    normals. Raises ``UsageError`` for shapes that Mitsuba samples wrongly.
    """

    def __init__(self, emitters, context: Context, redraws=None, mapped=None):
        about = context.facts.about

        def fact(kind: str, default, find):
            """``find(shape)`` of each emitter's shape."""
            shapes = rows(emitters, None, lambda emitter: emitter.get_shape())
            return rows(shapes, default, lambda shape: about(kind, partial(find, shape), shape))

        for emitter in filter(None, emitters):
            shape, owner = emitter.get_shape(), f"emitter {named(emitter)}"
            about("to_world", partial(check_to_world, shape, owner), shape)
        # First: the area of a mesh whose faces have invalid vertices is arbitrary.
        shapes = (emitter and emitter.get_shape() for emitter in emitters)
        self._smooth_meshes = about("smooth meshes", partial(SmoothMeshes.of, emitters), *shapes)
        self.smooth = self._smooth_meshes is not None
        areas = fact("area", 1.0, lambda shape: number(shape.surface_area()))
        if 0 in areas:
            emitter = emitters[areas.index(0)]
            raise UsageError(
                f"emitter {named(emitter)} is on a shape without area ({named(emitter.get_shape())}); "
                "remove it, or give it some"
            )
        self.inv_area = dr.rcp(mi.Float(areas))
        dr.make_opaque(self.inv_area)
        self._emitters, self._shape_errors = emitters, context.facts.errors
        self.spheres: list[Sphere | None] = fact("sphere", None, Sphere.of)
        none = rows(emitters, None, lambda _: False)
        self.textured = TexturedPoints(emitters, self.spheres, mapped or none, context.facts)
        redrawn = zip(emitters, redraws or none, strict=True)
        self._own = Mask([None if e is None else context.by_shapes or r for e, r in redrawn])
        turned = [s if s is not None and s.turned else None for s in self.spheres]
        other = Sphere((0, 0, 0), 0.0, 0.0, False)
        self._turned = table([s or other for s in turned]) if any(turned) else None
        self._reversed = Mask(fact("reversed", None, is_reversed))

    def sample(self, chosen, u, shared, active):
        """Sample a ``PositionSample3f`` (density over area) and its geometric normal."""
        index = chosen.index
        if self._own.all:
            ps = self._own_point(index, shared.time, u, active)
        else:
            mask = self._own.at(index, active)
            ps, _ = chosen.emitter.sample_position(shared.time, u, active & ~mask)
            if self._own.any:
                ps = dr.select(mask, self._own_point(index, shared.time, u, mask), ps)
        ps = self._upright(ps, index, active)
        return ps, self.geometric_normal(ps, index, u, active)

    def sample_own(self, index, time, u, active):
        """Sample a point of the emitter ``index``, by its mapped texture or else by shape."""
        return self._upright(self._own_point(index, time, u, active), index, active)

    def _own_point(self, index, time, u, active):
        mapped = self.textured.mask
        if mapped.all:
            return self.textured.sample(index, time, u, active)
        shapes = [emitter and emitter.get_shape() for emitter in self._emitters]
        ps = switch(shapes, "sample_position", index, time, u, active)
        if not mapped.any:
            return ps
        mask = mapped.at(index, active)
        return dr.select(mask, self.textured.sample(index, time, u, mask), ps)

    def _upright(self, ps, index, active):
        """Turn the sampled normal of a turned sphere; see `Sphere`."""
        if self._turned is not None:
            sphere = look_up(self._turned, index, active)
            n = sphere_normal(ps.p, sphere.center, sphere.outward)
            ps.n = dr.select(sphere.outward != 0, n, ps.n)
        return ps

    def geometric_normal(self, ps, index, u, active):
        """Normal of hits at the point sampled from ``u``; Mitsuba samples interpolated or mirrored ones."""
        n = ps.n
        if self._reversed.any:
            n = dr.select(self._reversed.at(index, active), -n, n)
        return n if self._smooth_meshes is None else self._smooth_meshes.normal(n, index, u.y, active)

    def anchor(self, chosen, p, n, active) -> rays.Anchor:
        errors = self._shape_errors.at(chosen.emitter.get_shape(), active)
        return rays.sampled_anchor(p, n, errors)
