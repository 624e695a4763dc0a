"""One batch (a pass, or a band of its rows) as one kernel.

A lane carries one light subpath, kept in its local memory, and then one after the other the S camera
subpaths that it serves, in S different pixels (see `sharing`); all strategies of a pair are evaluated by that
lane. Nothing per lane lives in global memory: apart from the film, the footprint does not grow with samples
or image size.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..geometry import rays
from ..sampling.points import Points, Purpose
from ..settings import MAX_STORED, UNLIMITED
from . import bsdf, contribution, light_path, mis, techniques
from .batch import Batch, Places
from .counters import Counters, counted_by_camera, counted_by_light, one
from .sharing import Sharing
from .walk import Side, Walk, random_walk

# Sizes of the lanes' local memory. They do not matter for speed; few of them make few kernels.
STORE_SIZES = (64, MAX_STORED)


@dataclass
class Coefficients:
    """kappa of each class of strategies, with which it enters all weights, see `plan.Plan`; the Python
    number 0 for classes that are not in use."""

    hit: object
    direct: object
    splat: object
    endpoints: object
    arrival: object
    inner: object


@dataclass
class Shared:
    """Time and wavelengths of a lane's light subpath and of all camera subpaths it serves; ``u_wavelength``
    chose the wavelengths, ``weight`` is 1 / their density."""

    time: object
    wavelengths: object
    weight: object
    u_wavelength: object


class Kernel:
    """Everything that a pass needs besides its batch. Holds the scene for one render only."""

    def __init__(self, prepared, plan, settings, heuristic):
        self.scene, self.camera, self.emitters = prepared.scene, prepared.camera, prepared.emitters
        self.plan, self.heuristic = plan, heuristic
        self.shape_errors = prepared.emitters.shape_errors
        self.surfaces, self.refracts = prepared.surfaces, prepared.refracts
        self.traits = prepared.traits
        depth = min(settings.max_depth, UNLIMITED)
        reach = min(depth, settings.stored_vertices)
        self.store_size = next(size for size in STORE_SIZES if size >= reach - 2)
        self.strategy_images = settings.strategy_images
        u32, f32 = _opaque(mi.UInt32), _opaque(mi.Float)
        self.max_depth, self.rr_depth = u32(depth), u32(settings.rr_depth)
        self._reach = u32(reach)
        self.last_stored, self.last_inner = u32(max(reach - 2, 0)), u32(reach)
        self.last_splat, self.last_arrival = u32(max(reach - 1, 0)), u32(reach)
        after = 0 if plan.arrival else 1 if plan.splat else 2  # edges that the class adds to a light subpath
        self.last_light = u32(max(reach - after, 0))
        self.camera_paths_per_light_path = u32(plan.camera_paths_per_light_path)
        self.kappa = _coefficients(plan, isinstance(heuristic, mis.ByClass))
        self.inverse_threshold = f32(dr.inf)

    def bound(self, points, count_light: float) -> Kernel:
        """The kernel for one batch: with the batch's ``points`` and its exact count of light subpaths per
        camera subpath, which the estimates of t <= 1 are divided by (weights keep the nominal one)."""
        other = copy(self)
        other.points, other.count_light = points, dr.opaque(mi.Float, count_light)
        return other

    def within_store(self, k):
        """Mask: paths of ``k`` edges use all strategies; longer ones s = 0 and s = 1 only."""
        return k <= self._reach

    def set_threshold(self, size):
        """Contributions below this size play roulette (a power of two near it, so that the order of atomic
        sums rarely changes a decision), none if it is 0. ``size``: ``Float64`` of width 1."""
        rounded = dr.exp2(dr.round(dr.log2(size)))
        self.inverse_threshold = mi.Float(dr.select(size > 0, dr.rcp(rounded), dr.inf))
        dr.eval(self.inverse_threshold)


def trace(kernel: Kernel, sink, batch: Batch, points: Points, spp: int):
    """Trace one batch and put its contributions into ``sink`` (see `sink`); ``spp`` is the render's total,
    which places the batch in the image's point sequence. Returns `Counters.summed`; nothing is evaluated
    yet."""
    sharing = shared_by(kernel, batch, points)
    kernel = kernel.bound(points, _count_light(batch, sharing))
    lane = dr.arange(mi.UInt32, sharing.lanes)
    common, of_light = _begin(kernel, sink, Places(kernel, batch, spp), lane)

    def serve(slot, counters):
        active = slot < dr.opaque(mi.UInt32, batch.size)
        return counters + _camera_subpath(kernel, sink, common, slot, active)

    counters = Counters.zeros("camera") + counted_by_camera(kernel.plan)
    if not kernel.plan.light:
        counters = serve(lane, counters)
    else:
        seat = sharing.seat(lane)
        _, counters = dr.while_loop(
            (mi.UInt32(0), counters),
            lambda served, counters: served < kernel.camera_paths_per_light_path,
            lambda served, counters: (served + 1, serve(sharing.slot(seat, served), counters)),
            label="camera subpaths of one light subpath",
        )
    return (of_light + counters).summed()


def retrace(kernel: Kernel, sink, batch: Batch, points: Points, spp: int, slot):
    """Trace some camera samples of a batch again, as `trace` does: those of these ``slot``s (``UInt32``) with
    the light subpath of the lane that each is in. (For whoever looks at single samples; no render does.)"""
    sharing = shared_by(kernel, batch, points)
    kernel = kernel.bound(points, _count_light(batch, sharing))
    common, of_light = _begin(kernel, sink, Places(kernel, batch, spp), sharing.lane(slot))
    return (of_light + _camera_subpath(kernel, sink, common, slot, mi.Bool(True))).summed()


def shared_by(kernel: Kernel, batch: Batch, points: Points) -> Sharing:
    """Which camera samples of a batch share a light subpath. Those of a pilot do not, and some of its light
    subpaths have none."""
    if batch.spread:
        return Sharing(batch.lanes, 1, 1, points.seed)
    return Sharing(batch.pixels, batch.samples, kernel.plan.camera_paths_per_light_path, points.seed)


def _count_light(batch: Batch, sharing: Sharing) -> float:
    """Light subpaths per camera subpath: exact also where S does not divide the batch. A pilot's estimates
    are those of one, whose number it divides by itself."""
    return 1.0 if batch.spread else sharing.lanes / batch.size


def _begin(kernel, sink, place: Places, lane):
    """Trace the light subpaths of these ``lane``s: what their camera subpaths share, and the counters."""
    stream = kernel.points.stream("light", place.index(lane), lane)
    shared = _shared(kernel, stream)
    path = light_path.allocate_light_path(kernel, dr.width(lane))
    counters = Counters()
    if kernel.plan.light:
        path, counters = _light_subpath(kernel, sink, stream, shared, path)
    return _Lane(place, shared, path), counters


@dataclass
class _Lane:
    """What a lane's camera subpaths share: the map of samples, time and wavelengths, light vertices."""

    place: Places
    shared: Shared
    path: light_path.LightPath


