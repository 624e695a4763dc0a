"""Tests whether renders agree: on the means of tiles, and bias checks.

Samples are tile means: one number per tile and render, renders with different seeds. Welch's test needs
normal samples; means of many pixels are nearly normal, single pixels are not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from ..errors import CommandError
from .metrics import CONFIDENCE, Estimate

ROUNDING = 2e-5  # relative differences of tile means up to this are attributed to float32
NONZERO_SHARE = 0.9  # tiles nonzero in a smaller share of the renders are not normal, and not tested

# Fewest renders of a bias check: in the far tail Welch's test of fewer rejects too often (of 48 values at
# 1e-3, 4 % false alarms for 5 renders, 0.9 % for 8).
FEWEST_RUNS = 8

TILES, SIGNIFICANCE = 4, 1e-3  # of a bias check: tiles along each side, probability of a false alarm


def tile_means(image: ArrayLike, tiles: int) -> np.ndarray:
    """Return means over ``tiles`` x ``tiles`` tiles, of (height, width, channels).

    Shape (tiles * tiles, channels), row by row. ``tiles`` must divide the size.
    """
    image = np.asarray(image, dtype=np.float64)
    h, w, c = image.shape
    if not isinstance(tiles, Integral) or tiles < 1 or h % tiles or w % tiles:
        raise CommandError(f"tiles={tiles!r} must be an integer that divides height {h} and width {w}.")
    parts = image.reshape(tiles, h // tiles, tiles, w // tiles, c)
    return parts.mean(axis=(1, 3)).reshape(tiles * tiles, c)


@dataclass(frozen=True)
class Sample:
    """Means and standard errors of m quantities over several renders, each (m,).

    With the errors' degrees of freedom, and the share of the renders in which each quantity is nonzero.
    """

    mean: np.ndarray
    error: np.ndarray
    freedom: float
    nonzero: np.ndarray

    @staticmethod
    def of(values: ArrayLike) -> Sample:
        """Return the sample of ``values`` (renders, m)."""
        values = np.asarray(values, dtype=np.float64)
        error = values.std(0, ddof=1) / np.sqrt(len(values))
        return Sample(values.mean(0), error, len(values) - 1.0, (values != 0).mean(0))

    def joined(self, other: Sample) -> Sample:
        """Return the sample of the renders of both."""
        a, b = self.freedom + 1, other.freedom + 1
        mean = (a * self.mean + b * other.mean) / (a + b)
        squares = sum((n - 1) * n * s.error**2 for n, s in ((a, self), (b, other)))
        squares = squares + a * b / (a + b) * (self.mean - other.mean) ** 2
        error = np.sqrt(squares / ((a + b) * (a + b - 1)))
        return Sample(mean, error, a + b - 1, (a * self.nonzero + b * other.nonzero) / (a + b))

    @staticmethod
    def known(mean: ArrayLike) -> Sample:
        """Return exact values (m,)."""
        mean = np.asarray(mean, dtype=np.float64)
        return Sample(mean, np.zeros_like(mean), np.inf, np.ones_like(mean))


class Difference(NamedTuple):
    """Differences of the means of m quantities and their significance, each (m,).

    Mean a - mean b, its standard error and degrees of freedom, the p-value, and whether the p-value is
    uniform under equality (not where rounding or few nonzero values decide).
    """

    value: np.ndarray
    error: np.ndarray
    freedom: np.ndarray
    p: np.ndarray
    continuous: np.ndarray


def welch(a: Sample, b: Sample) -> Difference:
    """Welch's two-sided t-test; Student's where one side is known exactly.

    Differences within `ROUNDING` of the larger mean count as none. p is 1 where both sides are nonzero in
    less than `NONZERO_SHARE` of the renders. Source: B. L. Welch, Biometrika 34, 1947.
    """
    error = np.hypot(a.error, b.error)
    gap = np.abs(a.mean - b.mean)
    floor = ROUNDING * np.maximum(np.abs(a.mean), np.abs(b.mean))
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(error > 0, np.maximum(gap - floor, 0) / error, np.where(gap > floor, np.inf, 0))
        share = a.error**2 / (a.error**2 + b.error**2)
        freedom = 1 / (share**2 / a.freedom + (1 - share) ** 2 / b.freedom)
    freedom = np.where(error > 0, freedom, 1.0)
    applies = np.maximum(a.nonzero, b.nonzero) >= NONZERO_SHARE
    p = np.where(applies, 2 * stats.t.sf(t, freedom), 1.0)
    return Difference(a.mean - b.mean, error, freedom, p, applies & (error > 10 * floor))


def sidak(p: ArrayLike) -> float:
    """Return the probability of so small a minimum of independent p-values."""
    p = np.asarray(p, dtype=np.float64)
    return float(-np.expm1(len(p) * np.log1p(-min(p.min(), 1 - 1e-16))))


@dataclass(frozen=True)
class BiasCheck:
    """Result of `compare_means`.

    ``passed``: no difference at the given significance; ``p``: the smallest p-value; ``family_p``: the same
    after Sidak's correction for all comparisons; ``tile``: (row, column) of the worst, None for the whole
    image; ``difference``: image - reference there, in radiance, with a simultaneous interval of all
    comparisons at confidence 1 - significance; ``missing``: `missing_energy`.
    """

    passed: bool
    p: float
    family_p: float
    tile: tuple[int, int] | None
    difference: Estimate
    missing: Estimate


def tile_columns(image: ArrayLike, tiles: int = TILES) -> np.ndarray:
    """Return `tile_means` and the means of the channels, flat, (3 tiles^2 + 3,)."""
    return np.concatenate([tile_means(image, tiles).ravel(), tile_means(image, 1).ravel()])


@dataclass(frozen=True)
class Means:
    """Samples of `tile_columns` and of the image's mean, for `compare_means`."""

    columns: Sample
    whole: Sample

    @staticmethod
    def of(columns: ArrayLike, fewest: int = FEWEST_RUNS) -> Means:
        """Return the means of ``columns`` (renders, 3 tiles^2 + 3), one seed each.

        Raises ``CommandError`` for fewer than ``fewest``.
        """
        values = np.asarray(columns, dtype=np.float64)
        if len(values) < fewest:
            raise CommandError(f"{len(values)} renders are too few for the test; give {fewest} or more.")
        return Means(Sample.of(values), Sample.of(values[:, -3:].mean(1, keepdims=True)))

    def joined(self, other: Means) -> Means:
        """Return the means of the renders of both."""
        return Means(self.columns.joined(other.columns), self.whole.joined(other.whole))

    @staticmethod
    def known(image: ArrayLike, tiles: int = TILES) -> Means:
        """Return the means of an exact image."""
        columns = tile_columns(image, tiles)
        return Means(Sample.known(columns), Sample.known(columns[-3:].mean(keepdims=True)))


