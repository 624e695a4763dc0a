"""Tables of the scene's emitters that a kernel can index."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UsageError
from ..geometry.quadrics import Sphere, is_small
from ..host.introspection import named, own_parameters
from .kinds import AREA, DIRECTIONAL_AREA, POINT, PROJECTOR, SPOT, check_angles, is_textured


@dataclass
class Placement:
    """Where an emitter is: axes ``x``, ``y``, ``z`` and ``position`` of point and spot lights, their
    constant density of emission ``density_w`` (solid angle) within ``cos_cutoff``; ``position`` of
    projectors. Of spheres ``position``; the ``radius`` up to which one that emits inwards, and everywhere
    the same, samples as from inside, ``outward`` of a rotated one (see `Sphere`), the radius ``far`` of one
    that may be so small, as seen from the scene, that Mitsuba's density is wrong (see
    `quadrics.cone_density`); 0 for all others.
    Scalars for one emitter, Dr.Jit arrays for a table of them."""

    x: object = (1, 0, 0)
    y: object = (0, 1, 0)
    z: object = (0, 0, 1)
    position: object = (0, 0, 0)
    density_w: object = 1.0
    cos_cutoff: object = -1.0
    radius: object = 0.0
    outward: object = 0.0
    far: object = 0.0

    @staticmethod
    def table(rows):
        """The rows as columns that `at` can look up."""

        def column(name):
            # Lists, not NumPy: Dr.Jit borrows an array's memory, and its alignment is part of the kernel.
            values = np.array([getattr(row, name) for row in rows], dtype=np.float64).T.tolist()
            if not isinstance(values[0], list):
                return mi.Float(values)
            return (mi.Point3f if name == "position" else mi.Vector3f)(*(mi.Float(v) for v in values))

        return Placement(**{name: column(name) for name in vars(Placement())})

    def at(self, index, active):
        """The row ``index``."""
        return Placement(**{k: dr.gather(type(v), v, index, active) for k, v in vars(self).items()})


def placement(emitter, kind, extent) -> Placement:
    """The row of one emitter in a scene of the diameter ``extent``."""
    if kind == POINT:
        position = dr.slice(mi.Point3f(own_parameters(emitter)["position"]))
        return Placement(position=position, density_w=1 / (4 * dr.pi))
    if kind == SPOT:
        check_angles(emitter)
        params = own_parameters(emitter)
        to_world = params["to_world"]
        x, y, z = (
            dr.slice(dr.normalize(mi.Vector3f(to_world @ mi.Vector3f(*a))))
            for a in ((1, 0, 0), (0, 1, 0), (0, 0, 1))
        )
        cutoff_angle = mi.Float(params["cutoff_angle"])
        cos_cutoff = dr.slice(dr.cos(dr.deg2rad(cutoff_angle)))
        if cos_cutoff >= 1:
            raise UsageError(
                f"spot {named(emitter)} has cutoff_angle={dr.slice(cutoff_angle):g}, a cone without "
                "width in single precision; make it 0.02 degrees or more"
            )
        return Placement(
            x=x,
            y=y,
            z=z,
            position=dr.slice(mi.Point3f(to_world @ mi.Point3f(0, 0, 0))),
            density_w=1 / (2 * dr.pi * (1 - cos_cutoff)),
            cos_cutoff=cos_cutoff,
        )
    if kind == PROJECTOR:
        to_world = own_parameters(emitter)["to_world"]
        return Placement(position=dr.slice(mi.Point3f(to_world @ mi.Point3f(0, 0, 0))))
    sphere = Sphere.of(emitter.get_shape()) if kind in (AREA, DIRECTIONAL_AREA) else None
    if sphere is not None:
        # By direction, unless it has a texture: then Mitsuba samples that, wherever the lit point is.
        by_direction = not is_textured(emitter, kind)
        small = kind == AREA and by_direction and is_small(sphere, extent)
        return Placement(
            position=sphere.center,
            # Mitsuba's RayEpsilon, as in Sphere::sample_direction.
            radius=sphere.radius * (1 + 1500 * 2.0**-24) if by_direction and sphere.outward < 0 else 0.0,
            outward=sphere.outward if sphere.turned else 0.0,
            far=sphere.radius if small else 0.0,
        )
    return Placement()


def inverse_table(pointers):
    """Emitter index by the number that Dr.Jit gives to a pointer."""
    ids = dr.reinterpret_array(mi.UInt32, pointers).numpy()
    table = [0] * (int(ids.max()) + 1)
    for index, number in enumerate(ids):
        table[int(number)] = index
    return mi.UInt32(table)