@dataclass
class _Sample:
    """A camera sample: its `CameraStart`, random numbers, point of the lens, and whether there is one."""

    start: object
    stream: object
    u_lens: object
    covered: object


def _shared(kernel, stream) -> Shared:
    sensor, points = kernel.camera.sensor, kernel.points
    time = mi.Float(sensor.shutter_open())
    if sensor.shutter_open_time() > 0:
        u = points.draw_1d("light", stream, Purpose.TIME)
        time += u * sensor.shutter_open_time()
    if not mi.is_spectral:
        return Shared(time, mi.Color0f(), mi.Spectrum(1), mi.Float(0.5))
    u = points.draw_1d("light", stream, Purpose.WAVELENGTH)
    wavelengths, weight = sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), u)
    return Shared(time, wavelengths, weight, u)


def _light_subpath(kernel, sink, stream, shared, path):
    points, h, emitters = kernel.points, kernel.heuristic, kernel.emitters
    e = emitters.sample_emission(
        points.draw_2d("light", stream, Purpose.EMISSION_POINT),
        points.draw_2d("light", stream, Purpose.EMISSION_DIRECTION),
        shared,
        mi.Bool(True),
    )
    counters = Counters()
    if kernel.plan.endpoints:
        c = techniques.join_endpoints(kernel, e, stream, mi.Bool(True))
        counters += _splat(kernel, sink, c, shared)
    active = ~bsdf.is_zero(e.weight) & (kernel.last_light >= 1)
    broken = active & ~bsdf.is_finite(e.weight)
    counters += Counters(non_finite=one(broken))
    active &= ~broken
    inverse = dr.rcp(e.pdf_first * e.pdf_second)
    ray = rays.spawn(e.anchor, e.d, shared)
    pi = kernel.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    hit = h.scale(h.start(dr.select(e.delta, 0, e.cos * inverse)), kernel.kappa.hit)
    partial = mis.Partial(h.start(inverse), h.present(hit))
    walk = Walk.begin(kernel, pi, ray, e.si.p, mi.Spectrum(e.weight), partial, active)
    side = Side(
        "light",
        shared,
        bsdf.brightest(walk.throughput),
        True,
        kernel.last_light,
        kernel.kappa.direct,
        complete=lambda si, first: emitters.connection_density(e, si, first),
        join=(lambda y: techniques.look_at_sensor(kernel, y, stream)) if kernel.plan.splat else None,
    )

    def visit(vertex, state, walk):
        path, counters = state
        if kernel.plan.arrival:
            counters += _splat(kernel, sink, techniques.hit_sensor(kernel, e, vertex, walk), shared)
        if kernel.plan.splat:
            counters += _splat(kernel, sink, techniques.splat(kernel, vertex, stream), shared)
        if kernel.plan.connections != "none":
            light_path.store_light_vertex(kernel, vertex, path)
        return path, counters

    state = path, counted_by_light(kernel.plan)
    (path, counted), walk = random_walk(kernel, side, walk, stream, visit, state)
    counters += counted
    return path, counters + Counters(light=dr.select(active, walk.traced(), 0), non_finite=one(walk.broken))


