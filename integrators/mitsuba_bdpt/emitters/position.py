"""Emitters at a point: point lights, spots and projectors."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..errors import UsageError
from ..geometry import rays
from ..geometry.to_world import check_angles
from ..host.introspection import named, own_parameters
from .group import Context, Group, emitting_point, free_emission, weight_over
from .projectors import Projectors
from .records import Chosen, Direct, Emission, Place
from .tables import Mask, look_up, rows, table


@dataclass
class _Cone:
    """Position of an emitter and its cone of directions (all for a point light).

    ``position`` (world); the axes ``x``, ``y``, ``z`` of the cone (unit length), the cosine ``cos_cutoff`` of
    its half angle, and the density ``pdf_w`` of a direction within (solid angle). Projectors use ``position``
    alone.
    """

    position: mi.Vector3f | tuple = (0, 0, 0)
    x: mi.Vector3f | tuple = (1, 0, 0)
    y: mi.Vector3f | tuple = (0, 1, 0)
    z: mi.Vector3f | tuple = (0, 0, 1)
    cos_cutoff: mi.Float | float = -1.0
    pdf_w: mi.Float | float = 1.0


class PositionEmitters(Group):
    """Emitters at a point: intensity by Mitsuba, density of directions by formulas.

    Emission: y_0 is the position; the direction is uniform in a cone, or a projector's own (solid angle).
    """

    guidable = True

    @classmethod
    def tables(cls, emitter) -> int:
        return 0 if emitter.class_name() == "Projector" else 1

    def __init__(self, emitters, context: Context):
        self._cones = table(rows(emitters, _Cone(), lambda emitter: _CONES[emitter.class_name()](emitter)))
        projects = rows(emitters, None, lambda emitter: emitter.class_name() == "Projector")
        self._is_projector = Mask(projects)
        self._projectors = Projectors.of(emitters, projects)

    def _direction_pdf_w(self, index, d, active):
        """Density (solid angle) of emission along ``d``."""
        pdf_w = dr.gather(mi.Float, self._cones.pdf_w, index, active)
        if self.guide is not None:
            pdf_w *= self.guide.density(index, self.place(index, None, d, active), active)
        if self._projectors is None:
            return pdf_w
        projector = self._is_projector.at(index, active)
        return dr.select(projector, self._projectors.pdf_w(index, d, projector), pdf_w)

    def place(self, index, p, d, active) -> Place:
        cone = look_up(self._cones, index, active)
        local = mi.Vector3f(dr.dot(cone.x, d), dr.dot(cone.y, d), dr.dot(cone.z, d))
        return Place(mi.UInt32(0), mi.warp.uniform_cone_to_square(local, cone.cos_cutoff))

    # -- emission ---------------------------------------------------------------------------

    def sample_emission(self, chosen: Chosen, u_point, u_direction, shared, active) -> Emission:
        cone = look_up(self._cones, chosen.index, active)
        u, pdf_w = u_direction, cone.pdf_w
        if self.guide is not None:
            u, density = self.guide.warp(chosen.index, mi.UInt32(0), u, active)
            pdf_w *= density
        local = mi.warp.square_to_uniform_cone(u, cone.cos_cutoff)
        d = cone.x * local.x + cone.y * local.y + cone.z * local.z
        if self._projectors is not None:
            mask = self._is_projector.at(chosen.index, active)
            projected, density = self._projectors.sample(chosen.index, u_direction, mask)
            d, pdf_w = dr.select(mask, projected, d), dr.select(mask, density, pdf_w)
        p = mi.Point3f(cone.position)
        intensity = _intensity(chosen.emitter, p, d, shared, active)
        weight = dr.select(pdf_w == 0, 0, intensity / pdf_w)
        si = emitting_point(p, shared)
        si.t = mi.Float(0)
        return free_emission(chosen.index, weight, d, mi.Float(1), pdf_w, mi.Bool(True), si)

    def direction_density(self, chosen: Chosen, emission: Emission, p, d, active):
        return self._direction_pdf_w(chosen.index, d, active)

    def connection_density(self, chosen: Chosen, emission: Emission, si, active):
        return chosen.pmf * dr.square(dr.norm(emission.si.p - si.p))

    def radiance_towards(self, chosen: Chosen, emission: Emission, d, active):
        return _intensity(chosen.emitter, emission.si.p, d, emission.si, active)

    # -- next-event estimation --------------------------------------------------------------

    def complete_direct(self, chosen: Chosen, ds, weight, si, u, active) -> Direct:
        emitted = self._direction_pdf_w(chosen.index, -ds.d, active)
        return Direct(
            weight=weight_over(chosen.pmf, weight, ds.pdf),
            pdf_w=mi.Float(chosen.pmf),
            d=ds.d,
            anchor=rays.free_anchor(ds.p),
            infinite=mi.Bool(False),
            delta=mi.Bool(True),
            emission_ratio=emitted / dr.square(ds.dist),
        )


def _intensity(emitter, p, d, shared, active):
    """Intensity of an emitter at ``p`` along ``d``, from its ``sample_direction``."""
    far = 1 + dr.max(dr.abs(p))  # keeps the probe's relative rounding small away from 0
    it = dr.zeros(mi.Interaction3f)
    it.p, it.time, it.wavelengths = p + d * far, shared.time, shared.wavelengths
    ds, weight = emitter.sample_direction(it, mi.Point2f(0.5), active)
    return weight * dr.square(ds.dist)


def _of_point(emitter) -> _Cone:
    position = dr.slice(mi.Point3f(own_parameters(emitter)["position"]))
    return _Cone(position=position, pdf_w=1 / (4 * dr.pi))


def _of_spot(emitter) -> _Cone:
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
    pdf_w = 1 / (2 * dr.pi * (1 - cos_cutoff))
    return _Cone(_origin(to_world), x, y, z, cos_cutoff, pdf_w)


def _of_projector(emitter) -> _Cone:
    return _Cone(position=_origin(own_parameters(emitter)["to_world"]))


def _origin(to_world):
    return dr.slice(mi.Point3f(to_world @ mi.Point3f(0, 0, 0)))


_CONES = {"PointLight": _of_point, "SpotLight": _of_spot, "Projector": _of_projector}
