"""Statistics of a pilot: errors of all candidates, from the arrays of a `pilot.Pilot`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .configuration import CANDIDATES

# Rows that a pilot stores, by name of a part: `SAMPLE` of camera samples, `SPLAT` of cells.
Rows = dict[str, np.ndarray]

# Candidates with inner connections, the last ones, and those with several light subpaths per lane.
WITH_INNER = tuple(candidate for candidate in CANDIDATES if candidate.connections != "none")
_SEVERAL = [number for number, candidate in enumerate(CANDIDATES) if candidate.joined > 1]

# Sums of a camera sample over its contributions, with their number: estimates; second and fourth moments
# ("peak"), less the powers of contributions in the estimate without t<=1; variance of drawing one inner
# connection, for `WITH_INNER`; sum of the inner connections, for `_SEVERAL`. Then of the last candidate the
# second moment due to t<=1 ("light") and the light that it finds.
SUMS = {
    "estimate": len(CANDIDATES),
    "moment": len(CANDIDATES),
    "peak": len(CANDIDATES),
    "draw": len(WITH_INNER),
    "several": len(_SEVERAL),
    "light": 1,
    "brightness": 1,
}

# Row of a camera sample, with its fine tile and, in scenes with media, the number of evaluated pairs. Each
# `PER_PIXEL` consecutive samples are of one pixel.
SAMPLE = SUMS | {"tile": 1, "evaluated": 1}

# Row of the splats in a cell (group of the light subpath, fine tile): their size and moments.
SPLAT = {"size": 1, "moment": len(CANDIDATES), "peak": len(CANDIDATES)}


def width(parts: dict[str, int]) -> int:
    """Numbers per row, even: Dr.Jit then adds it as a packet."""
    used = sum(parts.values())
    return used + used % 2


def split(rows: np.ndarray, parts: dict[str, int]) -> Rows:
    """Split flat ``rows`` into their parts, shape (rows, size of the part)."""
    columns = np.split(rows.reshape(-1, width(parts)), np.cumsum([*parts.values()]), axis=1)
    return dict(zip(parts, columns, strict=False))  # without the padding


# Tiles of the image per direction: fine ones with their own brightness, and larger ones that replace it where
# it is noisy. (A caustic and its shadow are smaller than the larger tiles.)
FINE, TILES = 32, 8

EMISSION_TILES = 4  # the same for emission statistics
GROUPS = 16  # independent parts of the pilot, for resampling
PER_PIXEL = 2  # least number of camera samples per pixel; their products estimate the squared mean

# Share of the pixels of a render whose errors the trimmed error leaves out. Contributions that fewer pixels
# receive are not in the variance of a typical render, but their light is missing from it.
TRIMMED = 1e-3

RULED_OUT = 1e15  # candidates of a larger relative variance are ruled out, see `pilot.LOST`


@dataclass(frozen=True)
class Moments:
    """What a pilot measured.

    * ``errors``, shape (2, `GROUPS`, candidates): relative squared error per sample and pixel, first the mean
      of many renders, then that of a typical one, in which contributions that fewer than `TRIMMED` of the
      pixels receive are missing.
    * ``guidable``: both errors of s = 0 on SDS paths that photons can guide, which no other field includes.
    * ``mean`` of the image over the colours, without directly seen emitters; the median of the groups' means.
    * ``rays``: rays and connections per camera sample by kind, with one light subpath each.
    * ``non_finite``: number of non-finite values, counted as zero.
    * ``emission``: emission statistics, see `_of_tiles`.
    """

    errors: np.ndarray
    guidable: tuple[float, float]
    mean: float
    rays: dict[str, float]
    non_finite: int = 0
    emission: np.ndarray | None = None


class GuidableLight(NamedTuple):
    """SDS light that photons can guide s = 0 to find, per camera sample, by fine tile.

    ``light``: mean over the colours; ``second``, ``fourth``: moments of its samples by s = 0 without guiding;
    ``vertices``: number at which s = 0 is guided; ``rare`` part of ``light``: `unsampled_light.FEWEST_HITS`.
    """

    light: np.ndarray
    second: np.ndarray
    fourth: np.ndarray
    vertices: np.ndarray
    rare: np.ndarray


def group(lane):
    """Index of the independent part of a sample, or of a lane's light subpath; one for all of a pixel."""
    return lane // PER_PIXEL % GROUPS


