"""One function per class of strategies: the path it builds, its contribution and its weight.

All return a `Contribution`: the full *unweighted* estimate f / p of the strategy, divided by the
class's count, with the weight beside it; the two are multiplied in `Contribution.weighted` alone.
Densities and cosines are geometric, throughputs contain everything up to and including the edge to
the vertex. Equation numbers: Georgiev 2012, see `mis`.

What a lane accumulates (``counters``, a dictionary, and ``path``) is changed in place: these are state of the
loops around, and each statement binds a new array to a name.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from . import bsdf, mis, rays
from .points import Purpose
from .subpath import Vertex, newest_coefficient

# Least probability of surviving roulette: random numbers are multiples of 2^-24.
LEAST_SURVIVAL = 2.0**-20


@dataclass
class Contribution:
    """``value`` unweighted estimate (a spectrum), ``weight`` in [0, 1], numbers of light vertices
    ``s`` and camera vertices ``t``, ``active``; ``shares`` see `mis.ByClass`,
    ``kind`` the class among `mis.CLASSES`."""

    value: object
    weight: object
    s: object
    t: object
    active: object
    shares: object = None
    kind: str = ""

    def weighted(self):
        """What the strategy adds to the image."""
        return dr.select(self.active, self.value * self.weight, 0)


def finite(c: Contribution, counters) -> Contribution:
    """``c``, inactive where it adds no finite value, which is counted: such a contribution counts as zero."""
    lost = c.active & ~bsdf.is_finite(c.value * c.weight)
    count(counters, "non_finite", lost)
    return replace(c, active=c.active & ~lost)


def count(counters, name: str, mask):
    """Add 1 to a counter of `kernel.COUNTERS` in lanes where ``mask`` holds."""
    counters[name] += _one(mask)


@dataclass
class LightPath:
    """Connectible vertices of a lane's light subpath in local memory, ``count`` of them.

    ``throughput`` is that of the vertex over its cosine of incidence (the constant part of the adjoint
    factor); ``newest`` and ``older`` are its `mis.Partial`; ``s`` the number of light vertices up to and
    including it.
    """

    si: object
    throughput: object
    newest: object
    older: object
    anchor: object
    s: object
    count: object


def allocate_light_path(kernel, lanes: int) -> LightPath:
    """Local memory for stored vertices; no field is a Bool (these abort LLVM code generation)."""
    size = kernel.store_size
    return LightPath(
        si=dr.alloc_local(mi.SurfaceInteraction3f, size),
        throughput=dr.alloc_local(mi.Spectrum, size),
        newest=dr.alloc_local(mi.Float, size),
        older=dr.alloc_local(type(kernel.heuristic.zero()), size),
        anchor=dr.alloc_local(mi.Vector2f, size),
        s=dr.alloc_local(mi.UInt32, size),
        # As wide as the lanes: Dr.Jit takes an index of width 1 for the same in all lanes.
        count=dr.zeros(mi.UInt32, lanes),
    )


def store_light_vertex(kernel, vertex: Vertex, path: LightPath):
    """Keep a light vertex that inner connections can use."""
    keep = vertex.hit & (vertex.edges <= kernel.last_stored) & bsdf.connectible(vertex.bsdf)
    slot = path.count
    path.si.write(vertex.si, slot, keep)
    path.throughput.write(mi.Spectrum(vertex.throughput / vertex.cos), slot, keep)
    path.newest.write(vertex.partial.d_vcm, slot, keep)
    path.older.write(vertex.partial.d_vc, slot, keep)
    path.anchor.write(mi.Vector2f(vertex.anchor.offset, vertex.anchor.curvature), slot, keep)
    path.s.write(vertex.edges + 1, slot, keep)
    path.count = path.count + dr.select(keep, mi.UInt32(1), mi.UInt32(0))


def read_light_vertex(kernel, path: LightPath, slot) -> Vertex:
    """The stored vertex ``slot``, the same in all lanes that use it."""
    si = path.si[slot]
    anchor = path.anchor[slot]
    s = path.s[slot]
    return Vertex(
        si=si,
        bsdf=si.bsdf(),
        cos=mi.Float(1),
        anchor=rays.Anchor(si.p, si.n, anchor.x, anchor.y if kernel.shape_errors.any else mi.Float(0)),
        throughput=path.throughput[slot],
        partial=mis.Partial(path.newest[slot], path.older[slot]),
        edges=s - 1,
        previous=None,
        seen=None,
        hit=mi.Bool(True),
        active=mi.Bool(True),
    )


def sees_emitter(kernel, z: Vertex):
    """Mask: the camera subpath has hit an emitter that may be seen."""
    active = z.active & (z.si.emitter(kernel.scene) != dr.zeros(mi.EmitterPtr))
    if kernel.plan.hide_emitters:  # as in `path`: the surroundings are behind null surfaces too
        active &= z.hit | z.seen
    return active


def hit_emitter(kernel, z: Vertex) -> Contribution:
    """s = 0: the camera subpath has hit an emitter (eqs. 42, 43)."""
    h, emitters = kernel.heuristic, kernel.emitters
    t = z.edges + 1
    active = sees_emitter(kernel, z)
    radiance = emitters.emitted(z.si, active)
    active &= ~bsdf.is_zero(radiance)
    connect, first, second = emitters.hit_densities(z.si, z.previous, active)
    directly = z.edges == 1
    endpoints = mis.times(kernel.kappa.endpoints, first)
    if kernel.camera.parallel:  # (1,1) would need just this direction
        endpoints = mis.choose(z.hit, endpoints, 0)
    newest = mis.choose(directly, endpoints, mis.times(kernel.kappa.direct, connect))
    older = dr.select(kernel.within_store(z.edges), first * second, 0)
    if kernel.plan.arrival:  # straight from infinity past all shapes no light subpath comes
        older = dr.select(z.hit | ~directly | emitters.covers(z.previous, z.si.wi), older, 0)
    camera_side = h.combine(
        h.scale(z.partial.d_vcm, newest),
        h.scale(z.partial.d_vc, older),
    )
    weight, shares = h.weigh(kernel.kappa.hit, 0, camera_side)
    value = _known(z.throughput * radiance, connect, first, second)
    return Contribution(value, weight, mi.UInt32(0), t, active, shares, "hit")


def _known(value, *densities):
    """``value``, NaN where one of the ``densities`` of other strategies is not finite: no weight follows."""
    finite = mi.Bool(True)
    for density in densities:
        finite &= dr.isfinite(density)
    return dr.select(finite, value, dr.nan)


def choose_emitter(kernel, z: Vertex, stream):
    """Sample an emitter for the camera vertex ``z``: an `emitters.Direct` and the `bsdf.Target` in which it
    lies."""
    active = z.hit & (z.edges + 1 <= kernel.max_depth) & bsdf.connectible(z.bsdf)
    u = kernel.points.draw_2d("camera", stream, Purpose.EMITTER, z.edges)
    e = kernel.emitters.sample_direct(z.si, u, active)
    return e, bsdf.Target(z.si.to_local(e.d), active & ~bsdf.is_zero(e.weight))


def next_event(kernel, z: Vertex, counters) -> Contribution:
    """s = 1: a camera vertex joined with the emitter point that `choose_emitter` sampled (eqs. 44, 45)."""
    h, e, f, active = kernel.heuristic, z.endpoint, z.f, z.joinable
    k = z.edges + 1
    value = _known(z.throughput * f.value * e.weight, e.emission_ratio)
    active = active & ~bsdf.is_zero(value)

    light_side = h.scale(h.start(dr.select(e.delta, 0, f.pdf_fwd_w / e.pdf_w)), kernel.kappa.hit)
    older = mis.choose(kernel.within_store(k), z.partial.d_vc, 0)
    newest = newest_coefficient(kernel, kernel.kappa.splat, z.edges)
    newest = mis.choose(kernel.within_store(k), newest, 0)
    camera_side = mis.alternatives(
        h,
        mis.Partial(z.partial.d_vcm, older),
        newest,
        f.pdf_rev_w,
        e.emission_ratio * dr.abs(dr.dot(z.si.n, e.d)),
    )
    weight, shares = h.weigh(kernel.kappa.direct, light_side, camera_side)
    active &= _counts(kernel, value, weight)

    to_infinity = rays.spawn(z.anchor, e.d, z.si)
    to_point, own = rays.sight(kernel.shape_errors, z.anchor, e.anchor, e.met, z.si)
    ray = dr.select(e.infinite, to_infinity, to_point)
    count(counters, "shadow_s1", active)
    active &= ~rays.occluded(kernel.scene, ray, active, own)
    return Contribution(value, weight, mi.UInt32(1), k, active, shares, "direct")


def join_endpoints(kernel, emission, stream, counters, active):
    """(1,1): a sampled emitter point seen directly by the sensor.

    Returns the `Contribution` and the film position.
    """
    h = kernel.heuristic
    u = _sensor_points(kernel, stream)
    join = kernel.camera.join(emission.si.p, *u)
    if kernel.camera.parallel:
        active &= ~emission.infinite  # measure zero
    else:
        join = dr.select(emission.infinite, kernel.camera.join_direction(emission.d, *u), join)
    active &= join.valid & ~(emission.pdf_first == 0) & ~emission.beam
    if kernel.camera.delta:
        active &= ~emission.delta  # measure zero: `path` sees nothing either
    radiance = kernel.emitters.radiance_towards(emission, join.d, active)
    cos = dr.select(emission.infinite | emission.delta, 1, dr.abs(dr.dot(emission.anchor.n, join.d)))
    geometry = cos / join.dist2
    value = radiance * (geometry * join.importance / (emission.pdf_first * kernel.count_light))
    active &= ~bsdf.is_zero(value)
    # s = 0: the camera hits the same point.
    ratio = join.pdf_w * geometry / emission.pdf_first
    light_side = h.scale(h.start(dr.select(emission.delta, 0, ratio)), kernel.kappa.hit)
    camera_side = 0
    if kernel.plan.arrival:
        towards = kernel.emitters.direction_density(emission, join.p, join.d, active)
        covered = ~emission.infinite | kernel.emitters.covers(join.p, join.d)
        towards = dr.select(covered, towards, 0)
        camera_side = h.scale(h.start(towards * join.arrival), kernel.kappa.arrival)
    weight, shares = h.weigh(kernel.kappa.endpoints, light_side, camera_side)
    active &= _counts(kernel, value, weight)

    ray = rays.segment(emission.anchor, join.anchor, emission.si)
    # From the sensor into the distance, for light from infinity.
    away = rays.spawn(join.anchor, -join.d, emission.si)
    away.maxt = join.reach  # camera rays see the surroundings behind the far plane
    ray = dr.select(emission.infinite, away, ray)
    count(counters, "shadow_t1", active)
    active &= ~rays.occluded(kernel.scene, ray, active)
    return Contribution(value, weight, mi.UInt32(1), mi.UInt32(1), active, shares, "light"), join.position


def look_at_sensor(kernel, y: Vertex, stream):
    """Join the light vertex ``y`` with the sensor: what `Sensor.join` returns, and the `bsdf.Target` in which
    that lies."""
    active = y.hit & bsdf.connectible(y.bsdf) & (y.edges <= kernel.last_splat)
    join = kernel.camera.join(y.si.p, *_sensor_points(kernel, stream, y.edges))
    active &= join.valid
    if kernel.plan.hide_emitters:
        active &= y.si.shape.emitter() == dr.zeros(mi.EmitterPtr)
    cos_ratio = dr.abs(dr.dot(y.si.n, join.d)) / y.cos
    return join, bsdf.Target(y.si.to_local(join.d), active, cos_ratio)


def splat(kernel, y: Vertex, stream, counters):
    """t = 1: a light vertex joined with the sensor as `look_at_sensor` says (eqs. 46, 47).

    Returns the `Contribution` and the film position.
    """
    h, scene, join, f = kernel.heuristic, kernel.scene, y.endpoint, y.f
    to_area = dr.abs(dr.dot(y.si.n, join.d)) / join.dist2
    estimate = y.throughput * f.value * (join.importance / join.dist2)
    value = estimate * dr.rcp(kernel.count_light)
    active = y.joinable & ~bsdf.is_zero(value)

    newest = newest_coefficient(kernel, kernel.kappa.direct, y.edges)
    light_side = mis.alternatives(h, y.partial, newest, f.pdf_rev_w, join.pdf_w * to_area)
    camera_side = 0
    if kernel.plan.arrival:
        camera_side = h.scale(h.start(f.pdf_fwd_w * join.arrival), kernel.kappa.arrival)
    weight, shares = h.weigh(kernel.kappa.splat, light_side, camera_side)
    active &= _counts(kernel, value, weight)

    u = kernel.points.draw_1d("light", stream, Purpose.CONNECTION, y.edges)
    c = Contribution(value, weight, y.edges + 1, mi.UInt32(1), active, shares, "light")
    active, survival = _roulette(kernel, c.weighted(), u, active, counters)
    count(counters, "shadow_t1", active)
    ray = rays.segment(y.anchor, join.anchor, y.si)
    if kernel.plan.hide_emitters:
        pi, _ = rays.intersect_past_emitters(scene, kernel.shape_errors, ray, active, coherent=False)
        active &= ~pi.is_valid()
    else:
        active &= ~rays.occluded(scene, ray, active)
    c.value, c.active = value / survival, active
    return c, join.position


def arrive(kernel, emission, y: Vertex, walk):
    """t = 0: the last edge of a light subpath hits the sensor.

    ``walk`` before it arrived at ``y``. The vertex at the sensor takes the place of ``y``, whose densities
    are those of the scene's surface behind. Returns the `Contribution` and the film position.
    """
    h = kernel.heuristic
    directly = walk.edges == 1
    z = kernel.camera.arrive(walk, y, emission.infinite & directly)
    active = z.active & (walk.edges <= kernel.last_arrival)
    if kernel.plan.hide_emitters:
        active &= walk.seen
    value = walk.throughput * (z.importance * dr.rcp(kernel.count_light))
    active &= ~bsdf.is_zero(value)

    # (1,1) makes y_0 by emission, not by next-event estimation from z_0, and cannot make that of a beam.
    completing = dr.select(emission.beam, 0, emission.pdf_first)
    before = mis.Partial(h.scale(walk.partial.d_vcm, dr.select(directly, completing, 1)), walk.partial.d_vc)
    dist2 = dr.select(directly & emission.infinite, 1, z.dist2)
    partial = mis.arrive(h, before, dist2, z.cos)
    newest = mis.choose(directly, kernel.kappa.endpoints, kernel.kappa.splat)
    light_side = mis.alternatives(h, partial, newest, z.pdf_w, z.pdf_area)
    weight, shares = h.weigh(kernel.kappa.arrival, light_side, 0)
    active &= _counts(kernel, value, weight)
    if z.surroundings is not None and kernel.emitters.at_infinity:
        asked = active & emission.infinite & directly
        active &= ~(asked & rays.occluded(kernel.scene, z.surroundings, asked))
    return Contribution(value, weight, walk.edges + 1, mi.UInt32(0), active, shares, "light"), z.position


def inner(kernel, z: Vertex, y: Vertex) -> Contribution:
    """s, t >= 2: a camera vertex joined with a light vertex, before visibility (eqs. 40, 41).

    ``active`` where the contribution is not zero.
    """
    h = kernel.heuristic
    k = z.edges + y.edges + 1
    active = z.hit & (k <= kernel.last_inner)
    between = y.si.p - z.si.p
    dist2 = dr.squared_norm(between)
    active &= dist2 > 0
    inverse = dr.rcp(dist2)
    d = between * dr.sqrt(inverse)
    wo_z, wo_y = z.si.to_local(d), y.si.to_local(-d)
    cos_z, cos_y = dr.abs(dr.dot(z.si.n, d)), dr.abs(dr.dot(y.si.n, d))
    f_z = bsdf.evaluate(z.bsdf, z.si, wo_z, active, kernel.traits)
    f_y = bsdf.evaluate_adjoint(y.bsdf, y.si, wo_y, active, kernel.traits, cos_y / y.cos)
    value = (z.throughput * f_z.value) * (f_y.value * y.throughput) * inverse
    active &= ~bsdf.is_zero(value)

    light_side = mis.alternatives(
        h,
        y.partial,
        newest_coefficient(kernel, kernel.kappa.direct, y.edges),
        f_y.pdf_rev_w,
        f_z.pdf_fwd_w * cos_y * inverse,
    )
    camera_side = mis.alternatives(
        h,
        z.partial,
        newest_coefficient(kernel, kernel.kappa.splat, z.edges),
        f_z.pdf_rev_w,
        f_y.pdf_fwd_w * cos_z * inverse,
    )
    weight, shares = h.weigh(kernel.kappa.inner, light_side, camera_side)
    active &= _counts(kernel, value, weight)
    return Contribution(value, weight, y.edges + 1, z.edges + 1, active, shares, "inner")


def connect_all(kernel, z: Vertex, path: LightPath, counters, total, add):
    """Join ``z`` with every stored light vertex, a visibility ray each.

    ``add(contribution, visible, total)`` adds a contribution to the running ``total`` and returns it;
    ``visible``: it is active and nothing is in between.
    """

    def body(slot, total, nonzero, lost):
        y = read_light_vertex(kernel, path, slot)
        counted = {"non_finite": lost}
        c = finite(inner(kernel, z, y), counted)
        nonzero = nonzero + _one(c.active)
        ray, own = _sight(kernel, z, y)
        visible = c.active & ~rays.occluded(kernel.scene, ray, c.active, own)
        return slot + 1, add(c, visible, total), nonzero, counted["non_finite"]

    candidates = candidate_count(kernel, z, path)
    _, total, nonzero, lost = dr.while_loop(
        (mi.UInt32(0), total, mi.UInt32(0), mi.UInt32(0)),
        lambda slot, *_: slot < candidates,
        body,
        label="inner connections",
    )
    counters["non_finite"] += lost
    counters["evaluated"] += candidates
    counters["zero"] += candidates - nonzero
    counters["shadow_inner"] += nonzero
    return total


def connect_one(kernel, z: Vertex, path: LightPath, stream, counters):
    """Join ``z`` with one light vertex, drawn by its weighted unshadowed contribution.

    The draw is a running one over all candidates; the estimate is that of all of them. One random
    number serves the whole draw: what is left of it after each decision is uniform again.
    """

    def body(slot, chosen, total, end, u, nonzero, lost):
        y = read_light_vertex(kernel, path, slot)
        counted = {"non_finite": lost}
        c = finite(inner(kernel, z, y), counted)
        value = c.weighted()
        size = _size(value)
        before, total = total, total + size
        # What is left of the number after the decision, u / share or (u - share) / (1 - share).
        u_total = u * total
        take = u_total < size
        rest = dr.select(take, u_total, u_total - size) / dr.select(take, size, before)
        u = dr.select(total > 0, rest, u)
        chosen = dr.select(take, value, chosen)
        # The end of the visibility ray is kept rather than the slot: a look-up by lane costs more.
        end = dr.select(take, slot if small else rays.end_point(z.anchor, y.anchor), end)
        return slot + 1, chosen, total, end, u, nonzero + _one(c.active), counted["non_finite"]

    candidates = candidate_count(kernel, z, path)
    u = kernel.points.draw_1d("camera", stream, Purpose.CONNECTION, z.edges)
    small = kernel.shape_errors.small
    none = mi.UInt32(0), dr.zeros(mi.Spectrum), mi.Float(0), mi.UInt32(0) if small else mi.Point3f(z.si.p)
    _, chosen, total, end, u, nonzero, lost = dr.while_loop(
        (*none, u, mi.UInt32(0), mi.UInt32(0)),
        lambda slot, *_: slot < candidates,
        body,
        label="draw an inner connection",
    )
    counters["evaluated"] += candidates
    counters["zero"] += candidates - nonzero
    counters["non_finite"] += lost
    # In this order: the draw may hit a tiny one, for which total / size is infinite.
    value = (chosen / _size(chosen)) * total
    active = total > 0
    active, survival = _roulette(kernel, value, u, active, counters)
    count(counters, "shadow_inner", active)
    own = None
    if small:
        y = read_light_vertex(kernel, path, end)
        ray, own = _sight(kernel, z, y)
    else:
        ray = rays.segment_to(z.anchor, end, z.si)
    active &= ~rays.occluded(kernel.scene, ray, active, own)
    return dr.select(active, value / survival, 0)


def _sight(kernel, z: Vertex, y: Vertex):
    """`rays.sight` from ``z`` to the light vertex ``y``."""
    return rays.sight(kernel.shape_errors, z.anchor, y.anchor, rays.met(y.si.shape, y.si.instance), z.si)


def candidate_count(kernel, z: Vertex, path: LightPath):
    """Number of light vertices to try at ``z``: slot i holds y_{i+1} or a later one, and paths have at
    most `Kernel.last_inner` edges."""
    possible = z.hit & bsdf.connectible(z.bsdf) & (z.edges + 2 <= kernel.last_inner)
    return dr.select(possible, dr.minimum(path.count, kernel.last_inner - z.edges - 1), 0)


def _sensor_points(kernel, stream, edges=0):
    """The random points with which the light vertex ``edges`` is joined with the sensor."""
    u_lens = kernel.points.draw_2d("light", stream, Purpose.LENS, edges)
    if not kernel.camera.needs_film_sample:
        return u_lens, None
    return u_lens, kernel.points.draw_2d("light", stream, Purpose.FILM, edges)


def _roulette(kernel, value, u, active, counters):
    """Unbiased roulette on a weighted contribution before its visibility is tested."""
    if not kernel.plan.roulette:
        return active, mi.Float(1)
    size = _size(value)
    # Not below the spacing of the random numbers, which are 0 more often than that; NaN goes on.
    survival = dr.clip(size * kernel.inverse_threshold, LEAST_SURVIVAL, 1)
    survival = dr.select(dr.isfinite(size), survival, 1)
    survived = u < survival
    count(counters, "rouletted", active & ~survived)
    return active & survived, survival


def _counts(kernel, value, weight):
    """Mask: a strategy of this ``value`` and weight is worth a ray, or has to be counted by `finite` (of what
    is not finite the weight may be 0). Technique images show unweighted ones too."""
    return mi.Bool(True) if kernel.strategy_images else ~(weight == 0) | ~bsdf.is_finite(value)


def _size(value):
    """A measure of a contribution's size; any will do as long as it is positive where f is."""
    return bsdf.brightest(value)


def _one(mask):
    return dr.select(mask, mi.UInt32(1), mi.UInt32(0))
