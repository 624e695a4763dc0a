"""Light that no strategy in use samples, found by subpaths that follow delta events only.

An SDS path (no edge is connectible, see `sds`) from an emitter that no ray can hit is not sampled. Here
camera subpaths merge with photons at a path's only non-delta vertex, which samples it in one way: the weight
is 1. Not included: paths with several non-delta vertices, on surfaces or in media, of which no two are
neighbours; with light_paths=0 also those with neighbours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..sampling.points import Points
from ..transport import subpaths
from ..transport.batch import Batch, Places
from ..transport.inputs import Kernel, Observer
from ..transport.photons import photon_pass
from ..transport.photons.aim import Aim
from ..transport.photons.photon_pass import Kept
from ..transport.walk import is_sds_vertex, random_walk
from .merging import Merging
from .merging import sample as draw
from .passes import sort
from .radius import Footprints
from .wavelength_sets import SETS, WavelengthSets

# Merging radius in distances between camera samples on the film: discs overlap, and remain small relative to
# the image.
RADIUS = 1.5

# Merging radius in pixels of `Footprints` where these cannot be measured: 1/64 of the scene's diagonal.
UNMEASURED = 8.0


@dataclass
class Unsampled:
    """Sums over camera samples.

    ``by_emitter``: a spectrum for each emitter. Of each sample ``seen``: mask, it has a vertex for merging;
    ``size``: the sum of its spectrum; ``through``: index of its first shape. ``broken``: mask by emitter,
    a photon subpath ended by a non-finite value.
    """

    by_emitter: mi.Float64
    seen: mi.Bool
    size: mi.Float
    through: mi.UInt32
    broken: mi.Bool


def estimate(kernel: Kernel, batch: Batch, count: int, photon_points: Points, points: Points) -> Unsampled:
    """Merge the camera subpaths of a pilot's ``batch`` with ``count`` photon subpaths.

    ``kernel``: follows delta lobes only.
    """
    footprints = Footprints.of(kernel.scene, kernel.camera.sensor)
    of_samples = RADIUS * math.sqrt(kernel.camera.region.size.prod() / count)
    discs = footprints.radius(of_samples if footprints.measured else UNMEASURED)
    sets, wavelengths = 1, None
    if mi.is_spectral:
        sets, wavelengths = SETS, WavelengthSets.of(mi.Float(0.5), 0)
    aim, met = Aim.of(kernel.scene, kernel.emitters), dr.opaque(mi.Float, count / sets)
    merging = Merging(discs, met, mi.Float(1), aim, wavelengths=wavelengths)
    traced = photon_pass.trace(kernel, merging, aim, photon_points, count, Kept.UNSAMPLED)
    merging.photons = sort(merging, traced.photons, traced.count)
    return _merged(kernel, merging, batch, points, traced.broken)


def _merged(kernel: Kernel, merging: Merging, batch: Batch, points: Points, broken: mi.Bool) -> Unsampled:
    kernel = kernel.bound(points, 1.0, Observer())
    kernel.sds = merging
    lane = dr.arange(mi.UInt32, batch.size)
    place = Places(kernel, batch, batch.samples)
    # By lane: photons have the same sets of wavelengths in turn.
    shared = subpaths.shared_by_lane(kernel, points.stream("light", mi.UInt64(lane)), mi.UInt64(lane))
    sample = subpaths.camera_sample(kernel, place, shared, lane, mi.Bool(True))
    walk = subpaths.camera_walk(kernel, sample, mi.Bool(True) & (kernel.max_depth >= 1))
    walk = replace(walk, sds=None, partial=replace(walk.partial, d_vm=0))
    side = subpaths.camera_side(kernel, sample, shared, walk)
    side = replace(side, connect=None, only_delta=True, sds=None)
    channels = len(mi.UnpolarizedSpectrum())
    sums = dr.zeros(mi.Float64, len(kernel.scene.emitters()) * channels)

    def merge(z, size):
        found = draw(kernel, merging, z, sample.stream, shared.wavelength_set)
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
    return Unsampled(sums, *state, broken)