def _splat(kernel, sink, c, shared) -> Counters:
    """Hand a contribution with t <= 1 to the sink."""
    c = contribution.finite(c)
    return c.counted + sink.splat(kernel, c, shared)


def _camera_subpath(kernel, sink, lane: _Lane, slot, active) -> Counters:
    points, plan = kernel.points, kernel.plan
    place, shared = lane.place, lane.shared
    stream = points.stream("camera", place.index(slot), slot)
    u_film = points.draw_2d("camera", stream, Purpose.FILM)
    u_lens = mi.Point2f(0.5)
    if kernel.camera.needs_aperture_sample:
        u_lens = points.draw_2d("camera", stream, Purpose.APERTURE)
    start = kernel.camera.start(place.pixel(slot), u_film, u_lens, shared)
    sample = _Sample(start, stream, u_lens, active)
    active = active & (kernel.max_depth >= 1)  # `&=` would change the sample's too
    walk = _camera_walk(kernel, start, active)

    def add_hit(z, total, lost):
        c = contribution.finite(techniques.hit_emitter(kernel, z))
        return sink.add(kernel, c, total, start, shared), lost + c.counted.non_finite

    def visit(z, state, _):
        total, counters = state
        if plan.hit:
            # A branch of its own: few lanes hit an emitter.
            total, lost = dr.if_stmt(
                (z, total, counters.non_finite),
                techniques.sees_emitter(kernel, z),
                add_hit,
                lambda z, total, lost: (total, lost),
                label="s = 0",
            )
            counters = replace(counters, non_finite=lost)
        if plan.direct:
            c = contribution.finite(techniques.next_event(kernel, z))
            total, counters = sink.add(kernel, c, total, start, shared), counters + c.counted
        if plan.connections != "none":
            total, counted = sink.connect(kernel, z, lane, stream, total, start)
            counters += counted
        return total, counters

    side = Side(
        "camera",
        shared,
        bsdf.brightest(walk.throughput),
        False,
        kernel.max_depth,
        kernel.kappa.splat,
        alpha=sink.alpha,
        parallel=kernel.camera.parallel,
        join=(lambda z: techniques.choose_emitter(kernel, z, stream)) if plan.direct else None,
    )
    state = sink.begin(), counted_by_camera(plan)
    (total, counters), walk = random_walk(kernel, side, walk, stream, visit, state)
    counters += Counters(camera=dr.select(active, walk.traced(), 0), non_finite=one(walk.broken))
    return counters + sink.end(kernel, lane, sample, total, walk.seen)


def _camera_walk(kernel, start, active) -> Walk:
    """A camera subpath on its first edge."""
    ray = start.ray
    if kernel.plan.hide_emitters:
        pi, ray = rays.intersect_past_emitters(kernel.scene, kernel.shape_errors, ray, active, coherent=True)
    else:
        pi = kernel.scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    partial = _first_partial(kernel, start)
    return Walk.begin(kernel, pi, ray, start.p, mi.Spectrum(start.weight), partial, active)


def _first_partial(kernel, start):
    """Partial sums of a camera subpath's first edge: t = 1 is its newest alternative, t = 0 an older one."""
    h = kernel.heuristic
    arrival = h.scale(h.start(start.arrival), kernel.kappa.arrival)
    if not (mis.is_absent(kernel.kappa.splat) and mis.is_absent(kernel.kappa.inner)):
        arrival = h.present(arrival)
    return mis.Partial(h.start(dr.rcp(start.pdf_w)), arrival)


def _coefficients(plan, by_class: bool) -> Coefficients:
    """Run-time values, or ``by_class`` those of a pilot: 1 in the place of the class, see `mis.ByClass`."""

    def entry(kind, value, used):
        if not used:
            return 0
        if by_class:
            return mi.Vector4f(*(1.0 if name == kind else 0.0 for name in mis.CLASSES))
        return dr.opaque(mi.Float, value)

    count = 1 / plan.camera_paths_per_light_path if plan.light else 0.0  # nominal, see `Kernel.bound`
    light = count * plan.kappa_light
    return Coefficients(
        hit=entry("hit", 1, plan.hit),
        direct=entry("direct", plan.kappa_direct, plan.direct),
        splat=entry("light", light, plan.splat),
        endpoints=entry("light", light, plan.endpoints),
        arrival=entry("light", light, plan.arrival),
        inner=entry("inner", 1, plan.connections != "none"),
    )


def _opaque(kind):
    return lambda value: dr.opaque(kind, value)
