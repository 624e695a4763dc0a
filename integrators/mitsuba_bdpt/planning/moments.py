"""Statistics of a pilot: variances of all candidates.

NumPy arithmetic on the arrays of a `pilot.Pilot`, whose module has the equations. `SAMPLE` and `SPLAT` are
the rows that a pilot stores.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

import mitsuba as mi
import numpy as np

from ..transport import mis
from .configuration import CANDIDATES

if TYPE_CHECKING:
    Lanes = TypeVar("Lanes", np.ndarray, mi.UInt32)


@dataclass(frozen=True)
class Layout:
    """Named parts of a row: their sizes, in order."""

    parts: dict[str, int]

    @property
    def width(self) -> int:
        """Numbers per row, even: Dr.Jit then adds it as a packet."""
        used = sum(self.parts.values())
        return used + used % 2

    def place(self, name: str) -> slice:
        """Slice of a part."""
        names = list(self.parts)
        first = sum(self.parts[other] for other in names[: names.index(name)])
        return slice(first, first + self.parts[name])

    def of(self, rows: np.ndarray, name: str) -> np.ndarray:
        """A part of all rows, along the last axis."""
        return rows[..., self.place(name)]

    def row(self, values: Mapping[str, list[Any]]) -> list[Any]:
        """One row from lists by the names of its parts."""
        return [x for name in self.parts for x in values[name]]


# Number of candidates that use a class of strategies: the last ones.
_USERS = {kind: sum(c.weights[kind] > 0 for c in CANDIDATES) for kind in mis.CLASSES}

# Candidates with several light subpaths per lane.
_SEVERAL = [number for number, candidate in enumerate(CANDIDATES) if candidate.joined > 1]

# Per camera sample, for each candidate: estimate, and second moments of contributions without t<=1, less
# their squares; for each candidate with t<=1 the second moments due to t<=1; for each candidate with inner
# connections the variance of drawing one; fourth moments of the contributions of all classes, less their
# fourth powers; for each of `_SEVERAL` the sum of the inner connections. Then the light that the last
# candidate finds, and the tile; in scenes with media the number of evaluated pairs, else 0.
SAMPLE = Layout(
    {
        "estimate": len(CANDIDATES),
        "moment": len(CANDIDATES),
        "light": _USERS["light"],
        "draw": _USERS["inner"],
        "peak": len(CANDIDATES),
        "several": len(_SEVERAL),
        "brightness": 1,
        "tile": 1,
        "evaluated": 1,
    }
)

# Parts of `SAMPLE` that are sums over contributions.
SUMS = ("estimate", "moment", "light", "draw", "peak", "several", "brightness")

# Size of splats, their second moments without t <= 1, those due to t <= 1, and fourth powers.
SPLAT = Layout(
    {
        "size": 1,
        "moment": len(CANDIDATES),
        "light": _USERS["light"],
        "peak": len(CANDIDATES),
    }
)

# Tiles of the image per direction: fine ones with their own brightness, and larger ones that replace it where
# it is noisy. (A caustic and its shadow are smaller than the larger tiles.)
FINE, TILES = 32, 8

# The same for emission statistics.
EMISSION_TILES = 4

# Independent parts of the pilot, for resampling.
GROUPS = 16

# Least number of camera samples per pixel; their products estimate the squared mean.
PER_PIXEL = 2

# Share of the pixels of a render whose errors the trimmed error leaves out. Contributions that fewer pixels
# receive are not in the variance of a typical render, but their light is missing from it.
TRIMMED = 1e-3

# Candidates of a larger relative variance are ruled out, see `pilot.LOST`.
RULED_OUT = 1e15

# Fields of `Moments` with a row per group.
_OF_GROUPS = ("variance", "typical")


@dataclass(frozen=True)
class Moments:
    """What a pilot measured: relative squared error per sample and pixel.

    * ``variance``, shape (`GROUPS`, candidates): the mean of the squared errors of many renders.
    * ``typical``: the same of a typical render, in which contributions that fewer than `TRIMMED` of the
      pixels receive are missing.
    * ``guidable``: both of s = 0 by SDS paths on which photons can guide it, which are in no other figure.
    * ``mean`` of the image over the colours, without directly seen emitters; the median of the groups' means.
    * ``rays``: rays and connections per camera sample by kind, with one light subpath each.
    * ``lanes``: number of camera samples.
    * ``emission``: emission statistics, see `_of_tiles` (no cells: none).
    """

    variance: np.ndarray
    typical: np.ndarray
    guidable: tuple[float, float]
    mean: float
    rays: dict[str, float]
    lanes: int
    emission: np.ndarray = field(default_factory=lambda: np.zeros((2, 0, 0)))

    @property
    def non_finite(self) -> int:
        """Number of non-finite values, counted as zero."""
        return round(self.rays["non_finite"] * self.lanes)

    def of(self, groups: np.ndarray) -> Moments:
        """The moments of the groups with these indices."""
        return replace(self, **{n: getattr(self, n)[groups] for n in _OF_GROUPS})


@dataclass(frozen=True)
class Samples:
    """Camera samples of a pilot, one row each.

    ``estimate`` by candidate; sums of second moments (``moment`` without t <= 1, less the squares that are in
    the estimate, ``light`` due to t <= 1); ``draw``: variance of drawing one connection; ``peak``: fourth
    moments, less the powers in the estimate; ``several``: inner connections of `_SEVERAL`; ``brightness``:
    the last candidate's light; fine ``tile``. Each `PER_PIXEL` consecutive samples are of one pixel.
    """

    estimate: np.ndarray
    moment: np.ndarray
    light: np.ndarray
    draw: np.ndarray
    peak: np.ndarray
    several: np.ndarray
    brightness: np.ndarray
    tile: np.ndarray

    @staticmethod
    def of_rows(rows: np.ndarray) -> Samples:
        """Parse rows of `SAMPLE`."""
        found = {f.name: SAMPLE.of(rows, f.name) for f in fields(Samples)}
        single = {"brightness": found["brightness"][:, 0], "tile": found["tile"][:, 0].astype(int)}
        return Samples(**found | single)


@dataclass(frozen=True)
class Splats:
    """Sums of the splats of ``lanes`` light subpaths.

    Shape (`GROUPS`, fine tiles, `SPLAT`), by the group of the subpath and fine tile.
    """

    sums: np.ndarray
    lanes: int


def group(lane: Lanes) -> Lanes:
    """Index of the independent part of a sample, or of a lane's light subpath.

    The `PER_PIXEL` samples of a pixel, whose products are taken, belong to one group.
    """
    return lane // PER_PIXEL % GROUPS


def _dark() -> np.ndarray:
    return np.zeros(FINE**2)


@dataclass(frozen=True)
class GuidableLight:
    """SDS light that photons can guide s = 0 to find, per camera sample.

    By fine tile ``light``, and the ``second`` and ``fourth`` moments of samples of s = 0 without guiding;
    ``vertices`` at which s = 0 is guided.
    """

    light: np.ndarray = field(default_factory=_dark)
    second: np.ndarray = field(default_factory=_dark)
    fourth: np.ndarray = field(default_factory=_dark)
    vertices: float = 0.0


def moments(
    samples: Samples,
    splats: Splats,
    rays: dict[str, float],
    spp: float,
    guidable: GuidableLight,
    emission: np.ndarray | None = None,
) -> Moments:
    """The moments of a pilot for a render of ``spp`` samples per pixel.

    ``splats`` are normalised to one light subpath per camera sample; ``rays`` are per camera sample;
    ``guidable`` light is in no sample; ``emission``: see `guided_emission.EmissionStatistics`.
    """
    count = len(samples.tile)
    width = samples.estimate.shape[1]
    sizes = SPLAT.of(splats.sums, "size").sum(axis=2) / splats.lanes
    sizes = sizes + guidable.light / GROUPS
    groups = group(np.arange(count))
    inverse = 1 / _norms(samples, groups % 2, np.stack([sizes[half::2].sum(axis=0) for half in (0, 1)]))
    of_group = inverse[np.arange(GROUPS) % 2][:, None]
    weighted = np.matmul(of_group, splats.sums)[:, 0] * (GROUPS / splats.lanes)
    of_sample = inverse[groups % 2, samples.tile][:, None]

    def summed(values: np.ndarray, of_splats: str | None = None) -> np.ndarray:
        """Sums by group and candidate; candidates without ``values`` come first."""
        total = _by_group(values * of_sample) * (GROUPS / count)
        return _padded(total + SPLAT.of(weighted, of_splats) if of_splats else total, width)

    estimate = samples.estimate
    squares = _second(samples) - estimate * _other(estimate)
    for i, candidate in enumerate(_SEVERAL):
        # As if all of their variance were that of the light subpaths.
        own, several = samples.several[:, i : i + 1], CANDIDATES[candidate].counts["inner"]
        squares[:, [candidate]] += (1 - 1 / several) * own * _other(own)
    variance = summed(squares, "moment") + summed(samples.light, "light") + summed(samples.draw)
    variance = np.where(variance < RULED_OUT, variance, np.inf)
    hidden, missing = _hidden(samples, squares, splats, inverse, spp)
    by_group = _by_group(samples.brightness[:, None])[:, 0] / count + sizes.sum(axis=1)
    return Moments(
        variance=variance,
        typical=variance - hidden + missing,
        guidable=_of_guidable(guidable, inverse.mean(axis=0), spp),
        emission=_of_tiles(emission, samples, sizes.sum(axis=0)),
        mean=float(np.median(by_group) * GROUPS),
        rays=rays,
        lanes=count,
    )


def _second(samples: Samples, power: int = 2) -> np.ndarray:
    """Second moments of camera samples without t <= 1, or fourth ones with ``power`` = 4.

    Connections of `_SEVERAL` with different light subpaths are independent.
    """
    found = samples.estimate**power + (samples.moment if power == 2 else samples.peak)
    for i, candidate in enumerate(_SEVERAL):
        several = CANDIDATES[candidate].counts["inner"]
        found[:, candidate] -= (1 - several ** (1 - power)) * samples.several[:, i] ** power
    return found


def _hidden(
    samples: Samples, squares: np.ndarray, splats: Splats, inverse: np.ndarray, spp: float
) -> tuple[np.ndarray, np.ndarray]:
    """The variance in contributions that a typical render lacks, and the squared error of lacking them.

    By group and candidate, and by candidate; ``squares`` of the camera samples as in `Moments.variance`.
    Camera samples and cells of splats count as contributions of one size each: of second moment m and fourth
    p they have the squared size p / m and the rate m^2 / p. Those of the largest squared error, up to a rate
    of `TRIMMED` per pixel, are hidden. Their light is taken to lie in the fine tiles that the pilot met.
    """
    count, width = samples.estimate.shape
    groups = group(np.arange(count))
    of_sample = inverse[groups % 2, samples.tile][:, None]
    of_cell = inverse[np.arange(GROUPS) % 2].reshape(-1, 1)

    def contributions(values: np.ndarray, part: str, power: int = 1) -> np.ndarray:
        cells = _padded(SPLAT.of(splats.sums, part).reshape(len(of_cell), -1), width)
        values = _padded(values, width) * of_sample**power / count
        return np.concatenate((values, cells * of_cell**power / splats.lanes))

    light = contributions(samples.light, "light")
    second = contributions(_second(samples), "moment") + light
    fourth = contributions(_second(samples, 4), "peak", 2)
    part = contributions(squares, "moment") + light
    tile = np.concatenate((samples.tile, np.tile(np.arange(FINE**2), GROUPS)))
    of_group = np.concatenate((groups, np.repeat(np.arange(GROUPS), FINE**2)))
    hidden, missing = np.zeros((GROUPS, width)), np.zeros(width)
    for c in range(width):
        real = np.flatnonzero((second[:, c] > 0) & (fourth[:, c] > 0) & np.isfinite(fourth[:, c]))
        m, p = second[real, c], fourth[real, c]
        rare = _rare(m, p, spp)
        where = real[rare]
        hidden[:, c] = np.bincount(of_group[where], part[where, c], GROUPS) * GROUPS
        missed = np.bincount(tile[where], m[rare] * np.sqrt(m[rare] / p[rare]), FINE**2) * FINE**2
        missing[c] = spp * np.mean(missed**2)
    return hidden, missing


def _rare(second: np.ndarray, fourth: np.ndarray, spp: float) -> np.ndarray:
    """Indices of the contributions of the largest squared error, up to a rate of `TRIMMED` per pixel."""
    order = np.argsort(-fourth / second, kind="stable")
    return order[np.cumsum((second**2 / fourth)[order]) * spp < TRIMMED]


def _of_guidable(guidable: GuidableLight, inverse: np.ndarray, spp: float) -> tuple[float, float]:
    """Relative squared error per sample of guidable light: of the mean render, and of a typical one.

    Each fine tile counts as one contribution, see `_hidden`; ``inverse`` of its squared brightness.
    """
    lit = np.flatnonzero(guidable.second)
    second, inverse = guidable.second[lit], inverse[lit]
    hidden = _rare(second * inverse, guidable.fourth[lit] * inverse**2, spp)
    missing = spp * FINE**2 * float((guidable.light[lit] ** 2 * inverse)[hidden].sum())
    variance = second * inverse
    return float(variance.sum()), float(np.delete(variance, hidden).sum()) + missing


def _padded(values: np.ndarray, width: int) -> np.ndarray:
    """``values`` of the last candidates with zeros of those before."""
    return np.pad(values, ((0, 0), (width - values.shape[-1], 0)))


def _of_tiles(emission: np.ndarray | None, samples: Samples, splats: np.ndarray) -> np.ndarray:
    """Emission statistics relative to the brightness of `EMISSION_TILES`^2 tiles.

    Shape (2, cells, columns), per sample; no cells if ``emission`` is None. ``splats``: shares of the fine
    tiles in the image's brightness.
    """
    if emission is None:
        return np.zeros((2, 0, 0))

    def over_tiles(values: np.ndarray) -> np.ndarray:
        return _sums_of_blocks(values, EMISSION_TILES).ravel()

    last = samples.brightness
    counts = over_tiles(np.bincount(samples.tile, minlength=FINE**2).astype(float))
    brightness = over_tiles(np.bincount(samples.tile, last, FINE**2)) / np.maximum(counts, 1)
    brightness += over_tiles(splats) * EMISSION_TILES**2
    norms = brightness**2 + 0.01 * brightness.mean() ** 2
    found = np.einsum("htck,t->hck", emission, 1 / np.where(norms > 0, norms, np.inf)) / len(last)
    return found if np.isfinite(found).all() else np.zeros_like(found)


def _other(estimate: np.ndarray) -> np.ndarray:
    """For each sample another sample of its pixel."""
    return estimate.reshape(-1, PER_PIXEL, estimate.shape[1])[:, ::-1].reshape(estimate.shape)


def _by_group(values: np.ndarray) -> np.ndarray:
    """Sums of the samples' ``values`` by group, shape (`GROUPS`, columns)."""
    whole = -(-len(values) // (GROUPS * PER_PIXEL)) * GROUPS * PER_PIXEL
    padded = np.zeros((whole, values.shape[1]))
    padded[: len(values)] = values
    return padded.reshape(-1, GROUPS, PER_PIXEL, values.shape[1]).sum(axis=(0, 2))  # see `group`


def _norms(samples: Samples, half: np.ndarray, splats: np.ndarray) -> np.ndarray:
    """Denominators of the squared errors by fine tile, shape (2, tiles).

    Squared brightness plus 0.01 of the image's squared mean brightness, as in relMSE. For each half of the
    samples, given by ``half`` (0 or 1), the brightness is that of the other half: an outlier would hide
    itself. ``splats``: shares of the halves in the image, shape (2, tiles).
    """
    last = samples.brightness
    place = half * FINE**2 + samples.tile
    counts = np.bincount(place, minlength=2 * FINE**2).reshape(2, FINE, FINE).astype(float)
    sums = np.bincount(place, last, 2 * FINE**2).reshape(2, FINE, FINE)
    splats = splats.reshape(2, FINE, FINE) * FINE**2  # radiance, half in each
    coarse = _over_blocks(sums.sum(axis=0)) / np.maximum(_over_blocks(counts.sum(axis=0)), 1)
    coarse += _over_blocks(splats.sum(axis=0)) / (FINE // TILES) ** 2
    floor = 0.01 * coarse.mean() ** 2
    # Weight of the larger tile against a tile's own samples: their noise.
    square = last**2 + samples.moment[:, -1] - last * _other(last[:, None])[:, 0]
    first = (coarse**2 + floor).ravel()[samples.tile]
    noise = np.sum(square / np.where(first > 0, first, np.inf)) / len(last)
    least = 2 * max(noise, 1e-3)
    found: list[np.ndarray] = []
    for other in (1, 0):
        near = _with_neighbours(counts[other])
        own = _with_neighbours(sums[other]) / np.maximum(near, 1)
        own += 2 * _with_neighbours(splats[other]) / _with_neighbours(np.ones_like(coarse))
        brightness = (near * own + least * coarse) / (near + least)
        found.append(brightness**2 + floor)
    norms = np.stack(found).reshape(2, -1)
    return np.where(norms > 0, norms, np.inf)


def _over_blocks(values: np.ndarray) -> np.ndarray:
    """Sums over the larger tiles, at each fine tile."""
    many = FINE // TILES
    return np.kron(_sums_of_blocks(values, TILES), np.ones((many, many)))


def _sums_of_blocks(values: np.ndarray, tiles: int) -> np.ndarray:
    """Sums of fine ``values`` over larger tiles, ``tiles`` per direction."""
    many = FINE // tiles
    return values.reshape(tiles, many, tiles, many).sum(axis=(1, 3))


def _with_neighbours(values: np.ndarray) -> np.ndarray:
    """Sums over squares of 3 x 3 tiles."""
    padded = np.pad(values, 1)
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
