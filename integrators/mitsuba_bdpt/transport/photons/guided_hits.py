"""Photon-guided BSDF sampling: samples SDS paths by hitting an emitter (s = 0).

From a diffuse vertex n further directions (`plan.GUIDED_SAMPLES`) are sampled from the density p_g of a
`photon_guide.Guide` and followed through specular events only. All densities but those of the direction
cancel: guided s = 0 over s = 0 by the BSDF is n p_g / p_bsdf. Under the balance heuristic a guided subpath
has the throughput and the weight of one by the BSDF, since each technique of a path contributes f over the
same sum of densities. See docs/method/sds_paths.md and docs/method/near_specular.md.
"""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ...geometry import rays
from ...sampling import sobol
from ...sampling.points import Purpose, Stream
from .. import bsdf, mis, path_layers, spectra, techniques
from ..alternatives import is_sds_vertex, newest_coefficient
from ..contribution import one
from ..inputs import TraceContext
from ..near_specular import SPECULAR
from ..sds import Advice, PhotonStrategy, State, begun_near_specular, is_specular
from ..walk import Side, Vertex, Walk, not_finite, random_walk
from . import photon_guide

_SEED = 0x5BD1E995  # seed that separates random numbers of guided subpaths from those of their camera subpath


class Guiding(PhotonStrategy):
    """Photon-guided BSDF sampling by a ``guide``; ``near_specular``: through near-specular events too."""

    counters = ("guided",)

    def __init__(self, guide: photon_guide.Guide, near_specular: bool):
        self.guide, self.near_specular = guide, near_specular

    def begin_light(self, kernel, walk):
        if self.near_specular:
            return begun_near_specular(walk, light=True)
        partial = replace(walk.partial, d_vm=kernel.heuristic.zero())
        return replace(walk, sds=State(mi.Bool(True), only_delta=mi.Bool(True)), partial=partial)

    def begin_camera(self, kernel, walk):
        if self.near_specular:
            return begun_near_specular(walk, light=False, guided=mi.Float(0))
        return replace(walk, sds=State(mi.Bool(True), guided=mi.Float(0)))

    def advise(self, kernel, adjoint, vertex, walk, step) -> Advice | None:
        """At a light vertex ``other`` is that of the direction that the subpath came from."""
        if adjoint and self.near_specular:
            return None
        if adjoint:
            possible = is_sds_vertex(kernel, vertex, adjoint) & vertex.sds.only_delta
            return self._evaluated(kernel, vertex, -walk.d, possible)
        possible = is_sds_vertex(kernel, vertex, adjoint)
        return self._evaluated(kernel, vertex, vertex.si.to_world(step.wo), possible)

    def _evaluated(self, kernel: TraceContext, vertex: Vertex, d: mi.Vector3f, active: mi.Bool) -> Advice:
        def look(p, d):
            found = photon_guide.find(self.guide, p)
            return Advice(mi.Bool(True), found, self.density(kernel, p, found, d))

        def nothing(p, d):
            return Advice(mi.Bool(False), mi.UInt32(0), mi.Float(0))

        return dr.if_stmt((mi.Point3f(vertex.si.p), d), active, look, nothing, label="guide")

    def density(self, kernel: TraceContext, p, found, d) -> mi.Float:
        """Density of ``d`` by the guide, times the number of guided samples."""
        return kernel.plan.guided * photon_guide.density(self.guide, p, found, d)

    def visit(self, kernel, z, walk, stream, shared, add, state):
        """Trace guided subpaths from ``z`` where the guide is active."""
        total, counters = state
        total, lost, traced = dr.if_stmt(
            (z, total, counters.non_finite, counters.guided),
            z.advice.active,
            lambda z, *state: _follow_all(kernel, self, z, stream, shared, add, state),
            lambda z, *state: state,
            label="guided subpaths",
        )
        return total, replace(counters, non_finite=lost, guided=traced)


class _Guided(PhotonStrategy):
    """The strategy of guided subpaths, which count on SDS paths alone."""

    def __init__(self, guiding: Guiding):
        self.guiding, self.near_specular = guiding, guiding.near_specular

    def advise(self, kernel, adjoint, vertex, walk, step) -> Advice:
        """Further vertices guide too where all events are specular."""
        possible = is_sds_vertex(kernel, vertex, adjoint)
        possible &= is_specular(step) & ~vertex.sds.diffuse
        return self.guiding._evaluated(kernel, vertex, vertex.si.to_world(step.wo), possible)

    def counts(self, active, on_sds_path):
        return active & on_sds_path


