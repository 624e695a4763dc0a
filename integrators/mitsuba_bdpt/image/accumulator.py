"""Raw sums of samples, and their conversion to the film.

Camera samples and splats (t <= 1) have separate blocks. Camera samples carry the filter's weight W. A splat's
weight is analytic: W' = spp * integral of the filter over the region that camera samples cover. Splats enter
the film as W * splat / W', so that `Film.develop` is right for every filter, crop window and border. One
block for both, as in Mitsuba's ``ptracer``, is biased for every filter but the box: E[1/W] > 1/E[W].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import accumulate
from math import ceil
from operator import add

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UsageError
from ..settings import Settings
from . import denoising
from .layers import film_layers, image_count, strategies, strategy_count, strategy_index
from .replicates import Replicates
from .taps import Taps, is_wide


class Block:
    """Sums of samples weighted by the film's filter, like ``mi.ImageBlock``.

    ``size``: (width, height). ``channels``: even, so that Dr.Jit adds them as a packet. ``mode``: ``Local``
    where neighbouring lanes mostly share a pixel, else ``Direct``. ``packet``: array type of a pixel's sums.
    """

    def __init__(self, size, offset, channels: int, rfilter, mode, packet):
        self.channels, self._rfilter, self._mode, self._packet = channels, rfilter, mode, packet
        self.row = size[0] * channels
        self._length = size[1] * self.row
        self._size = dr.opaque(mi.Point2i, size)
        self._offset = dr.opaque(mi.Point2i, offset)
        self.clear()

    def clear(self):
        """Set all sums to zero, without memory before something is added."""
        self.data = dr.zeros(dr.value_t(self._packet), self._length)

    def put(self, position, values, active, row=0):
        """Add one value per channel (a final 0 may be left out) at a film position, ``row`` rows below."""
        if self._rfilter.is_box_filter():
            self._add(mi.Point2i(dr.floor(position)) - self._offset, values, active, row)
            return
        at, radius = self._in_centres(position), self._rfilter.radius()
        first, taps = mi.Point2i(dr.ceil(at - radius)), ceil(2 * radius)

        def tap(number):
            pixel = first + mi.Point2i(number % taps, number // taps)
            distance = mi.Point2f(pixel) - at
            return pixel, self._rfilter.eval(distance.x) * self._rfilter.eval(distance.y)

        self._add_each(taps**2, tap, values, active, row)

    def splat(self, position, values, active, u, row=0):
        """Like `put` in expectation over ``u`` in [0, 1)^2, with fewer additions, see `taps`."""
        if self._rfilter.is_box_filter() or is_wide(self._rfilter):
            self.put(position, values, active, row)
            return
        taps = Taps(self._rfilter, self._in_centres(position), u)
        self._add_each(taps.count, taps.tap, values, active, row)

    def totals(self, stride: int, rows: int) -> mi.Float64:
        """Sums in double precision of the strips of ``rows`` rows, one every ``stride`` rows."""
        strips = mi.TensorXd(mi.Float64(self.data), (self._length // (stride * self.row), stride * self.row))
        return dr.gather(mi.Float64, dr.sum(strips, axis=0).array, dr.arange(mi.UInt32, rows * self.row))

    def strips(self, stride: int, rows: int) -> mi.Float64:
        """The strips of ``rows`` rows, one every ``stride`` rows, one after the other."""
        count, size = self._length // (stride * self.row), dr.opaque(mi.UInt32, rows * self.row)
        index = dr.arange(mi.UInt32, count * rows * self.row)
        strip = index // size
        place = strip * dr.opaque(mi.UInt32, stride * self.row) + index - strip * size
        return dr.gather(mi.Float64, self.data, place)

    def _in_centres(self, position):
        """Return a film position in the block's pixels; integers are pixel centres."""
        return position - mi.Point2f(self._offset) - 0.5

    def _add_each(self, count: int, tap, values, active, row):
        """Add ``values`` to ``count`` pixels; ``tap(number)`` returns a pixel and its weight."""

        def body(number):
            pixel, weight = tap(number)
            self._add(pixel, [weight * v for v in values], active, row)
            return (number + 1,)

        dr.while_loop((mi.Int32(0),), lambda number: number < count, body, label="reconstruction filter")

    def _add(self, pixel, values, active, row):
        pixel = pixel + mi.Point2i(0, mi.Int32(row))
        values = values + [mi.Float(0)] * (self.channels - len(values))
        inside = active & dr.all((pixel >= 0) & (pixel < self._size))
        index = mi.UInt32(pixel.y * self._size.x + pixel.x)
        dr.scatter_reduce(dr.ReduceOp.Add, self.data, self._packet(values), index, inside, mode=self._mode)


