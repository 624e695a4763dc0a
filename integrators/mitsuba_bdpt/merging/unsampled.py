"""Estimate of the light that no strategy in use samples: SDS paths from emitters that no ray can hit.

Camera subpaths merge with photons at a path's only non-delta vertex: one strategy, whose weight is 1. Not
included: paths with several non-delta vertices, on surfaces or in media, of which no two are neighbours; with
light_paths=0 also those with neighbours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..sampling.points import Points
from ..transport import spectra, subpaths
from ..transport.alternatives import is_sds_vertex
from ..transport.batch import Batch, Places
from ..transport.inputs import TraceContext
from ..transport.photons import photon_pass
from ..transport.photons.aim import Aim
from ..transport.photons.photon_pass import PhotonPolicy
from ..transport.sds import PhotonStrategy
from ..transport.walk import Side, Vertex, Walk, random_walk
from .merging import Merging, Sample
from .merging import sample as draw
from .passes import sort
from .radius import BALLS, Footprints, film_pixels
from .wavelength_sets import SETS, WavelengthSets

RADIUS = 1.5  # merging radius in distances between camera samples (of a set of wavelengths) on the film


@dataclass
class Estimate:
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


@dataclass
class Unsampled(PhotonPolicy):
    """Photons and camera subpaths are merged at the only non-delta vertex of paths that are not sampled."""

    # Sums of sizes by kind of light, see `undersampled.KINDS`: none is sampled.
    sums = (1.0, 0.0, 0.0)

    def emission(self, e, aim):
        """Non-finite emissions are traced to see where their light arrives: their aim is NaN."""
        finite = spectra.is_finite(e.weight)
        return replace(e, weight=dr.select(finite, e.weight, 1)), dr.select(finite, aim, dr.nan)

    def begin(self, kernel, e, walk):
        # s = 0 samples the others, guided if need be.
        return replace(walk, active=walk.active & e.delta)

    def stored(self, kernel, y, stream):
        return is_sds_vertex(kernel, y, adjoint=True), 1.0

    def begin_camera(self, kernel: TraceContext, walk: Walk, side: Side) -> tuple[Walk, Side]:
        """The camera subpath ``walk`` on its first edge."""
        return walk, replace(side, connect=None, only_specular=self.only_specular)

    def is_merged(self, kernel: TraceContext, z: Vertex) -> mi.Bool:
        """Mask: a camera subpath may merge at ``z``."""
        return is_sds_vertex(kernel, z, adjoint=False)

    def missing(self, kernel: TraceContext, merging: Merging, z: Vertex, found: Sample, position) -> mi.Bool:
        """Mask: the merge ``found`` at ``z`` counts; ``position`` of the camera sample on the film."""
        return found.active


def estimate(
    kernel: TraceContext,
    batch: Batch,
    count: int,
    photon_points: Points,
    points: Points,
    aim: Aim,
    policy: Unsampled,
) -> Estimate:
    """Merge the camera subpaths of ``batch`` with ``count`` photon subpaths."""
    sets, wavelengths = 1, None
    if mi.is_spectral:
        sets, wavelengths = SETS, WavelengthSets.of(mi.Float(0.5), 0)
    footprints = Footprints.of(kernel.scene, kernel.camera.sensor)
    of_samples = RADIUS * math.sqrt(film_pixels(kernel.camera.sensor) * sets / count)
    of_samples = of_samples if footprints.measured else 1.0
    discs = footprints.radius(of_samples)
    balls = footprints.balls(of_samples * BALLS, kernel.space)
    met = dr.opaque(mi.Float, count / sets)
    merging = Merging(discs, met, mi.Float(1), wavelengths=wavelengths, balls=balls)
    unmerged = PhotonStrategy()  # no merges in the weights
    unmerged.wavelengths = wavelengths
    kernel = kernel.replaced(sds=unmerged, last_light=kernel.max_depth)
    traced = photon_pass.trace(kernel, policy, aim, photon_points, count)
    merging.photons = sort(merging, traced.photons, traced.count)
    found = _merged(kernel.bound(points), merging, batch, policy)
    return Estimate(*found, traced.broken)


def _merged(kernel: TraceContext, merging: Merging, batch: Batch, policy: Unsampled) -> tuple:
    """`Estimate` up to ``through``."""
    lane = dr.arange(mi.UInt32, batch.size)
    place = Places(kernel, batch, batch.samples)
    # By lane: photons have the same sets of wavelengths in turn.
    _, shared = subpaths.begin_lane(kernel, mi.UInt64(lane))
    sample, walk, side = subpaths.camera_subpath(kernel, place, shared, lane, mi.Bool(True))
    walk, side = policy.begin_camera(kernel, walk, side)
    channels = len(mi.UnpolarizedSpectrum())
    sums = dr.zeros(mi.Float64, kernel.emitters.count * channels)

    def merge(z, size):
        found = draw(kernel, merging, z, sample.stream, shared.wavelength_set)
        active = policy.missing(kernel, merging, z, found, sample.start.position)
        flaw = dr.select(dr.isfinite(found.photon.d_vc + found.photon.aim), mi.Float(0), dr.nan)
        value = dr.select(active, mi.unpolarized_spectrum(found.value) + flaw, 0)
        for i in range(channels):
            index = found.photon.emitter * channels + i
            # Other modes drop NaN.
            mode = dr.ReduceMode.Direct
            dr.scatter_reduce(dr.ReduceOp.Add, sums, mi.Float64(value[i]), index, active, mode)
        return size + dr.sum(value)

    def visit(z, state, walk):
        seen, size, through = state
        there = policy.is_merged(kernel, z)
        size = dr.if_stmt((z, size), there, merge, lambda z, size: size, label="unsampled light")
        first = z.hit & (z.edges == 1)
        through = dr.select(first, dr.reinterpret_array(mi.UInt32, z.si.shape), through)
        return seen | there, size, through

    state = mi.Bool(False), mi.Float(0), mi.UInt32(0)
    state, _ = random_walk(kernel, side, walk, visit, state)
    dr.eval(sums, state, policy)
    return sums, *state
