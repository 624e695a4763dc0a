"""Samples Mitsuba's BSDFs with the density of the sampled direction.

Multiple importance sampling requires that the density of a sample equals ``pdf()`` of its direction.
Mitsuba's ``blendbsdf`` (3.9.1) violates it, see docs/user/differences.md; it is sampled here by its parts.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi

from ..host.introspection import children
from .spectra import is_zero

# Plugins whose sample() returns pdf(). Others, third-party ones included, may return that of the picked lobe.
_SAMPLED_PDF_IS_PDF = frozenset(
    "SmoothDiffuse SmoothConductor RoughConductor SmoothDielectric RoughDielectric ThinDielectric "
    "SmoothPlastic RoughPlastic PolarizedPlastic Principled PrincipledThin Hair "
    "TwoSidedBRDF MaskBSDF BumpMap NormalMap Null".split()
)

MAPS = "BumpMap", "NormalMap"  # plugins that change the frame of nested BSDFs
_BY_PARTS = "BlendBSDF", "TwoSidedBRDF", "MaskBSDF"  # plugins that are sampled here if they contain a blend


@dataclass
class Draw:
    """A direction ``bs``; ``weight``: f |cos| / density (or probability, if delta).

    ``density``: solid angle, `bs.pdf` corrected by `_density`; unspecified where ``rejected``.
    """

    bs: mi.BSDFSample3f
    weight: mi.Spectrum
    density: mi.Float
    rejected: mi.Bool


def draw(bsdf, si: mi.SurfaceInteraction3f, u1: mi.Float, u2: mi.Point2f, active: mi.Bool) -> Draw:
    """Sample a BSDF in radiance mode; ``u1`` picks the lobe, ``u2`` the direction.

    ``bs.pdf``: Mitsuba's; of a blend ``pdf()`` (solid angle) or the probability of a delta event.
    """
    if not by_parts(bsdf):
        bs, weight = bsdf.sample(mi.BSDFContext(), si, u1, u2, active)
        return Draw(bs, weight, bs.pdf, is_zero(weight))
    if bsdf.class_name() == "TwoSidedBRDF":
        return _two_sided(bsdf, si, u1, u2, active)
    share = _share(bsdf, si, active)
    found = (_blend if bsdf.class_name() == "BlendBSDF" else _mask)(bsdf, si, share, u1, u2, active)
    bad = dr.isnan(share)  # to be counted
    return Draw(found.bs, dr.select(bad, dr.nan, found.weight), found.density, found.rejected & ~bad)


def draw_delta(bsdf, si: mi.SurfaceInteraction3f, u1: mi.Float, u2: mi.Point2f, active: mi.Bool) -> Draw:
    """Sample the delta lobes of a BSDF in radiance mode; rejected without one."""
    context = mi.BSDFContext(mi.TransportMode.Radiance, +mi.BSDFFlags.Delta)
    bs, weight = bsdf.sample(context, si, u1, u2, active)
    rejected = is_zero(weight) | ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    return Draw(bs, dr.select(rejected, 0, weight), bs.pdf, rejected)


def by_parts(bsdf) -> bool:
    """Whether `draw` samples the parts of a BSDF: it is or contains a blend.

    Mitsuba samples blends under bump and normal maps, and those of pointers.
    """
    if not isinstance(bsdf, mi.BSDF) or bsdf.class_name() not in _BY_PARTS:
        return False
    return any(b.class_name() == "BlendBSDF" for b in nested([bsdf]))


def _blend(bsdf, si, share, u1, u2, active) -> Draw:
    """Sample one part of a ``blendbsdf``, and evaluate both unless it rejects."""
    parts, second = children(bsdf), u1 < share
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
    # A NaN direction has density 0; it is counted, not rejected.
    rejected = mine.rejected | ((density == 0) & ~dr.isnan(bs.wo.z))
    weight = dr.select(rejected, 0, dr.select(delta, mine.weight, value / density))
    return Draw(bs, weight, density, rejected)


def _share(bsdf, si, active) -> mi.Float:
    """Share of a blend's second part, or opacity of a mask."""
    texture = children(bsdf)["weight" if bsdf.class_name() == "BlendBSDF" else "opacity"]
    share = texture.eval_1(si, active)
    return dr.select(dr.isnan(share), share, dr.clip(share, 0, 1))


