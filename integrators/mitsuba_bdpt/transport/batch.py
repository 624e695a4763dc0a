"""The samples of one kernel launch, and where each of them lies."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..sampling import sobol
from .inputs import Kernel

# Points of a net of one pixel, and nets of a pixel: their means differ by what points leave of the variance.
# (Longer nets gain more, and there are fewer of them: with 16 points in half as many pixels what is found in
# a Cornell box is off by 31 % instead of 24 %.)
NET, NETS = 8, 2


@dataclass(frozen=True)
class Batch:
    """The samples of one launch: of a pass, of a band of its rows, or of a pilot.

    Pixels ``first_pixel`` and on, ``pixels`` of them (row by row in the film region), samples
    ``first_sample`` and on, ``samples`` of each pixel.

    With ``spread``, for pilots, the pixels are not neighbours, but one by chance in each of equal parts of
    the first so many, and samples are independent of each other. Then come those of ``nets`` other pixels
    chosen like that, `batch.NETS` of `batch.NET` samples each, which are points of a sequence of their own;
    and so many times ``light`` as there are camera samples light subpaths.
    """

    first_pixel: int
    pixels: int
    first_sample: int
    samples: int
    spread: int = 0
    nets: int = 0
    light: int = 1

    @property
    def lanes(self) -> int:
        """Number of light subpaths of a pilot."""
        return self.size * self.light

    @property
    def size(self) -> int:
        """Number of camera samples."""
        return self.pixels * self.samples + self.nets * NETS * NET


class Places:
    """Where a camera sample of the batch lies: pixel, and index in the image's sequence."""

    def __init__(self, kernel: Kernel, batch: Batch, spp: int):
        self._camera = kernel.camera
        self._first_pixel = dr.opaque(mi.UInt32, batch.first_pixel)
        self._pilot = batch.spread > 0
        if self._pilot:
            self._spread = dr.opaque(mi.UInt64, batch.spread)
            self._first_net = dr.opaque(mi.UInt32, batch.pixels * batch.samples)
            self._nets = dr.opaque(mi.UInt64, max(batch.nets, 1))
        self._pixels = dr.opaque(mi.UInt64, batch.pixels)
        self._samples = dr.opaque(mi.UInt32, batch.samples)
        self._first_sample = dr.opaque(mi.UInt32, batch.first_sample)
        self._spp = dr.opaque(mi.UInt64, spp)

    def _split(self, slot):
        if self._pilot:
            return self._split_of_pilot(slot)
        pixel = slot // self._samples
        return pixel + self._first_pixel, slot - pixel * self._samples + self._first_sample

    def _split_of_pilot(self, slot):
        in_net = slot >= self._first_net
        after = slot - self._first_net
        pixel = dr.select(in_net, after // (NETS * NET), slot // self._samples)
        sample = dr.select(in_net, after % (NETS * NET), slot % self._samples)
        parts = dr.select(in_net, self._nets, self._pixels)
        # By chance: one in so many would miss columns of films that wide.
        hashed = sobol.mix(dr.select(in_net, ~pixel, pixel + 1))
        within = mi.UInt64(hashed) % self._spread
        pixel = mi.UInt32((mi.UInt64(pixel) * self._spread + within) // parts)
        return pixel + self._first_pixel, sample

    def index(self, slot: mi.UInt32) -> mi.UInt64:
        if self._pilot:  # each sample, or net, is of a sequence of its own
            within = dr.select(slot >= self._first_net, (slot - self._first_net) % NET, 0)
            return (mi.UInt64(slot - within) << 32) | mi.UInt64(within)
        pixel, sample = self._split(slot)
        return mi.UInt64(pixel) * self._spp + mi.UInt64(sample)

    def pixel(self, slot: mi.UInt32) -> mi.Point2i:
        pixel, _ = self._split(slot)
        return self._camera.region.pixel(pixel)
