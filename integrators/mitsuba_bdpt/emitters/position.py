"""Emitters at a point: point lights, spots and projectors."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UsageError
from ..geometry import rays
from ..geometry.to_world import check_angles
from ..host.introspection import children, matrix_of, named, own_parameters
from .group import Context, Group, emitting_point, weight_over
from .records import Chosen, Direct, Emission, Factor, Place
from .tables import Mask, look_up, rows, switch, table


@dataclass
class _Cone:
    """Position of an emitter (world) and its cone of directions (all for a point light).

    Unit axes of the cone, cosine ``cos_cutoff`` of its half angle, and density ``pdf_w`` of a direction
    within (solid angle). Projectors use ``position`` alone.
    """

    position: mi.Vector3f | tuple = (0, 0, 0)
    x: mi.Vector3f | tuple = (1, 0, 0)
    y: mi.Vector3f | tuple = (0, 1, 0)
    z: mi.Vector3f | tuple = (0, 0, 1)
    cos_cutoff: mi.Float | float = -1.0
    pdf_w: mi.Float | float = 1.0


class PositionEmitters(Group):
    """Emitters at a point: y_0 fixed, d uniform in a cone or a projector's own (solid angle)."""

    @classmethod
    def tables(cls, emitter) -> int:
        return 0 if emitter.class_name() == "Projector" else 1

    def __init__(self, emitters, context: Context):
        self._cones = table(rows(emitters, _Cone(), lambda emitter: _CONES[emitter.class_name()](emitter)))
        projects = rows(emitters, None, lambda emitter: emitter.class_name() == "Projector")
        self._is_projector = Mask(projects)
        self._projectors = [_Projector(e) if p else None for e, p in zip(emitters, projects, strict=True)]

    def _direction_pdf_w(self, index, d, active):
        """Density (solid angle) of emission along ``d``."""
        pdf_w = dr.gather(mi.Float, self._cones.pdf_w, index, active)
        if self.guide is not None:
            pdf_w *= self.guide.density(index, self.place(index, None, d, active), active)
        if not self._is_projector.any:
            return pdf_w
        mask = self._is_projector.at(index, active)
        return dr.select(mask, switch(self._projectors, "pdf_w", index, d, mask), pdf_w)

    def place(self, index, p, d, active) -> Place:
        cone = look_up(self._cones, index, active)
        local = mi.Vector3f(dr.dot(cone.x, d), dr.dot(cone.y, d), dr.dot(cone.z, d))
        return Place(mi.UInt32(0), mi.warp.uniform_cone_to_square(local, cone.cos_cutoff))

    def factor(self, index, p, d, cos, side, active) -> Factor:
        return Factor.whole()

    def sample_emission(self, chosen: Chosen, u_point, u_direction, shared, active) -> Emission:
        cone = look_up(self._cones, chosen.index, active)
        u, pdf_w = u_direction, cone.pdf_w
        if self.guide is not None:
            u, density = self.guide.warp(chosen.index, mi.UInt32(0), u, active)
            pdf_w *= density
        local = mi.warp.square_to_uniform_cone(u, cone.cos_cutoff)
        d = cone.x * local.x + cone.y * local.y + cone.z * local.z
        if self._is_projector.any:
            mask = self._is_projector.at(chosen.index, active)
            projected, density = switch(self._projectors, "sample", chosen.index, u_direction, mask)
            d, pdf_w = dr.select(mask, projected, d), dr.select(mask, density, pdf_w)
        p = mi.Point3f(cone.position)
        intensity = _intensity(chosen.emitter, p, d, shared, active)
        weight = dr.select(pdf_w == 0, 0, intensity / pdf_w)
        si = emitting_point(p, shared)
        si.t = mi.Float(0)
        cos, first, delta = mi.Float(1), mi.Float(1), mi.Bool(True)
        return Emission(weight, d, rays.free_anchor(p), cos, first, pdf_w, chosen.index, si, delta=delta)

    def direction_density(self, chosen: Chosen, emission: Emission, p, d, active):
        return self._direction_pdf_w(chosen.index, d, active)

    def connection_density(self, chosen: Chosen, emission: Emission, si, active):
        return chosen.pmf * dr.square(dr.norm(emission.si.p - si.p))

    def radiance_towards(self, chosen: Chosen, emission: Emission, d, active):
        return _intensity(chosen.emitter, emission.si.p, d, emission.si, active)

    def complete_direct(self, chosen: Chosen, ds, weight, si, u, active) -> Direct:
        emitted = self._direction_pdf_w(chosen.index, -ds.d, active)
        return Direct(
            weight=weight_over(chosen.pmf, weight, ds.pdf),
            pdf_w=mi.Float(chosen.pmf),
            d=ds.d,
            anchor=rays.free_anchor(ds.p),
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
    to_world, axes = params["to_world"], ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    x, y, z = (dr.slice(dr.normalize(mi.Vector3f(to_world @ mi.Vector3f(*axis)))) for axis in axes)
    cutoff_angle = mi.Float(params["cutoff_angle"])
    cos_cutoff = dr.slice(dr.cos(dr.deg2rad(cutoff_angle)))
    if cos_cutoff >= 1:
        raise UsageError(
            f"spot {named(emitter)} has cutoff_angle={dr.slice(cutoff_angle):g}, a cone without "
            "width in single precision; make it 0.02 degrees or more"
        )
    return _Cone(_origin(to_world), x, y, z, cos_cutoff, pdf_w=1 / (2 * dr.pi * (1 - cos_cutoff)))


def _origin(to_world):
    return dr.slice(mi.Point3f(to_world @ mi.Point3f(0, 0, 0)))


_CONES = {
    "PointLight": _of_point,
    "SpotLight": _of_spot,
    "Projector": lambda e: _Cone(_origin(own_parameters(e)["to_world"])),
}


class _Projector:
    """Density of a projector's directions, which Mitsuba lacks: unit axes, map to ``uv``, sampled texture.

    ``uv`` is an affine map of (x / z, y / z) about the axis, measured by probes. The texture is None where it
    would miss directions: with ``to_uv`` Mitsuba's textures sample another image than they show.
    """

    def __init__(self, emitter):
        check_angles(emitter)
        matrix = matrix_of(emitter)
        # Far enough for the rounding of the probes' coordinates not to matter.
        far = (1 + np.abs(matrix[:3, 3]).max()) / np.linalg.norm(matrix[:3, 2])
        probes = matrix @ np.array([[0, 0, far, 1], [far, 0, far, 1], [0, far, far, 1]], dtype=np.float64).T
        it = dr.zeros(mi.Interaction3f, 3)
        it.p = mi.Point3f(*(mi.Float(row.tolist()) for row in probes[:3]))
        ds, _ = emitter.sample_direction(it, mi.Point2f(0.5))
        uv = np.array(ds.uv, dtype=np.float64)
        to_uv = np.stack([uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], axis=1)
        axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)
        self._axes = [dr.opaque(mi.Vector3f, column.tolist()) for column in axes.T]
        self._origin = dr.opaque(mi.Point2f, uv[:, 0].tolist())
        self._to_uv = [dr.opaque(mi.Float, float(x)) for x in to_uv.ravel()]
        self._from_uv = [dr.opaque(mi.Float, float(x)) for x in np.linalg.inv(to_uv).ravel()]
        self._area = dr.opaque(mi.Float, abs(np.linalg.det(np.linalg.inv(to_uv))))
        texture = children(emitter)["irradiance"]
        turned = own_parameters(texture).get("to_uv")
        as_it_is = turned is None or np.allclose(np.array(turned.matrix).reshape(3, 3), np.eye(3), atol=1e-7)
        self._texture = texture if texture.is_spatially_varying() and as_it_is else None

    def sample(self, u, active):
        """Sample a direction (world) and its density (solid angle)."""
        uv, pdf = mi.Point2f(u), mi.Float(1)
        if self._texture is not None:
            uv, pdf = self._texture.sample_position(u, active)
        offset, back = uv - self._origin, self._from_uv
        x, y = back[0] * offset.x + back[1] * offset.y, back[2] * offset.x + back[3] * offset.y
        local = dr.normalize(mi.Vector3f(x, y, 1))
        d = self._axes[0] * local.x + self._axes[1] * local.y + self._axes[2] * local.z
        return d, self._to_solid_angle(pdf, local.z)

    def pdf_w(self, d, active):
        """Density (solid angle) with which `sample` returns the direction ``d``."""
        x, y, z = (dr.dot(axis, d) for axis in self._axes)
        a = self._to_uv
        uv = self._origin + mi.Point2f(a[0] * x + a[1] * y, a[2] * x + a[3] * y) / z
        active = active & (z > 0) & dr.all((uv >= 0) & (uv <= 1))
        pdf = mi.Float(1)
        if self._texture is not None:
            pdf = self._texture.pdf_position(uv, active)
        return dr.select(active, self._to_solid_angle(pdf, z), 0)

    def _to_solid_angle(self, pdf, cos):
        return pdf / (self._area * cos * cos * cos)
