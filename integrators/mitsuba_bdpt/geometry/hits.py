"""Surfaces at hits, with one function for all instances and one for all spheres.

Mitsuba records a function per shape; of an instance it has in turn one per shape of the process: n^2 for n
instances. Here ``to_world`` and the side of the normal are looked up, and the shape of an instance's group is
called in its own coordinates.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from ..host.introspection import (
    grouped_shapes,
    inverse_of,
    is_instance,
    matrix_of,
    registry_id,
    shape_groups,
    shapes_in,
)
from .boxes import asked_anew
from .quadrics import is_sphere
from .rounding import met

# Fewest instances or spheres that are looked up; of spheres only where other shapes, which are then called
# through Python, are at most `_OTHERS` times as many.
MANY = 8
_OTHERS = 4

# Mitsuba's description of an instance alone names its group.
_GROUP = re.compile(r'shapegroup = ShapeGroup\[\s*name = "([^"]*)"')


@dataclass
class HitTables:
    """Tables of a scene's instances and spheres; hold no object of Mitsuba.

    By registry index: ``first``, the place of a shape in `_targets`, of an instance that of the first shape
    of its group; ``row`` in ``frames`` of an instance or sphere; ``side`` of a sphere, the sign of its
    normals (1: outwards), 0 for other shapes. ``frames``: the upper three rows of ``to_world`` and of its
    inverse. ``targets``: registry indices of `_targets`. ``instances``, ``spheres``: there are some.
    """

    first: mi.UInt32
    row: mi.UInt32
    side: mi.Float
    frames: mi.Float
    targets: mi.UInt32
    instances: bool
    spheres: bool

    @staticmethod
    def of(scene: mi.Scene, about: Callable = asked_anew) -> HitTables | None:
        """Return the tables of a scene; None if Mitsuba's own call is to be used.

        That is, for few instances and spheres, for instances whose group is not known by its name, and on
        GPUs, where hits do not have the index of the shape in its group.
        """
        shapes = scene.shapes()
        instances, spheres = ([s for s in shapes if is_one(s)] for is_one in (is_instance, is_sphere))
        others = len(shapes) - len(instances) - len(spheres)
        many_spheres = len(spheres) >= max(MANY, others / _OTHERS)
        if dr.backend_v(mi.Float) != dr.JitBackend.LLVM or not (many_spheres or len(instances) >= MANY):
            return None
        first_of = _first_shapes(scene, others) if instances else {}
        names = [about("group", partial(_group_of, instance), instance) for instance in instances]
        if not first_of.keys() >= set(names):
            return None
        targets = {registry_id(shape): place for place, shape in enumerate(_targets(scene))}
        placed = [*instances, *spheres]
        rows = {registry_id(shape): row for row, shape in enumerate(placed)}
        places = targets | {index: first_of[name] for index, name in zip(rows, names, strict=False)}
        sides = {registry_id(s): -1.0 if s.has_flipped_normals() else 1.0 for s in spheres}
        indices = range(max(*places, *rows) + 1)
        frames = np.array([about("frame", partial(_frame, shape), shape) for shape in placed])
        made = HitTables(
            first=mi.UInt32([places.get(index, 0) for index in indices]),
            row=mi.UInt32([rows.get(index, 0) for index in indices]),
            side=mi.Float([sides.get(index, 0.0) for index in indices]),
            frames=mi.Float(frames.ravel().tolist()),
            targets=mi.UInt32(list(targets) or [0]),
            instances=bool(instances),
            spheres=bool(spheres),
        )
        dr.make_opaque(made.first, made.row, made.side, made.frames, made.targets)
        return made

    def frame(self, index: mi.UInt32, active: mi.Bool) -> tuple[mi.Transform4f, mi.Transform4f]:
        """``to_world`` of the instance or sphere with this registry ``index``, and its inverse."""
        row = dr.gather(mi.UInt32, self.row, index, active) * 6
        rows = [[*dr.gather(mi.Vector4f, self.frames, row + k, active)] for k in range(6)]
        last = [0, 0, 0, 1]
        to_object = [*rows[3:], last]
        inverse_transpose = [list(column) for column in zip(*to_object, strict=True)]
        to_world = mi.Transform4f(mi.Matrix4f(*rows[:3], last), mi.Matrix4f(*inverse_transpose))
        return to_world, to_world.inverse()


class Hits:
    """Computes the surface at a hit of ``scene``; its ``tables``, or None."""

    def __init__(self, scene: mi.Scene, tables: HitTables | None):
        self._tables = tables
        self._targets = [] if tables is None else _targets(scene)

    def at(self, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """Return the surface at the hit ``pi`` of ``ray``, as ``pi.compute_surface_interaction`` does."""
        tables = self._tables
        if tables is None:
            return pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        active, index = active & pi.is_valid(), met(pi.shape, pi.instance)
        inside = active & (pi.instance != dr.zeros(mi.ShapePtr)) if tables.instances else mi.Bool(False)
        side = dr.gather(mi.Float, tables.side, index, active) if tables.spheres else mi.Float(0)
        on_sphere = side != 0
        to_world, to_object = tables.frame(index, inside | on_sphere)
        si, shape = dr.zeros(mi.SurfaceInteraction3f), pi.shape
        if self._targets:
            local = mi.Ray3f(ray)
            local.o = dr.select(inside, to_object @ ray.o, ray.o)
            local.d = dr.select(inside, to_object @ ray.d, ray.d)
            number = dr.gather(mi.UInt32, tables.first, index, active)
            number += dr.select(inside, pi.shape_index, 0)
            if tables.instances:
                own = dr.gather(mi.UInt32, tables.targets, number, inside)
                shape = dr.select(inside, dr.reinterpret_array(mi.ShapePtr, own), shape)
            calls = [partial(_call, shape) for shape in self._targets]
            si = dr.switch(number, calls, pi, local, active & ~on_sphere, label="Shape")
        if tables.instances:
            si = _placed(si, inside, to_world)
        if tables.spheres:
            si = dr.select(on_sphere, _on_sphere(pi, ray, to_world, to_object, side), si)
        # Not the functions' results: shapes that return themselves would not share a function.
        si.shape = dr.select(active, shape, dr.zeros(mi.ShapePtr))
        return _finished(si, pi, ray, active)


def _call(shape: mi.Shape, pi, ray, active) -> mi.SurfaceInteraction3f:
    return shape.compute_surface_interaction(ray, pi, mi.RayFlags.All, active)


def _placed(si: mi.SurfaceInteraction3f, inside: mi.Bool, to_world: mi.Transform4f):
    """Transform ``si`` where ``inside`` of an instance, as Mitsuba's ``Instance`` does."""
    si.p = dr.select(inside, to_world @ si.p, si.p)
    si.n = dr.select(inside, dr.normalize(to_world @ si.n), si.n)
    si.sh_frame.n = dr.select(inside, dr.normalize(to_world @ si.sh_frame.n), si.sh_frame.n)
    si.dp_du = dr.select(inside, to_world @ si.dp_du, si.dp_du)
    si.dp_dv = dr.select(inside, to_world @ si.dp_dv, si.dp_dv)
    return si


