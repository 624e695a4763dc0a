"""Surfaces at hits, with one function for all instances.

Mitsuba records a function per instance, and in each of these one per shape of the process: n^2 for n
instances. Here the shape of the group is called in its own coordinates, and ``to_world`` of the instance is
looked up.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from ..host import renamed
from ..host.introspection import (
    grouped_shapes,
    inverse_of,
    is_instance,
    matrix_of,
    registry_index,
    shape_groups,
    shapes_in,
)
from .rounding import met

# From this number of instances on they are looked up.
MANY = 8

# Mitsuba's description of an instance alone names its group.
_GROUP = re.compile(r'shapegroup = ShapeGroup\[\s*name = "([^"]*)"')


@dataclass
class Instances:
    """Tables of a scene's instances; hold no object of Mitsuba.

    ``first``: by registry index of a shape its place in `_targets`, of an instance that of the first shape of
    its group; ``row``: by registry index of an instance, its row in ``frames``; ``frames``: per instance the
    upper three rows of ``to_world`` and of its inverse.
    """

    first: mi.UInt32
    row: mi.UInt32
    frames: mi.Float

    @staticmethod
    def of(scene: mi.Scene) -> Instances | None:
        """Return the tables of a scene; None if Mitsuba's own call is to be used.

        That is, for few instances, for instances whose group is not known by its name, and on GPUs, where
        hits do not have the index of the shape in its group.
        """
        instances = [shape for shape in scene.shapes() if is_instance(shape)]
        if len(instances) < MANY or dr.backend_v(mi.Float) != dr.JitBackend.LLVM:
            return None
        first_of = _first_shapes(scene)
        found = [_GROUP.search(repr(instance)) for instance in instances]
        names = [match[1] if match else None for match in found]
        if not first_of.keys() >= set(names):
            return None
        places = {registry_index(shape): place for place, shape in enumerate(_targets(scene))}
        rows = {registry_index(instance): row for row, instance in enumerate(instances)}
        places |= {index: first_of[name] for index, name in zip(rows, names, strict=True)}
        indices = range(max(places) + 1)
        frames = np.array([[matrix_of(one)[:3], inverse_of(one)[:3]] for one in instances])
        made = Instances(
            first=mi.UInt32([places.get(index, 0) for index in indices]),
            row=mi.UInt32([rows.get(index, 0) for index in indices]),
            frames=mi.Float(frames.ravel().tolist()),
        )
        dr.make_opaque(made)
        return made

    def frame(self, index: mi.UInt32, active: mi.Bool) -> tuple[mi.Transform4f, mi.Transform4f]:
        """``to_world`` of the instance with this registry ``index``, and its inverse."""
        row = dr.gather(mi.UInt32, self.row, index, active) * 6
        rows = [dr.gather(mi.Vector4f, self.frames, row + k, active) for k in range(6)]
        rows = [[*row] for row in rows]
        last = [0, 0, 0, 1]
        to_object = [*rows[3:], last]
        inverse_transpose = [list(column) for column in zip(*to_object, strict=True)]
        to_world = mi.Transform4f(mi.Matrix4f(*rows[:3], last), mi.Matrix4f(*inverse_transpose))
        return to_world, to_world.inverse()


class Hits:
    """Computes the surface at a hit of ``scene``; ``instances`` of it, or None."""

    def __init__(self, scene: mi.Scene, instances: Instances | None):
        self._instances = instances
        self._targets = [] if instances is None else _targets(scene)

    def at(self, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """Return the surface at the hit ``pi`` of ``ray``, as ``pi.compute_surface_interaction`` does."""
        if self._instances is None:
            return pi.compute_surface_interaction(ray, renamed.hit_flags(), active)
        active, index = active & pi.is_valid(), met(pi.shape, pi.instance)
        inside = active & (pi.instance != dr.zeros(mi.ShapePtr))
        to_world, to_object = self._instances.frame(index, inside)
        local = mi.Ray3f(ray)
        local.o = dr.select(inside, to_object @ ray.o, ray.o)
        local.d = dr.select(inside, to_object @ ray.d, ray.d)
        number = dr.gather(mi.UInt32, self._instances.first, index, active)
        number += dr.select(inside, pi.shape_index, 0)
        si = dr.switch(number, [partial(_ask, shape) for shape in self._targets], pi, local, active)
        return _finished(_placed(si, inside, to_world), pi, ray, active)


def _ask(shape: mi.Shape, pi, ray, active) -> mi.SurfaceInteraction3f:
    return shape.compute_surface_interaction(ray, pi, renamed.hit_flags(), active)


def _placed(si: mi.SurfaceInteraction3f, inside: mi.Bool, to_world: mi.Transform4f):
    """Transform ``si`` where ``inside`` of an instance, as Mitsuba's ``Instance`` does."""
    si.p = dr.select(inside, to_world @ si.p, si.p)
    si.n = dr.select(inside, dr.normalize(to_world @ si.n), si.n)
    si.sh_frame.n = dr.select(inside, dr.normalize(to_world @ si.sh_frame.n), si.sh_frame.n)
    si.dp_du = dr.select(inside, to_world @ si.dp_du, si.dp_du)
    si.dp_dv = dr.select(inside, to_world @ si.dp_dv, si.dp_dv)
    return si


def _finished(si: mi.SurfaceInteraction3f, pi, ray, active) -> mi.SurfaceInteraction3f:
    """Complete ``si`` as ``SurfaceInteraction3f::finalize_surface_interaction`` does."""
    si.t = dr.select(active, si.t, dr.inf)
    si.time, si.wavelengths = mi.Float(ray.time), ray.wavelengths
    si.prim_index = dr.select(active, pi.prim_index, 0)
    si.instance = dr.select(active, pi.instance, dr.zeros(mi.ShapePtr))
    si.initialize_sh_frame()
    si.wi = dr.select(active, si.to_local(-ray.d), -ray.d)
    si.duv_dx = si.duv_dy = mi.Vector2f(0)
    return si


def _targets(scene: mi.Scene) -> list[mi.Shape]:
    """Shapes that rays hit: all but instances, followed by those of groups."""
    own = [shape for shape in scene.shapes() if not is_instance(shape)]
    return [*own, *grouped_shapes(scene)]


def _first_shapes(scene: mi.Scene) -> dict[str, int]:
    """Place in `_targets` of the first shape of each group, by the group's name; {} if two have one name."""
    groups, place = shape_groups(scene), sum(not is_instance(shape) for shape in scene.shapes())
    found = {}
    for group in groups:
        found[group.id()] = place
        place += len(shapes_in(group))
    return found if len(found) == len(groups) else {}
