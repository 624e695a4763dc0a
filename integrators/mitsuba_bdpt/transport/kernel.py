"""One batch (a pass, a band of its rows, or a pilot) as one kernel.

A lane traces one light subpath into its local memory, then its S camera subpaths one after the other, in S
different pixels (see `batch`), and evaluates all strategies of each pair. No vertex lies in global memory:
except in pilots, only the film grows with the image size, and nothing with the number of samples.

A lane, with y_0 on the emitter and z_0 on the sensor::

    time, wavelengths                                                      subpaths.begin_lane
    # the light subpath, or M of them                                      _light_subpath, _light_subpaths
    y_0 and the first edge                                                 subpaths.emission, light_subpath
    (1,1)                                                                  techniques.connect_endpoints
    for y in y_1, y_2, ...                                                 walk.random_walk
        partial sums in the area measure                                   walk._vertex
        BSDF: the next direction, and towards a point of the sensor        walk._interact
        t = 0, t = 1                                                       techniques.hit_sensor, splat
        store y for inner connections                                      light_path
        partial sums and throughput after the event, roulette, next edge   walk._scatter
    # its camera subpaths, M S of them                                     _camera_paths, _camera_subpath
    z_0 and the first edge                                                 subpaths.camera_subpath
    for z in z_1, z_2, ...                                                 walk.random_walk, as above
        photons: merges, or guided subpaths                                PhotonStrategy.visit
        s = 0, s = 1                                                       techniques.hit_emitter, next_event
        s >= 2: all stored y, or one drawn by its unshadowed contribution  connections
    add the sum to the film                                                sink.end

Each strategy i of a path adds w_i f / (n_i p_i), with n_i its number of samples per camera sample: the light
subpaths per camera subpath for t <= 1, else 1. Weights: `mis`, docs/method/method.md. Where S does not divide
the batch's pixels, only the estimate's n_i is exact: weights need only sum to 1. Classes that the plan leaves
out have kappa = 0 and are not recorded. A pilot traces several light subpaths per camera sample, all but one
without camera subpath; its estimates are those of one each.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..emitters.records import Cell
from ..sampling.points import Points, Purpose
from . import contribution, light_path, subpaths, techniques
from .batch import Batch, Places, Sharing
from .contribution import Counters, counted_by_camera, counted_by_light
from .inputs import Observer, Shared, TraceContext
from .sds import PhotonStrategy
from .walk import random_walk


@dataclass
class Lane:
    """What a lane's camera subpaths share; ``emission``, in a pilot: see `Contribution.emission`."""

    place: Places
    shared: Shared
    path: light_path.LightPath
    emission: Cell | None = None


def trace(
    kernel: TraceContext, sink, batch: Batch, points: Points, spp: int, observer: Observer | None = None
) -> mi.UInt64:
    """Trace one batch and accumulate its contributions in ``sink`` (see `image.sink`).

    ``spp``: samples per pixel of the render, which place the batch in the image's sequence; ``observer``, of
    tools, may trace some lanes only. Returns `Counters.summed`; evaluates nothing.
    """
    sharing = shared_by(kernel, batch, points)
    # Exact also if S does not divide the pixels; a pilot divides by the number of light subpaths itself.
    count_light = 1.0 if batch.spread else kernel.plan.joined * sharing.lanes / batch.size
    kernel = kernel.bound(points, count_light, observer)
    only = kernel.observer.lanes
    index = dr.arange(mi.UInt32, only or sharing.lanes)
    lane, of_light = _begin(kernel, sink, Places(kernel, batch, spp), index)

    def trace_sample(slot) -> Counters:
        active = slot < dr.opaque(mi.UInt32, batch.size)
        return _camera_subpath(kernel, sink, lane, slot, active)

    if kernel.plan.light and not only:
        of_camera = _camera_paths(kernel, sharing.slots(index), trace_sample)
    else:
        of_camera = trace_sample(index)
    return (of_light + of_camera).summed()


def shared_by(kernel: TraceContext, batch: Batch, points: Points) -> Sharing:
    """Which camera samples of a batch share a light subpath; none in a pilot."""
    if batch.spread:
        return Sharing(batch.lanes, 1, 1, points.seed)
    return Sharing(batch.pixels, batch.samples, kernel.plan.camera_paths, points.seed)


def _begin(kernel: TraceContext, sink, place: Places, index) -> tuple[Lane, Counters]:
    """Trace the light subpaths of these lanes; returns the lanes, and counters."""
    place_in_sequence = place.index(index)
    stream, shared = subpaths.begin_lane(kernel, place_in_sequence)
    path = light_path.allocate_light_path(kernel, dr.width(index))
    counters, emitted = Counters(), None
    if kernel.plan.joined > 1:
        path, counters = _light_subpaths(kernel, sink, place_in_sequence, index, shared, path)
    elif kernel.plan.light:
        path, counters, emitted = _light_subpath(kernel, sink, stream, shared, path)
    return Lane(place, shared, path, emitted), counters


