"""Scattering at a vertex: a BSDF on surfaces, a phase function in a medium."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from . import bsdf
from .bsdf import Evaluation, Target


def sample(kernel, vertex, adjoint: bool, u1, u2, active, target: Target | None):
    """Continue a subpath: the `Step`, and the `Evaluation` of ``target`` or None."""
    take = bsdf.sample_adjoint if adjoint else bsdf.sample
    if vertex.volume is None:
        return take(vertex.bsdf, vertex.si, u1, u2, active, kernel.traits, target)
    on_surface = _of(target, ~vertex.volume)
    step, f = None, None
    if kernel.surfaces:
        step, f = take(vertex.bsdf, vertex.si, u1, u2, active & ~vertex.volume, kernel.traits, on_surface)
    if not kernel.space.media.scatters:
        return step, f
    medium, active = vertex.edge.medium, active & vertex.volume
    in_volume = kernel.space.sample(medium, vertex.si, u1, u2, active, _of(target, vertex.volume))
    return in_volume if step is None else dr.select(vertex.volume, in_volume, (step, f))


def _of(target: Target | None, mask: mi.Bool) -> Target | None:
    """``target`` where ``mask`` holds."""
    return target and Target(target.wo, target.active & mask, target.cos_ratio)


def evaluate(kernel, vertex, wo: mi.Vector3f, active: mi.Bool, reverse: bool = True) -> Evaluation:
    """Evaluate a camera vertex towards the local ``wo``, with both densities (``reverse``) or one."""
    traits = kernel.traits if reverse else kernel.traits.from_one_side()
    if vertex.volume is None:
        return bsdf.evaluate(vertex.bsdf, vertex.si, wo, active, traits)
    return _chosen(
        kernel,
        vertex,
        vertex.edge.medium,
        wo,
        active,
        lambda mask: bsdf.evaluate(vertex.bsdf, vertex.si, wo, mask, traits),
    )


def evaluate_adjoint(kernel, vertex, wo: mi.Vector3f, active: mi.Bool, cos_ratio) -> Evaluation:
    """Evaluate a light vertex towards the local ``wo``, see `bsdf.evaluate_adjoint`."""
    if vertex.volume is None:
        return bsdf.evaluate_adjoint(vertex.bsdf, vertex.si, wo, active, kernel.traits, cos_ratio)
    return _chosen(
        kernel,
        vertex,
        vertex.medium,
        wo,
        active,
        lambda mask: bsdf.evaluate_adjoint(vertex.bsdf, vertex.si, wo, mask, kernel.traits, cos_ratio),
    )


def _chosen(kernel, vertex, medium, wo, active, surface) -> Evaluation:
    """Evaluation by ``surface`` (a function of a mask) or by the vertex's medium."""
    if not kernel.space.media.scatters:
        return surface(active & ~vertex.volume)
    in_volume = kernel.space.evaluate(medium, vertex.si, wo, active & vertex.volume)
    if not kernel.surfaces:
        return in_volume
    return dr.select(vertex.volume, in_volume, surface(active & ~vertex.volume))
