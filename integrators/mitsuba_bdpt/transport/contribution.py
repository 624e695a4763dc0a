"""What a strategy returns: its estimate and its weight."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..emitters.emission_tables import Cell
from . import spectra
from .counters import Counters, one
from .inputs import Kernel

# Least probability of surviving roulette: random numbers are multiples of 2^-24.
LEAST_SURVIVAL = 2.0**-20


@dataclass
class Contribution:
    """An estimate of one strategy.

    ``value`` unweighted (a spectrum), ``weight`` in [0, 1], numbers of light vertices ``s`` and camera
    vertices ``t``, ``active``; ``shares`` see `mis.ByClass`, ``kind`` the class among `mis.CLASSES`;
    ``position`` on the film in pixels, None where it adds to the lane's own pixel (t >= 2); ``counted`` what
    was done for it. In scenes with media ``value`` and ``weight`` are those of an edge without any until
    `visibility.seen` has looked; it needs the ``sides``: what `mis.Heuristic.weigh` takes. ``emission``: what
    `Emitters.cell` says of the path, where a pilot asks for it. ``towards``: the direction in which the light
    reaches the sensor, None for t >= 2, which know it by their `CameraStart`.
    """

    value: mi.Spectrum
    weight: mi.Float
    s: mi.UInt32
    t: mi.UInt32
    active: mi.Bool
    shares: mi.Vector4f | None = None
    kind: str = ""
    position: mi.Point2f | None = None
    counted: Counters = field(default_factory=Counters)
    sides: Any = None
    emission: Cell | None = None
    towards: mi.Vector3f | None = None

    def weighted(self) -> mi.Spectrum:
        """What the strategy adds to the image."""
        return dr.select(self.active, self.value * self.weight, 0)


def drop_non_finite(c: Contribution) -> Contribution:
    """``c``, inactive where it adds no finite value, which is counted: such a contribution counts as zero.

    All contributions pass here on their way to the sink; whatever finds a density from which no weight
    follows makes the value NaN.
    """
    lost = c.active & ~spectra.is_finite(c.value * c.weight)
    return replace(c, active=c.active & ~lost, counted=c.counted + Counters(non_finite=one(lost)))


def roulette(
    kernel: Kernel, value: mi.Spectrum, u: mi.Float, active: mi.Bool
) -> tuple[mi.Bool, mi.Float, Counters]:
    """Unbiased roulette on a weighted contribution before its visibility is tested.

    Returns where it survived, the probability of that, and `Counters`."""
    if not kernel.plan.roulette:
        return active, mi.Float(1), Counters()
    size = size_of(value)
    # Not below the spacing of the random numbers, which are 0 more often than that; NaN goes on.
    survival = dr.clip(size * kernel.inverse_threshold, LEAST_SURVIVAL, 1)
    survival = dr.select(dr.isfinite(size), survival, 1)
    survived = u < survival
    return active & survived, survival, Counters(rouletted=one(active & ~survived))


def size_of(value: mi.Spectrum):
    """A measure of a contribution's size; any will do as long as it is positive where f is."""
    return spectra.brightest(value)
