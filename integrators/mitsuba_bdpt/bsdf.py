"""Evaluation of Mitsuba's BSDFs in both directions, and the one home of the adjoint factor.

Directions: ``c`` points towards the camera's side of a vertex, ``l`` towards the light's side, both
away from the surface. On camera subpaths Mitsuba's ``si.wi`` is ``c``. On light subpaths ``si.wi``
is ``l``, and the BSDF is evaluated in *radiance* mode with the two swapped, times the ratio of
geometric cosines |n.c| / |n.l|: exact for bump and normal maps, interpolated normals and hair,
where Mitsuba's importance mode with Veach's correction (thesis, eq. 5.19) is not.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

# Plugins whose sample() returns the density of the lobe that was picked, not that of pdf().
# Plugins that are not Mitsuba's own are treated like them.
_SAMPLED_PDF_IS_PDF = frozenset(
    "SmoothDiffuse SmoothConductor RoughConductor SmoothDielectric RoughDielectric ThinDielectric "
    "SmoothPlastic RoughPlastic PolarizedPlastic Principled PrincipledThin Hair "
    "TwoSidedBRDF MaskBSDF BumpMap NormalMap Null".split()
)


@dataclass
class Evaluation:
    """``value`` f |cos| (light subpaths: adjoint factor included), densities in solid angle.

    ``pdf_fwd`` of leaving into the new direction, ``pdf_rev`` of the reverse.
    """

    value: object
    pdf_fwd: object
    pdf_rev: object


@dataclass
class Step:
    """A sampled direction. Densities in solid angle; ``pdf_*`` are unset where ``delta``."""

    wo: object
    weight: object
    pdf_fwd: object
    pdf_rev: object
    cos_out: object
    delta: object
    null: object
    eta: object


def with_wi(si, wi):
    """A copy of ``si`` that is seen from ``wi``. (Assigning to ``si.wi`` changes aliases.)"""
    other = mi.SurfaceInteraction3f(si)
    other.wi = wi
    return other


def connectible(bsdf):
    """Mask: the BSDF has a lobe that is not delta."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)


def evaluate(bsdf, si, wo, active) -> Evaluation:
    """BSDF of a camera vertex towards the local direction ``wo``, and both densities."""
    ctx = mi.BSDFContext()
    value, pdf_fwd = bsdf.eval_pdf(ctx, si, wo, active)
    pdf_rev = bsdf.pdf(ctx, with_wi(si, wo), si.wi, active)
    return Evaluation(value, pdf_fwd, pdf_rev)


def evaluate_adjoint(bsdf, si, wo, active) -> Evaluation:
    """BSDF of a light vertex towards the local direction ``wo`` (to the camera's side).

    ``value`` includes |n.wo| / |n.wi| with the geometric normal.
    """
    ctx = mi.BSDFContext()
    value, pdf_rev = bsdf.eval_pdf(ctx, with_wi(si, wo), si.wi, active)
    pdf_fwd = bsdf.pdf(ctx, si, wo, active)
    ratio = geometric_cos(si, wo) / geometric_cos(si, si.wi)
    return Evaluation(value * ratio, pdf_fwd, pdf_rev)


def geometric_cos(si, w):
    """Absolute cosine between the local direction ``w`` and the geometric normal."""
    return dr.abs(dr.dot(si.n, si.to_world(w)))


def sample(bsdf, si, u1, u2, active, full_pdf: bool) -> Step:
    """Continue a camera subpath. ``u1`` picks the lobe, ``u2`` the direction.

    ``full_pdf`` asks pdf() instead of trusting sample(), see `needs_full_pdf`.
    """
    ctx = mi.BSDFContext()
    bs, weight = bsdf.sample(ctx, si, u1, u2, active)
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    smooth = active & ~delta
    pdf_fwd = bsdf.pdf(ctx, si, bs.wo, smooth) if full_pdf else bs.pdf
    pdf_rev = bsdf.pdf(ctx, with_wi(si, bs.wo), si.wi, smooth)
    return _step(si, bs, weight, pdf_fwd, pdf_rev)


def sample_adjoint(bsdf, si, u1, u2, active, full_pdf: bool) -> Step:
    """Continue a light subpath; the adjoint factor is part of ``weight``."""
    ctx = mi.BSDFContext(mi.TransportMode.Importance)
    bs, mitsuba_weight = bsdf.sample(ctx, si, u1, u2, active)
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    smooth = active & ~delta
    radiance = mi.BSDFContext()
    value, pdf_rev = bsdf.eval_pdf(radiance, with_wi(si, bs.wo), si.wi, smooth)
    pdf_fwd = bsdf.pdf(radiance, si, bs.wo, smooth) if full_pdf else bs.pdf
    cos_ratio = geometric_cos(si, bs.wo) / geometric_cos(si, si.wi)
    weight = dr.select(
        delta,
        mitsuba_weight * (_event_cos_ratio(si, bs) * cos_ratio),
        value * (cos_ratio / pdf_fwd),
    )
    # A direction that Mitsuba rejects has weight 0, whatever its pdf says.
    valid = (bs.pdf > 0) & (delta | (pdf_fwd > 0))
    valid &= dr.max(dr.abs(mi.unpolarized_spectrum(mitsuba_weight))) > 0
    weight = dr.select(valid, weight, 0)
    return _step(si, bs, weight, pdf_fwd, pdf_rev)


def _event_cos_ratio(si, bs):
    """|m.l| / |m.c| about the normal m of a delta event, which under a bump or normal map is not
    the shading frame's. Reflection and null: 1. Refraction: m along eta_c c + eta_l l.
    """
    m = bs.eta * bs.wo + si.wi  # bs.eta = eta_c / eta_l when sampling from l
    ratio = dr.abs(dr.dot(m, si.wi) / dr.dot(m, bs.wo))
    refracted = mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaTransmission)
    return dr.select(refracted, ratio, 1)


def _step(si, bs, weight, pdf_fwd, pdf_rev) -> Step:
    return Step(
        wo=bs.wo,
        weight=weight,
        pdf_fwd=pdf_fwd,
        pdf_rev=pdf_rev,
        cos_out=geometric_cos(si, bs.wo),
        delta=mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta),
        null=mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null),
        eta=bs.eta,
    )


def needs_full_pdf(bsdfs) -> bool:
    """Whether some BSDF's sample() may report another density than its pdf().

    A mixture that reports the picked lobe's density gives an unbiased ``weight`` but cannot serve
    in the weights of multiple importance sampling, nor as divisor of a full evaluation.
    """
    return any(b.class_name() not in _SAMPLED_PDF_IS_PDF for b in nested(bsdfs))


def nested(bsdfs):
    """``bsdfs`` and every BSDF inside them (two-sided, mask, blend, bump and normal maps)."""
    found = []

    class Collect(mi.TraversalCallback):
        def put(self, name, value, flags, cpptype=None):
            if isinstance(value, mi.BSDF):
                visit(value)

    def visit(bsdf):
        found.append(bsdf)
        bsdf.traverse(Collect())

    for bsdf in bsdfs:
        visit(bsdf)
    return found
