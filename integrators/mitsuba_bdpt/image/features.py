"""Feature layers: what the first surface on a camera ray is like, by Mitsuba's own plugin ``aov``.

The plugin is asked at each camera sample, with the ray that Mitsuba's sensor gives for the sample's film
position. Features are thus filtered and normalised exactly as the image is, after every number of
passes, and mean what they mean in ``aov``: they show emitters under ``hide_emitters``, and uv
derivatives shrink with the square root of the samples per pixel. Two things differ. Albedo is RGB on
every film: its wavelengths are drawn for that, where ``aov`` takes the sensor's and is wrong if these
follow a response. And uv derivatives are 0 where there are none, as where a ray meets nothing; those of
``aov`` are NaN, which its sums keep or lose as the number of channels is even or odd. Other features that are
not finite count as 0 too, and are counted.
"""

from __future__ import annotations

import re

import drjit as dr
import mitsuba as mi

from ..errors import UsageError, did_you_mean
from ..sampling.points import Purpose
from ..sensors.records import Region
from .denoising import GUIDES

# What ``aov`` of Mitsuba 3.9.1 knows.
KINDS = (
    "albedo",
    "depth",
    "position",
    "uv",
    "geo_normal",
    "sh_normal",
    "dp_du",
    "dp_dv",
    "duv_dx",
    "duv_dy",
    "prim_index",
    "shape_index",
)


def check_syntax(aovs: str):
    """Raise ``UsageError`` unless ``aovs`` consists of pairs ``name:kind``, as ``aov`` has them."""
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


def feature_names(aovs: str) -> list[str]:
    """Names of the layers that the parameter ``aovs`` asks for."""
    return _plugin(aovs).aov_names() if pairs(aovs) else []


def _may_be_undefined(aovs: str) -> list[bool]:
    """Whether each layer is one of uv derivatives, which are NaN where there are none."""
    kinds = (pair.partition(":")[2] for pair in pairs(aovs))
    return [kind.startswith("duv_") for kind in kinds for _ in feature_names(f"x:{kind}")]


def pairs(aovs: str) -> list[str]:
    """The pairs ``name:kind`` of a parameter ``aovs``, also of Mitsuba's."""
    return [pair for pair in re.split("[, ]+", aovs) if pair]


def _plugin(aovs: str):
    # Not in parallel: this may run on a thread that itself loads a scene.
    return mi.load_dict({"type": "aov", "aovs": aovs}, parallel=False)


class FeatureLayers:
    """The layers ``names`` of a render of ``spp`` samples per pixel, and a denoiser's ``guides`` after them.

    There must be some: ``aovs`` or `denoising.GUIDES`. ``count`` of all; guides are no layers of the film.
    """

    def __init__(self, scene, sensor, aovs: str, spp: int, guides: bool = False):
        asked = f"{aovs},{GUIDES}" if guides else aovs
        self._scene, self._sensor, self._plugin = scene, sensor, _plugin(asked)
        self.names, self.guides = feature_names(aovs), guides
        self.count = len(self._plugin.aov_names())
        self._may_be_undefined = _may_be_undefined(asked)
        self._region = Region(sensor.film())
        self._spread = dr.opaque(mi.Float, spp**-0.5)  # of ray differentials, as in Mitsuba

    def sample(self, points, stream, position, u_lens, time, active) -> tuple[list, object]:
        """Return one number per layer for a camera sample, and whether all were finite.

        The sample is at the film ``position`` (pixels), seen through the point of the lens that ``u_lens``
        chooses. A number that is not finite is 0, and the mask false.
        """
        uv = self._region.to_uv(position)
        ray, _ = self._sensor.sample_ray_differential(time, 0.5, uv, u_lens, active)
        ray.scale_differential(self._spread)
        if mi.is_spectral:
            u = points.draw_1d("camera", stream, Purpose.WAVELENGTH)
            ray.wavelengths, _ = mi.sample_rgb_spectrum(mi.sample_shifted(u))
        _, _, values = self._plugin.sample(self._scene, self._sensor.sampler(), ray, active=active)
        finite = mi.Bool(True)
        for value, undefined in zip(values, self._may_be_undefined, strict=True):
            finite &= undefined | dr.isfinite(value)
        return [dr.select(dr.isfinite(value), value, 0) for value in values], finite
