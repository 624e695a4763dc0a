"""Light that no strategy in use samples, found by subpaths that follow delta events only.

An SDS path (no edge is connectible, see `sds`) from an emitter that no ray can hit is not sampled. Here
camera subpaths merge with photons at a path's only non-delta vertex, which samples it in one way: the weight
is 1. In scenes with near-specular lobes they follow these too, see `undersampled`. Not included: paths with
several non-delta vertices, on surfaces or in media, of which no two are neighbours; with light_paths=0 also
those with neighbours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..sampling.points import Points
from ..transport import subpaths
from ..transport.alternatives import has_lobe, is_sds_vertex
from ..transport.batch import Batch, Places
from ..transport.inputs import Kernel, Observer
from ..transport.near_specular import NARROW
from ..transport.photons import photon_pass
from ..transport.photons.aim import Aim
from ..transport.photons.guided_hits import Unguided
from ..transport.photons.photon_pass import PhotonPolicy
from ..transport.walk import random_walk
from .merging import Merging
from .merging import sample as draw
from .passes import sort
from .radius import Footprints
from .undersampled import Undersampled
from .wavelength_sets import SETS, WavelengthSets

# Merging radius in distances between camera samples (of a set of wavelengths) on the film: discs overlap, and
# remain small relative to the image.
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


@dataclass
class _Discs(Merging):
    """Photons in discs, of which weights do not know."""

    merges = False

    def begin_light(self, kernel, walk):
        return walk

    begin_camera = begin_light


def estimate(
    kernel: Kernel,
    batch: Batch,
    count: int,
    photon_points: Points,
    points: Points,
    aim: Aim,
    undersampled: Undersampled | None = None,
) -> Unsampled:
    """Merge the camera subpaths of a pilot's ``batch`` with ``count`` photon subpaths, which ``aim`` begins.

    ``kernel``: samples delta lobes only. With ``undersampled`` it samples all lobes, and such
    light is included.
    """
    sets, wavelengths = 1, None
    if mi.is_spectral:
        sets, wavelengths = SETS, WavelengthSets.of(mi.Float(0.5), 0)
    footprints = Footprints.of(kernel.scene, kernel.camera.sensor)
    of_samples = RADIUS * math.sqrt(kernel.camera.region.size.prod() * sets / count)
    discs = footprints.radius(of_samples if footprints.measured else UNMEASURED)
    met = dr.opaque(mi.Float, count / sets)
    merging = _Discs(discs, met, mi.Float(1), aim, wavelengths=wavelengths)
    kept = PhotonPolicy.UNSAMPLED if undersampled is None else PhotonPolicy.UNDERSAMPLED
    traced = photon_pass.trace(kernel, merging, aim, photon_points, count, kept)
    merging.photons = sort(merging, traced.photons, traced.count)
    found = _merged(kernel, merging, batch, points, undersampled)
    return Unsampled(*found, traced.broken)


def _merged(
    kernel: Kernel, merging: Merging, batch: Batch, points: Points, undersampled: Undersampled | None
) -> tuple:
    """`Unsampled` up to ``through``."""
    kernel = kernel.bound(points, 1.0, Observer())
    kernel.sds = merging
    lane = dr.arange(mi.UInt32, batch.size)
    place = Places(kernel, batch, batch.samples)
    # By lane: photons have the same sets of wavelengths in turn.
    shared = subpaths.shared_by_lane(kernel, points.stream("light", mi.UInt64(lane)), mi.UInt64(lane))
    sample = subpaths.camera_sample(kernel, place, shared, lane, mi.Bool(True))
    walk = subpaths.camera_walk(kernel, sample, mi.Bool(True) & (kernel.max_depth >= 1))
    side = subpaths.camera_side(kernel, sample, shared, walk)
    delta = undersampled is None
    side = replace(side, connect=None, only_delta=delta, only_specular=0 if delta else NARROW, sds=None)
    isolated = undersampled and undersampled.isolated
    if isolated:
        walk = Unguided(kernel.near_specular).begin_camera(kernel, walk)
        side = replace(side, only_specular=0, isolated=True)
    channels = len(mi.UnpolarizedSpectrum())
    sums = dr.zeros(mi.Float64, kernel.emitters.count * channels)

    def merge(z, size):
        found = draw(kernel, merging, z, sample.stream, shared.wavelength_set)
        if undersampled is None:
            active, flaw = found.active, found.photon.older  # 0, or NaN
        else:
            active = undersampled.missing(kernel, merging, z, found, sample.start.position)
            flaw = 0 * found.photon.older
        value = dr.select(active, mi.unpolarized_spectrum(found.value) + flaw, 0)
        for i in range(channels):
            index = found.photon.emitter * channels + i
            # Other modes leave out NaN.
            mode = dr.ReduceMode.Direct
            dr.scatter_reduce(dr.ReduceOp.Add, sums, mi.Float64(value[i]), index, active, mode)
        return size + dr.sum(value)

    def visit(z, state, walk):
        seen, size, through = state
        if delta or isolated:
            there = is_sds_vertex(kernel, kernel.kappa.splat, walk, z)
        else:
            there = has_lobe(kernel, z)
        size = dr.if_stmt((z, size), there, merge, lambda z, size: size, label="unsampled light")
        first = z.hit & (z.edges == 1)
        through = dr.select(first, dr.reinterpret_array(mi.UInt32, z.si.shape), through)
        return seen | there, size, through

    state = mi.Bool(False), mi.Float(0), mi.UInt32(0)
    state, _ = random_walk(kernel, side, walk, visit, state)
    dr.eval(sums, state, undersampled or ())
    return sums, *state
