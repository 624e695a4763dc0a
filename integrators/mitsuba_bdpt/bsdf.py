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

from .objects import children

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

    ``pdf_fwd_w`` of leaving into the new direction, ``pdf_rev_w`` of the reverse.
    """

    value: object
    pdf_fwd_w: object
    pdf_rev_w: object


@dataclass
class Step:
    """A sampled direction. Densities in solid angle; ``pdf_*`` are unset where ``delta``."""

    wo: object
    weight: object
    pdf_fwd_w: object
    pdf_rev_w: object
    cos_out: object
    delta: object
    null: object
    eta: object


@dataclass(frozen=True)
class Traits:
    """What the BSDFs of a scene demand: `needs_full_pdf` and `needs_round_trip`."""

    full_pdf: bool
    round_trip: bool

    @staticmethod
    def of(bsdfs) -> Traits:
        """Of BSDFs that one virtual call may visit."""
        return Traits(needs_full_pdf(bsdfs), needs_round_trip(bsdfs))


@dataclass
class Target:
    """A local direction ``wo`` in which a BSDF is evaluated where ``active``; ``cos_ratio``, for light
    vertices, |n.wo| / |n.wi| with the geometric normal."""

    wo: object
    active: object
    cos_ratio: object = None


def with_wi(si, wi):
    """A copy of ``si`` that is seen from ``wi``. (Assigning to ``si.wi`` changes aliases.)"""
    other = mi.SurfaceInteraction3f(si)
    other.wi = wi
    return other


def _ask(bsdf, question, *args):
    """All questions to a BSDF in one virtual call: its arguments go through memory."""
    if isinstance(bsdf, mi.BSDF):
        return question(bsdf, *args)
    # Run step by step, calls of functions of ours fail for `plastic`; its own methods do not.
    if not dr.flag(dr.JitFlag.SymbolicCalls):
        return question(bsdf, *args)
    return dr.dispatch(bsdf, question, *args)


def _ask_both(bsdf, sampling, arguments, evaluating, target):
    """Answers to ``sampling(bsdf, si, u1, u2, active)``, these are the ``arguments``, and, if there is a
    ``target``, to ``evaluating(bsdf, si, wo, active)`` with its own."""
    if target is None:
        return _ask(bsdf, sampling, *arguments), None
    *_, active = arguments

    def ask(self, wo, joined, si, u1, u2, sampled, _):
        return sampling(self, si, u1, u2, sampled), evaluating(self, si, wo, joined)

    # The last argument is the call's mask.
    return _ask(bsdf, ask, target.wo, target.active, *arguments, active | target.active)


def connectible(bsdf):
    """Mask: the BSDF has a lobe that is not delta."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)


def evaluate(bsdf, si, wo, active) -> Evaluation:
    """BSDF of a camera vertex towards the local direction ``wo``, and both densities."""
    return _evaluation(*_ask(bsdf, _evaluated, si, wo, active))


def _evaluation(value, pdf_fwd_w, pdf_rev_w) -> Evaluation:
    """The value is NaN, so that whoever uses it counts it, also where a density is not finite: no weight
    follows from that. (Where the value is 0 it does not matter.)"""
    finite = dr.isfinite(pdf_fwd_w + pdf_rev_w)
    return Evaluation(dr.select(finite | is_zero(value), value, dr.nan), pdf_fwd_w, pdf_rev_w)


def _evaluated(self, si, wo, active):
    ctx = mi.BSDFContext()
    value, pdf_fwd_w = self.eval_pdf(ctx, si, wo, active)
    return value, pdf_fwd_w, self.pdf(ctx, with_wi(si, wo), si.wi, active)


def evaluate_adjoint(bsdf, si, wo, active, cos_ratio=None) -> Evaluation:
    """BSDF of a light vertex towards the local direction ``wo`` (to the camera's side).

    ``value`` includes the adjoint factor ``cos_ratio``, |n.wo| / |n.wi| with the geometric normal,
    which is computed unless given.
    """
    if cos_ratio is None:
        cos_ratio = geometric_cos(si, wo) / geometric_cos(si, si.wi)
    return _adjoint(cos_ratio, *_ask(bsdf, _evaluated_adjoint, si, wo, active))


