"""Sets of wavelengths that photons and camera subpaths share in a merging pass.

A photon merges only with camera vertices of the same wavelengths. Photon subpaths and lanes use the `SETS` of
a pass in turn. The sets of a pass are stratified, and rotated from pass to pass.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

SET_BITS = 3  # bits of a set's index

# Sets of a pass: fewer tint the image, more leave fewer photons in each; see experiments, "Vertex merging".
SETS = 1 << SET_BITS

_TURN = 0.25  # sample values in [0, 1) that differ by this give the same wavelengths in another order
_GOLDEN = 0.6180339887498949  # fractional part of the golden ratio: its multiples modulo 1 are stratified


@dataclass
class WavelengthSets:
    """The sets of a pass, rotated by ``offset`` (opaque ``Float``)."""

    offset: mi.Float

    @staticmethod
    def of(start: mi.Float, done: float) -> WavelengthSets:
        """The sets after ``done`` passes; ``start`` in [0, 1) is fixed for an image."""
        offset = start + (done * _GOLDEN) % 1 * _TURN / SETS
        dr.make_opaque(offset)
        return WavelengthSets(offset)

    def number(self, index: mi.UInt32 | mi.UInt64) -> mi.UInt32:
        """The set of the subpath with this ``index``."""
        return mi.UInt32(index) & (SETS - 1)

    def u(self, number: mi.UInt32) -> mi.Float:
        """Sample value in [0, 1) of the wavelengths of set ``number``."""
        # First wavelengths, which may determine directions, of consecutive sets lie in different quarters.
        u = self.offset + mi.Float(number) * (_TURN / SETS) + mi.Float(number & 3) * _TURN
        return dr.minimum(u - dr.floor(u), 1 - 2**-24)