def missing_energy(image: Sample, reference: Sample) -> Estimate:
    """Return 1 - mean(image) / mean(reference) with its 95 % interval (m = 1).

    The interval is Banerjee's, of half width sqrt(t_x^2 v_x / r^2 + t_r^2 x^2 v_r / r^4) with Student's
    quantile of each side, which holds the value in 95 % of cases or more. Source: S. K. Banerjee, Sankhya 22,
    1960.
    """
    x, r = float(image.mean[0]), float(reference.mean[0])
    if not r > 0:
        raise CommandError(f"references have mean {r:g}; no share of it can be missing.")
    errors = float(image.error[0] / r), float(x * reference.error[0] / r**2)
    tail = (1 - CONFIDENCE) / 2
    sides = zip(errors, (image.freedom, reference.freedom), strict=True)
    half = math.hypot(*(stats.t.isf(tail, freedom) * error for error, freedom in sides))
    return Estimate(1 - x / r, 1 - x / r - half, 1 - x / r + half)


def compare_means(ours: Means, theirs: Means, significance: float = SIGNIFICANCE) -> BiasCheck:
    """Test whether renders agree with the reference within their noise.

    `welch` over the means of tiles and of the whole image, by channel, with Sidak's correction. Without bias
    it fails with probability ``significance``, up to 2.5 times that for 12 seeds and 9 times for 8; use 16.

    It detects bias of a few standard errors of a tile; noise may hide smaller bias (see the intervals). It
    cannot distinguish bias from energy in events that are rarer than the samples.
    """
    found, tiles = welch(ours.columns, theirs.columns), math.isqrt(len(ours.columns.mean) // 3 - 1)
    worst = int(np.lexsort((-np.abs(found.value), found.p))[0])
    tile = worst // 3
    family, each = sidak(found.p), (1 - significance) ** (1 / len(found.p))
    value, error, freedom = (float(of[worst]) for of in found[:3])
    half = error * float(stats.t.isf((1 - each) / 2, freedom))
    return BiasCheck(
        passed=family >= significance,
        p=float(found.p[worst]),
        family_p=family,
        tile=divmod(tile, tiles) if tile < tiles**2 else None,
        difference=Estimate(value, value - half, value + half),
        missing=missing_energy(ours.whole, theirs.whole),
    )
