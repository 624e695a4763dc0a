"""Raw accumulators, and how they become the film.

Camera samples go into one block with Mitsuba's filter weights W, splats (t <= 1) into another. The
weight that a splat must be divided by is analytic, W' = spp * integral of the filter over the region
that camera samples cover; it enters the film as W * splat / W', so that `Film.develop` does the
right thing for every filter, crop window and border. Putting both kinds into one block, as Mitsuba's
``ptracer`` does, is biased for every filter but the box: E[1/W] > 1/E[W].
"""

from __future__ import annotations

from functools import reduce
from math import ceil, inf

import drjit as dr
import mitsuba as mi
import numpy as np

from .spread import Spread, restored, stored
from .strategies import layer_names, strategies, strategy_count, strategy_index

# The blocks of sums, as `Snapshot.arrays` calls them.
_NAMES = ("camera", "light", "strategies")


class Block:
    """Sums of samples weighted by the film's filter, as in ``mi.ImageBlock``, but of a size that is a
    run-time value: Mitsuba's, and Dr.Jit's copies of small targets for each thread, are literals in the
    kernel, which would be compiled anew for every resolution.

    ``size`` (width, height); ``channels`` an even number, so that Dr.Jit adds a pixel's as a packet;
    ``mode`` how neighbouring lanes are added: ``Local`` where they mostly meet in a pixel, else ``Direct``
    (measured for 2^20 samples of 4 channels on two cores: 3 and 9 ms if 64 lanes meet, 41 and 26 ms if
    they do not); ``packet`` the type of a pixel's sums, in double precision where any number of samples may
    meet in a pixel.
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
        """Add ``values`` (one per channel, a last one of 0 may be left out) at a continuous film
        position, ``row`` rows below."""
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


class Replicates:
    """Independent images of the scene, in turn in one of two `Spread`: what one half of them says about the
    error can be put beside what the other says about the image."""

    def __init__(self):
        self.halves, self._sums = (Spread(), Spread()), None

    @property
    def count(self) -> int:
        """How many images."""
        return sum(half.count for half in self.halves)

    @property
    def spp(self) -> int:
        """Samples per pixel of all of them."""
        return sum(half.spp for half in self.halves)

    def add(self, sums, spp: int, develop):
        """Add an image: ``sums`` and ``spp`` are those of all images so far, ``develop(camera, light,
        spp)`` makes an image of the difference."""
        new = sums if self._sums is None else [a - b for a, b in zip(sums, self._sums, strict=True)]
        n, halves = spp - self.spp, list(self.halves)
        which = self.count % 2
        halves[which] = halves[which].joined(Spread.of(develop(*new, n), n))
        self.halves, self._sums = tuple(halves), sums

    def store(self) -> tuple[dict, dict]:
        """Arrays of a `Snapshot`, and the numbers that `restore` needs beside them."""
        arrays, progress = stored(self.halves)
        if self.count:
            arrays |= {f"replicates.last.{i}": sums for i, sums in enumerate(self._sums)}
        return arrays, progress

    def restore(self, progress: dict, arrays: dict):
        """Go on from what `store` gave."""
        self.halves = restored(progress, arrays)
        if self.count:
            self._sums = [arrays[n] for n in sorted(arrays) if n.startswith("replicates.last.")]

    def variance(self, spp: int, shape=()):
        """Variance of the mean of ``spp`` samples per pixel (those of a replicate that was not
        finished included); infinite, in the given shape, with fewer than two replicates."""
        if self.count < 2:
            return np.full(shape, np.inf)
        first, second = self.halves
        both = first.joined(second)
        return both.variance() * (both.spp / spp)

    def error(self, spp: int, unit) -> float:
        """Estimated relMSE of the mean of ``spp`` samples per pixel, colours in multiples of ``unit``;
        infinite with fewer than two replicates in a half.

        The variance that one half shows is divided by r^2 + 0.01 mean(image)^2 with r from the other half:
        beside a mean that has the same firefly no value could count for more than 1. The noise of r alone
        would add 1 + V max(3 r^2 - e, 0) / (r^2 + e)^2 in the mean (second order; where it would take away,
        nothing is added), with V the variance of r and e = 0.01 mean(image)^2; it is divided by that.
        """
        first, second = self.halves
        if min(first.count, second.count) < 2:
            return inf
        epsilon = 0.01 * (first.joined(second).mean / unit).mean() ** 2 + 1e-150  # whose square is not 0 yet
        found = 0.0
        for own, other in ((first, second), (second, first)):
            variance = own.variance() / unit**2 * (own.spp / spp)
            square, noise = (other.mean / unit) ** 2, other.variance() / unit**2
            below = square + epsilon
            surplus = 1 + noise * np.maximum(3 * square - epsilon, 0) / below**2
            found += float((variance / (below * surplus)).mean()) / 2
        return found


class Accumulator:
    """Collects the samples of one render.

    ``film`` Mitsuba's film; ``colour`` what it keeps of a spectrum, see `colour`; ``border`` how many
    pixels camera samples reach beyond the crop window; ``depth`` the largest path length of the strategy
    images, 0 for none; ``variance`` whether the layers of the variance are wanted, see
    `close_replicate`; ``features`` the `FeatureLayers` that camera samples bring along, or ``None``.
    """

    def __init__(self, film, colour, border: int, depth: int, variance: bool = False, features=None):
        self.film, self.colour, self.features = film, colour, features
        self.border = border
        self.alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
        self.depth = depth
        self.size = [int(x) for x in film.crop_size()]
        self.offset = [int(x) for x in film.crop_offset()]
        self.rfilter = film.rfilter()
        self.replicates = Replicates() if variance else None
        names = features.names if features else []
        colour.prepare(layer_names(depth, variance, names, colour.names))
        self._colours = len(colour.names)
        self._weight = self._colours + self.alpha  # where W lies among the camera samples' sums
        self._channels = self._weight + 1 + len(names)
        self.camera = self._block(self._channels, dr.ReduceMode.Local, mi.ArrayXf)
        # In single precision the 2^22 splats of a small lamp on its one pixel are off by 0.3 %.
        self.light = self._block(self._colours, dr.ReduceMode.Direct, mi.ArrayXd)
        # One strip of rows per strategy, far enough apart for the filter.
        self._stride = self.size[1] + 2 * (self.rfilter.border_size() + border)
        rows = strategy_count(depth) * self._stride
        self.strategies = self._block(6, dr.ReduceMode.Direct, mi.ArrayXd, rows) if depth else None
        self._done = (None, ())
        self._share = [self._covered(n) for n in self.size]

    def _block(self, channels: int, mode, packet, height: int | None = None):
        size = [self.size[0], height or self.size[1]]
        return Block(size, self.offset, channels + channels % 2, self.rfilter, mode, packet)

    def put_camera(self, position, colours, alpha, features, active):
        """Add a camera sample (sum over all strategies with t >= 2) with filter weight 1."""
        values = [*colours, *([alpha] if self.alpha else []), mi.Float(1), *features]
        self.camera.put(position, values, active)

    def put_light(self, position, colours, active):
        """Add a splat at a continuous film position."""
        self.light.put(position, [*colours], active)

    def put_strategy(self, position, weighted, unweighted, s, t, active):
        """Add to the technique images of the strategy (s, t)."""
        values = [*(weighted[i] for i in range(3)), *(unweighted[i] for i in range(3))]
        self.strategies.put(position, values, active, strategy_index(s, t) * self._stride)

    def evaluate(self, *others):
        """Run what was recorded since the last call as one kernel, ``others`` with it."""
        dr.eval([b.data for b in self._blocks()], *others)

    def _blocks(self):
        return [b for b in (self.camera, self.light, self.strategies) if b is not None]

    @property
    def passes(self) -> tuple:
        """Samples per pixel of each pass that is in the sums."""
        return self._done[1]

    def close_pass(self, spp: int):
        """Add the sums of a pass with ``spp`` samples per pixel to those of all, in double precision."""
        blocks = self._blocks()
        sums = [mi.Float64(b.data) for b in blocks]
        before, passes = self._done
        if before is not None:
            sums = [a + b for a, b in zip(before, sums, strict=True)]
        dr.eval(sums)
        self._done = (sums, (*passes, spp))  # at once: Ctrl-C may come between any two steps
        for b in blocks:
            b.clear()

    def store(self) -> tuple[tuple, dict, dict | None]:
        """What a `Snapshot` needs: passes, arrays (of Dr.Jit or NumPy, none of which changes any more), and
        numbers about the replicates, if there are any."""
        sums, passes = self._done
        arrays, replicates = self.replicates.store() if self.replicates else ({}, None)
        return passes, arrays | dict(zip(_NAMES, sums or [], strict=False)), replicates

    def ends_replicates(self) -> bool:
        """Whether all passes belong to whole replicates."""
        return self.replicates is not None and self.replicates.spp == sum(self.passes) > 0

    def restore(self, passes: tuple, arrays: dict, replicates: dict | None):
        """Go on from what `store` gave after these ``passes``."""
        sums = [mi.Float64(arrays[name]) for name in _NAMES if name in arrays]
        for block, s, name in zip(self._blocks(), sums, _NAMES, strict=False):
            if len(s) != len(block.data):
                raise ValueError(f"bdpt: the snapshot has {len(s)} numbers of {name}, not {len(block.data)}")
        self._done = (sums, tuple(passes))
        if self.replicates is not None:
            self.replicates.restore(replicates, arrays)

    def close_replicate(self):
        """Count what was added since the last call as one independent replicate of the image."""
        sums, passes = self._done
        self.replicates.add([np.array(s) for s in sums[:2]], sum(passes), self._image)

    def error(self) -> float:
        """Estimated relMSE of the image, see `Replicates.error`."""
        return self.replicates.error(sum(self.passes), np.array(self.colour.unit))

    def _image(self, camera, light, spp: int):
        """Image (height, width, colours) of sums over ``spp`` samples per pixel."""
        w, h = self.size
        camera, light = camera.reshape(h, w, -1), light.reshape(h, w, -1)
        weight, n = camera[..., self._weight, None], self._colours
        return camera[..., :n] / weight + light[..., :n] / self._splat_weight(spp)[..., None]

    def mean(self):
        """Mean of the image so far (largest colour, each in its unit), for the scale of roulette: a
        ``Float64`` of width 1, for which nobody has waited yet."""
        blocks = zip(self._done[0][:2], (self.camera, self.light), strict=True)
        camera, light = (
            [dr.sum(sums[i :: block.channels]) for i in range(self._colours)] for sums, block in blocks
        )
        weight = dr.sum(self._done[0][0][self._weight :: self.camera.channels])
        splat_weight = float(self._splat_weight(sum(self.passes)).sum())
        weight, splat_weight = dr.maximum(weight, 1e-30), dr.opaque(mi.Float64, max(splat_weight, 1e-30))
        colours = zip(camera, light, self.colour.unit, strict=True)
        return reduce(dr.maximum, [(c / weight + y / splat_weight) / unit for c, y, unit in colours])

    def _splat_weight(self, spp: int):
        """W', shape (height, width)."""
        x, y = self._share
        return spp * y[:, None] * x[None, :]

    def _covered(self, n: int):
        """Integral of the one-dimensional filter about each pixel over the camera samples' region."""
        if self.rfilter.is_box_filter():
            return np.ones(n)  # camera samples are put at the pixel itself: each weighs 1
        radius, steps = self.rfilter.radius(), 4096
        edges = np.linspace(-radius, radius, 2 * steps + 1)
        middle = (edges[1:] + edges[:-1]) / 2
        density = np.array(self.rfilter.eval(mi.Float(middle)), dtype=np.float64)
        cumulative = np.concatenate([[0], np.cumsum(density * np.diff(edges))])
        centre = np.arange(n) + 0.5
        high = np.interp(n + self.border - centre, edges, cumulative)
        return high - np.interp(-self.border - centre, edges, cumulative)

    def finish(self):
        """Store the result of the passes so far in the film."""
        w, h = self.size
        sums, passes = self._done
        if not passes:
            return
        camera, light = (np.array(s).reshape(h, w, -1) for s in sums[:2])
        n, last = self._colours, self._weight + 1
        colours, weight, features = camera[..., : last - 1], camera[..., last - 1 : last], camera[..., last:]
        to_film = weight / self._splat_weight(sum(passes))[..., None]
        colours[..., :n] += light[..., :n] * to_film
        layers = [features[..., : self._channels - last]]
        if self.replicates is not None:
            layers.append(self.replicates.variance(sum(passes), (h, w, n)) * weight)
        if self.depth:
            tall = np.array(sums[2]).reshape(-1, self._stride, w, 6)[:, :h]
            for index, (_, _, t) in enumerate(strategies(self.depth)):
                layers.append(tall[index] * (to_film if t <= 1 else 1))
        values = np.concatenate(self.colour.stored(colours, weight, layers), axis=-1).astype(np.float32)
        block = mi.ImageBlock(mi.TensorXf(values), self.offset, border=False)
        self.film.put_block(block)
