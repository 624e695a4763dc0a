"""Weighted reservoir sampling of one candidate from a stream.

Source: M. T. Chao, "A general purpose unequal probability sampling plan", Biometrika 69 (1982).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

# Sum of sizes below which its products with random numbers, of 24 bits, may underflow; a power of two.
FAINT = 2.0**-96


def offer(total: mi.Float, size: mi.Float, u: mi.Float) -> tuple[mi.Float, mi.Bool, mi.Float]:
    """Offer a candidate of this ``size`` after others that sum to ``total``.

    ``u`` is uniform in [0, 1). Returns the new total, whether the candidate replaces the kept one, and ``u``
    rescaled by that decision to be uniform again: u / share or (u - share) / (1 - share).
    """
    before, total = total, total + size
    # Products with u are exact to the last bit in every unit of the sizes.
    scale = dr.select(total < FAINT, 1 / FAINT, 1)
    u_total, scaled = u * (total * scale), size * scale
    take = u_total < scaled
    rest = dr.select(take, u_total, u_total - scaled) / dr.select(take, scaled, before * scale)
    return total, take, dr.select(total > 0, rest, u)
