"""Seeds of point sequences besides the image's own."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

# Numbers from 1 are the replicates of `variance`. Pilots have the sequences that follow the first of these,
# images, after changes of the decision, those that follow the other one.
PILOT, CHANGED = 1 << 16, 1 << 17

# Photons have the sequence that follows this by the number of passes done, or one that follows from it; the
# wavelengths of passes with merging begin with a number of the other one.
PHOTONS, WAVELENGTHS = 1 << 18, 1 << 30

# Those of the guide of s = 0.
GUIDE = 1 << 19


def sequence_seed(seed, number: int):
    """Seed of the sequence ``number`` of a render of ``seed`` (``UInt32`` both)."""
    other = mi.sample_tea_32(seed, mi.UInt32(number))[1]
    dr.make_opaque(other)
    return other
