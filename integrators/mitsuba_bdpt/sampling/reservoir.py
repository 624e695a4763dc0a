"""Weighted reservoir sampling of one candidate from a stream.

Source: M. T. Chao, "A general purpose unequal probability sampling plan", Biometrika 69 (1982).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def offer(total: mi.Float, size: mi.Float, u: mi.Float) -> tuple[mi.Float, mi.Bool, mi.Float]:
    """Offer a candidate of this ``size`` after others that sum to ``total``.

    ``u`` is uniform in [0, 1). Returns the new total, whether the candidate replaces the kept one, and ``u``
    rescaled by that decision to be uniform again: u / share or (u - share) / (1 - share).
    """
    before, total = total, total + size
    u_total = u * total
    take = u_total < size
    rest = dr.select(take, u_total, u_total - size) / dr.select(take, size, before)
    return total, take, dr.select(total > 0, rest, u)
