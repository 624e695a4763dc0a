"""Wavelengths of passes in which vertices are merged: few sets of them, which photons and camera share.

A photon's flux is known at its own wavelengths, so it can be merged with a camera vertex of the same ones
only. A pass has `SETS` sets of wavelengths; photons' subpaths and lanes take them in turn, and the grid of
the photons has cells of each set. The sets of a pass lie evenly, turned by another number in each pass.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

# Bits of a set's number.
SET_BITS = 3

# Sets of a pass. Few of them would tint the image, with many there are few photons of each.
SETS = 1 << SET_BITS

# Numbers in [0, 1) that differ by this choose wavelengths of the same set, in another order.
_TURN = 0.25

# Fractional part of the golden ratio: its multiples lie evenly, however many there are.
_GOLDEN = 0.6180339887498949


@dataclass
class WavelengthSets:
    """The sets of a pass: ``offset`` (opaque ``Float``) turns all of them."""

    offset: mi.Float

    @staticmethod
    def of(start: mi.Float, done: int) -> WavelengthSets:
        """Those of the pass after ``done`` others; ``start`` in [0, 1) is the same for all of an image."""
        offset = start + (done * _GOLDEN) % 1 * _TURN / SETS
        dr.make_opaque(offset)
        return WavelengthSets(offset)

    def number(self, index: mi.UInt32 | mi.UInt64) -> mi.UInt32:
        """The set of the subpath of this ``index``."""
        return mi.UInt32(index) & (SETS - 1)

    def u(self, number: mi.UInt32) -> mi.Float:
        """The number in [0, 1) that chooses the wavelengths of a set."""
        # Each first wavelength, which may decide directions, is in another quarter than that of the next set.
        u = self.offset + mi.Float(number) * (_TURN / SETS) + mi.Float(number & 3) * _TURN
        return dr.minimum(u - dr.floor(u), 1 - 2**-24)