def _adjoint(cos_ratio, value, pdf_fwd_w, pdf_rev_w) -> Evaluation:
    return _evaluation(value * cos_ratio, pdf_fwd_w, pdf_rev_w)


def _evaluated_adjoint(self, si, wo, active):
    ctx = mi.BSDFContext()
    value, pdf_rev_w = self.eval_pdf(ctx, with_wi(si, wo), si.wi, active)
    return value, self.pdf(ctx, si, wo, active), pdf_rev_w


def geometric_cos(si, w):
    """Absolute cosine between the local direction ``w`` and the geometric normal."""
    return dr.abs(dr.dot(si.n, si.to_world(w)))


def sample(
    bsdf, si, u1, u2, active, traits: Traits, target: Target | None = None
) -> tuple[Step, Evaluation | None]:
    """Continue a camera subpath where ``active``: the `Step`. ``u1`` picks the lobe, ``u2`` the direction.

    With a ``target`` also its `Evaluation`, in the same virtual call: what a call takes is mostly to hand
    over the interaction. Returns both, None for the latter without a target.
    """

    def ask(self, si, u1, u2, active):
        ctx = mi.BSDFContext()
        bs, weight = self.sample(ctx, si, u1, u2, active)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        smooth = active & ~delta
        pdf_fwd_w = self.pdf(ctx, si, bs.wo, smooth) if traits.full_pdf else bs.pdf
        pdf_rev_w = self.pdf(ctx, with_wi(si, bs.wo), si.wi, smooth)
        reversible = mi.Bool(True)
        if traits.round_trip:
            back, _ = _back(self, si, bs, u1, u2, active & delta, mi.TransportMode.Importance)
            reversible = ~delta | back
        return bs, weight, pdf_fwd_w, pdf_rev_w, reversible

    sampled, evaluated = _ask_both(bsdf, ask, (si, u1, u2, active), _evaluated, target)
    bs, weight, pdf_fwd_w, pdf_rev_w, reversible = sampled
    step = _step(si, bs, weight, weight, pdf_fwd_w, pdf_rev_w)
    if traits.round_trip:  # no alternative that would have to make this event from the other side
        step.cos_out = dr.select(reversible, step.cos_out, 0)
    return step, _evaluation(*evaluated) if target else None


def sample_adjoint(
    bsdf, si, u1, u2, active, traits: Traits, target: Target | None = None
) -> tuple[Step, Evaluation | None]:
    """Continue a light subpath; the adjoint factor is part of ``weight``, and of the evaluation's ``value``.
    Arguments and results as of `sample`."""

    def ask(self, si, u1, u2, active):
        bs, mitsuba_weight = self.sample(mi.BSDFContext(mi.TransportMode.Importance), si, u1, u2, active)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        smooth = active & ~delta
        ctx = mi.BSDFContext()
        value, pdf_rev_w = self.eval_pdf(ctx, with_wi(si, bs.wo), si.wi, smooth)
        pdf_fwd_w = self.pdf(ctx, si, bs.wo, smooth) if traits.full_pdf else bs.pdf
        delta_weight = mitsuba_weight
        if traits.round_trip:  # the radiance that a camera subpath carries, without its factor eta^-2
            back, weight = _back(self, si, bs, u1, u2, active & delta, mi.TransportMode.Radiance)
            delta_weight = dr.select(back, weight / dr.square(bs.eta), 0)
        # A direction that Mitsuba rejects has weight 0, whatever its pdf says. NaN is kept, to be counted.
        rejected = (bs.pdf == 0) | (~delta & (pdf_fwd_w == 0)) | is_zero(mitsuba_weight)
        weight = dr.select(delta, delta_weight * _event_cos_ratio(si, bs), value / pdf_fwd_w)
        return bs, mitsuba_weight, dr.select(rejected, 0, weight), pdf_fwd_w, pdf_rev_w

    sampled, evaluated = _ask_both(bsdf, ask, (si, u1, u2, active), _evaluated_adjoint, target)
    bs, mitsuba_weight, weight, pdf_fwd_w, pdf_rev_w = sampled
    cos_ratio = geometric_cos(si, bs.wo) / geometric_cos(si, si.wi)
    weight = dr.select(is_zero(weight), 0, weight * cos_ratio)
    step = _step(si, bs, mitsuba_weight, weight, pdf_fwd_w, pdf_rev_w)
    return step, _adjoint(target.cos_ratio, *evaluated) if target else None


