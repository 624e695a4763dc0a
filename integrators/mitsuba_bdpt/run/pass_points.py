"""The random numbers of a render's passes."""

from __future__ import annotations

import mitsuba as mi

from ..sampling.points import Points, sequential
from ..sampling.sequences import CHANGED, GUIDE, PHOTONS, WAVELENGTHS, sequence_seed
from ..settings import Settings
from ..transport.photons.wavelength_sets import WavelengthSets
from .schedule import Step


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
