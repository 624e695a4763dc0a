"""Raw accumulators, and how they become the film.

Camera samples go into one block with Mitsuba's filter weights W, splats (t <= 1) into another. The
weight that a splat must be divided by is analytic, W' = spp * integral of the filter over the region
that camera samples cover; it enters the film as W * splat / W', so that `Film.develop` does the
right thing for every filter, crop window and border. Putting both kinds into one block, as Mitsuba's
``ptracer`` does, is biased for every filter but the box: E[1/W] > 1/E[W].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UsageError
from . import denoising, stokes
from .block import Block
from .layers import image_count, layer_names, strategies, strategy_count, strategy_index
from .replicates import Replicates, Spread


def even(count: int) -> int:
    """So many numbers and a last one of 0 if need be: Dr.Jit adds an even number as a packet."""
    return count + count % 2


@dataclass(frozen=True)
class Channels:
    """Order of a pixel's sums of camera samples.

    So many ``colours``, ``alpha`` (0 or 1 of it), the filter's weight W, so many ``features``, and numbers
    of ``stokes`` vectors besides the colours. Splats have colours and Stokes vectors alone.
    """

    colours: int
    alpha: int
    features: int
    stokes: int = 0

    @classmethod
    def of(cls, film, colours: int, features: int, stokes: int) -> Channels:
        """Those of a film that keeps so many colours, features, and numbers of Stokes vectors."""
        return cls(colours, int(mi.has_flag(film.flags(), mi.FilmFlags.Alpha)), features, stokes)

    @property
    def of_colours(self) -> slice:
        """Place of the colours, also among the sums of splats."""
        return slice(0, self.colours)

    @property
    def weight(self) -> int:
        """Place of the filter's weight."""
        return self.colours + self.alpha

    @property
    def of_features(self) -> slice:
        """Place of the features."""
        return slice(self.weight + 1, self.weight + 1 + self.features)

    @property
    def of_stokes(self) -> slice:
        """Place of the Stokes vectors."""
        return slice(self.of_features.stop, self.of_features.stop + self.stokes)

    @property
    def of_stokes_light(self) -> slice:
        """Place of the Stokes vectors among the sums of splats."""
        return slice(self.colours, self.colours + self.stokes)

    @property
    def camera(self) -> int:
        """Numbers of a pixel in the sums of camera samples."""
        return even(self.of_stokes.stop)

    @property
    def light(self) -> int:
        """Numbers of a pixel in the sums of splats."""
        return even(self.of_stokes_light.stop)

    def sample(self, colours, alpha, features, stokes) -> list:
        """A camera sample of filter weight 1, in the order of the sums."""
        return [*colours, *[alpha] * self.alpha, mi.Float(1), *features, *stokes]


# The blocks of sums, as `Snapshot.arrays` calls them.
_NAMES = ("camera", "light", "strategies")


