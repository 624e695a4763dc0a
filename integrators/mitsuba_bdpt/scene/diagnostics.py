"""Diagnostics: parameters of a scene that spoil images.

Reflectances above 1, spots that rounding changes, and values that are not finite.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..host.introspection import children, named, number, own_parameters

# What names of a BSDF's textures say that they scale the light that it scatters.
_SCALES = ("reflectance", "transmittance", "base_color")

# What is above 1 by more than rounding (8 bits per colour, half precision).
_MORE_THAN_ALL = 1 + 1e-3

# A step of single precision below 1, where cosines of narrow cones are.
_STEP = 2.0**-24

# A step over 1 - cos of the cutoff angle: below 0.2 degrees. The light that is lost or gained is less than
# this quotient, whatever the orientation (stress case `narrow-spots`).
_COARSE = 1e-2

# Numbers of all bitmaps together that are looked at, at most: 2 ms.
_QUICKLY_READ = 1 << 17


@dataclass(frozen=True)
class _Scale:
    """A texture that scales what a BSDF scatters, the parameter ``name``.

    ``owners``: the texture, that BSDF and the objects around it, the innermost first.
    """

    owners: tuple
    name: str


def non_conserving_bsdfs(owners) -> list[str]:
    """Return the BSDFs that are not energy-conserving, in words.

    Found among ``owners``, BSDFs or shapes with a BSDF, and the BSDFs inside them, as far as their parameters
    tell.
    """
    scales = _scales([(owner,) for owner in owners])
    most = max(_QUICKLY_READ // max(len(scales), 1), 1)
    found = [(scale, _largest(scale.owners[0], most)) for scale in scales]
    return [
        f"{_called(scale.owners)} has {scale.name} up to {largest:.4g}"
        for scale, largest in found
        if largest > _MORE_THAN_ALL
    ]


def _scales(chains) -> list[_Scale]:
    """What scales light in the objects that begin these ``chains``, each followed by those around it."""
    chains, found, seen = list(chains), [], set()
    for chain in chains:  # grows on the way
        for name, value in children(chain[0]).items():
            if isinstance(value, mi.BSDF) and id(value) not in seen:
                seen.add(id(value))
                chains.append((value, *chain))
            elif isinstance(value, mi.Texture) and isinstance(chain[0], mi.BSDF) and name.endswith(_SCALES):
                found.append(_Scale((value, *chain), name))
    return found


def _called(owners) -> str:
    """A name for the BSDF that holds the first of ``owners``, a texture, by the nearest that has an id."""
    holder = next((owner for owner in owners[1:] if owner.id()), None)
    if isinstance(holder, mi.BSDF):
        return f"BSDF {named(holder)}"
    texture = owners[0].id() or _file_of(owners[0])
    if texture:
        return f"the BSDF with texture '{texture}'"
    if holder is not None:
        return f"the BSDF of shape {named(holder)}"
    return f"a BSDF without id ({' of '.join(owner.class_name() for owner in owners[1:])})"


def _file_of(texture) -> str:
    """Name of the file of a bitmap, which has no id; only its text tells it. Empty for other textures."""
    found = re.search(r'^\s*name = "(.*)",$', str(texture), re.MULTILINE)
    return found[1] if found and texture.class_name().startswith("BitmapTexture") else ""


def _largest(texture, most: int) -> float:
    """The largest value of a texture, 0 if it cannot be told. Of a bitmap's numbers so many are looked at."""
    inner = [_largest(value, most) for value in children(texture).values() if isinstance(value, mi.Texture)]
    if inner:
        return max(inner)
    try:
        return number(texture.max())
    except RuntimeError:  # not implemented, for bitmaps among others
        pass
    data = own_parameters(texture).get("data")
    if data is None or (mi.is_spectral and data.shape[-1] == 3):
        return 0.0  # of colours these are coefficients of spectra, which are 1 at most
    if dr.is_integral_v(data):
        return 1.0  # at most: bytes are shares of 255, and undoing sRGB keeps 1
    values, count = dr.detach(data.array), min(dr.width(data), most)
    # Sizes are no literals: one kernel for all.
    index = dr.arange(mi.UInt64, count) * dr.opaque(mi.UInt64, dr.width(data)) // dr.opaque(mi.UInt64, count)
    read = dr.gather(type(values), values, mi.UInt32(index))
    return float(np.nanmax(np.array(read, dtype=np.float32), initial=0))


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
            found.append(f"spot {named(emitter)} has cutoff_angle={angle:g} (up to {most} of its light)")
    return found


def not_finite(scene) -> list[str]:
    """Names of the scene's parameters that hold NaN or infinity. (Looks at every number.)"""
    found, held = [], children(scene)
    for name, value in mi.traverse(scene):
        value = getattr(value, "matrix", value)  # of transforms
        if dr.is_float_v(value) and not np.isfinite(np.array(value)).all():
            found.append(_in_words(name, held))
    return found


def _in_words(name: str, held) -> str:
    """Return the ``name`` of a parameter of a scene in words.

    ``held`` are the scene's objects: Mitsuba names one without id by its address, which identifies nothing.
    """
    first, _, rest = name.partition(".")
    owner = held.get(first)
    return f"{rest} of an object {named(owner)}" if isinstance(owner, mi.Object) and not owner.id() else name