def moments(
    samples: Rows,
    splats: Rows,
    rays: dict[str, float],
    spp: float,
    guidable: GuidableLight,
    emission: np.ndarray | None,
) -> Moments:
    """The moments of a pilot for a render of ``spp`` samples per pixel.

    ``splats`` and ``rays`` are per camera sample, with one light subpath each; ``emission``: see
    `guided_emission.EmissionStatistics`.
    """
    brightness = samples["brightness"][:, 0]
    count, groups = len(brightness), group(np.arange(len(brightness)))
    sizes = splats["size"].reshape(GROUPS, -1) + guidable.light / GROUPS
    inverse = 1 / _norms(samples, np.stack([sizes[half::2].sum(axis=0) for half in (0, 1)]))
    by_group = np.bincount(groups, brightness, GROUPS) / count + sizes.sum(axis=1)
    return Moments(
        errors=_errors(samples, splats, inverse, spp),
        guidable=_of_guidable(guidable, inverse.mean(axis=0), spp),
        emission=None if emission is None else _of_tiles(emission, samples, sizes.sum(axis=0)),
        mean=float(np.median(by_group) * GROUPS),
        rays=rays,
        non_finite=round(rays["non_finite"] * count),
    )


def _errors(samples: Rows, splats: Rows, inverse: np.ndarray, spp: float) -> np.ndarray:
    """`Moments.errors`; ``inverse`` of the norms.

    Camera samples and cells of splats count as contributions of one size each: of second moment m and fourth
    p they have the squared size p / m and the rate m^2 / p. A typical render lacks those of `_rare`. Their
    light is taken to lie in the fine tiles that the pilot met.
    """
    count, candidates = samples["estimate"].shape
    lane, cell = np.arange(count), np.arange(GROUPS * FINE**2)
    groups = np.concatenate((group(lane), cell // FINE**2))
    tiles = np.concatenate((samples["tile"][:, 0].astype(int), cell % FINE**2))
    inverse = inverse[groups % 2, tiles][:, None]
    square = _without_products(np.square, samples) + samples["moment"]
    power = _without_products(lambda x: x**4, samples, 4) + samples["peak"]
    own = square - _without_products(lambda x: x * _other(x), samples)
    second = np.concatenate((square / count, splats["moment"])) * inverse
    fourth = np.concatenate((power / count, splats["peak"])) * inverse**2
    variance = np.concatenate((own / count, splats["moment"])) * inverse
    draw = np.zeros((count, candidates))
    draw[:, -len(WITH_INNER) :] = samples["draw"] / count * inverse[:count]
    errors = np.zeros((2, GROUPS, candidates))
    for c in range(candidates):
        m, p = second[:, c], fourth[:, c]
        real = np.flatnonzero((m > 0) & (p > 0) & np.isfinite(p))
        rare = real[_rare(m[real], p[real], spp)]
        missed = np.bincount(tiles[rare], m[rare] * np.sqrt(m[rare] / p[rare]), FINE**2) * FINE**2
        whole = np.bincount(groups, variance[:, c], GROUPS) + np.bincount(group(lane), draw[:, c], GROUPS)
        hidden = np.bincount(groups[rare], variance[rare, c], GROUPS) * GROUPS
        whole = np.where(whole * GROUPS < RULED_OUT, whole * GROUPS, np.inf)
        errors[:, :, c] = whole, whole - hidden + spp * np.mean(missed**2)
    return errors


def _without_products(of: Callable[[np.ndarray], np.ndarray], samples: Rows, power: int = 2) -> np.ndarray:
    """``of`` the estimates, of degree ``power``, without products of independent connections (`_SEVERAL`)."""
    found = of(samples["estimate"])
    for i, candidate in enumerate(_SEVERAL):
        several = CANDIDATES[candidate].counts["inner"]
        found[:, [candidate]] -= (1 - several ** (1 - power)) * of(samples["several"][:, [i]])
    return found


def _rare(second: np.ndarray, fourth: np.ndarray, spp: float) -> np.ndarray:
    """Indices of the contributions of the largest squared error, up to a rate of `TRIMMED` per pixel."""
    order = np.argsort(-fourth / second, kind="stable")
    return order[np.cumsum((second**2 / fourth)[order]) * spp < TRIMMED]


def _of_guidable(guidable: GuidableLight, inverse: np.ndarray, spp: float) -> tuple[float, float]:
    """`Moments.guidable`: each fine tile is one contribution, see `_errors`."""
    lit = np.flatnonzero(guidable.second)
    light, second, fourth = (x[lit] * inverse[lit] ** n for x, n in zip(guidable, (0.5, 1, 2), strict=False))
    rare = _rare(second, fourth, spp)
    missing = spp * FINE**2 * float((light[rare] ** 2).sum())
    return float(second.sum()), float(np.delete(second, rare).sum()) + missing


def _of_tiles(emission: np.ndarray, samples: Rows, splats: np.ndarray) -> np.ndarray:
    """Emission statistics relative to `_brightness`, shape (2, cells, columns), per sample."""
    brightness = _brightness(samples, splats, EMISSION_TILES).ravel()
    norms = brightness**2 + 0.01 * brightness.mean() ** 2
    inverse = 1 / np.where(norms > 0, norms, np.inf)
    found = np.einsum("htck,t->hck", emission, inverse) / len(samples["tile"])
    return found if np.isfinite(found).all() else np.zeros_like(found)


def _brightness(samples: Rows, splats: np.ndarray, tiles: int) -> np.ndarray:
    """Brightness of ``tiles``^2 tiles; ``splats``: shares of the fine tiles in that of the image."""
    tile, many = samples["tile"][:, 0].astype(int), FINE // tiles
    fine = (
        np.bincount(tile, minlength=FINE**2),
        np.bincount(tile, samples["brightness"][:, 0], FINE**2),
        splats,
    )
    counts, sums, splats = (x.reshape(tiles, many, tiles, many).sum(axis=(1, 3)) for x in fine)
    return sums / np.maximum(counts, 1) + splats * tiles**2


def _other(estimate: np.ndarray) -> np.ndarray:
    """For each sample another sample of its pixel."""
    return estimate.reshape(-1, PER_PIXEL, estimate.shape[1])[:, ::-1].reshape(estimate.shape)


def _norms(samples: Rows, splats: np.ndarray) -> np.ndarray:
    """Denominators of the squared errors by fine tile, shape (2, tiles).

    Squared brightness plus 0.01 of the image's squared mean brightness, as in relMSE. For the groups of even
    and of odd index the brightness is that of the other half: an outlier would hide itself. ``splats``:
    shares of the halves in the image, shape (2, tiles).
    """
    tile, last = samples["tile"][:, 0].astype(int), samples["brightness"]
    place = group(np.arange(len(tile))) % 2 * FINE**2 + tile
    counts = np.bincount(place, minlength=2 * FINE**2).reshape(2, FINE, FINE).astype(float)
    sums = np.bincount(place, last[:, 0], 2 * FINE**2).reshape(2, FINE, FINE)
    fine = counts, sums, splats.reshape(2, FINE, FINE) * FINE**2  # of splats: radiance, half in each
    coarse = _brightness(samples, splats.sum(axis=0), TILES)
    floor = 0.01 * coarse.mean() ** 2
    coarse = np.kron(coarse, np.ones((FINE // TILES, FINE // TILES)))
    # Weight of the larger tile against a tile's own samples: their noise.
    square = (last**2 + samples["moment"][:, -1:] - samples["light"] - last * _other(last))[:, 0]
    first = (coarse**2 + floor).ravel()[tile]
    noise = np.sum(square / np.where(first > 0, first, np.inf)) / len(tile)
    least = 2 * max(noise, 1e-3)
    near, light, splat = (_with_neighbours(x[::-1]) for x in fine)
    own = light / np.maximum(near, 1) + 2 * splat / _with_neighbours(np.ones_like(coarse))
    norms = ((near * own + least * coarse) / (near + least)) ** 2 + floor
    return np.where(norms > 0, norms, np.inf).reshape(2, -1)


def _with_neighbours(values: np.ndarray) -> np.ndarray:
    """Sums over squares of 3 x 3 tiles of the last two axes."""
    padded = np.pad(values, [(0, 0)] * (values.ndim - 2) + [(1, 1)] * 2)
    rows = padded[..., :-2, :] + padded[..., 1:-1, :] + padded[..., 2:, :]
    return rows[..., :-2] + rows[..., 1:-1] + rows[..., 2:]
