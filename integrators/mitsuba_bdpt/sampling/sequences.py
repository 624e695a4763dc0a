"""Seeds of the point sequences other than the image's own."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

PILOT = 1 << 16  # numbers from 1 are the replicates of `variance`; a pilot uses `PILOT`

# Photons use `PHOTONS` plus the number of finished passes, or a sequence derived from it; wavelengths of
# passes with merging use numbers from `WAVELENGTHS`.
PHOTONS, WAVELENGTHS = 1 << 18, 1 << 30

GUIDE = 1 << 19  # the guide of photon-guided BSDF sampling


def sequence_seed(seed, number: int):
    """Seed of the sequence ``number`` of a render with ``seed`` (``UInt32``)."""
    other = mi.sample_tea_32(seed, mi.UInt32(number))[1]
    dr.make_opaque(other)
    return other
