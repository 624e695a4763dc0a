"""Distances in grids by delta tracking, their transmittance by ratio tracking.

E. R. Woodcock et al. 1965; J. Novák, A. Selle, W. Jarosz 2014, "Residual Ratio Tracking for Estimating
Attenuation in Participating Media". Both sample tentative collisions in a homogeneous medium of the grid's
majorant. T~ of a grid is that of its mean extinction within its box.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..geometry import polarization
from ..sampling.points import sequential
from .media import Media, coefficients, interaction


@dataclass
class Tracked:
    """Result of delta tracking: distance ``t`` of a real collision (infinite if none).

    ``depth``: optical depth of T~ up to it; ``rest``: optical depth until the next tentative collision;
    ``throughput`` times the ratios of null collisions; next random ``word``; number of tentative
    ``collisions``.
    """

    t: mi.Float
    depth: mi.Float
    rest: mi.Float
    throughput: mi.Spectrum
    word: mi.UInt32
    collisions: mi.UInt32


def exponential(u: mi.Float) -> mi.Float:
    """Optical depth with density exp(-depth); never 0, where vertices would coincide."""
    return dr.select(u > 0, -dr.log(1 - u), 2.0**-25)


def _tracks(majorant, throughput, inside):
    """Mask of finite majorants above 0; ``throughput``, NaN at non-finite ones."""
    finite = dr.isfinite(majorant)
    return inside & finite & (majorant > 0), dr.select(inside & ~finite, dr.nan, throughput)


def _within(media: Media, number, ray, end, active):
    """Interval of ``ray`` in the grid's box, up to ``end``; mask: it is not empty."""

    def box(medium: mi.Medium, ray, active):
        return medium.intersect_aabb(ray)

    meets, low, high = media.query(number, box, ray, active)
    low, high = dr.maximum(low, 0), dr.minimum(high, end)
    return low, high, active & meets & (low < high)


@dr.syntax
def delta(media: Media, number, ray, end, rest, throughput, word, active) -> Tracked:
    """Delta tracking along ``ray`` up to ``end``; ``rest``: first tentative collision."""
    low, high, inside = _within(media, number, ray, end, active)
    majorant = media.majorant(number, ray, active)
    t, met = mi.Float(low), mi.Float(dr.inf)
    rest, throughput, word = mi.Float(rest), type(throughput)(throughput), mi.UInt32(word)
    collisions = mi.UInt32(0)
    going, throughput = _tracks(majorant, throughput, inside)
    while dr.hint(
        going, label="delta tracking", exclude=[media, number, ray, low, high, majorant, inside, end, active]
    ):
        left = (high - t) * majorant
        tentative = going & (rest <= left)
        rest = dr.select(going & ~tentative, rest - left, rest)
        t = dr.select(tentative, t + rest / majorant, t)
        mei = interaction(ray(t), ray.d, ray)
        _, sigma_t = media.query(number, coefficients, mei, tentative)
        null = dr.mean(majorant - sigma_t)
        u, word = sequential(word)
        # The probability of a real collision is the mean over channels; the channels' ratios remain.
        passed = tentative & (u * majorant < null)
        left_over = polarization.scaled(throughput, (majorant - sigma_t) / null)
        throughput = dr.select(passed, left_over, throughput)
        met = dr.select(tentative & ~passed, t, met)
        u, word = sequential(word)
        rest = dr.select(passed, exponential(u), rest)
        collisions += dr.select(tentative, mi.UInt32(1), 0)
        going = mi.Bool(passed)
    travelled = dr.maximum(dr.minimum(met, high) - low, 0)
    depth = dr.select(inside, media.mean(number) * travelled, 0)
    return Tracked(met, depth, rest, throughput, word, collisions)


@dr.syntax
def ratio(media: Media, number, ray, end, word, active):
    """Ratio tracking along ``ray`` up to ``end``.

    Returns transmittance (``Spectrum``), depth of T~, the next random word and the number of collisions.
    """
    low, high, inside = _within(media, number, ray, end, active)
    majorant = media.majorant(number, ray, active)
    t, transmittance, word = mi.Float(low), mi.UnpolarizedSpectrum(1), mi.UInt32(word)
    collisions = mi.UInt32(0)
    going, transmittance = _tracks(majorant, transmittance, inside)
    while dr.hint(
        going, label="ratio tracking", exclude=[media, number, ray, low, high, majorant, inside, end, active]
    ):
        u, word = sequential(word)
        t += exponential(u) / majorant
        going &= t < high
        collisions += dr.select(going, mi.UInt32(1), 0)
        mei = interaction(ray(dr.select(going, t, 0)), ray.d, ray)
        _, sigma_t = media.query(number, coefficients, mei, going)
        transmittance = dr.select(going, transmittance * (1 - sigma_t / majorant), transmittance)
        going &= ~dr.all(transmittance == 0)
    depth = dr.select(inside, media.mean(number) * (high - low), 0)
    return transmittance, depth, word, collisions
