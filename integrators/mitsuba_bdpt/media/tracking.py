"""Distances in grids by delta tracking, their transmittance by ratio tracking.

E. R. Woodcock et al. 1965; J. Novák, A. Selle, W. Jarosz 2014, "Residual Ratio Tracking for Estimating
Attenuation in Participating Media". Both sample tentative collisions in a homogeneous medium of the grid's
majorant. T~ of a grid is that of its mean extinction within its box.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..geometry import polarization
from ..sampling.points import sequential
from .media import Media, coefficients, interaction


def exponential(u: mi.Float) -> mi.Float:
    """Optical depth with density exp(-depth); never 0, where vertices would coincide."""
    return dr.select(u > 0, -dr.log(1 - u), 2.0**-25)


def _begin(media: Media, number, ray, end, throughput, active):
    """Begin to track along ``ray`` in the grid's box, up to ``end``.

    Returns the interval, the mask of nonempty ones, the majorant, one number for all channels (1 / scene
    unit), the mask of lanes with tentative collisions, and ``throughput``, NaN where the majorant is
    non-finite.
    """

    def box(medium: mi.Medium, ray, active):
        return medium.intersect_aabb(ray)

    meets, low, high = media.query(number, box, ray, active)
    low, high = dr.maximum(low, 0), dr.minimum(high, end)
    inside = active & meets & (low < high)
    majorant = media.extinction(number, ray, active)
    majorant = majorant if media.gray else majorant[0]
    finite = dr.isfinite(majorant)
    throughput = dr.select(inside & ~finite, dr.nan, throughput)
    return low, high, inside, majorant, inside & finite & (majorant > 0), throughput


@dr.syntax
def delta(media: Media, number, ray, end, rest, throughput, word, active):
    """Delta tracking along ``ray`` up to ``end``; ``rest``: optical depth until the next tentative collision.

    Returns the distance of the real collision (infinite if there is none), depth of T~ up to it, ``rest``,
    ``throughput`` times the ratios of null collisions, the next random word, the number of tentative
    collisions.
    """
    low, high, inside, majorant, going, throughput = _begin(media, number, ray, end, throughput, active)
    t, met = mi.Float(low), mi.Float(dr.inf)
    rest, word, collisions = mi.Float(rest), mi.UInt32(word), mi.UInt32(0)
    while dr.hint(
        going, label="delta tracking", exclude=[media, number, ray, low, high, majorant, inside, end, active]
    ):
        left = (high - t) * majorant
        tentative = going & (rest <= left)
        rest = dr.select(going & ~tentative, rest - left, rest)
        t = dr.select(tentative, t + rest / majorant, t)
        mei = interaction(ray(t), ray.d, ray)
        _, sigma_t = media.query(number, coefficients, mei, tentative)
        left_out = dr.maximum(majorant - sigma_t, 0)  # interpolation exceeds a majorant by rounding
        null = dr.mean(left_out)
        u, word = sequential(word)
        # The probability of a real collision is the mean over channels; the channels' ratios remain.
        passed = tentative & (u * majorant < null)
        left_over = polarization.scaled(throughput, left_out / null)
        throughput = dr.select(passed, left_over, throughput)
        met = dr.select(tentative & ~passed, t, met)
        u, word = sequential(word)
        rest = dr.select(passed, exponential(u), rest)
        collisions += dr.select(tentative, mi.UInt32(1), 0)
        going = mi.Bool(passed)
    travelled = dr.maximum(dr.minimum(met, high) - low, 0)
    depth = dr.select(inside, media.mean(number) * travelled, 0)
    return met, depth, rest, throughput, word, collisions


@dr.syntax
def ratio(media: Media, number, ray, end, word, active):
    """Ratio tracking along ``ray`` up to ``end``.

    Returns transmittance (``Spectrum``), depth of T~, the next random word and the number of collisions.
    """
    one = mi.UnpolarizedSpectrum(1)
    low, high, inside, majorant, going, transmittance = _begin(media, number, ray, end, one, active)
    t, word, collisions = mi.Float(low), mi.UInt32(word), mi.UInt32(0)
    while dr.hint(
        going, label="ratio tracking", exclude=[media, number, ray, low, high, majorant, inside, end, active]
    ):
        u, word = sequential(word)
        t += exponential(u) / majorant
        going &= t < high
        collisions += dr.select(going, mi.UInt32(1), 0)
        mei = interaction(ray(dr.select(going, t, 0)), ray.d, ray)
        _, sigma_t = media.query(number, coefficients, mei, going)
        transmittance = dr.select(going, transmittance * dr.maximum(1 - sigma_t / majorant, 0), transmittance)
        going &= ~dr.all(transmittance == 0)
    depth = dr.select(inside, media.mean(number) * (high - low), 0)
    return transmittance, depth, word, collisions