def brightest(value):
    """The largest entry of a spectrum, in size; one that is NaN counts only where all others do."""
    return dr.max(dr.abs(mi.unpolarized_spectrum(value)))


def is_zero(value):
    """Mask: all entries of a spectrum are 0. NaN and infinity are not."""
    return dr.all(mi.unpolarized_spectrum(value) == 0)


def is_finite(value):
    """Mask: no entry of a spectrum is NaN or infinite."""
    return dr.all(dr.isfinite(mi.unpolarized_spectrum(value)))


def _back(bsdf, si, bs, u1, u2, active, mode):
    """Sample a delta event from its other end; whether it leads back, and its weight."""
    back, weight = bsdf.sample(mi.BSDFContext(mode), with_wi(si, bs.wo), u1, u2, active)
    same = dr.squared_norm(back.wo - si.wi) < 1e-4
    return same & (brightest(weight) > 0), weight


def _event_cos_ratio(si, bs):
    """|m.l| / |m.c| about the normal m of a delta event, which under a bump or normal map is not
    the shading frame's. Reflection and null: 1. Refraction: m along eta_c c + eta_l l.
    """
    m = bs.eta * bs.wo + si.wi  # bs.eta = eta_c / eta_l when sampling from l
    ratio = dr.abs(dr.dot(m, si.wi) / dr.dot(m, bs.wo))
    refracted = mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaTransmission)
    refracted &= dr.abs(bs.eta - 1) > 1e-5  # equal indices: straight on, and m is zero
    return dr.select(refracted, ratio, 1)


def _step(si, bs, mitsuba_weight, weight, pdf_fwd_w, pdf_rev_w) -> Step:
    """The step that Mitsuba's sample ``bs`` of ``mitsuba_weight`` stands for."""
    delta, cos_out = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), geometric_cos(si, bs.wo)
    # A direction that is NaN hits nothing, and nobody would know.
    finite = dr.isfinite(dr.select(delta, cos_out, cos_out + pdf_fwd_w + pdf_rev_w))
    finite &= is_finite(mitsuba_weight) & dr.isfinite(bs.eta)  # roulette asks for eta
    return Step(
        wo=bs.wo,
        weight=dr.select(finite | is_zero(mitsuba_weight), weight, dr.nan),
        pdf_fwd_w=pdf_fwd_w,
        pdf_rev_w=pdf_rev_w,
        cos_out=cos_out,
        delta=delta,
        null=mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null),
        eta=bs.eta,
    )


def needs_full_pdf(bsdfs) -> bool:
    """Whether some BSDF's sample() may report another density than its pdf().

    A mixture that reports the picked lobe's density gives an unbiased ``weight`` but cannot serve
    in the weights of multiple importance sampling, nor as divisor of a full evaluation.
    """
    return any(b.class_name() not in _SAMPLED_PDF_IS_PDF for b in nested(bsdfs))


def needs_round_trip(bsdfs) -> bool:
    """Whether a delta event may exist from one end only: under a bump or normal map.

    Mitsuba's maps drop sampled directions (not incident ones) on different sides of the surface and
    of the perturbed normal, and turn the normal towards the incident direction.
    """
    return any(
        b.class_name() in ("BumpMap", "NormalMap") and mi.has_flag(b.flags(), mi.BSDFFlags.Delta)
        for b in nested(bsdfs)
    )


def nested(bsdfs):
    """``bsdfs`` and every BSDF inside them (two-sided, mask, blend, bump and normal maps)."""
    found = list(bsdfs)
    for bsdf in found:  # grows on the way
        found += [value for value in children(bsdf).values() if isinstance(value, mi.BSDF)]
    return found
