"""Evaluates and samples Mitsuba's phase functions on both subpaths.

A walk's throughput includes the albedo of a volume vertex on arrival; the rest of sigma_s rho is the phase
function rho, with cosine 1. ``wi`` is the direction that the subpath comes from. Phase functions are
symmetric; that of microflakes is symmetric together with the extinction along ``wi``, with whose density the
subpath sampled the vertex: rho is evaluated with each subpath's own ``wi``, without an adjoint factor. Media
for which even that product is not symmetric (`asymmetry`; Mitsuba's ``blendphase`` of microflakes) get no
light subpaths.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..geometry.directions import random_directions, symmetric_frame
from ..host.introspection import children
from ..transport.bsdf import Evaluation, Step, Target
from .media import Media, interaction, probes, rows

# Plugins with equal forward and reverse densities.
_SYMMETRIC = frozenset(
    "IsotropicPhaseFunction HGPhaseFunction RayleighPhaseFunction TabulatedPhaseFunction".split()
)


def is_symmetric(phase: mi.PhaseFunction) -> bool:
    """Whether the plugin is known to have equal forward and reverse densities."""
    if phase.class_name() == "BlendPhaseFunction":
        nested = [v for v in children(phase).values() if isinstance(v, mi.PhaseFunction)]
        return bool(nested) and all(map(is_symmetric, nested))
    return phase.class_name() in _SYMMETRIC


def asymmetry(medium: mi.Medium) -> float:
    """Mean relative difference of sigma_t(w) rho(w, w') and sigma_t(w') rho(w', w).

    At random points; 0 for known plugins (`is_symmetric`).
    """
    phase = medium.phase_function()
    if is_symmetric(phase):
        return 0.0
    there = probes(medium)
    back = mi.MediumInteraction3f(there)
    back.wi = random_directions(np.random.default_rng(1), dr.width(there.wi))
    back.sh_frame = symmetric_frame(back.wi)
    found = []
    for mei, wo in ((there, back.wi), (back, there.wi)):
        value, _ = phase.eval_pdf(mi.PhaseFunctionContext(None), mei, wo, mi.Bool(True))
        _, _, sigma_t = medium.get_scattering_coefficients(mei, mi.Bool(True))
        found += rows(mi.UnpolarizedSpectrum(sigma_t) * mi.unpolarized_spectrum(mi.Spectrum(value)))
    return float(np.abs(found[0] - found[1]).mean() / max(found[0].mean(), np.finfo(float).tiny))


def _evaluated(medium: mi.Medium, mei, wo, active):
    """rho from ``mei.wi`` to ``wo`` (world), and densities of ``wo`` and the reverse."""
    phase, ctx = medium.phase_function(), mi.PhaseFunctionContext(None)
    value, pdf = phase.eval_pdf(ctx, mei, wo, active)
    if is_symmetric(phase):
        return mi.Spectrum(value), pdf, mi.Float(pdf)
    back = mi.MediumInteraction3f(mei)
    back.wi, back.sh_frame = mi.Vector3f(wo), symmetric_frame(wo)
    _, pdf_rev = phase.eval_pdf(ctx, back, mei.wi, active)
    return mi.Spectrum(value), pdf, pdf_rev


@dataclass(frozen=True)
class PhaseFunctions:
    """Phase functions at the vertices in ``media``."""

    media: Media

    def evaluate(self, vertex, wo: mi.Vector3f, active: mi.Bool) -> Evaluation:
        """Evaluate towards the local ``wo``."""
        mei, wo = _at(vertex), vertex.si.to_world(wo)
        return Evaluation(*self.media.query(vertex.medium, _evaluated, mei, wo, active), mi.Bool(True))

    def sample(
        self, vertex, u1, u2, active: mi.Bool, target: Target | None
    ) -> tuple[Step, Evaluation | None]:
        """Continue a subpath; results as in `bsdf.sample`."""

        def call(medium: mi.Medium, mei, u1, u2, sampled, wo, evaluated, _):
            phase, ctx = medium.phase_function(), mi.PhaseFunctionContext(None)
            d, weight, pdf = phase.sample(ctx, mei, u1, u2, sampled)
            _, _, pdf_rev = _evaluated(medium, mei, d, sampled)
            joined = _evaluated(medium, mei, wo, evaluated) if target else None
            return d, mi.Spectrum(weight), pdf, pdf_rev, joined

        wo = vertex.si.to_world(target.wo) if target else mi.Vector3f(0, 0, 1)
        evaluated = target.active if target else mi.Bool(False)
        # Subpaths that end here are still connected.
        queried = active | evaluated
        d, weight, pdf, pdf_rev, joined = self.media.query(
            vertex.medium, call, _at(vertex), u1, u2, active, wo, evaluated, queried
        )
        step = Step(
            # Otherwise its length would drift along subpaths: frames are built from directions.
            wo=dr.normalize(vertex.si.to_local(d)),
            weight=dr.select(pdf > 0, weight, 0),
            pdf_fwd_w=pdf,
            pdf_rev_w=pdf_rev,
            cos_out=mi.Float(1),
            delta=mi.Bool(False),
            null=mi.Bool(False),
            eta=mi.Float(1),
            volume=mi.Bool(True),
        )
        return step, Evaluation(*joined, mi.Bool(True)) if target else None


def _at(vertex) -> mi.MediumInteraction3f:
    return interaction(vertex.si.p, -vertex.si.to_world(vertex.si.wi), vertex.si)
