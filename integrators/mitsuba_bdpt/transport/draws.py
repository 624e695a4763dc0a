"""Directions that Mitsuba's BSDFs draw, with the density that they are drawn by.

Multiple importance sampling asks that the density of a draw is what ``pdf()`` says of its direction. That of
Mitsuba's ``blendbsdf`` (3.9.1) is another: it keeps what one of its parts has drawn and rejected (a
``diffuse`` from behind, a ``roughdielectric`` below the horizon), with what the other part reflects there,
and it mixes the probability of a delta event with the density of the other part, so that mirrors within are
too dark. So a blend is drawn here by its parts.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..host.introspection import children
from .spectra import is_zero

# Plugins whose sample() returns the density of the lobe that was picked, not that of pdf().
# Plugins that are not Mitsuba's own are treated like them.
_SAMPLED_PDF_IS_PDF = frozenset(
    "SmoothDiffuse SmoothConductor RoughConductor SmoothDielectric RoughDielectric ThinDielectric "
    "SmoothPlastic RoughPlastic PolarizedPlastic Principled PrincipledThin Hair "
    "TwoSidedBRDF MaskBSDF BumpMap NormalMap Null".split()
)

# Plugins inside of which there are other frames.
MAPS = "BumpMap", "NormalMap"


@dataclass
class Draw:
    """A direction ``bs`` and its ``weight``, f |cos| over its density (or probability, if it is delta).

    ``density``: that by which it was drawn (solid angle), `bs.pdf` but for what `_density` says. Where it was
    ``rejected`` there is none, whatever is stated.
    """

    bs: mi.BSDFSample3f
    weight: mi.Spectrum
    density: mi.Float
    rejected: mi.Bool


def draw(bsdf, si: mi.SurfaceInteraction3f, u1: mi.Float, u2: mi.Point2f, active: mi.Bool) -> Draw:
    """What a BSDF draws in radiance mode where ``active``; ``u1`` picks the lobe, ``u2`` the direction.

    ``bs.pdf`` is what Mitsuba's ``sample`` states, of a blend its ``pdf()`` (solid angle); or the probability
    of a delta event.
    """
    if not by_parts(bsdf):
        return _by_mitsuba(bsdf, si, u1, u2, active)
    return _BY_PARTS[bsdf.class_name()](bsdf, si, u1, u2, active)


def by_parts(bsdf) -> bool:
    """Whether `draw` asks the parts of a BSDF: a blend is among them.

    Not under bump and normal maps, nor of a pointer, of which any may be meant: there draws are Mitsuba's.
    """
    if not isinstance(bsdf, mi.BSDF) or bsdf.class_name() not in _BY_PARTS:
        return False
    return any(b.class_name() == "BlendBSDF" for b in nested([bsdf]))


def _by_mitsuba(bsdf, si, u1, u2, active) -> Draw:
    bs, weight = bsdf.sample(mi.BSDFContext(), si, u1, u2, active)
    return Draw(bs, weight, bs.pdf, is_zero(weight))


def _blend(bsdf, si, u1, u2, active) -> Draw:
    """Of a ``blendbsdf``: one part draws, and where it does not reject, both are evaluated."""
    parts, share = children(bsdf), _share(bsdf, si, active)
    second = u1 < share
    found = [
        _part(parts["bsdf_0"], si, (u1 - share) / (1 - share), u2, active & ~second),
        _part(parts["bsdf_1"], si, u1 / share, u2, active & second),
    ]
    mine = dr.select(second, found[1], found[0])
    bs, delta = mine.bs, mi.has_flag(mine.bs.sampled_type, mi.BSDFFlags.Delta)
    smooth = active & ~mine.rejected & ~delta
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, bs.wo, smooth)
    bs.pdf = dr.select(delta, bs.pdf * dr.select(second, share, 1 - share), pdf)
    density = dr.select(delta, bs.pdf, _density(bsdf, si, bs.wo, pdf, smooth))
    # A direction that is NaN has a density of 0; it is not rejected, but counted, as is a share that is NaN.
    rejected = mine.rejected | ((density == 0) & ~dr.isnan(bs.wo.z))
    weight = dr.select(rejected, 0, dr.select(delta, mine.weight, value / density))
    return _unless_nan(share, Draw(bs, weight, density, rejected))


def _share(bsdf, si, active) -> mi.Float:
    """The share of a blend's second part, or that of what is masked."""
    texture = children(bsdf)["weight" if bsdf.class_name() == "BlendBSDF" else "opacity"]
    share = texture.eval_1(si, active)
    return dr.select(dr.isnan(share), share, dr.clip(share, 0, 1))


def _unless_nan(share, found: Draw) -> Draw:
    bad = dr.isnan(share)
    return Draw(found.bs, dr.select(bad, dr.nan, found.weight), found.density, found.rejected & ~bad)


