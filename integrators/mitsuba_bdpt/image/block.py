"""Sums of samples weighted by the film's filter."""

from __future__ import annotations

from math import ceil

import drjit as dr
import mitsuba as mi


class Block:
    """Sums of samples weighted by the film's filter, like ``mi.ImageBlock``.

    The size is opaque: as a literal, it would compile a new kernel for every resolution.

    ``size``: (width, height). ``channels``: even, so that Dr.Jit adds them as a packet. ``mode``: ``Local``
    where neighbouring lanes mostly share a pixel, else ``Direct``. ``packet``: array type of a pixel's sums,
    in double precision where the number of samples of a pixel is unbounded.
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

        One value per channel; a final 0 may be left out.
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
