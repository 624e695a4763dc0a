"""Which camera samples of a batch share a light subpath.

The pixels of a batch are cut into S parts of one size (the last ones may be short), and a lane serves one
sample of a pixel of each part. Were that the same pixel of all parts, pixels that share light subpaths would
lie at one distance from each other all over the image, and the noise that they have in common would make
stripes. So the pixels of each part are dealt anew:

* All samples of a pixel share with those of the same pixels, in all passes, so that its light subpaths are
  neighbours in the sequence, a net where its camera samples are one (see `points`). To deal one of 16
  otherwise, in the first pass, made 8 % more error in `uplight_room` with S = 4.
* Runs of neighbouring pixels stay together if there are many, so that rays of neighbouring lanes are
  coherent.
* Runs are dealt by a Feistel network: with their numbers written as a table of rows and columns, each column
  is turned by a hash of its number, then each row, then each column again. That is a bijection for any number
  of runs, and needs neither memory nor, in the loop over the parts, a division.

What is left over, less than a run and the few runs that make no row of the table, stays in its place.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isqrt

import drjit as dr
import mitsuba as mi

from ..sampling import sobol

# Most pixels of a run: single ones make renders of one sample per pass 4 to 8 % slower.
LONGEST_RUN = 16

# A part has as many runs or more, or else runs of one pixel: few would meet at few distances.
LEAST_RUNS = 256

# Words that make other seeds of a pass's: 1 and 2 make those of the points (`Points.stream`). Parts that are
# dealt, from 1 on, have those after them.
_WORDS_OF_POINTS = 2

_ROUNDS = (0x3C6EF372, 0xDAA66D2B, 0x78DDE6E4)  # tell the keys of the rounds apart


@dataclass
class Seat:
    """A lane's place in a part.

    Of the ``lane`` of this number: ``row`` and ``column`` of its run, ``pixel`` in the run, ``sample`` of the
    pixel.
    """

    lane: mi.UInt32
    row: mi.UInt32
    column: mi.UInt32
    pixel: mi.UInt32
    sample: mi.UInt32


class Sharing:
    """The map of a batch's camera samples to lanes.

    Slots number the camera samples, pixel by pixel with ``samples`` of each of the ``pixels``; there are
    ``total`` of them. Each of the ``lanes`` serves ``served`` slots or fewer, all in different pixels. The
    map is another for each ``seed`` (``UInt32``), so that in the mean of several renders no two pixels share
    much.
    """

    def __init__(self, pixels: int, samples: int, served: int, seed: mi.UInt32):
        part = -(-pixels // served)
        self.total, self.lanes = pixels * samples, part * samples
        run = run_pixels(part)
        rows, columns = table_size(part // run)
        u32 = mi.UInt32
        self._seed = seed
        self._lanes, self._samples = dr.opaque(u32, self.lanes), dr.opaque(u32, samples)
        self._last, self._bits = dr.opaque(u32, run - 1), dr.opaque(u32, run.bit_length() - 1)
        self._rows, self._columns = dr.opaque(u32, rows), dr.opaque(u32, columns)

    def seat(self, lane: mi.UInt32) -> Seat:
        """What `slot` needs of a ``lane`` (``UInt32``), the same for all parts."""
        pixel = lane // self._samples
        run = pixel >> self._bits
        row = run // self._columns
        return Seat(lane, row, run - row * self._columns, pixel & self._last, lane - pixel * self._samples)

    def slot(self, seat: Seat, part: mi.UInt32) -> mi.UInt32:
        """The sample of a ``part`` (``UInt32``) that a lane serves.

        There is none if this is not below ``total``.
        """
        keys = self._keys(part)
        row = _turned(seat.row, self._rows, sobol.mix(seat.column ^ keys[0]))
        column = _turned(seat.column, self._columns, sobol.mix(row ^ keys[1]))
        hashed = sobol.mix(column ^ keys[2])
        row = _turned(row, self._rows, hashed)
        return part * self._lanes + self._place(seat, part, row, column, hashed)

    def lane(self, slot: mi.UInt32) -> mi.UInt32:
        """The lane that serves a sample, the inverse of `slot`."""
        part = slot // self._lanes
        seat, keys = self.seat(slot - part * self._lanes), self._keys(part)
        hashed = sobol.mix(seat.column ^ keys[2])
        row = _turned_back(seat.row, self._rows, hashed)
        column = _turned_back(seat.column, self._columns, sobol.mix(row ^ keys[1]))
        row = _turned_back(row, self._rows, sobol.mix(column ^ keys[0]))
        return self._place(seat, part, row, column, hashed)

    def _keys(self, part):
        key = sobol.hash_u32(self._seed, part + _WORDS_OF_POINTS)
        return [key ^ word for word in _ROUNDS]

    def _place(self, seat, part, row, column, hashed):
        """Place in a part of what is dealt from a ``seat``; the first part stays as it is.

        Pixels of a run change places too (by low bits of a hash whose high bits turned the column), or else
        those that share lanes would lie a multiple of a run apart.
        """
        run = row * self._columns + column
        dealt = ((run << self._bits) + (seat.pixel ^ (hashed & self._last))) * self._samples + seat.sample
        return dr.select((seat.row < self._rows) & (part > 0), dealt, seat.lane)


def run_pixels(part: int) -> int:
    """Pixels of a run, a power of two, in parts of so many pixels."""
    run = 1
    while run < LONGEST_RUN and part >= 2 * run * LEAST_RUNS:
        run *= 2
    return run


def table_size(runs: int) -> tuple[int, int]:
    """Rows and columns of a table of ``runs`` or nearly so many; 0 rows if there are no runs.

    Of those with between half and twice the root of it as columns, the one that leaves out least, the
    squarest of these.
    """
    root = isqrt(runs)
    sizes = ((runs // columns, columns) for columns in range(max(root // 2, 1), 2 * root + 2))
    return min(sizes, key=lambda size: (runs - size[0] * size[1], abs(size[0] - size[1])))


def _turned(place, count, hashed):
    """``place`` in a cycle of ``count``, turned by a hash."""
    place = place + dr.mul_hi(hashed, count)
    return dr.select(place >= count, place - count, place)


def _turned_back(place, count, hashed):
    by = dr.mul_hi(hashed, count)
    return dr.select(place >= by, place - by, place + (count - by))
