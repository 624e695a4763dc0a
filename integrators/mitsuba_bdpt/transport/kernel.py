"""One batch (a pass, a band of its rows, or a pilot) as one kernel.

A lane traces one light subpath into its local memory, then its S camera subpaths one after the other, in S
different pixels (see `batch`), and evaluates all strategies of each pair. No vertex lies in global memory:
except in pilots, only the film grows with the image size, and nothing with the number of samples.

Work of a lane. Vertices: y_0 on the emitter, z_0 on the sensor; a path of s light and t camera vertices has
k = s + t - 1 edges. Equations of Georgiev 2012, see `mis`; kappa as below::

    time, wavelengths <- drawn for all subpaths of the lane                 subpaths.begin_lane

    # The light subpath, or M of them one after the other                   _light_subpath, _light_subpaths
    y_0, direction, throughput <- an emitter, with pdf_first * pdf_second   subpaths.emission
    (1,1): splat y_0 seen by the sensor                                     techniques.connect_endpoints
    the first edge <- a ray; it ends here if the throughput is 0 or not     subpaths.light_subpath
        finite
    d_vcm <- 1 / densities of y_0 and direction (eq. 31)
    d_vc <- kappa of s = 0 * cos / the same; 0 if y_0 cannot be hit (eq. 32)
    for y in y_1, y_2, ... up to where the subpath misses or ends:          walk.random_walk
        if y is a hit: d_vcm, d_vc <- in the area measure (eqs. 31, 32,     walk._vertex
            34, 35); at y_1 with next-event estimation's density of y_0
            in d_vcm
        a point of the sensor; direction of the next edge and BSDF towards  walk._interact
            that point <- one virtual call
        t = 0: splat the edge to y if it crosses the sensor                 techniques.hit_sensor
        t = 1: splat y seen by the sensor (eqs. 46, 47)                     techniques.splat
        store y, if on a surface whose BSDF is not delta, for inner         light_path
            connections, unless no camera subpath could reach it in time
        d_vcm, d_vc (eqs. 34, 35, 53, 54), throughput <- the event at y     walk._scatter
        roulette of the subpath; the next edge <- a ray

    # Its camera subpaths
    for M S pixels (fewer in the last lanes; one without light subpaths):   _camera_paths, _camera_subpath
        z_0, direction, throughput <- the sensor, at a point of the pixel   subpaths._camera_sample
        the first edge <- a ray                                             subpaths._camera_walk
        d_vcm <- 1 / density of the direction (of z_0, if all are parallel) subpaths._first_partial
        d_vc <- kappa of t = 0 * cos / densities of z_0 and direction;
            0 without area
        total <- 0
        for z in z_1, z_2, ... up to where the subpath misses or ends:      walk.random_walk
            if z is a hit: d_vcm, d_vc <- in the area measure               walk._vertex
            a point of an emitter; direction of the next edge and BSDF      walk._interact
                towards that point <- one virtual call
            where vertices are merged: total += z merged with a photon      merging.merging
            s = 0:  total += emission of z towards the vertex before        techniques.hit_emitter
                        (eqs. 42, 43)
            s = 1:  total += z lit by the point (eqs. 44, 45)               techniques.next_event
            s >= 2: total += z connected with stored y (eqs. 40, 41):
                        each of them,                                       connections.connect_all
                        or one, drawn by what it would add unshadowed       connections.connect_one
                (of several light subpaths by an approximation of that)
            d_vcm, d_vc, throughput <- the event at z                       walk._scatter
            roulette of the subpath; the next edge <- a ray
        add the total to the film                                           sink.end

In scenes with media y and z may lie in one as well; null surfaces are passed and are no edges::

    the medium of the first edge <- boundaries around the emitter; the      media.light_media
        one that the sensor declares
    an edge ends where a flight collides, or at a surface that is not       media.flight
        null; throughput <- times the albedo
    d_vcm <- over T~ of the edge, on arrival                                walk._vertex, mis.to_area
    BSDF -> phase function, cosine -> 1, in a volume                        scattering, media.phase
    a shadow ray -> transmittance T of the value and T~ of the weight       media.space, media.transmittance
    store y -> of a long subpath 64 reweighted vertices                     light_path.Thinning

Each strategy i of a path adds w_i f / (n_i p_i), with n_i its number of samples per camera sample: the light
subpaths per camera subpath for t <= 1, else 1. Weights: `mis`, docs/method/method.md. kappa_i contains n_i as
1 / S for t <= 1, and the plan's coefficient of the class (`inputs._coefficients`). Where S does not divide
the batch's pixels, only the estimate's n_i is exact: weights need only sum to 1. Classes that the plan leaves
out have kappa = 0 and are not recorded. docs/development/architecture.md says where roulette is played and
non-finite values are dropped.

A pilot has several light subpaths per camera sample, most without one; its estimates are those of one each.
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
from .inputs import Kernel, Observer, Shared
from .sds import PhotonStrategy
from .subpaths import CameraSample
from .walk import random_walk


@dataclass
class Lane:
    """What a lane's camera subpaths share.

    ``emission``, in a pilot: see `Contribution.emission`.
    """

    place: Places
    shared: Shared
    path: light_path.LightPath
    emission: Cell | None = None


def trace(kernel: Kernel, sink, batch: Batch, points: Points, spp: int) -> mi.UInt64:
    """Trace one batch and accumulate its contributions in ``sink`` (see `image.sink`).

    ``spp``: samples per pixel of the render, which place the batch in the image's sequence. Returns
    `Counters.summed`; evaluates nothing.
    """
    sharing = shared_by(kernel, batch, points)
    kernel = kernel.bound(points, _count_light(kernel, batch, sharing), Observer())
    index = dr.arange(mi.UInt32, sharing.lanes)
    lane, of_light = _begin(kernel, sink, Places(kernel, batch, spp), index)

    def trace_sample(slot) -> Counters:
        active = slot < dr.opaque(mi.UInt32, batch.size)
        return _camera_subpath(kernel, sink, lane, slot, active)

    if kernel.plan.light:
        of_camera = _camera_paths(kernel, sharing.slots(index), trace_sample)
    else:
        of_camera = trace_sample(index)
    return (of_light + of_camera).summed()


def retrace(
    kernel: Kernel, sink, batch: Batch, points: Points, spp: int, slot: mi.UInt32, observer: Observer
) -> mi.UInt64:
    """Trace the camera samples ``slot`` again, like `trace`, with an ``observer``.

    ``slot``: ``UInt32``; each with the light subpath of its lane. For tools that inspect single samples.
    """
    sharing = shared_by(kernel, batch, points)
    kernel = kernel.bound(points, _count_light(kernel, batch, sharing), observer)
    lane, of_light = _begin(kernel, sink, Places(kernel, batch, spp), sharing.lane(slot))
    return (of_light + _camera_subpath(kernel, sink, lane, slot, mi.Bool(True))).summed()


def shared_by(kernel: Kernel, batch: Batch, points: Points) -> Sharing:
    """Which camera samples of a batch share a light subpath; none in a pilot.

    Some light subpaths of a pilot have no camera sample.
    """
    if batch.spread:
        return Sharing(batch.lanes, 1, 1, points.seed)
    return Sharing(batch.pixels, batch.samples, kernel.plan.camera_paths, points.seed)


def _count_light(kernel: Kernel, batch: Batch, sharing: Sharing) -> float:
    """Light subpaths per camera subpath, exact also if S does not divide the pixels.

    1 for a pilot, which divides by their number itself.
    """
    return 1.0 if batch.spread else kernel.plan.joined * sharing.lanes / batch.size


def _begin(kernel: Kernel, sink, place: Places, index) -> tuple[Lane, Counters]:
    """Trace the light subpaths of these lanes; returns the lanes."""
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
def _light_subpaths(kernel: Kernel, sink, place: mi.UInt64, index, shared, path):
    """Trace the light subpaths of a lane one after the other, see `_light_subpath`."""
    counters = Counters.zeros("light", "non_finite") + counted_by_light(kernel)
    number, count = mi.UInt32(0), kernel.plan.joined
    while dr.hint(
        number < count,
        label=f"{count} light subpaths",
        exclude=[kernel, sink, place, index, shared, count],
    ):
        stream = kernel.points.stream("light", place * count + mi.UInt64(number))
        path, counted, _ = _light_subpath(kernel, sink, stream, shared, path)
        counters = counters + counted
        number += 1
    return path, counters


# -- the light subpath ------------------------------------------------------------------------


def _light_subpath(kernel: Kernel, sink, stream, shared, path):
    """Trace a light subpath: its splats, (1,1) included, and its stored vertices.

    Returns the stored vertices, the counters, and in a pilot the emission.
    """
    plan = kernel.plan
    e = subpaths.emission(kernel, stream, shared)
    emitted = None
    if kernel.cells is not None:
        emitted = kernel.cells.at(e.index, e.si.p, e.d, e.cos, mi.Bool(True))
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
    # t = 0 samples SDS paths; other strategies do so with near-specular events.
    near_specular = kernel.sds.merges or kernel.sds.near_specular
    sds = kernel.sds if plan.arrival or near_specular else PhotonStrategy()
    begun, side = subpaths.light_subpath(kernel, e, stream, shared, sds)
    state = path, counted_by_light(kernel)
    (path, counted), walk = random_walk(kernel, side, begun, visit, state)
    counters += counted + walk.counted("light", begun.active)
    return path, counters, emitted


# -- its camera subpaths ----------------------------------------------------------------------


@dr.syntax
def _camera_paths(kernel: Kernel, slot_of, trace_sample) -> Counters:
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


def _camera_subpath(kernel: Kernel, sink, lane: Lane, slot, active) -> Counters:
    """Trace a camera subpath and connect it with the lane's light subpath."""
    sample, begun, side = subpaths.camera_subpath(kernel, lane.place, lane.shared, slot, active, sink.alpha)
    visit = _camera_visit(kernel, sink, lane, sample)
    state = sink.begin(), counted_by_camera(kernel)
    (total, counters), walk = random_walk(kernel, side, begun, visit, state)
    counters += walk.counted("camera", begun.active)
    return counters + sink.end(kernel, lane, sample, total, walk.seen)


def _camera_visit(kernel: Kernel, sink, lane: Lane, sample: CameraSample):
    """The strategies with t >= 2 at each vertex of a camera subpath."""
    plan, start, shared = kernel.plan, sample.start, lane.shared

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

    return visit
