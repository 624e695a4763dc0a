"""What a strategy returns: its estimate and its weight."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from . import bsdf

# Least probability of surviving roulette: random numbers are multiples of 2^-24.
LEAST_SURVIVAL = 2.0**-20


@dataclass
class Contribution:
    """``value`` unweighted estimate (a spectrum), ``weight`` in [0, 1], numbers of light vertices
    ``s`` and camera vertices ``t``, ``active``; ``shares`` see `mis.ByClass`,
    ``kind`` the class among `mis.CLASSES`."""

    value: object
    weight: object
    s: object
    t: object
    active: object
    shares: object = None
    kind: str = ""

    def weighted(self):
        """What the strategy adds to the image."""
        return dr.select(self.active, self.value * self.weight, 0)


def finite(c: Contribution, counters) -> Contribution:
    """``c``, inactive where it adds no finite value, which is counted: such a contribution counts as zero."""
    lost = c.active & ~bsdf.is_finite(c.value * c.weight)
    count(counters, "non_finite", lost)
    return replace(c, active=c.active & ~lost)


def count(counters, name: str, mask):
    """Add 1 to a counter of `kernel.COUNTERS` in lanes where ``mask`` holds."""
    counters[name] += _one(mask)


def _roulette(kernel, value, u, active, counters):
    """Unbiased roulette on a weighted contribution before its visibility is tested."""
    if not kernel.plan.roulette:
        return active, mi.Float(1)
    size = _size(value)
    # Not below the spacing of the random numbers, which are 0 more often than that; NaN goes on.
    survival = dr.clip(size * kernel.inverse_threshold, LEAST_SURVIVAL, 1)
    survival = dr.select(dr.isfinite(size), survival, 1)
    survived = u < survival
    count(counters, "rouletted", active & ~survived)
    return active & survived, survival


def _counts(kernel, value, weight):
    """Mask: a strategy of this ``value`` and weight is worth a ray, or has to be counted by `finite` (of what
    is not finite the weight may be 0). Technique images show unweighted ones too."""
    return mi.Bool(True) if kernel.strategy_images else ~(weight == 0) | ~bsdf.is_finite(value)


def _size(value):
    """A measure of a contribution's size; any will do as long as it is positive where f is."""
    return bsdf.brightest(value)


def _one(mask):
    return dr.select(mask, mi.UInt32(1), mi.UInt32(0))
