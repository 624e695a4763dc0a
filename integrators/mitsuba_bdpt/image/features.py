"""Feature layers (AOVs) of the first surface, by Mitsuba's plugin ``aov``.

Features are evaluated at each camera sample, with the sensor's ray, and are thus filtered and normalised like
the image. As those of ``aov``: emitters are shown under ``hide_emitters``, uv derivatives scale with
1 / sqrt(spp), and shading normals of bump maps are in the shading frame. Two differences:

* Albedo is RGB on every film: its wavelengths are sampled by `mi.sample_rgb_spectrum`. ``aov`` uses the
  sensor's, which is wrong if these follow a response.
* uv derivatives are 0 where they do not exist; those of ``aov`` are NaN. Other non-finite values count as 0
  and are counted.
"""

from __future__ import annotations

import re

import drjit as dr
import mitsuba as mi

from ..errors import UsageError, did_you_mean
from ..sampling.points import Purpose
from ..scene.prepared import bsdfs
from ..sensors.records import Region
from .denoising import GUIDES

# Suffixes of the layers of each kind.
KINDS = {
    "albedo": "RGB",
    "depth": "T",
    "position": "XYZ",
    "uv": "UV",
    "geo_normal": "XYZ",
    "sh_normal": "XYZ",
    "dp_du": "XYZ",
    "dp_dv": "XYZ",
    "duv_dx": "UV",
    "duv_dy": "UV",
    "prim_index": "I",
    "shape_index": "I",
}


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
    return [f"{name}.{part}" for name, kind in _named_kinds(aovs) for part in KINDS[kind]]


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
        features = pairs(f"{aovs},{GUIDES}" if guides else aovs)
        self._scene, self._sensor = scene, sensor
        self._aov = mi.load_dict({"type": "aov", "aovs": ",".join(features)})
        self._unused = mi.load_dict({"type": "independent"})
        self.names, self.guides = feature_names(aovs), guides
        self.count = len(self._aov.aov_names())
        found = {id(bsdf): bsdf for bsdf in bsdfs(scene) if bsdf.class_name() == "BumpMap"}
        self._bump_maps = list(found.values()) if guides else []
        kinds = [kind for _, kind in _named_kinds(",".join(features)) for _ in KINDS[kind]]
        self._may_be_nan = [kind.startswith("duv_") for kind in kinds]
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
        _, _, layers = self._aov.sample(self._scene, self._unused, ray, None, active)
        if self._bump_maps:
            layers[-3:] = self._in_world(ray, mi.Normal3f(layers[-3:]), active)
        finite = mi.Bool(True)
        for value, may_be_nan in zip(layers, self._may_be_nan, strict=True):
            finite &= may_be_nan | dr.isfinite(value)
        return [dr.select(dr.isfinite(value), value, 0) for value in layers], finite

    def _in_world(self, ray, normal: mi.Normal3f, active) -> mi.Normal3f:
        """Return the shading ``normal``, which is in the shading frame on bump maps, in world space."""
        si = self._scene.ray_intersect(ray, mi.RayFlags.All, coherent=True, active=active)
        bsdf, mapped = si.bsdf(), mi.Bool(False)
        for bump_map in self._bump_maps:
            mapped |= bsdf == mi.BSDFPtr(bump_map)
        return dr.select(mapped & si.is_valid(), mi.Normal3f(si.to_world(normal)), normal)
