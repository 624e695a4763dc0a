"""Guided s = 0: one more way to make isolated paths, which aims at light that glass focuses.

An isolated path (see `merging`) from an emitter with area is made by s = 0 and t = 0 alone, and by s = 0
only if a sampled direction happens to lead to the emitter by delta events. At the last vertex z whose event
is not delta the direction is drawn a second time, from the density p_g of a `photon_guide.Guide`, and
followed through delta events only. All densities but those of the direction cancel::

    guided s = 0 over s = 0 = p_g / p_bsdf

Both have a weight, which holds that ratio, and so does t = 0, which asks for p_g at the same vertex (its
first that is not delta).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..geometry import rays
from ..sampling import sobol
from ..sampling.points import Purpose, Stream
from . import bsdf, mis, photon_guide, techniques
from .counters import one
from .inputs import Kernel
from .walk import Side, Vertex, Walk, may_merge, newest_coefficient, not_finite, random_walk

# Tells the numbers of guided subpaths from those of the camera subpath that they branch off.
_SEED = 0x5BD1E995


@dataclass
class Aim:
    """What a guide says at a vertex, in solid angle.

    Its direction ``d`` (unit, world) and the density ``pdf`` with which it makes it, 0 if there is none; the
    density ``other`` with which it makes the walk's own direction.
    """

    d: mi.Vector3f
    pdf: mi.Float
    other: mi.Float


def _nothing() -> Aim:
    return Aim(mi.Vector3f(0, 0, 1), mi.Float(0), mi.Float(0))


def _numbers(stream: Stream) -> Stream:
    """The random numbers of guided subpaths."""
    return Stream(stream.digits, sobol.mix(stream.seed ^ _SEED), sobol.mix(stream.key ^ _SEED), {})


def aim(kernel: Kernel, z: Vertex, walk: Walk, step, stream: Stream) -> Aim:
    """What the guide says at the camera vertex ``z``; ``walk`` as it was before it arrived."""
    active = may_merge(kernel, kernel.kappa.splat, walk, z) & (z.edges < kernel.max_depth)
    arguments = mi.Point3f(z.si.p), z.si.to_world(step.wo), mi.UInt32(z.event)
    return dr.if_stmt(
        arguments,
        active,
        lambda p, d, event: _look(kernel, p, d, event, _numbers(stream)),
        lambda p, d, event: _nothing(),
        label="guide",
    )


def mark(kernel: Kernel, z: Vertex, walk: Walk, step) -> Aim:
    """As `aim`, of a guide that makes the walk's own direction as often, wherever s = 0 can be guided."""
    possible = may_merge(kernel, kernel.kappa.splat, walk, z) & (z.edges < kernel.max_depth)
    return Aim(mi.Vector3f(0, 0, 1), mi.Float(0), dr.select(possible, step.pdf_fwd_w, 0))


def _look(kernel: Kernel, p, d, event, numbers: Stream) -> Aim:
    """A direction drawn at ``p``, and the density of another one, ``d``."""
    found = photon_guide.find(kernel.guide, p)
    u1 = kernel.points.draw_1d("camera", numbers, Purpose.LOBE, event)
    u2 = kernel.points.draw_2d("camera", numbers, Purpose.BSDF, event)
    drawn, possible = photon_guide.draw(kernel.guide, p, found, u1, u2)
    pdf, other = photon_guide.densities(kernel.guide, p, found, drawn, d)
    return Aim(drawn, dr.select(possible, pdf, 0), other)


def look_back(kernel: Kernel, y: Vertex, walk: Walk) -> Aim:
    """What the guide says at the light vertex ``y``; ``other``: of the direction the light came from."""
    joined = mis.is_joined(y.partial, newest_coefficient(kernel, kernel.kappa.direct, y.edges))
    active = y.hit & walk.only_delta & y.connectible() & ~joined

    def look(p, d):
        found = photon_guide.find(kernel.guide, p)
        _, other = photon_guide.densities(kernel.guide, p, found, d, d)
        return Aim(d, mi.Float(0), other)

    arguments = mi.Point3f(y.si.p), -walk.d
    return dr.if_stmt(arguments, active, look, lambda p, d: _nothing(), label="guide")


def follow(kernel: Kernel, z: Vertex, stream: Stream, shared, add, state):
    """Follow the direction of the `Aim` at ``z``; returns the ``state`` after that.

    ``state``: a total, to which ``add(c, total, lost)`` adds a contribution, and counts of what was not
    finite, of `Counters.aimed` and `Counters.guided`.
    """
    chain = _chain(kernel, stream, shared, add)
    return dr.if_stmt((z, *state), z.aim.pdf > 0, chain, lambda z, *state: state, label="guided subpath")


def _chain(kernel: Kernel, stream: Stream, shared, add):
    """A function that follows the `Aim` at a vertex, as `follow` does."""

    def visit(vertex, state, walk):
        return dr.if_stmt(
            (vertex, *state),
            techniques.sees_emitter(kernel, vertex),
            lambda v, total, lost: add(techniques.hit_emitter(kernel, v, True), total, lost),
            lambda v, total, lost: (total, lost),
            label="guided s = 0",
        )

    def chain(z, total, lost, aimed, traced):
        walk = _begun(kernel, z, shared)
        side = Side(
            "camera",
            shared,
            bsdf.brightest(walk.throughput),  # what delta events leave of it plays roulette
            False,
            kernel.max_depth,
            kernel.kappa.splat,
            only_delta=True,
        )
        first, begun = walk.edges, walk.active
        state = total, lost
        (total, lost), walk = random_walk(kernel, side, walk, _numbers(stream), visit, state)
        traced += dr.select(begun, walk.edges - first, 0)
        return total, lost + one(walk.broken), aimed + one(begun), traced

    return chain


def _begun(kernel: Kernel, z: Vertex, shared) -> Walk:
    """A subpath that leaves ``z`` in the guide's direction."""
    h, d, pdf, local = kernel.heuristic, z.aim.d, z.aim.pdf, z.si.to_local(z.aim.d)
    f = bsdf.evaluate(z.bsdf, z.si, local, pdf > 0, kernel.traits)
    throughput = dr.select(pdf > 0, z.throughput * f.value / pdf, 0)
    active = bsdf.brightest(throughput) > 0
    broken = not_finite(active, throughput)
    active &= ~broken
    unlike, one_ = mi.Bool(False), mi.Float(1)
    step = bsdf.Step(local, f.value, pdf, f.pdf_rev_w, z.cosine(d), unlike, unlike, one_)
    partial = mis.scatter(h, z.partial, newest_coefficient(kernel, kernel.kappa.splat, z.edges), step)
    ray = rays.spawn(z.anchor, d, shared)
    pi = kernel.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    walk = Walk.begin(kernel, pi, ray, z.si.p, throughput, partial, active)
    guided = h.start(dr.select(pdf > 0, f.pdf_fwd_w / pdf, 0))
    return replace(walk, edges=z.edges + 1, seen=mi.Bool(True), broken=broken, guided=guided)
