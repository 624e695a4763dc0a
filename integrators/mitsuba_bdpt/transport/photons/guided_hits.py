"""Photon-guided BSDF sampling: samples SDS paths by hitting an emitter (s = 0).

Only s = 0 and t = 0 sample an SDS path from an emitter with area, and s = 0 only if a sampled direction
happens to lead to the emitter by delta events. At the path's diffuse vertex z, the last whose event is not
delta, a second direction is sampled from the density p_g of a `photon_guide.Guide` and followed through delta
events only. All densities but those of the direction cancel::

    guided s = 0 over s = 0 = p_g / p_bsdf

The weights of both contain that ratio, and so does that of t = 0, which evaluates p_g at the same vertex: the
first of the light subpath that is not delta.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ...geometry import rays
from ...sampling import sobol
from ...sampling.points import Purpose, Stream
from .. import bsdf, mis, spectra, techniques
from ..contribution import one
from ..inputs import Kernel
from ..walk import Side, Vertex, Walk, is_sds_vertex, newest_coefficient, not_finite, random_walk
from . import photon_guide

# Seed that separates random numbers of guided subpaths from those of their camera subpath.
_SEED = 0x5BD1E995


@dataclass
class Advice:
    """The guide at a vertex: ``active`` where s = 0 can be guided.

    ``found``: index of its photons; ``other``: density of the walk's own direction by the guide (solid angle,
    times the number of guided samples).
    """

    active: mi.Bool
    found: mi.UInt32
    other: mi.Float


def _numbers(stream: Stream, event: mi.UInt32, number: mi.UInt32) -> Stream:
    """Random numbers of guided subpath ``number`` at the vertex of ``event``."""
    seed = sobol.mix(stream.seed ^ sobol.mix(_SEED + event) ^ number)
    return Stream(stream.digits, seed, sobol.mix(stream.key ^ _SEED))


def advise(kernel: Kernel, z: Vertex, walk: Walk, step) -> Advice:
    """The guide at the camera vertex ``z``; ``walk`` as before its arrival."""
    return _evaluated(kernel, z, z.si.to_world(step.wo), is_sds_vertex(kernel, kernel.kappa.splat, walk, z))


def look_back(kernel: Kernel, y: Vertex, walk: Walk, step) -> Advice:
    """The guide at the light vertex ``y``; ``other`` of the incident direction.

    ``step`` is not used: `Side.guide` passes it.
    """
    possible = is_sds_vertex(kernel, kernel.kappa.direct, walk, y) & walk.only_delta
    return _evaluated(kernel, y, -walk.d, possible)


def mark(kernel: Kernel, z: Vertex, walk: Walk, step) -> Advice:
    """Like `advise`, for a guide with the BSDF's density of the walk's direction."""
    possible = is_sds_vertex(kernel, kernel.kappa.splat, walk, z)
    return Advice(possible, mi.UInt32(0), dr.select(possible, step.pdf_fwd_w, 0))


def _evaluated(kernel: Kernel, vertex: Vertex, d: mi.Vector3f, active: mi.Bool) -> Advice:
    def look(p, d):
        found = photon_guide.find(kernel.guide, p)
        return Advice(mi.Bool(True), found, _density(kernel, p, found, d))

    def nothing(p, d):
        return Advice(mi.Bool(False), mi.UInt32(0), mi.Float(0))

    return dr.if_stmt((mi.Point3f(vertex.si.p), d), active, look, nothing, label="guide")


def _density(kernel: Kernel, p, found, d) -> mi.Float:
    return kernel.plan.guided * photon_guide.density(kernel.guide, p, found, d)


def follow(kernel: Kernel, z: Vertex, stream: Stream, shared, add, state):
    """Trace guided subpaths from ``z`` where the guide is active.

    ``state``: a total, to which ``add(c, total, lost)`` adds a contribution, and the numbers of non-finite
    values, `Counters.aimed` and `Counters.guided`. Returns the new state.
    """
    return dr.if_stmt(
        (z, *state),
        z.advice.active,
        lambda z, *state: _follow_all(kernel, z, stream, shared, add, state),
        lambda z, *state: state,
        label="guided subpaths",
    )


@dr.syntax
def _follow_all(kernel: Kernel, z: Vertex, stream: Stream, shared, add, state):
    number = mi.UInt32(0)
    while dr.hint(
        number < kernel.plan.guided,
        label="guided subpaths of a vertex",
        exclude=[kernel, z, stream, shared, add],
    ):
        state = _follow_one(kernel, z, _numbers(stream, z.event, number), shared, add, state)
        number += 1
    return state


def _follow_one(kernel: Kernel, z: Vertex, numbers: Stream, shared, add, state):
    def visit(vertex, state, walk):
        return dr.if_stmt(
            (vertex, *state),
            techniques.sees_emitter(kernel, vertex),
            lambda v, total, lost: add(techniques.hit_emitter(kernel, v, True), total, lost),
            lambda v, total, lost: (total, lost),
            label="guided s = 0",
        )

    total, lost, aimed, traced = state
    walk = _begun(kernel, z, numbers, shared)
    side = Side(
        "camera",
        shared,
        spectra.brightest(walk.throughput),  # reference of roulette
        False,
        kernel.max_depth,
        kernel.kappa.splat,
        only_delta=True,
    )
    first, begun = walk.edges, walk.active
    (total, lost), walk = random_walk(kernel, side, walk, numbers, visit, (total, lost))
    traced += dr.select(begun, walk.edges - first, 0)
    return total, lost + one(walk.broken), aimed + one(begun), traced


def _begun(kernel: Kernel, z: Vertex, numbers: Stream, shared) -> Walk:
    """A subpath that leaves ``z`` in a direction sampled from the guide."""
    h, p, points = kernel.heuristic, z.si.p, kernel.points
    u1 = points.draw_1d("camera", numbers, Purpose.LOBE, z.event)
    u2 = points.draw_2d("camera", numbers, Purpose.BSDF, z.event)
    d, active = photon_guide.draw(kernel.guide, p, z.advice.found, u1, u2)
    pdf, local = _density(kernel, p, z.advice.found, d), z.si.to_local(d)
    f = bsdf.evaluate(z.bsdf, z.si, local, active, kernel.traits)
    throughput = dr.select(active, z.throughput * f.value / pdf, 0)
    broken = not_finite(active, throughput)
    active &= (spectra.brightest(throughput) > 0) & ~broken
    no, unit = mi.Bool(False), mi.Float(1)
    step = bsdf.Step(local, f.value, pdf, f.pdf_rev_w, z.cosine(d), no, no, unit)
    partial = mis.scatter(h, z.partial, newest_coefficient(kernel, kernel.kappa.splat, z.edges), step)
    ray = rays.spawn(z.anchor, d, shared)
    pi = kernel.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    walk = Walk.begin(kernel, pi, ray, p, throughput, partial, active)
    guided = h.start(dr.select(active, f.pdf_fwd_w / pdf, 0))
    return replace(walk, edges=z.edges + 1, seen=mi.Bool(True), broken=broken, guided=guided)