def _part(bsdf, si, u1, u2, active) -> Draw:
    """What a part of a blend draws.

    It is rejected on a side to which its lobe (if it tells) does not lead, and where its weight is 0 though
    it is not black: where a black part draws, the other one may be seen.
    """
    found, cos_theta = draw(bsdf, si, u1, u2, active), mi.Frame3f.cos_theta
    if by_parts(bsdf):
        return found
    bs = found.bs
    smooth = active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    f, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, bs.wo, smooth)
    rejected = is_zero(found.weight) & (~is_zero(f) | (pdf == 0) | (bs.sampled_type == 0))
    if not any(b.class_name() in MAPS for b in nested([bsdf])):  # sides are those of another frame
        side = cos_theta(si.wi) * cos_theta(bs.wo)  # false for NaN
        reflects, passes = (
            mi.has_flag(bs.sampled_type, f) for f in (mi.BSDFFlags.Reflection, mi.BSDFFlags.Transmission)
        )
        rejected |= ((side > 0) & passes & ~reflects) | ((side < 0) & reflects & ~passes)
    return Draw(bs, found.weight, found.density, dr.select(smooth, rejected, found.rejected))


def _density(bsdf, si, wo, pdf, active):
    """The density by which a BSDF that states ``pdf`` draws the direction ``wo`` (solid angle).

    From behind, a ``principled`` without transmission states a density, and draws nothing.
    """
    kind = bsdf.class_name()
    if kind == "TwoSidedBRDF" or not any(_is_blind_behind(b) for b in nested([bsdf])):
        return pdf
    if _is_blind_behind(bsdf):
        return dr.select(mi.Frame3f.cos_theta(si.wi) > 0, pdf, 0)
    if kind not in _BY_PARTS:  # a map
        return pdf

    def of(part):
        return _density(part, si, wo, part.pdf(mi.BSDFContext(), si, wo, active), active)

    parts, share = children(bsdf), _share(bsdf, si, active)
    if kind == "MaskBSDF":
        return share * of(parts["nested_bsdf"])
    return (1 - share) * of(parts["bsdf_0"]) + share * of(parts["bsdf_1"])


def _is_blind_behind(bsdf) -> bool:
    return bsdf.class_name() == "Principled" and not mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission)


def _two_sided(bsdf, si, u1, u2, active) -> Draw:
    """Of a ``twosided``: its parts see the world mirrored from behind."""
    parts, back = children(bsdf), mi.Frame3f.cos_theta(si.wi) < 0
    si = mi.SurfaceInteraction3f(si)
    si.wi = mi.Vector3f(si.wi.x, si.wi.y, dr.abs(si.wi.z))
    first, second = parts["brdf_0"], parts["brdf_1"]
    found = draw(first, si, u1, u2, active & ~back if second is not first else active)
    if second is not first:
        found = dr.select(back, draw(second, si, u1, u2, active & back), found)
    wo = found.bs.wo
    found.bs.wo = mi.Vector3f(wo.x, wo.y, dr.select(back, -wo.z, wo.z))
    return found


def _mask(bsdf, si, u1, u2, active) -> Draw:
    """Of a ``mask``: straight on, or what is masked."""
    opacity, straight_on = _share(bsdf, si, active), dr.zeros(mi.BSDFSample3f)
    seen = u1 < opacity
    straight_on.wo, straight_on.eta, straight_on.pdf = -si.wi, mi.Float(1), 1 - opacity
    straight_on.sampled_type = mi.UInt32(int(mi.BSDFFlags.Null))
    found = draw(children(bsdf)["nested_bsdf"], si, u1 / opacity, u2, active & seen)
    found.bs.pdf, found.density = found.bs.pdf * opacity, found.density * opacity
    passing = Draw(straight_on, mi.Spectrum(1), 1 - opacity, mi.Bool(False))
    return _unless_nan(opacity, dr.select(seen, found, passing))


_BY_PARTS = {"BlendBSDF": _blend, "TwoSidedBRDF": _two_sided, "MaskBSDF": _mask}


def none_from_behind(bsdfs: Iterable[mi.BSDF], si, bs: mi.BSDFSample3f):
    """Mask: no direction was drawn, since ``si`` is seen from behind a rough conductor of ``bsdfs``.

    Mitsuba's (Beckmann) draws NaN there and takes it back by a weight of 0, which Mitsuba's blend multiplies
    by the density, NaN. No other BSDF of Mitsuba's does: NaN of others is counted.
    """
    if not any(b.class_name() == "RoughConductor" for b in nested(bsdfs)):
        return mi.Bool(False)
    return (mi.Frame3f.cos_theta(si.wi) <= 0) & dr.isnan(bs.wo.z)


def needs_full_pdf(bsdfs: Iterable[mi.BSDF]) -> bool:
    """Whether some BSDF's sample() may report another density than its pdf().

    A mixture that reports the picked lobe's density gives an unbiased ``weight`` but cannot serve
    in the weights of multiple importance sampling, nor as divisor of a full evaluation.
    """
    return any(b.class_name() not in _SAMPLED_PDF_IS_PDF for b in nested(bsdfs))


def nested(bsdfs: Iterable[mi.BSDF]) -> list[mi.BSDF]:
    """``bsdfs`` and every BSDF inside them (two-sided, mask, blend, bump and normal maps)."""
    found = list(bsdfs)
    for bsdf in found:  # grows on the way
        found += [value for value in children(bsdf).values() if isinstance(value, mi.BSDF)]
    return found


def structure(plugin: mi.Object) -> tuple[Any, ...]:
    """The class of ``plugin`` and the structures of what it holds (BSDFs, textures), by name."""
    held = {name: value for name, value in children(plugin).items() if isinstance(value, mi.Object)}
    return plugin.class_name(), *((name, structure(held[name])) for name in sorted(held))
