"""Emitters whose radiance is 0 everywhere, or negative."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..host.introspection import children, named, number, own_parameters
from .group import Context, HitOnlyEmitters

# Names of the textures that scale the light of Mitsuba's emitters.
_FACTORS = ("radiance", "intensity", "irradiance", "texture")

# Classes of textures whose `mean` is 0 where they are black.
_KNOWN = ("SRGBReflectanceSpectrum", "UniformSpectrum", "BitmapTexture", "BlackBodySpectrum")

_QUICKLY_READ = 1 << 16  # values that are read of a picture
_QUICKLY_COPIED = 1 << 20  # largest array that is copied from a GPU


class BlackEmitters(HitOnlyEmitters):
    """Mitsuba's emitters without light, whose textures have no density (NaN) to sample by."""

    limits = "it emits no light: its radiance is 0 everywhere"

    @classmethod
    def left_out(cls, emitter) -> list[tuple[str, str]]:
        return [(f"emitter {named(emitter.get_shape() or emitter)}", cls.limits)]

    def __init__(self, emitters, context: Context):
        self.redraws = [emitter is not None for emitter in emitters]


def is_black(emitter: mi.Emitter) -> bool:
    """Whether one of Mitsuba's emitters is known to emit no light."""
    own, found = own_parameters(emitter), children(emitter)
    if any(map(_is_black, _textures(found))):
        return True
    if "sun_scale" in found:
        return number(own["sun_scale"]) == number(own["sky_scale"]) == 0
    if "scale" not in found:
        return False
    return number(own["scale"]) == 0 or ("data" in own and not _any_lit(own["data"]))


def _textures(found: dict) -> list[mi.Texture]:
    return [found[name] for name in _FACTORS if isinstance(found.get(name), mi.Texture)]


def is_negative(emitter: mi.Emitter) -> bool:
    """Whether one of Mitsuba's emitters is known to have negative radiance; reads some values of pictures."""
    found = children(emitter)
    held = [_data(texture) for texture in _textures(found)]
    if "scale" in found:
        own = own_parameters(emitter)
        held += [own["scale"], own.get("data")]
    # In spectral variants most values are coefficients.
    known = () if mi.is_spectral else (_values(data) for data in held)
    some = (values[:: len(values) // _QUICKLY_READ + 1] for values in known if values is not None)
    return any(bool((values < 0).any()) for values in some)


def _is_black(texture: mi.Texture) -> bool:
    if not texture.class_name().startswith(_KNOWN) or number(texture.mean()) != 0:
        return False
    return bool(mi.is_spectral) or not _any_lit(_data(texture))


def _data(texture: mi.Texture):
    """Return the values of a texture of a class in `_KNOWN`, None of others."""
    own = own_parameters(texture) if texture.class_name().startswith(_KNOWN) else {}
    return own.get("data", own.get("value"))


def _any_lit(data) -> bool:
    values = _values(data)
    if mi.is_spectral and values is not None:
        values = values[3::4]  # of a spectral envmap: the scale of three coefficients
    return values is None or bool(values[:: len(values) // _QUICKLY_READ + 1].any()) or bool(values.any())


def _values(data) -> np.ndarray | None:
    """Return an array's values, without a copy in LLVM variants; None where a copy takes long."""
    if data is None:
        return None
    data = dr.detach(data.array if dr.is_tensor_v(data) else data)
    if dr.depth_v(data) == 1 and dr.backend_v(data) == dr.JitBackend.LLVM:
        return np.from_dlpack(data)
    return np.array(data) if dr.width(data) <= _QUICKLY_COPIED else None
