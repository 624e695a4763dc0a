"""Guided s = 0: one more way to make isolated paths, which aims at light that glass focuses.

An isolated path (see `merging`) from an emitter with area is made by s = 0 and t = 0 alone, and by s = 0 only
if a sampled direction happens to lead to the emitter by delta events. At the last vertex z whose event is not
delta the direction is drawn a second time, from the density p_g of a `photon_guide.Guide`, and followed through
delta events only. All densities but those of the direction cancel::

    guided s = 0 over s = 0 = p_g / p_bsdf

Both have a weight, which holds that ratio, and so does t = 0, which asks for p_g at the same vertex (its first
that is not delta).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..geometry import rays
from ..sampling import sobol
from ..sampling.points import Purpose, Stream
from . import bsdf, mis, photon_guide, techniques
from .counters import Counters, one
from .inputs import Kernel
from .walk import Side, Vertex, Walk, may_merge, newest_coefficient, not_finite, random_walk

# Tells the numbers of guided subpaths from those of the camera subpath that they branch off.
_SEED = 0x5BD1E995


@dataclass
class Aim:
    """Where ``active``, the guide's direction ``d`` (unit, world), the density ``pdf`` with which it makes it,
    and the density ``other`` with which it makes the walk's own direction (solid angle)."""

    active: mi.Bool
    d: mi.Vector3f
    pdf: mi.Float
    other: mi.Float


def _nothing() -> Aim:
    return Aim(mi.Bool(False), mi.Vector3f(0, 0, 1), mi.Float(0), mi.Float(0))


def own(stream: Stream) -> Stream:
    """The random numbers of guided subpaths."""
    return Stream(stream.digits, sobol.mix(stream.seed ^ _SEED), sobol.mix(stream.key ^ _SEED), {})


def aim(kernel: Kernel, z: Vertex, walk: Walk, step, stream: Stream) -> Aim:
    """What the guide says at the camera vertex ``z``; ``walk`` as it was before it arrived."""
    guide = kernel.guide
    active = may_merge(kernel, kernel.kappa.splat, walk, z) & (z.edges < kernel.max_depth)

    def look(p, wo, event):
        found = photon_guide.find(guide, p)
        numbers = own(stream)
        u1 = kernel.points.draw_1d("camera", numbers, Purpose.LOBE, event)
        u2 = kernel.points.draw_2d("camera", numbers, Purpose.BSDF, event)
        d, drawn = photon_guide.draw(guide, p, found, u1, u2)
        pdf, other = photon_guide.densities(guide, p, found, d, wo)
        return Aim(drawn | (other > 0), d, dr.select(drawn, pdf, 0), other)

    arguments = mi.Point3f(z.si.p), z.si.to_world(step.wo), mi.UInt32(z.event)
    return dr.if_stmt(arguments, active, look, lambda p, wo, event: _nothing(), label="guide")


def look_back(kernel: Kernel, y: Vertex, walk: Walk) -> Aim:
    """The density with which the guide makes, at the light vertex ``y``, the direction the light came from."""
    joined = mis.is_joined(y.partial, newest_coefficient(kernel, kernel.kappa.direct, y.edges))
    active = y.hit & walk.only_delta & y.connectible() & ~joined

    def look(p, d):
        found = photon_guide.find(kernel.guide, p)
        _, other = photon_guide.densities(kernel.guide, p, found, d, d)
        return Aim(mi.Bool(True), d, other, other)

    arguments = mi.Point3f(y.si.p), -walk.d
    return dr.if_stmt(arguments, active, look, lambda p, d: _nothing(), label="guide")


def follow(kernel: Kernel, z: Vertex, stream: Stream, total, counters: Counters, add, shared):
    """Follow the direction of the `Aim` at ``z``; returns ``total`` with what it found, and the counters.

    ``add(c, total, lost)`` adds a contribution.
    """

    def chain(z, total, lost, aimed, traced):
        walk = _begun(kernel, z, shared)
        side = Side(
            "camera",
            shared,
            bsdf.brightest(walk.throughput),
            False,
            kernel.max_depth,
            kernel.kappa.splat,
            only_delta=True,
        )

        def visit(vertex, state, walk):
            total, lost = state
            return dr.if_stmt(
                (vertex, total, lost),
                techniques.sees_emitter(kernel, vertex),
                lambda v, total, lost: add(techniques.hit_emitter(kernel, v, True), total, lost),
                lambda v, total, lost: (total, lost),
                label="guided s = 0",
            )

        first, begun = walk.edges, walk.active
        (total, lost), walk = random_walk(kernel, side, walk, own(stream), visit, (total, lost))
        lost += one(walk.broken)
        traced += dr.select(begun, walk.edges - first, 0)
        return total, lost, aimed + one(begun), traced

    total, lost, aimed, traced = dr.if_stmt(
        (z, total, counters.non_finite, counters.aimed, counters.guided),
        z.aim.active & (z.aim.pdf > 0),
        chain,
        lambda z, total, lost, aimed, traced: (total, lost, aimed, traced),
        label="guided subpath",
    )
    return total, replace(counters, non_finite=lost, aimed=aimed, guided=traced)


def _begun(kernel: Kernel, z: Vertex, shared) -> Walk:
    """A subpath that leaves ``z`` in the guide's direction."""
    h, guided, local = kernel.heuristic, z.aim, z.si.to_local(z.aim.d)
    f = bsdf.evaluate(z.bsdf, z.si, local, True, kernel.traits)
    throughput = z.throughput * f.value / guided.pdf
    active = bsdf.brightest(throughput) > 0
    broken = not_finite(active, throughput)
    active &= ~broken
    step = bsdf.Step(
        local, f.value, guided.pdf, f.pdf_rev_w, z.cosine(guided.d), mi.Bool(False), mi.Bool(False), mi.Float(1)
    )
    coefficient = newest_coefficient(kernel, kernel.kappa.splat, z.edges)
    partial = mis.scatter(h, z.partial, coefficient, step)
    ray = rays.spawn(z.anchor, guided.d, shared)
    pi = kernel.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    walk = Walk.begin(kernel, pi, ray, z.si.p, throughput, partial, active)
    return replace(
        walk,
        edges=z.edges + 1,
        seen=mi.Bool(True),
        broken=broken,
        guided=h.start(f.pdf_fwd_w / guided.pdf),
    )