@dr.syntax
def _light_subpaths(kernel: TraceContext, sink, place: mi.UInt64, index, shared, path):
    """Trace the light subpaths of a lane one after the other, see `_light_subpath`."""
    counters = Counters.zeros("light", "non_finite") + counted_by_light(kernel)
    number, count = mi.UInt32(0), kernel.plan.joined
    while dr.hint(
        number < count, label=f"{count} light subpaths", exclude=[kernel, sink, place, index, shared, count]
    ):
        stream = kernel.points.stream("light", place * count + mi.UInt64(number))
        path, counted, _ = _light_subpath(kernel, sink, stream, shared, path)
        counters = counters + counted
        number += 1
    return path, counters


# -- the light subpath ------------------------------------------------------------------------


def _light_subpath(kernel: TraceContext, sink, stream, shared, path):
    """Trace a light subpath; returns the stored vertices, the counters, and in a pilot the emission."""
    plan = kernel.plan
    e = subpaths.emission(kernel, stream, shared)
    emitted = kernel.cells and kernel.cells.at(e.index, e.si.p, e.d, e.cos, mi.Bool(True))
    counters, light_group = Counters(), kernel.light_group(e.index, mi.Bool(True))
    if light_group is not None:
        path = replace(path, light_group=light_group)

    def splat(c):
        """Pass a contribution with t <= 1 to the sink."""
        c = contribution.seen(kernel, replace(c, emission=emitted, light_group=light_group))
        return c.counted + sink.splat(kernel, c, shared, stream)

    if plan.endpoints:
        counters += splat(techniques.connect_endpoints(kernel, e, stream, mi.Bool(True)))

    def visit(vertex, state, walk):
        path, counters = state
        if plan.arrival:
            counters += splat(techniques.hit_sensor(kernel, e, vertex, walk))
        if plan.splat:
            counters += splat(techniques.splat(kernel, vertex, stream))
        if plan.connections != "none":
            light_path.store_light_vertex(kernel, vertex, path)
        return path, counters

    if kernel.has_media:
        # All purposes are in use (`points`); CHANNEL at vertex 0 chooses the channel.
        u = kernel.points.draw_1d("light", stream, Purpose.CHANNEL, 1)
        path = replace(path, thinning=light_path.Thinning.begin(u))
    # Of SDS paths of delta events t = 0 alone; merges and near-specular events concern all strategies.
    by_all = kernel.sds.merges or kernel.sds.near_specular
    sds = kernel.sds if plan.arrival or by_all else PhotonStrategy()
    begun, side = subpaths.light_subpath(kernel, e, stream, shared, sds)
    state = path, counted_by_light(kernel)
    (path, counted), walk = random_walk(kernel, side, begun, visit, state)
    counters += counted + walk.counted("light", begun.active)
    return path, counters, emitted


# -- its camera subpaths ----------------------------------------------------------------------


@dr.syntax
def _camera_paths(kernel: TraceContext, slot_of, trace_sample) -> Counters:
    """Call ``trace_sample`` for each camera sample of the lane (`Sharing.slots`); returns the counters."""
    counters = Counters.zeros("camera") + counted_by_camera(kernel)
    number = mi.UInt32(0)
    while dr.hint(
        number < kernel.camera_paths,
        label="camera subpaths of one light subpath",
        exclude=[kernel, slot_of, trace_sample],
    ):
        counters = counters + trace_sample(slot_of(number))
        number += 1
    return counters


def _camera_subpath(kernel: TraceContext, sink, lane: Lane, slot, active) -> Counters:
    """Trace a camera subpath and connect it with the lane's light subpath."""
    plan, shared = kernel.plan, lane.shared
    sample, begun, side = subpaths.camera_subpath(kernel, lane.place, shared, slot, active, sink.alpha)
    start = sample.start

    def add(c, total, lost):
        c = contribution.seen(kernel, c)
        return sink.add(kernel, c, total, start, shared), lost + c.counted.non_finite

    def visit(z, state, walk):
        total, counters = kernel.sds.visit(kernel, z, walk, sample.stream, shared, add, state)
        if plan.hit:
            # A separate branch: few lanes hit an emitter.
            total, lost = dr.if_stmt(
                (z, total, counters.non_finite),
                techniques.sees_emitter(kernel, z),
                lambda z, total, lost: add(techniques.hit_emitter(kernel, z, kernel.sds), total, lost),
                lambda z, total, lost: (total, lost),
                label="s = 0",
            )
            counters = replace(counters, non_finite=lost)
        if plan.direct:
            c = contribution.seen(kernel, techniques.next_event(kernel, z, sample.stream, kernel.sds))
            total, counters = sink.add(kernel, c, total, start, shared), counters + c.counted
        if plan.connections != "none":
            total, counted = sink.connect(kernel, z, lane, sample.stream, total, start)
            counters += counted
        return total, counters

    state = sink.begin(), counted_by_camera(kernel)
    (total, counters), walk = random_walk(kernel, side, begun, visit, state)
    counters += walk.counted("camera", begun.active)
    return counters + sink.end(kernel, lane, sample, total, walk.seen)
