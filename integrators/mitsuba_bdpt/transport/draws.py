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

import drjit as dr
import mitsuba as mi

from ..host.introspection import children

# Plugins whose sample() returns the density of the lobe that was picked, not that of pdf().
# Plugins that are not Mitsuba's own are treated like them.
_SAMPLED_PDF_IS_PDF = frozenset(
    "SmoothDiffuse SmoothConductor RoughConductor SmoothDielectric RoughDielectric ThinDielectric "
    "SmoothPlastic RoughPlastic PolarizedPlastic Principled PrincipledThin Hair "
    "TwoSidedBRDF MaskBSDF BumpMap NormalMap Null".split()
)

# What is drawn by its parts if a blend is among them. Under bump and normal maps Mitsuba's draws are kept.
_WRAPPERS = "TwoSidedBRDF", "MaskBSDF"

# Plugins that say by a weight of 0 alone that they reject a direction: their density may be that of other
# lobes, or sides are those of another frame. (Of other plugins a weight of 0 may mean that they are black.)
_REJECT_BY_WEIGHT = "Principled", "PrincipledThin", "BumpMap", "NormalMap"

# Ratio of two densities of one direction above which it was drawn by another one. (Rounding of half vectors
# gives up to 1.1 with a roughness of 1e-3; a part that rejects has a density of 0, mostly.)
_SAME = 2.0


@dataclass
class Draw:
    """A direction ``bs`` and its ``weight``, f |cos| over its density (or probability, if it is delta).

    Where it was ``rejected`` there is none, whatever density is stated.
    """

    bs: mi.BSDFSample3f
    weight: mi.Spectrum
    rejected: mi.Bool


def draw(bsdf, si: mi.SurfaceInteraction3f, u1: mi.Float, u2: mi.Point2f, active: mi.Bool) -> Draw:
    """What a BSDF draws in radiance mode where ``active``; ``u1`` picks the lobe, ``u2`` the direction.

    ``bs.pdf`` is the density of ``bsdf.pdf()`` (solid angle), unless `needs_full_pdf`, or the probability of
    a delta event.
    """
    if not by_parts(bsdf):
        return _by_mitsuba(bsdf, si, u1, u2, active)
    return _BY_PARTS[bsdf.class_name()](bsdf, si, u1, u2, active)


def by_parts(bsdf) -> bool:
    """Whether `draw` asks the parts of a BSDF. (A pointer, of which any may be meant, has none.)"""
    if not isinstance(bsdf, mi.BSDF):
        return False
    kind = bsdf.class_name()
    if kind in _WRAPPERS:
        return any(by_parts(part) for part in children(bsdf).values())
    return kind == "BlendBSDF"


def _by_mitsuba(bsdf, si, u1, u2, active) -> Draw:
    bs, weight = bsdf.sample(mi.BSDFContext(), si, u1, u2, active)
    return Draw(bs, weight, is_zero(weight))


def _blend(bsdf, si, u1, u2, active) -> Draw:
    """Of a ``blendbsdf``: one part draws, and where it does not reject, both are evaluated."""
    parts, ctx = children(bsdf), mi.BSDFContext()
    share = dr.clip(parts["weight"].eval_1(si, active), 0, 1)
    second = u1 <= share
    found = [
        _part(parts["bsdf_0"], si, (u1 - share) / (1 - share), u2, active & ~second),
        _part(parts["bsdf_1"], si, u1 / share, u2, active & second),
    ]
    mine = dr.select(second, found[1], found[0])
    bs = mine.bs
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    value, pdf = bsdf.eval_pdf(ctx, si, bs.wo, active & ~mine.rejected & ~delta)
    bs.pdf = dr.select(delta, bs.pdf * dr.select(second, share, 1 - share), pdf)
    rejected = mine.rejected | (bs.pdf == 0)
    weight = dr.select(rejected, 0, dr.select(delta, mine.weight, value / pdf))
    return Draw(bs, weight, rejected)


def _part(bsdf, si, u1, u2, active) -> Draw:
    """What a part of a blend draws.

    It is rejected on the side to which its lobe does not lead, and where the density that it states is not
    its ``pdf()``; not by its weight: where a black part draws, the other one may be seen.
    """
    found, kinds = draw(bsdf, si, u1, u2, active), {b.class_name() for b in nested([bsdf])}
    if by_parts(bsdf) or needs_full_pdf([bsdf]) or not kinds.isdisjoint(_REJECT_BY_WEIGHT):
        return found
    bs, cos_theta = found.bs, mi.Frame3f.cos_theta
    smooth = active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    pdf = bsdf.pdf(mi.BSDFContext(), si, bs.wo, smooth)
    # False for NaN.
    rejected = (bs.pdf == 0) | (bs.pdf > _SAME * pdf) | (pdf > _SAME * bs.pdf)
    through = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Transmission)
    rejected |= cos_theta(si.wi) * cos_theta(bs.wo) * dr.select(through, 1, -1) > 0
    return Draw(bs, found.weight, dr.select(smooth, rejected, found.rejected))


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
    parts, straight_on = children(bsdf), dr.zeros(mi.BSDFSample3f)
    opacity = dr.clip(parts["opacity"].eval_1(si, active), 0, 1)
    seen = u1 < opacity
    straight_on.wo, straight_on.eta, straight_on.pdf = -si.wi, mi.Float(1), 1 - opacity
    straight_on.sampled_type = mi.UInt32(int(mi.BSDFFlags.Null))
    found = draw(parts["nested_bsdf"], si, u1 / opacity, u2, active & seen)
    found.bs.pdf = found.bs.pdf * opacity
    return dr.select(seen, found, Draw(straight_on, mi.Spectrum(1), mi.Bool(False)))


_BY_PARTS = {"BlendBSDF": _blend, "TwoSidedBRDF": _two_sided, "MaskBSDF": _mask}


def is_drawn_from_behind(bsdfs: Iterable[mi.BSDF], si, bs: mi.BSDFSample3f):
    """Mask: no direction was drawn, since ``si`` is seen from behind a rough conductor of ``bsdfs``.

    Mitsuba's (Beckmann) draws NaN there and takes it back by a weight of 0, which is NaN once multiplied by
    the density. No other BSDF of Mitsuba's does: NaN of others is counted.
    """
    if not any(b.class_name() == "RoughConductor" for b in nested(bsdfs)):
        return mi.Bool(False)
    return (mi.Frame3f.cos_theta(si.wi) <= 0) & dr.isnan(bs.wo.z)


def is_zero(value: mi.Spectrum):
    """Mask: all entries of a spectrum are 0. NaN and infinity are not."""
    return dr.all(mi.unpolarized_spectrum(value) == 0)


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
