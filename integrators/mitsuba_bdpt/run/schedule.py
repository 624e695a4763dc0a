"""Schedules a render as passes and kernel launches, and gives passes their random numbers."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..sampling.points import Points, sequential
from ..sampling.sequences import CHANGED, GUIDE, PHOTONS, WAVELENGTHS, sequence_seed
from ..sensors.records import Sensor
from ..settings import Settings
from ..transport.batch import Batch
from ..transport.photons.wavelength_sets import WavelengthSets

# Samples in one kernel launch, but for launches of one row, which may have four times as many (see
# `batches`). Nothing per sample is kept in memory, so this only bounds how long a launch runs (seconds on a
# few cores) and with it the delay of Ctrl-C, timeout and progress.
LAUNCH_SAMPLES = 1 << 21

# The same on a GPU, which traces 2^21 camera subpaths in less time than Python needs to record the pass
# (docs/development/experiments.md, "CUDA").
LAUNCH_SAMPLES_CUDA = 1 << 24

# Samples that one pixel's sum takes in single precision: the rounding grows with them, is the same in
# every pass and does not average out (constant radiance, 2^12: 4e-6; 2^16: 5e-5; 2^20: 1e-3).
MOST_SPP = 1 << 12

# Independent images whose spread gives the variance: as few as the contract allows, since each has a
# point sequence of its own and short sequences are worse.
REPLICATES = 8

# Samples per pixel of each of the first `REPLICATES` under ``target_error``.
FIRST_REPLICATE = 4


def _most_samples() -> int:
    """Samples in one launch."""
    return LAUNCH_SAMPLES_CUDA if dr.backend_v(mi.Float) == dr.JitBackend.CUDA else LAUNCH_SAMPLES


def pass_sizes(camera: Sensor, spp: int, settings: Settings, small_first: bool) -> list[int]:
    """Samples per pixel of each pass, in order, ``spp`` in all; the first is 1 if ``small_first``."""
    limit = _most_samples()
    width, height = (int(x) for x in camera.region.size)
    # One row of pixels fits into four launches' worth, see `batches`.
    most = min(MOST_SPP, max(4 * limit // width, 1))
    size = min(settings.spp_per_pass or max(limit // (width * height), 1), most)
    sizes = []
    if small_first and spp > 1:
        sizes, spp = [1], spp - 1
    return sizes + [size] * (spp // size) + ([spp % size] if spp % size else [])


@dataclass(frozen=True)
class Step:
    """A pass: ``size`` samples per pixel after ``done`` of the ``of`` of its replicate.

    ``last``: whether it ends the replicate; ``replicate`` counts the independent images that `variance`
    needs, else 0.
    """

    replicate: int
    done: int
    size: int
    of: int
    last: bool


def schedule(camera: Sensor, spp: int, settings: Settings, small_first: bool) -> list[Step]:
    """All passes of a render of ``spp`` samples per pixel; ``small_first`` see `pass_sizes`."""
    parts = [spp]
    if settings.variance:
        parts = _replicates(spp, bool(settings.target_error))
    steps = []
    for replicate, part in enumerate(parts):
        done = 0
        for size in pass_sizes(camera, part, settings, small_first and replicate == 0):
            steps.append(Step(replicate, done, size, part, done + size == part))
            done += size
    return steps


def _replicates(spp: int, growing: bool) -> list[int]:
    """Samples per pixel of the replicates: `REPLICATES` of them.

    Or, if ``growing``, groups of so many, each group as large as all before it, so that half of the samples
    lie in few long sequences.
    """
    sizes = []
    while (left := spp - sum(sizes)) > 0:
        group = min(left, max(sum(sizes), REPLICATES * FIRST_REPLICATE)) if growing else left
        sizes += [group // REPLICATES + (i < group % REPLICATES) for i in range(min(group, REPLICATES))]
    return sizes


def passes_since(passes: tuple[int, ...], done: int) -> int:
    """How many of the ``passes`` done, the last ones, make up ``done`` samples per pixel."""
    count = 0
    while done > 0:
        count += 1
        done -= passes[-count]
    return count


def batches(camera: Sensor, first_sample: int, samples: int, settings: Settings):
    """Cut a pass into bands of rows that one kernel launch can take."""
    limit = _most_samples()
    width, height = (int(x) for x in camera.region.size)
    rows = (
        height
        if settings.spp_per_pass == 0 and width * height * samples <= limit
        else max(1, min(height, 4 * limit // max(width * samples, 1)))
    )
    return [
        Batch(y * width, min(rows, height - y) * width, first_sample, samples) for y in range(0, height, rows)
    ]


class PassPoints:
    """Gives each pass of one render its random numbers.

    They are sequences of the render's ``seed`` (``UInt32``).
    """

    def __init__(self, settings: Settings, seed):
        self._kind, self.seed = settings.points, seed

    def of(self, step: Step, changes: int) -> Points:
        """The points of the pass ``step``.

        ``changes``: how often the plan changed before, see `Planner.adopt`.
        """
        seed = self.seed
        number = step.replicate + (CHANGED + changes if changes else 0)
        if number:
            seed = sequence_seed(self.seed, number)
        return Points(self._kind, seed)

    def wavelengths(self, step: Step, done: int, changes: int) -> WavelengthSets:
        """The wavelengths of a pass after ``done`` others of the same image, or replicate, with merging."""
        start, _ = sequential(self._seed_beside(WAVELENGTHS, step, changes))
        return WavelengthSets.of(start, done)

    def _seed_beside(self, sequence: int, step: Step, changes: int) -> mi.UInt32:
        """The seed of a ``sequence`` of ours: others for each replicate and after changes of the plan."""
        seed = sequence_seed(self.seed, sequence)
        if number := step.replicate + (CHANGED + changes if changes else 0):
            seed = sequence_seed(seed, number)
        return seed

    def of_photons(self, step: Step, done: int, changes: int) -> Points:
        """The points of the photons of a pass after ``done`` others of the same image, or replicate."""
        seed = self._seed_beside(PHOTONS + done, step, changes)
        return Points(self._kind, seed)

    def of_guide(self) -> Points:
        """The points of the photons that guide s = 0."""
        seed = sequence_seed(self.seed, GUIDE)
        return Points(self._kind, seed)
