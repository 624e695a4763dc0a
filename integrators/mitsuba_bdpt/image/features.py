"""Feature layers (AOVs) of the first surface, as in Mitsuba's plugin ``aov``.

Features are evaluated at each camera sample, with the sensor's ray, and are thus filtered and normalised like
the image. They agree with ``aov`` of Mitsuba 3.9.1: emitters are shown under ``hide_emitters``, uv
derivatives scale with 1 / sqrt(spp), and shading normals of bump maps are in the shading frame. Two
differences:

* Albedo is RGB on every film: its wavelengths are sampled by `mi.sample_rgb_spectrum`. ``aov`` uses the
  sensor's, which is wrong if these follow a response.
* uv derivatives are 0 where they do not exist; those of ``aov`` are NaN. Other non-finite values count as 0
  and are counted.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import UsageError, did_you_mean
from ..sampling.points import Purpose
from ..scene.prepared import bsdfs
from ..sensors.records import Region
from .denoising import GUIDES, WORLD_NORMAL
from .mapped_normals import MappedNormals


@dataclass
class _Hit:
    """First hit of a camera ray: ``si`` and its ``bsdf``, valid where ``active``."""

    si: mi.SurfaceInteraction3f
    ray: mi.RayDifferential3f
    bsdf: mi.BSDFPtr
    active: mi.Bool
    normals: MappedNormals


def _albedo(hit: _Hit) -> mi.Color3f:
    """Diffuse reflectance; spectral variants use `mi.sample_rgb_spectrum`."""
    value = mi.unpolarized_spectrum(hit.bsdf.eval_diffuse_reflectance(hit.si, hit.active))
    if mi.is_monochromatic:
        return mi.Color3f(value.x)
    if not mi.is_spectral:
        return mi.Color3f(value)
    pdf = mi.pdf_rgb_spectrum(hit.ray.wavelengths)
    value *= dr.select(pdf != 0, dr.rcp(pdf), 0)
    return mi.spectrum_to_srgb(value, hit.ray.wavelengths, hit.active)


def _uv_partials(hit: _Hit) -> mi.SurfaceInteraction3f:
    hit.si.compute_uv_partials(hit.ray)
    return hit.si


# Suffixes of a kind's layers, and its values.
_KINDS: dict[str, tuple[str, Callable[[_Hit], Any]]] = {
    "albedo": ("RGB", _albedo),
    "depth": ("T", lambda hit: [hit.si.t]),
    "position": ("XYZ", lambda hit: hit.si.p),
    "uv": ("UV", lambda hit: hit.si.uv),
    "geo_normal": ("XYZ", lambda hit: hit.si.n),
    "sh_normal": ("XYZ", lambda hit: hit.normals.at(hit.si, hit.bsdf, hit.active, of_aov=True)),
    "dp_du": ("XYZ", lambda hit: hit.si.dp_du),
    "dp_dv": ("XYZ", lambda hit: hit.si.dp_dv),
    "duv_dx": ("UV", lambda hit: _uv_partials(hit).duv_dx),
    "duv_dy": ("UV", lambda hit: _uv_partials(hit).duv_dy),
    "prim_index": ("I", lambda hit: [mi.Float(hit.si.prim_index)]),
    "shape_index": ("I", lambda hit: [mi.Float(dr.reinterpret_array(mi.UInt32, hit.si.shape))]),
}

KINDS = tuple(_KINDS)

# For the denoiser, in world space.
_KINDS[WORLD_NORMAL] = ("XYZ", lambda hit: hit.normals.at(hit.si, hit.bsdf, hit.active, of_aov=False))


def checked(aovs: str) -> str:
    """Return ``aovs``; raises ``UsageError`` unless it consists of pairs ``name:kind``."""
    for pair in pairs(aovs):
        name, colon, kind = pair.partition(":")
        if not (name and colon and kind):
            raise UsageError(
                f"aovs={aovs!r}: {pair!r} is not a pair name:kind; write for example "
                "'albedo:albedo,nn:sh_normal'"
            )
        if kind not in KINDS:
            raise UsageError(
                f"aovs={aovs!r}: {kind!r} is not a kind of feature; "
                f"{did_you_mean(kind, KINDS)}Kinds: {', '.join(KINDS)}"
            )
    return aovs


def feature_names(aovs: str) -> list[str]:
    """Return the names of the layers of the parameter ``aovs``."""
    return [f"{name}.{part}" for name, kind in _named_kinds(aovs) for part in _KINDS[kind][0]]


def _named_kinds(aovs: str) -> list[tuple[str, str]]:
    """Return name and kind of each feature."""
    return [(name, kind) for name, _, kind in (pair.partition(":") for pair in pairs(aovs))]


def pairs(aovs: str) -> list[str]:
    """Return the pairs ``name:kind`` of a parameter ``aovs`` (ours or Mitsuba's)."""
    return [pair for pair in re.split("[, ]+", aovs) if pair]


class FeatureLayers:
    """Feature layers ``names`` of a render of ``spp`` samples per pixel.

    The denoiser's ``guides`` follow them and are no layers of the film; ``count``: of all. Needs ``aovs`` or
    `denoising.GUIDES`.
    """

    def __init__(self, scene, sensor, aovs: str, spp: int, guides: bool = False):
        features = f"{aovs},{GUIDES}" if guides else aovs
        self._scene, self._sensor = scene, sensor
        self._kinds = [kind for _, kind in _named_kinds(features)]
        self.names, self.guides = feature_names(aovs), guides
        self.count = len(feature_names(features))
        has_normals = {"sh_normal", WORLD_NORMAL}.intersection(self._kinds)
        self._normals = MappedNormals(bsdfs(scene) if has_normals else [])
        self._region = Region(sensor.film())
        self._spread = dr.opaque(mi.Float, spp**-0.5)  # scale of ray differentials, as in Mitsuba

    def sample(self, points, stream, position, u_lens, time, active) -> tuple[list, object]:
        """Return one value per layer for a camera sample, and whether all are finite.

        ``position``: on the film, in pixels; ``u_lens``: sample of the aperture. Non-finite values are
        replaced by 0.
        """
        uv = self._region.to_uv(position)
        ray, _ = self._sensor.sample_ray_differential(time, 0.5, uv, u_lens, active)
        ray.scale_differential(self._spread)
        if mi.is_spectral:
            u = points.draw_1d("camera", stream, Purpose.WAVELENGTH)
            ray.wavelengths, _ = mi.sample_rgb_spectrum(mi.sample_shifted(u))
        si = self._scene.ray_intersect(ray, mi.RayFlags.All, coherent=True, active=active)
        met = active & si.is_valid()
        hit = _Hit(si, ray, si.bsdf(ray), met, self._normals)
        layers, finite = [], mi.Bool(True)
        for kind in self._kinds:
            for value in _KINDS[kind][1](hit):
                value = dr.select(met, value, 0)
                finite &= kind.startswith("duv_") | dr.isfinite(value)
                layers.append(dr.select(dr.isfinite(value), value, 0))
        return layers, finite
