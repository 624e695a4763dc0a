"""Numbers among a scene's parameters that spoil images: reflectances above 1, spots that rounding changes,
and what is not finite."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from . import bsdf
from .objects import children, number, own_parameters

# What names of a BSDF's textures say that they scale the light that it scatters.
_SCALES = ("reflectance", "transmittance", "base_color")

# What is above 1 by more than rounding (8 bits per colour, half precision).
_MORE_THAN_ALL = 1 + 1e-3

# A step of single precision below 1, where cosines of narrow cones are.
_STEP = 2.0**-24

# A step over 1 - cos of the cutoff angle: below 0.2 degrees. The light that is lost or gained is less than
# this quotient, whatever the orientation (stress case `narrow-spots`).
_COARSE = 1e-2

# Numbers of a bitmap that are looked at, at most: 3 ms.
_QUICKLY_READ = 1 << 18


def brighteners(bsdfs) -> list[str]:
    """The ``bsdfs``, and those inside them, that return more light than they receive, as far as their
    parameters tell, in words."""
    found, seen = [], set()
    for owner in bsdf.nested(bsdfs):
        if id(owner) in seen:
            continue
        seen.add(id(owner))
        for name, texture in children(owner).items():
            if not name.endswith(_SCALES) or not isinstance(texture, mi.Texture):
                continue
            largest = _largest(texture)
            if largest > _MORE_THAN_ALL:
                found.append(f"BSDF '{owner.id()}' has {name} up to {largest:.4g}")
    return found


def _largest(texture) -> float:
    """The largest value of a texture, 0 if it cannot be told quickly."""
    inner = [_largest(value) for value in children(texture).values() if isinstance(value, mi.Texture)]
    if inner:
        return max(inner)
    try:
        return number(texture.max())
    except RuntimeError:  # not implemented, for bitmaps among others
        pass
    data = own_parameters(texture).get("data")
    if data is None or (mi.is_spectral and data.shape[-1] == 3):
        return 0.0  # of colours these are coefficients of spectra, which are 1 at most
    step = max(-(-dr.width(data) // _QUICKLY_READ), 1)
    return float(np.nanmax(np.array(data.array[::step], dtype=np.float32), initial=0))


def narrow_spots(scene) -> list[str]:
    """The spots whose falloff Mitsuba computes from too few steps of a cosine, in words."""
    found = []
    for emitter in scene.emitters():
        if emitter.class_name() != "SpotLight":
            continue
        angle = number(own_parameters(emitter)["cutoff_angle"])
        if not math.isfinite(angle):  # named by `not_finite`
            continue
        opening = 2 * math.sin(math.radians(angle) / 2) ** 2  # 1 - cos, of which none is lost
        if _STEP > _COARSE * opening:
            most = f"{_STEP / opening:.0%}" if opening > _STEP else "all"
            found.append(f"spot '{emitter.id()}' has cutoff_angle={angle:g} (up to {most} of its light)")
    return found


def not_finite(scene) -> list[str]:
    """Names of the scene's parameters that hold NaN or infinity. (Looks at every number.)"""
    found = []
    for name, value in mi.traverse(scene):
        if dr.is_float_v(value) and not np.isfinite(np.array(value)).all():
            found.append(name)
    return found