def _part(bsdf, si, u1, u2, active) -> Draw:
    """Sample a part of a blend.

    Rejected on a side to which the sampled lobe (if known) does not scatter, and where its weight is 0
    although it is not black: where a black part is sampled, the other one may contribute.
    """
    found = draw(bsdf, si, u1, u2, active)
    if by_parts(bsdf):
        return found
    bs, has = found.bs, partial(mi.has_flag, found.bs.sampled_type)
    smooth = active & ~has(mi.BSDFFlags.Delta)
    f, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, bs.wo, smooth)
    rejected = is_zero(found.weight) & (~is_zero(f) | (pdf == 0) | (bs.sampled_type == 0))
    if not any(b.class_name() in MAPS for b in nested([bsdf])):  # sides refer to another frame
        side = mi.Frame3f.cos_theta(si.wi) * mi.Frame3f.cos_theta(bs.wo)  # false for NaN
        reflects, passes = has(mi.BSDFFlags.Reflection), has(mi.BSDFFlags.Transmission)
        rejected |= ((side > 0) & passes & ~reflects) | ((side < 0) & reflects & ~passes)
    found.rejected = dr.select(smooth, rejected, found.rejected)
    return found


def _density(bsdf, si, wo, pdf, active):
    """Density (solid angle) with which a BSDF of this ``pdf`` samples ``wo``.

    From behind, a ``principled`` without transmission has a density but samples nothing.
    """
    kind, through = bsdf.class_name(), mi.BSDFFlags.Transmission
    blind = [
        b for b in nested([bsdf]) if b.class_name() == "Principled" and not mi.has_flag(b.flags(), through)
    ]
    if not blind or kind in ("TwoSidedBRDF", *MAPS):
        return pdf
    if kind == "Principled":
        return dr.select(mi.Frame3f.cos_theta(si.wi) > 0, pdf, 0)

    def of(part):
        return _density(part, si, wo, part.pdf(mi.BSDFContext(), si, wo, active), active)

    parts, share = children(bsdf), _share(bsdf, si, active)
    if kind == "MaskBSDF":
        return share * of(parts["nested_bsdf"])
    return (1 - share) * of(parts["bsdf_0"]) + share * of(parts["bsdf_1"])


def _two_sided(bsdf, si, u1, u2, active) -> Draw:
    """Sample a ``twosided``: its parts are mirrored from behind."""
    parts, back = children(bsdf), mi.Frame3f.cos_theta(si.wi) < 0
    si = mi.SurfaceInteraction3f(si)
    si.wi = mi.Vector3f(si.wi.x, si.wi.y, dr.abs(si.wi.z))
    found = draw(parts["brdf_0"], si, u1, u2, active)
    if parts["brdf_1"] is not parts["brdf_0"]:
        found = dr.select(back, draw(parts["brdf_1"], si, u1, u2, active), found)
    wo = found.bs.wo
    found.bs.wo = mi.Vector3f(wo.x, wo.y, dr.select(back, -wo.z, wo.z))
    return found


def _mask(bsdf, si, opacity, u1, u2, active) -> Draw:
    """Sample a ``mask``: null event or the nested BSDF."""
    seen, straight_on = u1 < opacity, dr.zeros(mi.BSDFSample3f)
    straight_on.wo, straight_on.eta, straight_on.pdf = -si.wi, mi.Float(1), 1 - opacity
    straight_on.sampled_type = mi.UInt32(int(mi.BSDFFlags.Null))
    found = draw(children(bsdf)["nested_bsdf"], si, u1 / opacity, u2, active & seen)
    found.bs.pdf, found.density = found.bs.pdf * opacity, found.density * opacity
    return dr.select(seen, found, Draw(straight_on, mi.Spectrum(1), 1 - opacity, mi.Bool(False)))


def none_from_behind(bsdfs: Iterable[mi.BSDF], si, bs: mi.BSDFSample3f):
    """Mask: no direction was sampled on the back of a rough conductor of ``bsdfs``.

    Mitsuba samples NaN there (Beckmann) with weight 0, in a blend NaN. NaN of other BSDFs is counted.
    """
    if not any(b.class_name() == "RoughConductor" for b in nested(bsdfs)):
        return mi.Bool(False)
    return (mi.Frame3f.cos_theta(si.wi) <= 0) & dr.isnan(bs.wo.z)


def needs_full_pdf(bsdfs: Iterable[mi.BSDF]) -> bool:
    """Whether sample() of one of ``bsdfs`` may report a density other than pdf(), as of the picked lobe.

    This serves neither in weights of multiple importance sampling nor as divisor of a full evaluation.
    """
    return any(b.class_name() not in _SAMPLED_PDF_IS_PDF for b in bsdfs)


def family(bsdfs: Iterable[mi.BSDF]) -> list[tuple[mi.BSDF, dict]]:
    """``bsdfs`` and all nested in them, each once, with their children."""
    found, left = {}, list(bsdfs)
    for bsdf in left:  # grows in the loop
        if id(bsdf) not in found:
            found[id(bsdf)] = bsdf, children(bsdf)
            left += [value for value in found[id(bsdf)][1].values() if isinstance(value, mi.BSDF)]
    return list(found.values())


def nested(bsdfs: Iterable[mi.BSDF]) -> list[mi.BSDF]:
    """The BSDFs of the `family` of ``bsdfs``."""
    return [bsdf for bsdf, _ in family(bsdfs)]