class Accumulator:
    """Collects the samples of one render.

    ``film`` Mitsuba's film; ``colour`` what it keeps of a spectrum, see `colour`; ``border`` how many
    pixels camera samples reach beyond the crop window; ``depth`` the largest path length of the strategy
    images, 0 for none, ``merges`` whether there is one of those too; ``variance`` whether the layers of the
    variance are wanted, see `close_replicate`; ``features`` the `FeatureLayers` that camera samples bring
    along, or ``None``.
    """

    def __init__(self, film, colour, border: int, depth: int, merges: bool, variance: bool, features):
        self.film, self.colour, self.features = film, colour, features
        self.border = border
        self.depth = depth
        self.size = [int(x) for x in film.crop_size()]
        self.offset = [int(x) for x in film.crop_offset()]
        self.rfilter = film.rfilter()
        self.variance, self.replicates = variance, Replicates()
        names = features.names if features else []
        guides = features is not None and features.guides
        self.stokes = colour.stokes
        colour.prepare(
            layer_names(depth, variance, names, colour.names, merges, guides, self.stokes is not None)
        )
        self._channels = Channels.of(
            film, len(colour.names), features.count if features else 0, stokes.POLARIZED if self.stokes else 0
        )
        self.camera = self._block(self._channels.camera, dr.ReduceMode.Local, mi.ArrayXf)
        # In single precision the 2^22 splats of a small lamp on its one pixel are off by 0.3 %.
        self.light = self._block(self._channels.light, dr.ReduceMode.Direct, mi.ArrayXd)
        # One strip of rows per strategy, far enough apart for the filter.
        self._stride = self.size[1] + 2 * (self.rfilter.border_size() + border)
        rows = image_count(depth, merges) * self._stride
        self.strategies = self._block(6, dr.ReduceMode.Direct, mi.ArrayXd, rows) if depth else None
        self._done: tuple[list, tuple[int, ...]] = ([], ())  # sums and passes
        self._share = [self._covered(n) for n in self.size]

    def _block(self, channels: int, mode, packet, height: int | None = None):
        size = [self.size[0], height or self.size[1]]
        return Block(size, self.offset, channels, self.rfilter, mode, packet)

    @property
    def alpha(self) -> bool:
        """Whether the film keeps alpha."""
        return bool(self._channels.alpha)

    def put_camera(self, position, values, active):
        """Add a camera sample (sum over all strategies with t >= 2) with filter weight 1.

        ``values``: colours, alpha, features, and what `Stokes` says, or nothing.
        """
        self.camera.put(position, self._channels.sample(*values), active)

    def put_light(self, position, colours, polarized, active):
        """Add a splat at a continuous film position; ``polarized``: what `Stokes` says of it, or nothing."""
        self.light.put(position, [*colours, *polarized], active)

    def put_strategy(self, position, weighted, unweighted, c, active):
        """Add to the technique images of the strategy of the contribution ``c``."""
        if self.strategies is None:
            raise ValueError("an accumulator of depth 0 has no strategy images")
        values = [*(weighted[i] for i in range(3)), *(unweighted[i] for i in range(3))]
        index = strategy_count(self.depth) if c.kind == "merge" else strategy_index(c.s, c.t)
        self.strategies.put(position, values, active, index * self._stride)

    def evaluate(self, *others):
        """Run what was recorded since the last call as one kernel, ``others`` with it."""
        dr.eval([b.data for b in self._blocks()], *others)

    def _blocks(self):
        return [b for b in (self.camera, self.light, self.strategies) if b is not None]

    @property
    def passes(self) -> tuple[int, ...]:
        """Samples per pixel of each pass that is in the sums."""
        return self._done[1]

    def close_pass(self, spp: int):
        """Add the sums of a pass with ``spp`` samples per pixel to those of all, in double precision."""
        blocks = self._blocks()
        sums = [mi.Float64(b.data) for b in blocks]
        before, passes = self._done
        if before:
            sums = [a + b for a, b in zip(before, sums, strict=True)]
        dr.eval(sums)
        self._done = (sums, (*passes, spp))  # at once: Ctrl-C may come between any two steps
        for b in blocks:
            b.clear()

    def store(self) -> tuple[tuple[int, ...], dict]:
        """Passes and raw sums for a `Snapshot`: arrays of Dr.Jit or NumPy, none of which changes any more."""
        sums, passes = self._done
        return passes, self.replicates.store() | dict(zip(_NAMES, sums, strict=False))

    @property
    def halves(self) -> tuple[Spread, Spread] | None:
        """The `Spread` of either half of the replicates, ``None`` without the variance."""
        return self.replicates.halves if self.variance else None

    def ends_replicates(self) -> bool:
        """Whether all passes belong to whole replicates."""
        return self.variance and self.replicates.spp == sum(self.passes) > 0

    def restore(self, passes: tuple[int, ...], arrays: dict, halves: tuple[Spread, Spread] | None):
        """Go on from what `store` and `halves` gave after these ``passes``."""
        sums = [mi.Float64(arrays[name]) for name in _NAMES if name in arrays]
        for block, s, name in zip(self._blocks(), sums, _NAMES, strict=False):
            if len(s) != len(block.data):
                raise UsageError(f"the snapshot has {len(s)} numbers of {name}, not {len(block.data)}")
        self._done = (sums, tuple(passes))
        if halves is not None:
            self.replicates.restore(halves, arrays)

    def close_replicate(self):
        """Count what was added since the last call as one independent replicate of the image."""
        sums, passes = self._done
        self.replicates.add([np.array(s) for s in sums[:2]], sum(passes), self._image)

    def error(self) -> float:
        """Estimated relMSE of the image, see `Replicates.error`."""
        return self.replicates.error(sum(self.passes), np.array(self.colour.unit))

    def _image(self, camera, light, spp: int):
        """Image (height, width, colours) of sums over ``spp`` samples per pixel."""
        pixels = self._pixels(camera, light)
        return pixels.colours / pixels.weight + pixels.light / self._splat_weight(spp)[..., None]

    def _pixels(self, camera, light) -> _Pixels:
        """The sums of an image, ordered by pixels."""
        w, h = self.size
        camera, light, channels = camera.reshape(h, w, -1), light.reshape(h, w, -1), self._channels
        return _Pixels(
            colours=camera[..., channels.of_colours],
            alpha=camera[..., channels.colours : channels.weight],
            weight=camera[..., channels.weight, None],
            features=camera[..., channels.of_features],
            light=light[..., channels.of_colours],
            polarized=(camera[..., channels.of_stokes], light[..., channels.of_stokes_light]),
        )

    def mean(self):
        """Mean of the image so far, the scale of roulette: a ``Float64`` of width 1, not yet evaluated.

        Of the colours, each in its unit, the largest.
        """
        channels, blocks = self._channels, zip(self._done[0][:2], (self.camera, self.light), strict=True)
        camera, light = (
            [dr.sum(sums[i :: block.channels]) for i in range(channels.colours)] for sums, block in blocks
        )
        weight = dr.sum(self._done[0][0][channels.weight :: self.camera.channels])
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
        """Store the result of the passes so far in the film, in the place of what was stored before."""
        sums, passes = self._done
        if not passes:
            return
        spp = sum(passes)
        pixels = self._pixels(*(np.array(s) for s in sums[:2]))
        to_film = pixels.weight / self._splat_weight(spp)[..., None]
        colours = np.concatenate([pixels.colours + pixels.light * to_film, pixels.alpha], axis=-1)
        layers = []
        if self.stokes is not None:
            of_camera, of_light = pixels.polarized
            layers += [colours[..., : self._channels.colours], of_camera + of_light * to_film]
        if self.features is not None and self.features.guides:
            layers += self._denoised(pixels, colours)
        else:
            layers.append(pixels.features)
        if self.variance:
            layers.append(self.replicates.variance(spp, pixels.colours.shape) * pixels.weight)
        if self.depth:
            layers += self._strategy_layers(sums[2], to_film)
        parts = self.colour.stored(colours, pixels.weight, layers)
        values = np.concatenate(parts, axis=-1).astype(np.float32)
        block = mi.ImageBlock(mi.TensorXf(values), self.offset, border=False)
        self.film.clear()  # of what was stored before
        self.film.put_block(block)

    def _denoised(self, pixels: _Pixels, colours) -> list:
        """The features that are layers of the film, and the image of these ``colours`` without noise."""
        shown, guides = np.split(pixels.features, [len(self.features.names)], axis=-1)
        # A pixel without samples (of a filter that is negative somewhere) has nothing to be divided.
        weight = np.where(pixels.weight == 0, 1, pixels.weight)
        image, guides = colours[..., : self._channels.colours] / weight, guides / weight
        found = denoising.denoised(image, guides[..., denoising.ALBEDO], guides[..., denoising.NORMAL])
        return [shown, found * pixels.weight]

    def _strategy_layers(self, sums, to_film) -> list:
        """The strategy images in the order of their layers; ``to_film``: what splats are multiplied by."""
        w, h = self.size
        tall = np.array(sums).reshape(-1, self._stride, w, 6)[:, :h]
        splats = [t <= 1 for _, _, t in strategies(self.depth)]
        splats += [False] * (len(tall) - len(splats))  # merges
        return [image * (to_film if splat else 1) for image, splat in zip(tall, splats, strict=True)]


@dataclass
class _Pixels:
    """Sums of an image, shape (height, width, numbers of each kind).

    Those of camera samples, and of ``light``, the splats; ``polarized`` of both.
    """

    colours: np.ndarray
    alpha: np.ndarray
    weight: np.ndarray
    features: np.ndarray
    light: np.ndarray
    polarized: tuple[np.ndarray, np.ndarray]
