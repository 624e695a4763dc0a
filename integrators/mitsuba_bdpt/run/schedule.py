"""Splits a render into passes and kernel launches, and seeds their random numbers."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..sampling.points import Points, sequential
from ..sampling.sequences import GUIDE, PHOTONS, WAVELENGTHS, sequence_seed
from ..sensors.records import Sensor
from ..settings import Settings
from ..transport.batch import STRIP, Batch

# Samples per kernel launch (four times as many in a launch of one row, see `batches`). Bounds the duration of
# a launch (seconds on a few cores), and thus the delay of Ctrl-C, timeout and progress; it needs no memory.
LAUNCH_SAMPLES = 1 << 21

# The same on a GPU: smaller launches take less time than recording a pass (see experiments, section CUDA).
LAUNCH_SAMPLES_CUDA = 1 << 24

# Independent images for the variance. Few, since each has its own, shorter sequence of points.
REPLICATES = 8

FIRST_REPLICATE = 4  # samples per pixel of each of the first `REPLICATES` images under ``target_error``


def _most_samples() -> int:
    """Return the maximum number of samples per launch."""
    return LAUNCH_SAMPLES_CUDA if dr.backend_v(mi.Float) == dr.JitBackend.CUDA else LAUNCH_SAMPLES


def longest_pass(camera: Sensor, settings: Settings, best: int = 0) -> int:
    """Samples per pixel of a whole pass, in renders of any length; ``best``: if the user says none."""
    limit = _most_samples()
    width, height = (int(x) for x in camera.region.size)
    # One row of pixels has to fit into four launches, see `batches`.
    whole = max(limit // (width * height), 1)
    most = min(max(4 * limit // width, 1), max(STRIP, whole))
    if settings.merging is True:  # photons, radius and wavelengths are those of a pass
        most = min(most, STRIP)
    return min(settings.spp_per_pass or min(whole, best or whole), most)


def pass_sizes(spp: int, longest: int, small_first: bool) -> list[int]:
    """Return the samples per pixel of each pass, ``longest`` at most; the first has 1 if ``small_first``."""
    sizes = []
    if small_first and spp > 1:
        sizes, spp = [1], spp - 1
    return sizes + [longest] * (spp // longest) + ([spp % longest] if spp % longest else [])


@dataclass(frozen=True)
class Step:
    """A pass: ``size`` samples per pixel after ``done`` of ``of`` of its ``replicate`` (0 without one)."""

    replicate: int
    done: int
    size: int
    of: int

    @property
    def last(self) -> bool:
        """Whether it ends the replicate."""
        return self.done + self.size == self.of


def schedule(spp: int, longest: int, settings: Settings, small_first: bool) -> list[Step]:
    """Return all passes of a render; ``longest``, ``small_first``: see `pass_sizes`."""
    parts = _replicates(spp, bool(settings.target_error)) if settings.variance else [spp]
    steps = []
    for replicate, part in enumerate(parts):
        done = 0
        for size in pass_sizes(part, longest, small_first and replicate == 0):
            steps.append(Step(replicate, done, size, part))
            done += size
    return steps


def _replicates(spp: int, growing: bool) -> list[int]:
    """Return the samples per pixel of the replicates: `REPLICATES` of them.

    If ``growing``, groups of `REPLICATES`, each with as many samples as all groups before it, so that half of
    the samples have long sequences.
    """
    sizes = []
    while (left := spp - sum(sizes)) > 0:
        group = min(left, max(sum(sizes), REPLICATES * FIRST_REPLICATE)) if growing else left
        sizes += [group // REPLICATES + (i < group % REPLICATES) for i in range(min(group, REPLICATES))]
    return sizes


def passes_since(passes: tuple[int, ...], done: int) -> int:
    """Return how many of the last ``passes`` add up to ``done`` samples per pixel."""
    count = 0
    while done > 0:
        count += 1
        done -= passes[-count]
    return count


def batches(camera: Sensor, first_sample: int, samples: int, settings: Settings):
    """Split a pass into bands of rows, one kernel launch each."""
    limit = _most_samples()
    width, height = (int(x) for x in camera.region.size)
    rows = height
    if settings.spp_per_pass or width * height * samples > limit:
        rows = max(1, min(height, 4 * limit // max(width * samples, 1)))
    bands = ((y, min(rows, height - y)) for y in range(0, height, rows))
    return [Batch(y * width, count * width, first_sample, samples) for y, count in bands]


class PassPoints:
    """Random numbers of each pass of a render, from its ``seed`` (``UInt32``)."""

    def __init__(self, settings: Settings, seed):
        self._kind, self.seed = settings.points, seed

    def of(self, step: Step) -> Points:
        """Return the points of the pass ``step``."""
        return Points(self._kind, self._seed_of(step, self.seed))

    def wavelengths(self, step: Step) -> mi.Float:
        """Return the number in [0, 1) from which the wavelengths of an image's merging passes follow."""
        return sequential(self._seed_of(step, sequence_seed(self.seed, WAVELENGTHS)))[0]

    def _seed_of(self, step: Step, seed: mi.UInt32) -> mi.UInt32:
        """Return a seed from ``seed`` that is distinct by replicate."""
        return sequence_seed(seed, step.replicate) if step.replicate else seed

    def of_photons(self, step: Step, done: int) -> Points:
        """Return the points of the photons of a pass, after ``done`` passes of its image."""
        seed = sequence_seed(self.seed, PHOTONS + done)
        return Points(self._kind, self._seed_of(step, seed))

    def of_guide(self) -> Points:
        """Return the points of the photons that guide BSDF sampling."""
        return Points(self._kind, sequence_seed(self.seed, GUIDE))
