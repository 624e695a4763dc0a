"""The samples of one kernel launch: their pixels, and which share a light subpath.

The pixels of a batch are cut into S parts of equal size (the last ones may be short); a lane has a sample of
one pixel of each part, and all samples of a pixel share with the same pixels. In large parts the pixels are
runs of neighbours. A Feistel network permutes the runs of each part, so that no distance is preferred (see
docs/user/samplers.md): in a table of rows and columns, each column is rotated by a hash of its number, then
each row, then each column. It is a bijection for any number of runs.

The remainder, less than a run and the few runs that fill no row of the table, stays in place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import isqrt

import drjit as dr
import mitsuba as mi

from ..sampling import sobol
from .inputs import TraceContext

# Samples of a pixel that a launch sums in single precision; further ones have sums of their own (strips).
# Bounds the rounding error, which is systematic (relative error 4e-6 at 2^12, 5e-5 at 2^16).
STRIP = 1 << 12


def strip_count(samples: int) -> int:
    """Number of sums per pixel of a launch of ``samples`` samples per pixel."""
    return -(-samples // STRIP)


@dataclass(frozen=True)
class Batch:
    """The samples of one launch: of a pass, of a band of its rows, or of a pilot.

    ``pixels`` pixels from ``first_pixel`` on (row by row in the film region), with ``samples`` samples of
    each from ``first_sample`` on. For pilots, ``spread`` > 0: one random pixel in each of ``pixels`` equal
    parts of the first ``spread``, with independent samples; ``light``: light subpaths per camera sample.
    """

    first_pixel: int
    pixels: int
    first_sample: int
    samples: int
    spread: int = 0
    light: int = 1

    @property
    def lanes(self) -> int:
        """Number of light subpaths of a pilot."""
        return self.size * self.light

    @property
    def size(self) -> int:
        """Number of camera samples."""
        return self.pixels * self.samples


class Places:
    """Maps camera samples of a batch to pixels and to indices in the image's sequence."""

    def __init__(self, kernel: TraceContext, batch: Batch, spp: int):
        self._camera = kernel.camera
        self._first_pixel = dr.opaque(mi.UInt32, batch.first_pixel)
        self._spread = dr.opaque(mi.UInt64, batch.spread) if batch.spread else None
        self._pixels = dr.opaque(mi.UInt64, batch.pixels)
        self._samples = dr.opaque(mi.UInt32, batch.samples)
        self._first_sample = dr.opaque(mi.UInt32, batch.first_sample)
        self._spp = dr.opaque(mi.UInt64, spp)

    def _split(self, slot):
        pixel, sample = _divided(slot, self._samples)
        if self._spread is not None:
            # Random: a regular stride would miss columns of films of that width.
            within = mi.UInt64(sobol.mix(pixel + 1)) % self._spread
            pixel = mi.UInt32((mi.UInt64(pixel) * self._spread + within) // self._pixels)
        return pixel + self._first_pixel, sample + self._first_sample

    def index(self, slot: mi.UInt32) -> mi.UInt64:
        if self._spread is not None:  # each sample has its own sequence
            return mi.UInt64(slot) << 32
        pixel, sample = self._split(slot)
        return mi.UInt64(pixel) * self._spp + mi.UInt64(sample)

    def strip(self, slot: mi.UInt32) -> mi.UInt32:
        """Index of the sum of its pixel to which a camera sample is added."""
        return _divided(slot, self._samples)[1] // STRIP

    def pixel(self, slot: mi.UInt32) -> mi.Point2i:
        return self._camera.region.pixel(self._split(slot)[0])


# Most pixels of a run, a power of two; runs of one pixel are 4 to 8 % slower with one sample per pass.
LONGEST_RUN = 16

LEAST_RUNS = 256  # parts of fewer runs use runs of one pixel: few runs would meet at few distances

# Words that derive seeds from that of a pass: the points use 1 and 2 (`Points.stream`), parts later ones.
_WORDS_OF_POINTS = 2

_ROUNDS = (0x3C6EF372, 0xDAA66D2B, 0x78DDE6E4)  # distinguish the keys of the rounds


class Sharing:
    """The map of a batch's camera samples to lanes.

    Slots number the ``total`` camera samples, pixel by pixel with ``samples`` of each of the ``pixels``. Each
    of the ``lanes`` has at most ``camera_paths`` slots, all in different pixels. The map depends on ``seed``
    (``UInt32``), so that over several renders no two pixels remain correlated.
    """

    def __init__(self, pixels: int, samples: int, camera_paths: int, seed: mi.UInt32):
        part = -(-pixels // camera_paths)
        self.total, self.lanes = pixels * samples, part * samples
        bits = max(min(LONGEST_RUN, part // LEAST_RUNS), 1).bit_length() - 1  # of the pixels of a run
        rows, columns = _table_size(part >> bits)
        u32 = mi.UInt32
        self._seed = seed
        self._lanes, self._samples = dr.opaque(u32, self.lanes), dr.opaque(u32, samples)
        self._last, self._bits = dr.opaque(u32, (1 << bits) - 1), dr.opaque(u32, bits)
        self._rows, self._columns = dr.opaque(u32, rows), dr.opaque(u32, columns)

    def slots(self, lane: mi.UInt32) -> Callable[[mi.UInt32], mi.UInt32]:
        """The slots of a ``lane`` by part; the first one is the lane, none from ``total`` on."""
        pixel, sample = _divided(lane, self._samples)
        in_run, (row, column) = pixel & self._last, _divided(pixel >> self._bits, self._columns)

        def slot(part: mi.UInt32) -> mi.UInt32:
            key = sobol.hash_u32(self._seed, part + _WORDS_OF_POINTS)
            keys = [key ^ word for word in _ROUNDS]
            turned = _turned(row, self._rows, sobol.mix(column ^ keys[0]))
            cycled = _turned(column, self._columns, sobol.mix(turned ^ keys[1]))
            hashed = sobol.mix(cycled ^ keys[2])
            run = _turned(turned, self._rows, hashed) * self._columns + cycled
            # Also permutes the pixels within a run, by the low bits of the hash whose high bits rotated the
            # column: otherwise pixels that share lanes would lie multiples of a run apart.
            dealt = ((run << self._bits) + (in_run ^ (hashed & self._last))) * self._samples + sample
            place = dr.select((row < self._rows) & (part > 0), dealt, lane)
            return part * self._lanes + place

        return slot


def _table_size(runs: int) -> tuple[int, int]:
    """Rows and columns of a table of at most ``runs`` runs; 0 rows without runs.

    Among column counts from half to twice the root, the table that leaves out least, then the squarest.
    """
    root = isqrt(runs)
    sizes = ((runs // columns, columns) for columns in range(max(root // 2, 1), 2 * root + 2))
    return min(sizes, key=lambda size: (runs - size[0] * size[1], abs(size[0] - size[1])))


def _divided(n, by):
    """Quotient and remainder."""
    quotient = n // by
    return quotient, n - quotient * by


def _turned(place, count, hashed):
    """Rotate ``place`` in a cycle of ``count`` by a hash."""
    place = place + dr.mul_hi(hashed, count)
    return dr.select(place >= count, place - count, place)