def even(count: int) -> int:
    """Round up to an even number: Dr.Jit adds an even number of channels as a packet."""
    return count + count % 2


PACKET = 8  # most channels that Dr.Jit adds as one packet
COPIES_MEMORY = 1 << 30  # bytes that copies of the sums for each thread may take, see `reduce_mode`


def reduce_mode(numbers: int, samples: int, additions: int = 16, otherwise=dr.ReduceMode.Local):
    """Return how samples of ``additions`` are added to sums of ``numbers`` in single precision.

    A copy of the sums for each of T threads pays from about T^2 / additions ``samples`` per pixel and launch
    on. ``otherwise``: the mode without copies.
    """
    threads = dr.thread_count()
    copied = threads * numbers * 4 <= COPIES_MEMORY and threads**2 <= additions * samples
    on_cpu = (mi.variant() or "").startswith("llvm")
    return dr.ReduceMode.Expand if copied and on_cpu else otherwise


@dataclass(frozen=True)
class Channels:
    """Order of the channels of a pixel's camera samples.

    ``colours``, ``alpha`` (0 or 1 channels), the filter's weight W, ``features``, ``stokes`` (channels
    beside the colours), and the colours of each layer of the ``partitions`` of the image (their numbers of
    layers, see `layers.partitions`). Splats have colours and Stokes channels only; those of each layer have
    sums of their own.
    """

    colours: int
    alpha: int
    features: int
    stokes: int = 0
    partitions: tuple[int, ...] = ()

    @property
    def layers(self) -> int:
        """Number of layers of all partitions."""
        return sum(self.partitions)

    @property
    def weight(self) -> int:
        """Index of the filter's weight."""
        return self.colours + self.alpha

    @property
    def camera(self) -> int:
        """Number of channels of camera samples, padded to an even number."""
        count = self.weight + 1 + self.features + self.stokes
        if not self.layers:
            return even(count)
        return -(-(count + self.layers * self.colours) // PACKET) * PACKET

    @property
    def light(self) -> int:
        """Number of channels of splats, padded to an even number."""
        return even(self.colours + self.stokes)

    @property
    def splats(self) -> int:
        """Number of sums of splats: of each layer, or one."""
        return max(self.layers, 1)

    @property
    def splats_of_image(self) -> int:
        """Number of sums of splats, the first ones, that add up to those of the image."""
        return self.partitions[0] if self.partitions else 1

    def sample(self, colours, alpha, features, stokes, layers) -> list:
        """Return the channels of a camera sample with filter weight 1."""
        return [*colours, *[alpha] * self.alpha, mi.Float(1), *features, *stokes, *layers]


@dataclass(frozen=True)
class Parts:
    """Parts of a film's sums.

    ``channels`` of a pixel; ``strips``: number of sums of each pixel's camera samples, see
    `batch.strip_count`; ``samples`` per pixel of a launch, at most; ``light_groups``: their names.
    """

    channels: Channels
    strips: int
    samples: int
    light_groups: tuple[str, ...] = ()


_NAMES = ("camera", "light", "strategies")  # names of the blocks in `Snapshot.arrays`


class Accumulator:
    """Accumulates the samples of one render.

    ``colour``: converts spectra to the film's colours, see `colour`; ``border``: pixels that camera samples
    reach beyond the crop window; ``features``: the `FeatureLayers`, or ``None``; ``parts`` of the sums;
    ``layers``: number of layers of all partitions.
    """

    def __init__(self, film, colour, border: int, settings: Settings, features, parts: Parts):
        self.film, self.colour, self.features = film, colour, features
        self.border = border
        self.depth = settings.strategy_depth
        self.size = [int(x) for x in film.crop_size()]
        self.offset = [int(x) for x in film.crop_offset()]
        self.rfilter = film.rfilter()
        self.variance, self.replicates = settings.variance, Replicates()
        self.stokes = colour.stokes
        colour.prepare(film_layers(settings, colour.names, parts.light_groups))
        self._channels = parts.channels
        self.alpha, self.layers = bool(self._channels.alpha), self._channels.layers
        # Strips of rows, of the camera's sums and of strategies, are separated by the filter's border.
        self._stride = self.size[1] + 2 * (self.rfilter.border_size() + border)
        self._samples = parts.samples
        self._strips, self._down = parts.strips, dr.opaque(mi.UInt32, self._stride)
        rows = self.size[1] if parts.strips == 1 else parts.strips * self._stride
        mode, channels = dr.ReduceMode.Local, self._channels.camera
        if self.layers:
            mode = reduce_mode(channels * self.size[0] * rows, parts.samples)
        self.camera = self._block(channels, mode, mi.ArrayXf, rows)
        # Double precision: one pixel may receive millions of splats of a small lamp.
        rows = self._stride * self.layers if self.layers else None
        self.light = self._block(self._channels.light, dr.ReduceMode.Direct, mi.ArrayXd, rows)
        rows = image_count(self.depth, settings.merge_images) * self._stride
        self.strategies = self._block(6, dr.ReduceMode.Direct, mi.ArrayXd, rows) if self.depth else None
        # Sums and passes; the sums of several passes are in double precision.
        self._done: tuple[list, tuple[int, ...]] = ([], ())
        self._share = self._covered()

    def _block(self, channels: int, mode, packet, height: int | None = None):
        size = [self.size[0], height or self.size[1]]
        if is_wide(self.rfilter):
            numbers = channels * size[0] * size[1] * (2 if packet == mi.ArrayXd else 1)
            mode = reduce_mode(numbers, self._samples, ceil(2 * self.rfilter.radius()) ** 2, mode)
        return Block(size, self.offset, channels, self.rfilter, mode, packet)

    def indices(self, layers: Sequence[mi.UInt32]) -> list[mi.UInt32]:
        """Return the indices, among all layers, of a layer of each partition."""
        firsts = accumulate(self._channels.partitions, initial=0)
        return [first + layer for first, layer in zip(firsts, layers, strict=False)]

    def put_camera(self, position, values, active, strip):
        """Add a camera sample (sum over all strategies with t >= 2) with filter weight 1.

        ``values``: colours, alpha, features, the channels of `Stokes` and the colours of layers, if kept;
        ``strip``: index of the sum to which it is added.
        """
        self.camera.put(position, self._channels.sample(*values), active, strip * self._down)

    def put_light(self, c, colours, polarized, active, u):
        """Add the splat ``c`` to the sums of its layers; ``polarized``: channels of `Stokes`."""
        rows = [layer * self._down for layer in self.indices(c.layers)]
        for row in rows or [0]:
            self.light.splat(c.position, [*colours, *polarized], active, u, row)

    def put_strategy(self, position, weighted, unweighted, c, active, u=None):
        """Add the contribution ``c`` to the image of its strategy; ``u`` of splats as in `put_light`."""
        if self.strategies is None:
            raise ValueError("an accumulator of depth 0 has no strategy images")
        values = [*(weighted[i] for i in range(3)), *(unweighted[i] for i in range(3))]
        index = strategy_count(self.depth) if c.kind == "merge" else strategy_index(c.s, c.t)
        row = index * self._stride
        if c.position is None:
            self.strategies.put(position, values, active, row)
        else:
            self.strategies.splat(position, values, active, u, row)

    def evaluate(self, *others):
        """Evaluate what was recorded since the last call, and ``others``, in one kernel."""
        dr.eval([b.data for b in self._blocks()], *others)

    def _blocks(self):
        return [b for b in (self.camera, self.light, self.strategies) if b is not None]

    @property
    def passes(self) -> tuple[int, ...]:
        """Samples per pixel of each pass in the sums."""
        return self._done[1]

    def close_pass(self, spp: int):
        """Add the sums of a pass of ``spp`` samples per pixel to the total."""
        blocks = self._blocks()
        sums = [b.data for b in blocks]
        if self._strips > 1:
            sums[0] = self.camera.totals(self._stride, self.size[1])
        if self.layers:
            sums[1] = self.light.strips(self._stride, self.size[1])
        before, passes = self._done
        if before:
            sums = [mi.Float64(a) + mi.Float64(b) for a, b in zip(before, sums, strict=True)]
        dr.eval(sums)
        self._done = (sums, (*passes, spp))  # one assignment: Ctrl-C may come between any two steps
        for b in blocks:
            b.clear()

    def store(self) -> tuple[tuple[int, ...], dict]:
        """Return passes and raw sums (arrays of Dr.Jit or NumPy, not changed later)."""
        sums, passes = self._done
        of_variance = self.replicates.store() if self.variance else {}
        return passes, of_variance | dict(zip(_NAMES, sums, strict=False))

    def restore(self, passes: tuple[int, ...], arrays: dict):
        """Restore the state that `store` returned."""
        sums = [mi.Float64(arrays[name]) for name in _NAMES if name in arrays]
        rows = {"camera": self.size[1], "light": self.size[1] * self._channels.splats}
        for block, s, name in zip(self._blocks(), sums, _NAMES, strict=False):
            expected = rows[name] * block.row if name in rows else len(block.data)
            if len(s) != expected:
                raise UsageError(f"the snapshot has {len(s)} numbers of {name}, not {expected}")
        self._done = (sums, tuple(passes))
        if self.variance:
            self.replicates.restore(arrays)

    def close_replicate(self):
        """Add what was accumulated since the last call as one independent replicate."""
        sums, passes = self._done
        self.replicates.add([mi.Float64(s) for s in sums[:2]], sum(passes), self._image)

    def error(self) -> float:
        """Estimated relMSE of the image, see `Replicates.error`."""
        return self.replicates.error(sum(self.passes), np.array(self.colour.unit))

    def _image(self, camera: mi.Float64, light: mi.Float64, spp: int) -> np.ndarray:
        """Return the image (height, width, colours) of sums over ``spp`` samples."""
        pixels, w = self._pixels(camera, light), self._splat_weight(spp)
        colours = zip(pixels.colours, pixels.light, strict=True)
        return self._on_host([c / pixels.weight + y / w for c, y in colours])

    def _on_host(self, channels: list[mi.Float64]) -> np.ndarray:
        """Return an image of ``channels`` in NumPy, (height, width, channels)."""
        values = dr.ravel(mi.ArrayXd(channels), order="F")
        return np.array(values).reshape(self.size[1], self.size[0], len(channels))

    def _pixels(self, camera, light) -> _Pixels:
        """Return the channels of sums in `_NAMES`' order."""

        def parts(sums, width: int, *counts: int) -> list[list[mi.Float64]]:
            numbers = iter(range(width))
            return [[mi.Float64(sums[next(numbers) :: width]) for _ in range(count)] for count in counts]

        c = self._channels
        count = c.layers * c.colours
        *of_camera, of_layers = parts(camera, c.camera, c.colours, c.alpha, 1, c.features, c.stokes, count)
        colours, alpha, [weight], features, polarized = of_camera
        of_each, size = [light], self.size[1] * self.light.row
        if c.layers:
            of_each = [light[i * size : (i + 1) * size] for i in range(c.layers)]
        each = [parts(sums, c.light, c.colours, c.stokes) for sums in of_each]
        splats, of_splats = (
            [reduce(add, values) for values in zip(*kind, strict=True)]
            for kind in zip(*each[: c.splats_of_image], strict=True)
        )
        layers = of_layers, [value for layer, _ in each for value in layer] if c.layers else []
        return _Pixels(colours, alpha, weight, features, splats, (polarized, of_splats), layers)

    def mean(self):
        """Largest mean of a colour in its unit: the scale of roulette; an unevaluated ``Float64``."""
        channels, (camera, light) = self._channels, self._done[0][:2]
        if channels.layers:
            light = light[: channels.splats_of_image * self.size[1] * self.light.row]
        camera, light = (
            [dr.sum(mi.Float64(sums[i :: block.channels])) for i in range(channels.colours)]
            for sums, block in ((camera, self.camera), (light, self.light))
        )
        weight = dr.sum(mi.Float64(self._done[0][0][channels.weight :: self.camera.channels]))
        x, y = self._share
        splat_weight = float(sum(self.passes) * y.sum() * x.sum())
        weight, splat_weight = dr.maximum(weight, 1e-30), dr.opaque(mi.Float64, max(splat_weight, 1e-30))
        colours = zip(camera, light, self.colour.unit, strict=True)
        return reduce(dr.maximum, [(c / weight + y / splat_weight) / unit for c, y, unit in colours])

    def _splat_weight(self, spp: int) -> mi.Float64:
        """Return W' of each pixel."""
        pixel = dr.arange(mi.UInt32, self.size[0] * self.size[1])
        row = pixel // dr.opaque(mi.UInt32, self.size[0])
        x, y = (mi.Float64(share) for share in self._share)
        y = dr.gather(mi.Float64, spp * y, row)
        return y * dr.gather(mi.Float64, x, pixel - row * dr.opaque(mi.UInt32, self.size[0]))

    def _covered(self) -> list[np.ndarray]:
        """Return each pixel's integral of the 1D filter over the camera samples' region, by axis."""
        if self.rfilter.is_box_filter():
            return [np.ones(n) for n in self.size]  # camera samples lie in the pixel itself
        radius, steps = self.rfilter.radius(), 4096
        edges = np.linspace(-radius, radius, 2 * steps + 1)
        middle = (edges[1:] + edges[:-1]) / 2
        density = np.array(self.rfilter.eval(mi.Float(middle)), dtype=np.float64)
        cumulative = np.concatenate([[0], np.cumsum(density * np.diff(edges))])
        found = []
        for n in self.size:
            centre = np.arange(n) + 0.5
            high = np.interp(n + self.border - centre, edges, cumulative)
            found.append(high - np.interp(-self.border - centre, edges, cumulative))
        return found

    def finish(self):
        """Store the image of all passes so far in the film."""
        sums, passes = self._done
        if not passes:
            return
        pixels = self._pixels(*sums[:2])
        to_film = pixels.weight / self._splat_weight(sum(passes))
        colours = _added(pixels.colours, pixels.light, to_film)
        layers = []
        if self.stokes is not None:
            layers += colours + _added(*pixels.polarized, to_film)
        if self.features is not None and self.features.guides:
            layers += pixels.features[: len(self.features.names)] + self._denoised(pixels, colours)
        else:
            layers += pixels.features
        if self.variance:
            shape = self.size[1], self.size[0], self._channels.colours
            variance = _channels(self.replicates.variance(sum(passes), shape))
            layers += [value * pixels.weight for value in variance]
        layers += _added(*pixels.layers, to_film)
        if self.strategies is not None:
            layers += self._strategy_layers(self.strategies, sums[2], to_film)
        stored = self.colour.stored(colours + pixels.alpha, pixels.weight, layers)
        values = dr.ravel(mi.ArrayXf(stored), order="F")
        dr.eval(values)
        shape = self.size[1], self.size[0], len(stored)
        self.film.clear()
        self.film.put_block(mi.ImageBlock(mi.TensorXf(values, shape), self.offset, border=False))

    def _denoised(self, pixels: _Pixels, colours: list[mi.Float64]) -> list[mi.Float64]:
        """Return the denoised ``colours``, weighted by the filter as these are."""
        # A filter with negative lobes may leave a weight of 0.
        weight = dr.select(pixels.weight == 0, 1, pixels.weight)
        image, guides = (
            self._on_host([value / weight for value in values])
            for values in (colours, pixels.features[len(self.features.names) :])
        )
        found = denoising.denoised(image, guides[..., denoising.ALBEDO], guides[..., denoising.NORMAL])
        return [value * pixels.weight for value in _channels(found)]

    def _strategy_layers(self, block: Block, sums: mi.Float64, to_film: mi.Float64) -> list[mi.Float64]:
        """Return the channels of the strategy images in film order; ``to_film``: factor of splats."""
        row, width = block.row, block.channels
        first = width * dr.arange(mi.UInt32, self.size[0] * self.size[1])
        splats = [t <= 1 for _, _, t in strategies(self.depth)]
        splats += [False] * (len(sums) // (self._stride * row) - len(splats))  # merges
        found = []
        for number, splat in enumerate(splats):
            start = first + dr.opaque(mi.UInt32, number * self._stride * row)
            image = [dr.gather(mi.Float64, sums, start + i) for i in range(width)]
            found += [value * to_film for value in image] if splat else image
        return found


def _added(camera: list[mi.Float64], light: list[mi.Float64], to_film: mi.Float64) -> list[mi.Float64]:
    """Return the sums of camera samples and of splats, with the film's weight."""
    return [c + y * to_film for c, y in zip(camera, light, strict=True)]


def _channels(image: np.ndarray) -> list[mi.Float64]:
    """Return the channels of an image in NumPy, (height, width, channels)."""
    values, count = mi.Float64(image.ravel()), image.shape[-1]
    return [mi.Float64(values[i::count]) for i in range(count)]


@dataclass
class _Pixels:
    """Sums of an image: channels, each an array over pixels in double precision.

    ``light``: splats; ``polarized``: Stokes channels of camera samples and of splats; ``layers``: colours of
    the partitions' layers, of both.
    """

    colours: list[mi.Float64]
    alpha: list[mi.Float64]
    weight: mi.Float64
    features: list[mi.Float64]
    light: list[mi.Float64]
    polarized: tuple[list[mi.Float64], list[mi.Float64]]
    layers: tuple[list[mi.Float64], list[mi.Float64]]