def _on_sphere(pi, ray, to_world: mi.Transform4f, to_object: mi.Transform4f, side) -> mi.SurfaceInteraction3f:
    """The surface at a hit on a sphere, as Mitsuba's ``Sphere`` computes it."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.t, si.p = pi.t, ray(pi.t)
    n = dr.normalize(si.p - to_world.translation())
    si.n = mi.Normal3f(dr.select(side < 0, -n, n))
    si.sh_frame.n = si.n
    local = mi.Vector3f(to_object @ si.p)
    phi, above = dr.atan2(local.y, local.x), local.z >= 0
    phi = dr.select(phi < 0, phi + dr.two_pi, phi)
    pole = mi.Vector3f(local.x, local.y, local.z - dr.select(above, mi.Float(1), mi.Float(-1)))
    from_pole = 2 * dr.asin(0.5 * dr.norm(pole))
    theta = dr.select(above, from_pole, dr.pi - from_pole)
    si.uv = mi.Point2f(phi * dr.inv_two_pi, theta * dr.inv_pi)
    r = dr.sqrt(dr.square(local.x) + dr.square(local.y))
    inverse = dr.rcp(r)
    down = mi.Vector3f(local.z * (local.x * inverse), local.z * (local.y * inverse), -r)
    down = dr.select(r == 0, mi.Vector3f(1, 0, 0), down)
    si.dp_du = (to_world @ mi.Vector3f(-local.y, local.x, 0)) * dr.two_pi
    si.dp_dv = (to_world @ down) * dr.pi
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


def _group_of(instance: mi.Shape) -> str | None:
    """Name of the group of an ``instance``; None if unknown."""
    found = _GROUP.search(repr(instance))
    return found[1] if found else None


def _frame(shape: mi.Shape) -> np.ndarray:
    return np.array([matrix_of(shape)[:3], inverse_of(shape)[:3]])


def _targets(scene: mi.Scene) -> list[mi.Shape]:
    """Shapes that are called: all but instances and the scene's spheres, then those of groups."""
    own = [shape for shape in scene.shapes() if not (is_instance(shape) or is_sphere(shape))]
    return [*own, *grouped_shapes(scene)]


def _first_shapes(scene: mi.Scene, place: int) -> dict[str, int]:
    """Places in `_targets` of groups' first shapes, from ``place`` on, by name; {} if two have one name."""
    groups, found = shape_groups(scene), {}
    for group in groups:
        found[group.id()] = place
        place += len(shapes_in(group))
    return found if len(found) == len(groups) else {}
