"""The random numbers of a render's passes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..sampling.points import Points, sequential
from ..sampling.sequences import CHANGED, GUIDE, PHOTONS, WAVELENGTHS, sequence_seed
from ..settings import Settings
from ..transport.batch import Batch
from ..transport.photons.wavelength_sets import WavelengthSets
from .schedule import Step


class PassPoints:
    """Gives each pass of one render its random numbers.

    They are sequences of the render's ``seed`` (``UInt32``), or the numbers of the scene's sampler.
    """

    def __init__(self, settings: Settings, sensor, seed):
        self._kind, self._sensor, self.seed = settings.points, sensor, seed
        self._samplers = {}

    def of(self, step: Step, batch: Batch, changes: int) -> Points:
        """The points of a batch of the pass ``step``.

        ``changes``: how often the plan changed before, see `Planner.adopt`.
        """
        seed = self.seed
        number = step.replicate + (CHANGED + changes if changes else 0)
        if number:
            seed = sequence_seed(self.seed, number)
        return self._of_sampler(step, batch, seed) if self._kind == "sampler" else Points(self._kind, seed)

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
        return Points("independent" if self._kind == "independent" else "sobol", seed)

    def of_guide(self) -> Points:
        """The points of the photons that guide s = 0."""
        seed = sequence_seed(self.seed, GUIDE)
        return Points("independent" if self._kind == "independent" else "sobol", seed)

    def _of_sampler(self, step: Step, batch: Batch, seed) -> Points:
        """One sampler per band of rows goes on from pass to pass, as Mitsuba's own passes do."""
        sampler = self._samplers.get(batch.first_pixel)
        if sampler is None or step.done == 0:
            sampler = self._sensor.sampler().clone()
            sampler.set_sample_count(step.of)
            sampler.set_samples_per_wavefront(batch.samples)
            band = mi.sample_tea_32(seed, mi.UInt32(batch.first_pixel))[0]
            sampler.seed(band, Points.sequences(batch.pixels) * batch.samples)
            self._samplers[batch.first_pixel] = sampler
        else:
            sampler.advance()
        points = Points("sampler", seed, sampler, batch.samples)
        sampler.schedule_state()
        dr.eval()
        return points