class Unguided(PhotonStrategy):
    """Leaves out s = 0 where it could be guided, in a pilot."""

    def __init__(self, near_specular: bool):
        self.near_specular = near_specular

    def begin_light(self, kernel, walk):
        return begun_near_specular(walk, light=True) if self.near_specular else walk

    def begin_camera(self, kernel, walk):
        if self.near_specular:
            return begun_near_specular(walk, light=False)
        return replace(walk, sds=State(mi.Bool(True), guided=mi.Float(0)))

    def advise(self, kernel, adjoint, vertex, walk, step) -> Advice | None:
        """A guide that has the BSDF's density of the walk's direction."""
        if adjoint or self.near_specular:
            return None
        possible = is_sds_vertex(kernel, vertex, adjoint)
        return Advice(possible, mi.UInt32(0), dr.select(possible, step.pdf_fwd_w, 0))

    def counts(self, active, on_sds_path):
        return active & ~on_sds_path


@dr.syntax
def _follow_all(kernel: TraceContext, guiding: Guiding, z: Vertex, stream: Stream, shared, add, state):
    number = mi.UInt32(0)
    while dr.hint(
        number < kernel.plan.guided,
        label="guided subpaths of a vertex",
        exclude=[kernel, guiding, z, stream, shared, add],
    ):
        seed = sobol.mix(stream.seed ^ sobol.mix(_SEED + z.event) ^ number)
        numbers = Stream(stream.digits, seed, sobol.mix(stream.key ^ _SEED))
        state = _follow_one(kernel, guiding, z, numbers, shared, add, state)
        number += 1
    return state


def _follow_one(kernel: TraceContext, guiding: Guiding, z: Vertex, numbers: Stream, shared, add, state):
    near_specular, guided = guiding.near_specular, _Guided(guiding)
    connects = near_specular and kernel.plan.direct

    def visit(vertex, state, walk):
        total, lost, traced = state
        if connects:
            c = techniques.next_event(kernel, vertex, numbers, guided)
            (total, lost), traced = add(c, total, lost), traced + c.counted.shadow_s1
        total, lost = dr.if_stmt(
            (vertex, total, lost),
            techniques.sees_emitter(kernel, vertex) & (vertex.edges > first),
            lambda v, total, lost: add(techniques.hit_emitter(kernel, v, guided), total, lost),
            lambda v, total, lost: (total, lost),
            label="guided s = 0",
        )
        return total, lost, traced

    total, lost, traced = state
    walk = _begun(kernel, guiding, z, numbers, shared)
    first = walk.edges
    side = Side(
        "camera",
        numbers,
        shared,
        False,
        kernel.max_depth,
        guided if near_specular else PhotonStrategy(),
        connect=(lambda z: techniques.choose_emitter(kernel, z, numbers)) if connects else None,
        only_specular=SPECULAR if near_specular else math.inf,
    )
    begun = walk.active
    (total, lost, traced), walk = random_walk(kernel, side, walk, visit, (total, lost, traced))
    traced += dr.select(begun, walk.edges - first, 0)
    return total, lost + one(walk.broken), traced


def _begun(kernel: TraceContext, guiding: Guiding, z: Vertex, numbers: Stream, shared) -> Walk:
    """A subpath that leaves ``z`` in a direction sampled from the guide."""
    h, p, points = kernel.heuristic, z.si.p, kernel.points
    u1 = points.draw_1d("camera", numbers, Purpose.LOBE, z.event)
    u2 = points.draw_2d("camera", numbers, Purpose.BSDF, z.event)
    d, active = photon_guide.draw(guiding.guide, p, z.advice.found, u1, u2)
    pdf, local = guiding.density(kernel, p, z.advice.found, d), z.si.to_local(d)
    f = bsdf.evaluate(z.bsdf, z.si, local, active, kernel.traits)
    newest = newest_coefficient(kernel, z, adjoint=False)
    active &= f.pdf_fwd_w > 0
    if guiding.near_specular:  # a diffuse vertex guides, specular ones after it do not
        specular = is_specular(f)
        active &= ~(specular & z.sds.diffuse)
    ratio = h.start(dr.select(active, pdf / f.pdf_fwd_w, 0))
    estimate = z.throughput * f.value / f.pdf_fwd_w * h.equal_weight(ratio)
    throughput = dr.select(active, estimate, 0)
    broken = not_finite(active, throughput)
    active &= (spectra.brightest(throughput) > 0) & ~broken
    no, unit = mi.Bool(False), mi.Float(1)
    step = bsdf.Step(local, f.value, f.pdf_fwd_w, f.pdf_rev_w, z.cosine(d), no, no, unit)
    partial = mis.scatter(h, z.partial, newest, step)
    ray = rays.spawn(z.anchor, d, shared)
    pi = kernel.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    walk = Walk.begin(kernel, pi, ray, p, throughput, partial, active)
    state = State(mi.Bool(True), guided=ratio)
    if guiding.near_specular:
        older = dr.select(specular, z.sds.guided_before_last(h), 0)
        state = replace(state, only_delta=mi.Bool(False), guided=older, newest=ratio)
        state = replace(state, specular=specular, diffuse=~specular)
    walk = replace(walk, edges=z.edges + 1, seen=mi.Bool(True), broken=broken, sds=state)
    return replace(walk, layer=path_layers.evaluated(z.layer, f, adjoint=False))
