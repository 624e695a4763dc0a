"""Which BSDFs have near-specular lobes: not delta, but so narrow that connections rarely sample them.

A connection over a distance d finds a lobe of density P (solid angle) with a probability proportional to
d^2 / P. P follows from the parameters of Mitsuba's BSDFs; only those of other classes are sampled, once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..geometry.directions import random_directions
from ..geometry.mitsubas_choices import spread_points
from ..host.introspection import number, own_parameters

# Least density (1 / sr, at the axis of the lobe at normal incidence) of a near-specular lobe: that of alpha
# .063 in reflection, of .38 in refraction by glass. See experiments, "Near-specular lobes".
NARROW = 20.0

# Least density (1 / sr) from both sides of an event that counts as specular in guiding, see `sds` and
# experiments, "Photon-guided BSDF sampling".
SPECULAR = 2.0

# Least cosine of incidence of sampled BSDFs: at grazing incidence all glossy lobes are narrow.
_LEAST_COS = 0.5

# ``cached(bsdf, name, find)``: the result of ``find()``, called ``name``, of the BSDF's parameters alone.
Cached = Callable[[Any, str, Callable[[], float]], float]

# Least or, with the sign -1, the negative largest value of a BSDF's parameter, the first one in use of
# these names, or 0.
Bound = Callable[..., float]


def near_specular(family: Collection[tuple[mi.BSDF, dict]], cached: Cached) -> list[tuple[mi.BSDF, float]]:
    """The BSDFs of a `draws.family` with a near-specular lobe, also of nested BSDFs, and its `density`."""
    own = {id(bsdf): (density(bsdf, held, cached), held) for bsdf, held in family}

    def largest(bsdf: mi.BSDF) -> float:
        found, held = own[id(bsdf)]
        return max(found, *(largest(inner) for inner in held.values() if id(inner) in own), 0.0)

    return [(bsdf, peak) for bsdf, _ in family if (peak := largest(bsdf)) >= NARROW]


def is_narrow(f, least: float | None = None):
    """Mask: near-specular scattering, by its densities from both sides, so that both subpaths agree.

    ``f``: an `Evaluation`, or a `Step` that is not delta; ``least`` density, by default `NARROW`.
    """
    least = NARROW if least is None else least
    return ~f.volume & (dr.minimum(f.pdf_fwd_w, f.pdf_rev_w) >= least)


def density(bsdf: mi.BSDF, held: dict, cached: Cached) -> float:
    """Approximate largest density (solid angle) of the BSDF's own glossy lobes, 0 if it has none.

    ``held``: its `children`. Attributes of meshes count as 0.
    """
    if not mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy) or bsdf.class_name() in _AROUND_OTHERS:
        return 0.0
    peak = _PEAKS.get(bsdf.class_name())
    if peak is None:
        return cached(bsdf, "density", partial(_sampled, bsdf))

    def bound(*names: str, sign: int = 1) -> float:
        name = next((name for name in names if name in held), None)
        if name is None:
            return 0.0
        if isinstance(held[name], mi.Texture):
            return _bound(held[name], sign, partial(cached, bsdf, f"{name} {sign}"))
        return sign * float(number(own_parameters(bsdf)[name]))

    return peak(bsdf, bound)


# -- Mitsuba's BSDFs --------------------------------------------------------------------------


def _microfacets(alpha: float) -> float:
    """Density of half vectors along the normal, of GGX and Beckmann; ``alpha``^2 = alpha_u alpha_v."""
    return 1 / (math.pi * max(alpha, 1e-4) ** 2)  # Mitsuba's least alpha


def _refracted(alpha: float, eta: float) -> float:
    """Density of refraction along the normal, in the narrower of both directions."""
    return _microfacets(alpha) * (max(eta, 1.0) / max(abs(eta - 1), 1e-6)) ** 2


def _unit(x: float) -> float:
    return min(max(x, 0), 1)


def _alpha(least: Bound) -> float:
    return math.sqrt(max(least("alpha_u", "alpha"), 0) * max(least("alpha_v", "alpha"), 0))


def _rough(bsdf, least: Bound) -> float:
    return _microfacets(_alpha(least)) / 4


def _principled(bsdf, least: Bound) -> float:
    alpha = max(max(least("roughness"), 0) ** 2, 1e-3)
    found = _microfacets(alpha) / 4
    if mi.has_flag(bsdf.flags(), mi.BSDFFlags.GlossyTransmission):
        eta = least("eta") or 2 / (1 - math.sqrt(0.08 * _unit(least("specular")))) - 1
        found = max(found, _refracted(alpha, eta))
    if coat := -least("clearcoat", sign=-1):  # GTR1, sampled at a quarter of the others' rate
        a = 0.1 + (0.001 - 0.1) * _unit(-least("clearcoat_gloss", sign=-1))
        found = max(found, coat * (a**2 - 1) / (2 * math.pi * math.log(a) * a**2) / 4 / 4)
    return found


def _thin(bsdf, least: Bound) -> float:
    """Of `principledthin`, which is specular only with ``spec_trans``; it refracts by a narrower lobe."""
    if not least("spec_trans", sign=-1):
        return 0.0
    narrower = _unit(0.65 * least("eta") - 0.35)
    return _microfacets(max((narrower * max(least("roughness"), 0)) ** 2, 1e-3)) / 4


_PEAKS = {
    "RoughConductor": _rough,
    "RoughPlastic": _rough,
    "RoughDielectric": lambda _, least: _refracted(_alpha(least), least("eta")),
    "Principled": _principled,
    "PrincipledThin": _thin,
}

# BSDFs whose lobes are those of nested ones.
_AROUND_OTHERS = frozenset({"TwoSidedBRDF", "MaskBSDF", "BlendBSDF", "BumpMap", "NormalMap"})


# -- textures and other BSDFs -----------------------------------------------------------------


def _bound(texture: mi.Texture, sign: int, cached: Callable) -> float:
    """Least value of ``sign`` times a ``texture`` of one number per point; ``cached(find)``: ``find()``."""
    kind = texture.class_name()
    if kind == "UniformSpectrum":
        return sign * float(number(own_parameters(texture)["value"]))
    data = own_parameters(texture).get("data") if kind.startswith("BitmapTexture") else None
    # Spectral variants store coefficients of colours. Of several channels the luminance is read.
    if data is not None and not dr.is_integral_v(data) and not (mi.is_spectral and data.shape[-1] == 3):
        values = dr.detach(data.array)
        return float(number(dr.min(values) if sign > 0 else -dr.max(values)))
    return cached(partial(_evaluated, texture, sign))


def _evaluated(texture: mi.Texture, sign: int) -> float:
    """`_bound` of values at points all over the unit square of texture coordinates."""
    found = np.array(texture.eval_1(spread_interactions(), mi.Bool(True)), dtype=np.float64)
    return float(np.nanmin(sign * found, initial=math.inf))


def _sampled(bsdf: mi.BSDF) -> float:
    """Largest density of samples of a BSDF, at points all over its textures, from both sides."""
    si, ctx = spread_interactions(), mi.BSDFContext()
    u = np.random.default_rng(1).random((3, dr.width(si)), dtype=np.float32)
    bs, weight = bsdf.sample(ctx, si, mi.Float(u[0]), mi.Point2f(u[1], u[2]), mi.Bool(True))
    glossy = ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    glossy &= dr.max(mi.unpolarized_spectrum(weight)) > 0
    pdf = np.array(dr.select(glossy, bsdf.pdf(ctx, si, bs.wo, glossy), 0), dtype=np.float64)
    return float(np.nanmax(pdf, initial=0))


def spread_interactions(count: int = 4096) -> mi.SurfaceInteraction3f:
    """Points of a plane with all texture coordinates in the unit square, seen from both sides."""
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.uv = spread_points(count)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    d = random_directions(np.random.default_rng(0), count)
    cos = dr.copysign(_LEAST_COS + (1 - _LEAST_COS) * dr.abs(d.z), d.z)
    sin = dr.safe_sqrt(1 - dr.square(cos)) * dr.rsqrt(dr.maximum(1 - dr.square(d.z), 1e-9))
    si.wi = mi.Vector3f(d.x * sin, d.y * sin, cos)
    if mi.is_spectral:
        step = (mi.MI_CIE_MAX - mi.MI_CIE_MIN) / 4
        si.wavelengths = mi.UnpolarizedSpectrum(*(mi.MI_CIE_MIN + (i + 0.5) * step for i in range(4)))
    return si
