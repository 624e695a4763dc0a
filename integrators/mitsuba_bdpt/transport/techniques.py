"""One function per class of strategies: its path, contribution and weight.

All return a `Contribution` before its shadow ray: the *unweighted* estimate f / p divided by the class's
count, and the weight; only `Contribution.weighted` multiplies the two. Densities and cosines are geometric;
throughputs contain everything up to and including the edge to the vertex. Equation numbers: Georgiev 2012,
see `mis`.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..emitters.records import Direct, Emission
from ..geometry import polarization, rays
from ..sampling.points import Purpose, Stream
from ..sensors.records import CameraConnection
from . import bsdf, mis, path_layers, spectra
from .alternatives import merges_before_end, side_of, where_lit
from .contribution import Contribution, Counters, one, roulette
from .inputs import TraceContext
from .sds import PhotonStrategy, connects_sds_path
from .vacuum import ShadowRay
from .walk import Vertex


def sees_emitter(kernel: TraceContext, z: Vertex) -> mi.Bool:
    """Mask: the camera subpath has hit a visible emitter."""
    active = z.active & (z.si.emitter(kernel.scene) != dr.zeros(mi.EmitterPtr))
    if kernel.plan.hide_emitters:  # as in `volpath`; in `path` the environment is behind null surfaces too
        active &= z.seen if kernel.has_media else z.hit | z.seen
    return active & ~z.volume


def hit_emitter(kernel: TraceContext, z: Vertex, sds: PhotonStrategy) -> Contribution:
    """s = 0: the subpath has hit an emitter (eqs. 42, 43); ``sds``: the strategy beside it on SDS paths."""
    h, emitters = kernel.heuristic, kernel.emitters
    t = z.edges + 1
    active = sees_emitter(kernel, z)
    radiance = emitters.emitted(z.si, active)
    active &= ~spectra.is_zero(radiance)
    # Area measure; for the environment solid angle and disk area, see `Emitters.hit_densities`.
    pdf_connect, pdf_first, pdf_second = emitters.hit_densities(z.si, z.previous, active)
    directly = z.edges == 1
    endpoints = h.scale(kernel.kappa.endpoints, pdf_first)
    if kernel.camera.parallel:  # (1,1) would need exactly this direction
        endpoints = mis.choose(z.hit, endpoints, 0)
    direct = where_lit(kernel, z.edge and z.edge.lit)
    newest = mis.choose(directly, endpoints, h.scale(direct, pdf_connect))
    older = dr.select(z.edges <= kernel.reach, pdf_first * pdf_second, 0)
    if kernel.plan.arrival:  # no light subpath comes straight from infinity past all shapes
        older = dr.select(z.hit | ~directly | emitters.covers(z.previous, z.si.wi), older, 0)
    sides = 0, mis.alternatives(h, z.partial, newest, older)
    if sds.near_specular:
        on_sds_path = z.sds.is_sds_path(z.edges, mis.choose(directly, kernel.kappa.endpoints, direct))
        alone = h.scale(z.partial.d_vcm, newest)
        sides = _beside_guided(kernel, z.sds.guided, on_sds_path, sides, alone, kernel.kappa.hit)
        active = sds.counts(active, on_sds_path)
    elif z.sds is not None and z.sds.guided is not None:
        on_sds_path = (z.partial.d_vcm == 0) & (z.sds.guided > 0)  # guided subpaths arrive from delta events
        guided = h.scale(dr.select(on_sds_path, z.sds.guided, 0), kernel.kappa.hit)
        sides, active = (0, h.combine(sides[1], guided)), sds.counts(active, on_sds_path)
    merges = merges_before_end(kernel, z.partial, newest, pdf_first * pdf_second)
    merges = mis.choose(z.edges <= kernel.last_merged, merges, 0)
    weight, shares = h.weigh(kernel.kappa.hit, *sides, ((0, merges),))
    others = (pdf_connect, pdf_first, pdf_second) if kernel.reverse else (pdf_connect,)
    value = _known(z.throughput * radiance, *others)
    c = Contribution(value, weight, mi.UInt32(0), t, active, shares, "hit", path_layer=z.layer)
    c.emission = kernel.cells and kernel.cells.of_hit(z.si, z.previous, active)
    if kernel.light_groups is not None:
        c.light_group = kernel.light_group(emitters.index_of_hit(z.si, active), active)
    return c


def _beside_guided(
    kernel: TraceContext, guided, on_sds_path, sides: tuple, alone, own: mis.Coefficient
) -> tuple:
    """Light and camera ``sides`` of s = 0 or s = 1, where near-specular events count as specular.

    The only alternatives on an SDS path are the other of the two, ``alone``, and both guided, at r times the
    density (``guided``). ``own``: coefficient of the strategy.
    """
    h = kernel.heuristic
    if guided is not None:
        alone = h.combine(alone, h.scale(h.combine(alone, own), guided))
    return mis.choose(on_sds_path, alone, sides[0]), mis.choose(on_sds_path, 0, sides[1])


def _known(value, *pdfs):
    """``value``, NaN where a density of another strategy is non-finite."""
    finite = mi.Bool(True)
    for pdf in pdfs:
        finite &= dr.isfinite(pdf)
    return dr.select(finite, value, dr.nan)


def choose_emitter(kernel: TraceContext, z: Vertex, stream: Stream) -> tuple[Direct, bsdf.Target]:
    """Sample an emitter for the camera vertex ``z``; returns it and its `bsdf.Target`."""
    active = z.hit & (z.edges + 1 <= kernel.max_depth) & z.connectible()
    active &= kernel.space.allows_next_event(z)
    u = kernel.points.draw_2d("camera", stream, Purpose.EMITTER, z.event)
    e = kernel.emitters.sample_direct(z.si, u, active)
    return e, bsdf.Target(z.si.to_local(e.d), active & ~spectra.is_zero(e.weight))


def next_event(kernel: TraceContext, z: Vertex, stream: Stream, sds: PhotonStrategy) -> Contribution:
    """s = 1: connect ``z`` with a sampled emitter point (eqs. 44, 45); ``sds`` as in `hit_emitter`."""
    h, e, f, active = kernel.heuristic, z.endpoint, z.f, z.endpoint_active
    k = z.edges + 1
    value = z.throughput * f.value * e.weight
    if kernel.reverse:
        value = _known(value, e.emission_ratio)
    active = active & ~spectra.is_zero(value)

    light_side = h.scale(h.start(dr.select(e.delta, 0, f.pdf_fwd_w / e.pdf_w)), kernel.kappa.hit)
    camera_side, merges = side_of(kernel, z, False, f, e.emission_ratio * z.cosine(e.d))
    merges = [[mis.choose(k <= kernel.last_merged, x, 0) for x in pair] for pair in merges]
    ends = light_side, mis.choose(k <= kernel.reach, camera_side, 0)
    if sds.near_specular:
        on_sds_path = connects_sds_path(k, (z.sds, f, 0)) & ~e.delta
        guided = None if z.sds.guided is None else z.sds.guided_before_last(h)
        ends = _beside_guided(kernel, guided, on_sds_path, ends, light_side, kernel.kappa.direct)
        active = sds.counts(active, on_sds_path)
    sides = kernel.kappa.direct, *ends, merges, kernel.kappa.direct
    weight, shares = h.weigh(*sides)

    to_infinity = rays.spawn(z.anchor, e.d, z.si)
    to_point, own = rays.shadow_ray(kernel.shape_errors, z.anchor, e.anchor, e.met, z.si)
    ray = dr.select(e.infinite, to_infinity, to_point)
    counted, cos = Counters(shadow_s1=one(active)), dr.abs(dr.dot(e.anchor.n, e.d))
    c = Contribution(value, weight, mi.UInt32(1), k, active, shares, "direct", None, counted, sides)
    return replace(
        c,
        emission=kernel.cells and kernel.cells.at(e.index, z.si.p, -e.d, cos, active),
        light_group=kernel.light_group(e.index, active),
        path_layer=path_layers.evaluated(z.layer, f, adjoint=False),
        shadow_ray=ShadowRay(ray, stream, z, e.d, own=own),
    )


def connect_endpoints(
    kernel: TraceContext, emission: Emission, stream: Stream, active: mi.Bool
) -> Contribution:
    """(1,1): connect a sampled emitter point with the sensor."""
    h = kernel.heuristic
    u = _sensor_points(kernel, stream)
    connection = kernel.camera.connect(emission.si.p, *u)
    if kernel.camera.parallel:
        active &= ~emission.infinite  # measure zero
    else:
        connection = dr.select(emission.infinite, kernel.camera.connect_direction(emission.d, *u), connection)
    active &= connection.valid & ~(emission.pdf_first == 0) & ~emission.beam
    if kernel.camera.delta:
        active &= ~emission.delta  # measure zero: `path` sees nothing either
    radiance = kernel.emitters.radiance_towards(emission, connection.d, active)
    cos = dr.select(emission.infinite | emission.delta, 1, dr.abs(dr.dot(emission.anchor.n, connection.d)))
    geometry = cos / connection.dist2
    value = radiance * (geometry * connection.importance / (emission.pdf_first * kernel.count_light))
    active &= ~spectra.is_zero(value)
    # s = 0: the camera subpath hits the same point.
    ratio = connection.pdf_w * geometry / emission.pdf_first
    light_side = h.scale(h.start(dr.select(emission.delta, 0, ratio)), kernel.kappa.hit)
    camera_side = 0
    if kernel.plan.arrival:
        pdf_second = kernel.emitters.direction_density(emission, connection.p, connection.d, active)
        covered = ~emission.infinite | kernel.emitters.covers(connection.p, connection.d)
        pdf_second = dr.select(covered, pdf_second, 0)
        camera_side = h.scale(h.start(pdf_second * connection.arrival), kernel.kappa.arrival)
    sides = kernel.kappa.endpoints, light_side, camera_side
    weight, shares = h.weigh(*sides)

    ray = rays.segment(emission.anchor, connection.anchor, emission.si)
    if kernel.has_media:  # the sensor's medium is known in every direction
        ray = rays.segment(connection.anchor, emission.anchor, emission.si)
    # From the sensor towards infinity, for light from infinity.
    away = rays.spawn(connection.anchor, -connection.d, emission.si)
    away.maxt = connection.reach  # camera rays see the environment behind the far plane
    ray = dr.select(emission.infinite, away, ray)
    counted = Counters(shadow_t1=one(active))
    ends = mi.UInt32(1), mi.UInt32(1)
    c = Contribution(value, weight, *ends, active, shares, "light", connection.position, counted, sides)
    layer = mi.UInt32(path_layers.EMISSION) if kernel.path_layers else None
    return replace(c, towards=connection.d, path_layer=layer, shadow_ray=ShadowRay(ray, stream))


def look_at_sensor(kernel: TraceContext, y: Vertex, stream: Stream) -> tuple[CameraConnection, bsdf.Target]:
    """Sample a connection of the light vertex ``y`` with the sensor; returns it and its `bsdf.Target`."""
    active = y.hit & y.connectible() & (y.edges + 1 <= kernel.reach)
    connection = kernel.camera.connect(y.si.p, *_sensor_points(kernel, stream, y.event))
    active &= connection.valid
    if kernel.plan.hide_emitters:
        on_emitter = y.si.shape.emitter() != dr.zeros(mi.EmitterPtr)
        active &= ~on_emitter
    cos_ratio = y.cosine(connection.d) / y.cos
    return connection, bsdf.Target(y.si.to_local(connection.d), active, cos_ratio)


def splat(kernel: TraceContext, y: Vertex, stream: Stream) -> Contribution:
    """t = 1: connect a light vertex with `look_at_sensor`'s point (eqs. 46, 47)."""
    h, connection, f = kernel.heuristic, y.endpoint, y.f
    to_area = y.cosine(connection.d) / connection.dist2
    estimate = polarization.extended(y.throughput, f.value, adjoint=True)
    value = estimate * (connection.importance / connection.dist2) * dr.rcp(kernel.count_light)
    active = y.endpoint_active & ~spectra.is_zero(value)

    light_side, merges = side_of(kernel, y, True, f, connection.pdf_w * to_area)
    camera_side = h.scale(h.start(f.pdf_fwd_w * connection.arrival), kernel.kappa.arrival)
    sides = kernel.kappa.splat, light_side, camera_side, merges, kernel.kappa.splat_prime
    if kernel.sds.near_specular:
        active &= ~connects_sds_path(y.edges + 1, (y.sds, f, 0))
    weight, shares = h.weigh(*sides)

    u = kernel.points.draw_1d("light", stream, Purpose.CONNECTION, y.event)
    c = Contribution(value, weight, y.edges + 1, mi.UInt32(1), active, shares, "light", connection.position)
    active, survival, rouletted = roulette(kernel, c.weighted(), u, active)
    counted = rouletted + Counters(shadow_t1=one(active))
    ray = rays.segment(y.anchor, connection.anchor, y.si)
    c = replace(c, value=value / survival, active=active, counted=counted, sides=sides, towards=connection.d)
    c.shadow_ray = ShadowRay(ray, stream, y, connection.d, hidden=kernel.plan.hide_emitters)
    of_light = path_layers.evaluated(y.layer, f, adjoint=True)
    return replace(c, path_layer=path_layers.joined(path_layers.EMISSION, of_light))


