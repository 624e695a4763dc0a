"""Light that no strategy in use samples, found by subpaths that follow delta events only.

An SDS path from an emitter that no ray can hit is not sampled if no edge of it is connected (see `merging`).
`trace` merges camera subpaths with photons at a path's only non-delta vertex, which samples it in one way:
the weight is 1. Not included: paths with several non-delta vertices, on surfaces or in media, of which no two
are neighbours; with light_paths=0 also those with neighbours. `arriving` finds emitters whose light reaches
the sensor without a non-delta vertex.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ...sampling.points import Points
from .. import subpaths, techniques
from ..batch import Batch, Places
from ..inputs import Kernel, Observer
from ..walk import is_sds_vertex, random_walk
from . import merging


@dataclass
class Unsampled:
    """Sums over camera samples.

    ``by_emitter``: a spectrum for each emitter. Of each sample ``seen``: mask, it has a vertex for merging;
    ``size``: the sum of its spectrum; ``through``: index of its first shape.
    """

    by_emitter: mi.Float64
    seen: mi.Bool
    size: mi.Float
    through: mi.UInt32


def trace(kernel: Kernel, batch: Batch, points: Points) -> Unsampled:
    """Merge the camera subpaths of a pilot's ``batch`` with the photons of ``kernel.merging``."""
    kernel = kernel.bound(points, 1.0, Observer())
    lane = dr.arange(mi.UInt32, batch.size)
    place = Places(kernel, batch, batch.samples)
    # By lane: photons have the same sets of wavelengths in turn.
    shared = subpaths.shared_by_lane(kernel, points.stream("light", mi.UInt64(lane)), mi.UInt64(lane))
    sample = subpaths.camera_sample(kernel, place, shared, lane, mi.Bool(True))
    walk = subpaths.camera_walk(kernel, sample, mi.Bool(True) & (kernel.max_depth >= 1))
    walk = replace(walk, isolated=None, partial=replace(walk.partial, d_vm=0))
    side = replace(subpaths.camera_side(kernel, sample, shared, walk), join=None, only_delta=True)
    channels = len(mi.UnpolarizedSpectrum())
    sums = dr.zeros(mi.Float64, len(kernel.scene.emitters()) * channels)

    def merge(z, size):
        found = merging.sample(kernel, z, sample.stream, shared.wavelength_set)
        value = mi.unpolarized_spectrum(found.value) + found.photon.older  # 0, or NaN
        value = dr.select(found.active, value, 0)
        for i in range(channels):
            index = found.photon.emitter * channels + i
            # Other modes leave out NaN.
            mode = dr.ReduceMode.Direct
            dr.scatter_reduce(dr.ReduceOp.Add, sums, mi.Float64(value[i]), index, found.active, mode)
        return size + dr.sum(value)

    def visit(z, state, walk):
        seen, size, through = state
        there = is_sds_vertex(kernel, kernel.kappa.splat, walk, z)
        size = dr.if_stmt((z, size), there, merge, lambda z, size: size, label="unsampled light")
        first = z.hit & (z.edges == 1)
        through = dr.select(first, dr.reinterpret_array(mi.UInt32, z.si.shape), through)
        return seen | there, size, through

    state = mi.Bool(False), mi.Float(0), mi.UInt32(0)
    state, _ = random_walk(kernel, side, walk, sample.stream, visit, state)
    dr.eval(sums, state)
    return Unsampled(sums, *state)


def arriving(kernel: Kernel, points: Points, count: int) -> mi.Bool:
    """Mask of the delta emitters whose light reaches the sensor by delta events only.

    Tests ``count`` light subpaths. Direct light counts only if no connection can sample it (of beams).
    """
    kernel = kernel.bound(points, 1.0, Observer())
    index = mi.UInt64(dr.arange(mi.UInt32, count))
    stream = points.stream("light", index)
    shared = subpaths.shared_by_lane(kernel, stream, index)
    e = subpaths.emission(kernel, stream, shared)
    walk = subpaths.light_walk(kernel, e, stream, shared, False)
    walk = replace(walk, active=walk.active & e.delta)
    side = replace(subpaths.light_side(kernel, e, stream, shared, walk), join=None, only_delta=True)

    def visit(y, arrived, walk):
        hit = techniques.hit_sensor(kernel, e, y, walk).active
        return arrived | (hit & ((walk.edges > 1) | e.beam))

    arrived, _ = random_walk(kernel, side, walk, stream, visit, mi.Bool(False))
    found = dr.zeros(mi.Bool, len(kernel.scene.emitters()))
    dr.scatter(found, mi.Bool(True), e.index, arrived)
    dr.eval(found)
    return found
