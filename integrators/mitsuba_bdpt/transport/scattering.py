"""Scattering at a vertex: a BSDF on surfaces, a phase function in a medium."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from . import bsdf
from .bsdf import Evaluation, Target


def sample(kernel, vertex, adjoint: bool, u1, u2, active, target: Target | None):
    """Continue a subpath: the `Step`, and the `Evaluation` of ``target`` or None."""
    take = bsdf.sample_adjoint if adjoint else bsdf.sample
    step, f, on_surface = None, None, _of(target, ~vertex.volume)
    if kernel.surfaces:
        step, f = take(vertex.bsdf, vertex.si, u1, u2, active & ~vertex.volume, kernel.traits, on_surface)
    if not kernel.space.scatters:
        return step, f
    of_medium, active = _of(target, vertex.volume), active & vertex.volume
    in_volume = kernel.space.sample(vertex.medium, vertex.si, u1, u2, active, of_medium)
    return in_volume if step is None else dr.select(vertex.volume, in_volume, (step, f))


def _of(target: Target | None, mask: mi.Bool) -> Target | None:
    """``target`` where ``mask`` holds."""
    return target and Target(target.wo, target.active & mask, target.cos_ratio)


def evaluate(kernel, vertex, wo: mi.Vector3f, active: mi.Bool, reverse: bool = True) -> Evaluation:
    """Evaluate a camera vertex towards the local ``wo``, with both densities (``reverse``) or one."""
    traits = kernel.traits if reverse else kernel.traits.from_one_side()
    return _evaluated(
        kernel, vertex, wo, active, lambda mask: bsdf.evaluate(vertex.bsdf, vertex.si, wo, mask, traits)
    )


def evaluate_adjoint(kernel, vertex, wo: mi.Vector3f, active: mi.Bool, cos_ratio) -> Evaluation:
    """Evaluate a light vertex towards the local ``wo``, see `bsdf.evaluate_adjoint`."""

    def on_surface(mask):
        return bsdf.evaluate_adjoint(vertex.bsdf, vertex.si, wo, mask, kernel.traits, cos_ratio)

    return _evaluated(kernel, vertex, wo, active, on_surface)


def _evaluated(kernel, vertex, wo, active, on_surface) -> Evaluation:
    """Evaluation by ``on_surface``, a function of a mask, or by the vertex's medium."""
    if not kernel.space.scatters:
        return on_surface(active & ~vertex.volume)
    in_volume = kernel.space.evaluate(vertex.medium, vertex.si, wo, active & vertex.volume)
    if not kernel.surfaces:
        return in_volume
    return dr.select(vertex.volume, in_volume, on_surface(active & ~vertex.volume))
