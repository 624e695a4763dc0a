"""Vertex merging in the passes of a render: photons, radius, coefficient."""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..host.introspection import named
from ..sampling.points import Points
from ..settings import Settings
from ..transport.inputs import TraceContext
from ..transport.photons import photon_pass
from ..transport.photons.aim import Aim
from ..transport.photons.photon import Photon
from .merging import (
    BUCKET_BITS,
    EDGES_BITS,
    Merging,
    Photons,
    bucket_of,
    coefficient,
    level_of,
    tag_of,
    width_of,
)
from .radius import BALLS, Footprints, after, film_pixels
from .wavelength_sets import SETS, WavelengthSets

# Camera samples of a pass per photon subpath; in media (experiments, "Vertex merging", "Merging in media").
SAMPLES_PER_PHOTON, IN_MEDIA = 4, 2

# Most photons of a cell that a search tests, more where there are fewer camera samples than photon subpaths.
PER_CELL = 4

# Samples per pixel of a pass; with near-specular lobes or without light subpaths, where many vertices merge;
# least samples of a pass. Merged photons grow with their square (experiments, "Which paths are merged").
_PASS, _SHORT_PASS, _LEAST_SAMPLES = 32, 16, 1 << 16

# Where pixels have no size (meters): least photon subpaths of a pass; samples that count as one per pixel.
_METER_PHOTONS, _METER_PIXELS = 1 << 16, 1 << 10

_LANE_BITS = 32  # bits of a subpath's index in the sort key of photons


def why_not(sensor: mi.Sensor) -> str:
    """Why vertex merging is not possible, or empty."""
    if sensor.shutter_open_time() > 0:
        return (
            f"merging while the shutter of {named(sensor)} is open is not supported: photons and camera "
            "subpaths have different times"
        )
    return ""


class Passes:
    """Vertex merging in one render of ``pixels`` pixels.

    ``near_specular``: the scene has near-specular lobes; ``best_pass``: samples per pixel of a pass.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        settings: Settings,
        aim: Aim,
        pixels: int,
        near_specular: bool,
    ):
        per_pixel = _SHORT_PASS if near_specular or settings.light_paths == 0 else _PASS
        self.best_pass = max(per_pixel, _LEAST_SAMPLES // pixels)
        self._footprints = Footprints.of(scene, sensor)
        # Photons of a uniform environment too: weights decide where its light is merged.
        self._aim = replace(aim, no_sky=False)
        self._radius, self._pixels = settings.internals.merging_radius, pixels
        self._uncropped = max(pixels, film_pixels(sensor))

    def trace(
        self, kernel: TraceContext, points: Points, samples: int, done: int, start: mi.Float | None
    ) -> tuple[Merging, mi.UInt64]:
        """Trace the photons of a pass; returns its strategy, and counters.

        ``samples`` per pixel of the pass, ``done`` before it in all parts of the image: their sum gives the
        radius. ``start``: see `WavelengthSets.of`, None but in spectral variants.
        """
        measured, of_window = self._footprints.measured, samples * self._pixels
        end = (done + samples) * (1 if measured else self._pixels / _METER_PIXELS)
        radius = after(self._radius, end)  # in pixels
        of_film = samples * self._uncropped if measured else of_window
        each = SAMPLES_PER_PHOTON if kernel.space.phase is None else IN_MEDIA
        count = photon_pass.photons_of(of_film, each, photon_pass.MOST_OF_PASS)
        if not measured:
            count = max(count, _METER_PHOTONS)
        sets, wavelengths = 1, None
        if start is not None:
            sets, wavelengths = SETS, WavelengthSets.of(start, done / samples)
            count = max(count // sets, 1) * sets
        kappa = coefficient(samples / sets, radius)
        # More photon subpaths than that would make ordinary paths merge-dominated.
        kappa *= min(1.0, of_window / (each * count))
        tested = PER_CELL * math.ceil(count / of_window)
        kappa, met, tested = (dr.opaque(mi.Float, x) for x in (kappa, count / sets, tested))
        balls = self._footprints.balls(after(BALLS * self._radius, end, 3), kernel.space)
        discs = self._footprints.radius(radius)
        merging = Merging(discs, met, kappa, tested, wavelengths=wavelengths, balls=balls)
        return trace(kernel, merging, self._aim, points, count)


def trace(
    kernel: TraceContext, merging: Merging, aim: Aim, points: Points, count: int
) -> tuple[Merging, mi.UInt64]:
    """Trace ``count`` photon subpaths; returns ``merging`` with photons, and counters."""
    kernel = kernel.replaced(sds=merging, last_light=kernel.last_merged)
    traced = photon_pass.trace(kernel, merging, aim, points, count)
    return replace(merging, photons=sort(merging, traced.photons, traced.count)), traced.counters


def sort(merging: Merging, photons: Photon, count: int) -> Photons:
    """Sort the first ``count`` photons by bucket, then subpath and edge: independent of threads."""
    index = dr.arange(mi.UInt32, max(count, 1))  # without photons one in no bucket
    found = photons.at(index)
    volume = mi.Bool(False) if found.medium is None else found.medium != 0
    r, radius = merging.around(found.p, volume, found.medium)
    sets = merging.wavelengths
    level = level_of(radius, r)
    tag = tag_of(found.edges, None if sets is None else sets.number(found.lane), found.medium)
    bucket = bucket_of(mi.Point3i(dr.floor(found.p / width_of(radius, level))), level, tag)
    key = (mi.UInt64(bucket) << (_LANE_BITS + EDGES_BITS)) | (mi.UInt64(found.lane) << EDGES_BITS)
    order = dr.argsort(key | mi.UInt64(tag & ((1 << EDGES_BITS) - 1)))
    counts = dr.zeros(mi.UInt32, (1 << BUCKET_BITS) + 1)
    dr.scatter_add(counts, mi.UInt32(1), bucket + 1, index < dr.opaque(mi.UInt32, count))
    result = Photons.of(found.at(order), dr.gather(mi.UInt32, tag, order), dr.cumsum(counts))
    dr.eval(result)
    return result