def hit_sensor(kernel: TraceContext, emission, y: Vertex, walk) -> Contribution:
    """t = 0: the last edge of a light subpath hits the sensor.

    ``walk`` as before its arrival at ``y``. The vertex on the sensor replaces ``y``, whose densities are
    those of the scene's surface behind it.
    """
    h = kernel.heuristic
    directly = walk.edges == 1
    reaching = walk
    if y.edge is not None:  # in scenes with media its edge ends at ``y``
        pi = mi.PreliminaryIntersection3f(walk.pi)
        pi.t = dr.select(y.hit, dr.norm(y.si.p - walk.previous), dr.inf)
        reaching = replace(walk, pi=pi)
    z = kernel.camera.hit(reaching, y, emission.infinite & directly)
    active = z.active & (walk.edges <= kernel.reach)
    reached, throughput, tr = kernel.space.up_to_sensor(walk, y, z, active)
    active &= reached
    if kernel.plan.hide_emitters:
        active &= walk.seen
    value = throughput * (z.importance * dr.rcp(kernel.count_light))
    active &= ~spectra.is_zero(value)

    # (1,1) samples y_0 by emission, not by next-event estimation from z_0, and cannot sample a beam's.
    completing = dr.select(emission.beam, 0, emission.pdf_first)
    before = replace(walk.partial, d_vcm=h.scale(walk.partial.d_vcm, dr.select(directly, completing, 1)))
    dist2 = dr.select(directly & emission.infinite, 1, z.dist2)
    partial = mis.to_area(h, before, dist2, z.cos, tr)
    newest = mis.choose(directly, kernel.kappa.endpoints, kernel.kappa.splat)
    light_side = mis.alternatives(h, partial, newest, z.pdf_w, z.pdf_a)
    kappa_prime = mis.choose(directly, kernel.kappa.endpoints, kernel.kappa.splat_prime)
    merges = h.scale(merges_before_end(kernel, partial, kappa_prime, z.pdf_w), z.pdf_a)
    if kernel.sds.near_specular:
        active &= ~walk.sds.is_sds_path(walk.edges, newest)
    elif walk.sds is not None:
        # Guided s = 0, of SDS paths: on these the last edge is not connectible either.
        guided = h.scale(partial.d_vm, z.pdf_w * z.pdf_a)
        light_side = h.combine(light_side, dr.select(mis.is_connectible(partial, newest), 0, guided))
    weight, shares = h.weigh(kernel.kappa.arrival, light_side, 0, ((0, merges),))
    if z.surroundings is not None and kernel.emitters.at_infinity:
        straight = active & emission.infinite & directly
        active &= ~straight | kernel.space.clear(z.surroundings, kernel.sensor_medium, straight)
    ends = walk.edges + 1, mi.UInt32(0)
    c = Contribution(value, weight, *ends, active, shares, "light", z.position, towards=walk.d)
    return replace(c, path_layer=path_layers.joined(path_layers.EMISSION, walk.layer))


def _sensor_points(kernel: TraceContext, stream, edges=0):
    """Random points of the connection of light vertex ``edges`` with the sensor."""
    u_lens = kernel.points.draw_2d("light", stream, Purpose.LENS, edges)
    if not kernel.camera.needs_film_sample:
        return u_lens, None
    return u_lens, kernel.points.draw_2d("light", stream, Purpose.FILM, edges)
