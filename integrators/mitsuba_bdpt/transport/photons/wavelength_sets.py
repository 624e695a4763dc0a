"""Sets of wavelengths that photons and camera subpaths share in a pass with vertex merging.

A photon's flux is given at its own wavelengths, so it merges only with camera vertices of the same ones. A
pass has `SETS` sets of wavelengths; photon subpaths and lanes take them in turn, and the photons' grid has
cells of each set. The sets of a pass are stratified, and rotated from pass to pass.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

# Bits of a set's index.
SET_BITS = 3

# Sets of a pass. Fewer tint the image; more leave fewer photons in each.
SETS = 1 << SET_BITS

# Sample values in [0, 1) that differ by this give the same set of wavelengths, in another order.
_TURN = 0.25

# Fractional part of the golden ratio: any number of its multiples modulo 1 is stratified.
_GOLDEN = 0.6180339887498949


@dataclass
class WavelengthSets:
    """The sets of a pass, rotated by ``offset`` (opaque ``Float``)."""

    offset: mi.Float

    @staticmethod
    def of(start: mi.Float, done: int) -> WavelengthSets:
        """The sets of pass ``done`` (from 0); ``start`` in [0, 1) is the same for all passes of an image."""
        offset = start + (done * _GOLDEN) % 1 * _TURN / SETS
        dr.make_opaque(offset)
        return WavelengthSets(offset)

    def number(self, index: mi.UInt32 | mi.UInt64) -> mi.UInt32:
        """The set of the subpath with this ``index``."""
        return mi.UInt32(index) & (SETS - 1)

    def u(self, number: mi.UInt32) -> mi.Float:
        """The sample value in [0, 1) from which the wavelengths of set ``number`` are drawn."""
        # First wavelengths, which may determine directions, of consecutive sets lie in different quarters.
        u = self.offset + mi.Float(number) * (_TURN / SETS) + mi.Float(number & 3) * _TURN
        return dr.minimum(u - dr.floor(u), 1 - 2**-24)
