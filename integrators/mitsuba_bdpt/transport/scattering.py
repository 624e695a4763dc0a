"""Scattering at a vertex: a BSDF on surfaces, a phase function in a medium."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from . import bsdf
from .bsdf import Evaluation, Target


def sample(kernel, vertex, adjoint: bool, u1, u2, active, target: Target | None):
    """Continue a subpath: the `Step`, and the `Evaluation` of ``target`` or None."""
    step = f = None
    if kernel.surfaces:
        given = vertex.bsdf, vertex.si, u1, u2, active & ~vertex.volume, kernel.traits
        step, f = bsdf.sample(*given, _of(target, ~vertex.volume), adjoint)
    if (phase := kernel.space.phase) is None:
        return step, f
    in_volume = phase.sample(vertex, u1, u2, active & vertex.volume, _of(target, vertex.volume))
    return in_volume if step is None else dr.select(vertex.volume, in_volume, (step, f))


def _of(target: Target | None, mask: mi.Bool) -> Target | None:
    """``target`` where ``mask`` holds."""
    return target and Target(target.wo, target.active & mask, target.cos_ratio)


def evaluate(
    kernel, vertex, wo: mi.Vector3f, active: mi.Bool, cos_ratio: mi.Float | None = None, reverse: bool = True
) -> Evaluation:
    """Evaluate ``vertex`` towards the local ``wo``, with both densities (``reverse``) or one.

    ``cos_ratio``, of light vertices: see `bsdf.evaluate`.
    """
    traits = kernel.traits if reverse else kernel.traits.from_one_side()

    def on_surface() -> Evaluation:
        return bsdf.evaluate(vertex.bsdf, vertex.si, wo, active & ~vertex.volume, traits, cos_ratio)

    if (phase := kernel.space.phase) is None:
        return on_surface()
    in_volume = phase.evaluate(vertex, wo, active & vertex.volume)
    return dr.select(vertex.volume, in_volume, on_surface()) if kernel.surfaces else in_volume
