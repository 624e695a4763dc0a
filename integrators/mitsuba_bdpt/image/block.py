"""Sums of samples weighted by the film's filter."""

from __future__ import annotations

from math import ceil

import drjit as dr
import mitsuba as mi


class Block:
    """Sums of samples weighted by the film's filter, as in ``mi.ImageBlock``, but of a run-time size.

    Sizes of Mitsuba's, and of Dr.Jit's copies of small targets for each thread, are literals in the kernel,
    which would be compiled anew for every resolution.

    ``size`` (width, height); ``channels`` an even number, so that Dr.Jit adds a pixel's as a packet; ``mode``
    how neighbouring lanes are added: ``Local`` where they mostly meet in a pixel, else ``Direct`` (measured
    for 2^20 samples of 4 channels on two cores: 3 and 9 ms if 64 lanes meet, 41 and 26 ms if they do not);
    ``packet`` the type of a pixel's sums, in double precision where any number of samples may meet in a
    pixel.
    """

    def __init__(self, size, offset, channels: int, rfilter, mode, packet):
        self.channels, self._rfilter, self._mode, self._packet = channels, rfilter, mode, packet
        self._length = size[0] * size[1] * channels
        self._size = dr.opaque(mi.Point2i, size)
        self._offset = dr.opaque(mi.Point2i, offset)
        self.clear()

    def clear(self):
        """Set all sums to zero."""
        self.data = dr.zeros(dr.value_t(self._packet), self._length)
        dr.make_opaque(self.data)

    def put(self, position, values, active, row=0):
        """Add ``values`` at a continuous film position, ``row`` rows below.

        One per channel; a last one of 0 may be left out.
        """
        values = values + [mi.Float(0)] * (self.channels - len(values))
        down = mi.Point2i(0, mi.Int32(row))
        if self._rfilter.is_box_filter():
            self._add(mi.Point2i(dr.floor(position)) - self._offset + down, values, active)
            return
        radius = self._rfilter.radius()
        taps = ceil(2 * radius)
        at = position - mi.Point2f(self._offset) - 0.5  # in pixel centres
        first = mi.Point2i(dr.ceil(at - radius))

        def body(tap):
            pixel = first + mi.Point2i(tap % taps, tap // taps)
            distance = mi.Point2f(pixel) - at
            weight = self._rfilter.eval(distance.x) * self._rfilter.eval(distance.y)
            self._add(pixel + down, [weight * v for v in values], active)
            return (tap + 1,)

        dr.while_loop((mi.Int32(0),), lambda tap: tap < taps * taps, body, label="reconstruction filter")

    def _add(self, pixel, values, active):
        inside = active & dr.all((pixel >= 0) & (pixel < self._size))
        index = mi.UInt32(pixel.y * self._size.x + pixel.x)
        dr.scatter_reduce(dr.ReduceOp.Add, self.data, self._packet(values), index, inside, mode=self._mode)
