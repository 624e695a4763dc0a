"""Directions of projectors."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..geometry.to_world import check_angles
from ..host.introspection import children, matrix_of, own_parameters


class Projectors:
    """Densities of the directions of the scene's projectors, which Mitsuba lacks.

    A projector's ``uv`` is an affine map of (x / z, y / z) about its axis, measured by probes.
    """

    @staticmethod
    def of(emitters, projects):
        """Return the projectors among ``emitters`` (flags ``projects``), or None."""
        found = [(i, e) for i, (e, p) in enumerate(zip(emitters, projects, strict=True)) if p]
        return Projectors(found) if found else None

    def __init__(self, projectors):
        self._rows = [(index, _Projector(emitter)) for index, emitter in projectors]

    def sample(self, index, u, active):
        """Sample a direction (world, unit length) and its density (solid angle)."""
        d, pdf_w = mi.Vector3f(0, 0, 1), mi.Float(1)
        for number, projector in self._rows:
            mask = active & (index == number)
            sampled, density = projector.sample(u, mask)
            d, pdf_w = dr.select(mask, sampled, d), dr.select(mask, density, pdf_w)
        return d, pdf_w

    def pdf_w(self, index, d, active):
        """Density (solid angle) of ``d`` from the projector ``index``; 0 for others."""
        pdf_w = mi.Float(0)
        for number, projector in self._rows:
            mask = active & (index == number)
            pdf_w = dr.select(mask, projector.pdf_w(d, mask), pdf_w)
        return pdf_w


class _Projector:
    """One projector: unit axes, affine map to ``uv`` and back, sampled texture.

    The texture is None where it would miss directions: with ``to_uv`` Mitsuba's textures sample another image
    than they show.
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
        self._texture = texture if texture.is_spatially_varying() and _is_as_it_was(texture) else None

    def sample(self, u, active):
        """Sample a direction and its density (solid angle)."""
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


def _is_as_it_was(texture) -> bool:
    """Whether a texture has no ``to_uv`` that changes it."""
    found = own_parameters(texture)
    if "to_uv" not in found:
        return True
    return np.allclose(np.array(found["to_uv"].matrix).reshape(3, 3), np.eye(3), atol=1e-7)
