"""Shading normals of bump and normal maps.

Mitsuba does not expose them to Python. Only maps that are a shape's outermost BSDF, as in ``aov`` of Mitsuba
3.9.1.
"""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..host.introspection import children, own_parameters

_CLASSES = {"BumpMap": "bumpmap", "NormalMap": "normalmap"}

# Directions compared in `_flips`.
_COMPARED = 1 << 12


class MappedNormals:
    """Shading normals at hits of a scene whose shapes have these ``bsdfs``."""

    def __init__(self, bsdfs: Iterable[mi.BSDF]):
        found = {id(b): b for b in bsdfs if b.class_name() in _CLASSES}
        self._maps = [_Map(bsdf) for bsdf in found.values()]

    def at(self, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active: mi.Bool, of_aov: bool) -> mi.Normal3f:
        """Return the shading normal at ``si`` (world; of bump maps in the shading frame if ``of_aov``)."""
        normal = mi.Normal3f(si.sh_frame.n)
        for one in self._maps:
            here = active & (bsdf == mi.BSDFPtr(one.bsdf))
            local = one.normal(si, here)
            mapped = local if of_aov and one.bumps else mi.Normal3f(si.to_world(local))
            normal = dr.select(here, mapped, normal)
        return normal


class _Map:
    def __init__(self, bsdf: mi.BSDF):
        self.bsdf, self._flips = bsdf, _flips(bsdf)
        self.bumps = bsdf.class_name() == "BumpMap"
        self._texture = children(bsdf)["nested_texture" if self.bumps else "normalmap"]
        self._scale = own_parameters(bsdf)["scale"] if self.bumps else 1

    def normal(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Normal3f:
        """Return the normal at ``si``, in the shading frame."""
        local = self._bumped(si, active) if self.bumps else self._read(si, active)
        if self._flips:  # to the side of `si.wi`
            away = mi.Frame3f.cos_theta(si.wi) * dr.dot(si.wi, local) <= 0
            local = dr.select(away, mi.Normal3f(-local.x, -local.y, local.z), local)
        return dr.normalize(local)

    def _bumped(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Normal3f:
        """Return the normal of the displaced surface."""
        slope, n = self._scale * self._texture.eval_1_grad(si, active), si.sh_frame.n
        along_u = si.dp_du + n * (slope.x - dr.dot(n, si.dp_du))
        along_v = si.dp_dv + n * (slope.y - dr.dot(n, si.dp_dv))
        normal = dr.normalize(dr.cross(along_u, along_v))
        return mi.Normal3f(si.to_local(dr.select(dr.dot(si.n, normal) < 0, -normal, normal)))

    def _read(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Normal3f:
        """Return the normal stored in the texture."""
        return mi.Normal3f(self._texture.eval_3(si, active) * 2 - 1)


def _flips(bsdf: mi.BSDF) -> bool:
    """Return ``flip_invalid_normals``, not exposed: compares sampled directions with a copy that flips."""
    rng = np.random.default_rng(1)
    u, turn = rng.random((3, _COMPARED)), 2 * np.pi * rng.random(_COMPARED)
    z = 0.5 * rng.random(_COMPARED) ** 4 * rng.choice([-1, 1], _COMPARED)
    si = dr.zeros(mi.SurfaceInteraction3f, _COMPARED)
    si.uv = mi.Point2f(u[:2])
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.wi = mi.Vector3f(np.stack([np.cos(turn) * np.sqrt(1 - z**2), np.sin(turn) * np.sqrt(1 - z**2), z]))

    def sampled(one: mi.BSDF) -> np.ndarray:
        sample, _ = one.sample(mi.BSDFContext(), si, mi.Float(u[2]), mi.Point2f(u[1:]))
        return np.array(sample.wo)

    nested = {name: value for name, value in children(bsdf).items() if isinstance(value, mi.Object)}
    copy = {"type": _CLASSES[bsdf.class_name()], **nested, **own_parameters(bsdf)}
    flipped = mi.load_dict(copy | {"flip_invalid_normals": True}, parallel=False)
    return bool(np.array_equal(sampled(bsdf), sampled(flipped), equal_nan=True))
