"""Evaluation of Mitsuba's phase functions in both directions.

A walk's throughput has the albedo of a volume vertex when it arrives there; what is left of sigma_s rho is
the phase function rho, whose cosine is 1. ``wi`` is the direction that the subpath comes from. Phase
functions are symmetric; that of microflakes is so together with the extinction along ``wi``, with whose
density the subpath made the vertex: rho is asked with each subpath's own ``wi``, and no adjoint factor is
needed.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..host.introspection import children
from ..media.media import Media, interaction, symmetric_frame
from .bsdf import Evaluation, Step, Target

# Plugins whose density of the reverse is the same number.
_SYMMETRIC = frozenset(
    "IsotropicPhaseFunction HGPhaseFunction RayleighPhaseFunction TabulatedPhaseFunction".split()
)


def _is_symmetric(phase: mi.PhaseFunction) -> bool:
    if phase.class_name() == "BlendPhaseFunction":
        nested = [v for v in children(phase).values() if isinstance(v, mi.PhaseFunction)]
        return all(map(_is_symmetric, nested))
    return phase.class_name() in _SYMMETRIC


def _evaluated(medium: mi.Medium, mei, wo, active):
    """rho from ``mei.wi`` to ``wo`` (world), and the densities of ``wo`` and of the reverse."""
    phase, ctx = medium.phase_function(), mi.PhaseFunctionContext(None)
    value, pdf = phase.eval_pdf(ctx, mei, wo, active)
    if _is_symmetric(phase):
        return mi.Spectrum(value), pdf, mi.Float(pdf)
    back = mi.MediumInteraction3f(mei)
    back.wi, back.sh_frame = mi.Vector3f(wo), symmetric_frame(wo)
    _, pdf_rev = phase.eval_pdf(ctx, back, mei.wi, active)
    return mi.Spectrum(value), pdf, pdf_rev


def evaluate(media: Media, medium: mi.UInt32, si, wo: mi.Vector3f, active: mi.Bool) -> Evaluation:
    """The phase function of ``medium`` (its number) at ``si`` towards the local direction ``wo``."""
    mei = interaction(si.p, -si.to_world(si.wi), si)
    return Evaluation(*media.ask(medium, _evaluated, mei, si.to_world(wo), active))


def sample(
    media: Media, medium: mi.UInt32, si, u1, u2, active: mi.Bool, target: Target | None
) -> tuple[Step, Evaluation | None]:
    """Continue a subpath from a volume vertex; with a ``target`` also its `Evaluation`, as `bsdf.sample`."""

    def questions(medium: mi.Medium, mei, u1, u2, sampled, wo, evaluated, _):
        phase, ctx = medium.phase_function(), mi.PhaseFunctionContext(None)
        d, weight, pdf = phase.sample(ctx, mei, u1, u2, sampled)
        _, _, pdf_rev = _evaluated(medium, mei, d, sampled)
        joined = _evaluated(medium, mei, wo, evaluated) if target else None
        return d, mi.Spectrum(weight), pdf, pdf_rev, joined

    mei = interaction(si.p, -si.to_world(si.wi), si)
    wo = si.to_world(target.wo) if target else mi.Vector3f(0, 0, 1)
    evaluated = target.active if target else mi.Bool(False)
    # Subpaths that end here are joined all the same.
    asked = active | evaluated

    d, weight, pdf, pdf_rev, joined = media.ask(medium, questions, mei, u1, u2, active, wo, evaluated, asked)
    step = Step(
        # Its length would drift along subpaths: frames are made of directions.
        wo=dr.normalize(si.to_local(d)),
        weight=dr.select(pdf > 0, weight, 0),
        pdf_fwd_w=pdf,
        pdf_rev_w=pdf_rev,
        cos_out=mi.Float(1),
        delta=mi.Bool(False),
        null=mi.Bool(False),
        eta=mi.Float(1),
    )
    return step, Evaluation(*joined) if target else None
