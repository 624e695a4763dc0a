"""Whether renders agree: tests on the means of tiles, bias checks. The one home of these statistics.

Samples are tile means: one number per tile and render, renders with different seeds. Tiles of many pixels and
samples are near normal, which Welch's test needs; single pixels are not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral
from typing import NamedTuple

import numpy as np
from scipy import stats

from ..errors import CommandError
from .checks import CONFIDENCE, Estimate, floats, image_of, number_of

# What float32 arithmetic alone may do to a tile's mean, relative: differences below are no finding.
ROUNDING = 2e-5

# Tiles that are nonzero in fewer renders on both sides hold a few lumps, which are not normal.
NONZERO_SHARE = 0.9

# Renders that a bias check takes at least. Sidak asks for the far tail, where Welch's test fails too often
# for few of them. At a significance of 1e-3 over 48 values, normal and as noisy as those of 64 references,
# the chance of a false alarm is 4 % for 5 renders, 0.9 % for 8, 0.2 % for 12 and 16 (8000 simulated).
FEWEST_RUNS = 8

# Tiles of a bias check along an edge of the image, and the chance of a false alarm of a whole check.
TILES = 4
SIGNIFICANCE = 1e-3


def tile_means(image, tiles: int) -> np.ndarray:
    """Means over ``tiles`` x ``tiles`` tiles of an image (height, width, channels).

    Flattened to (tiles * tiles, channels), row by row. The size must be divisible by ``tiles``.
    """
    image = np.asarray(image, dtype=np.float64)
    h, w, c = image.shape
    if not isinstance(tiles, Integral) or tiles < 1 or h % tiles or w % tiles:
        raise CommandError(f"tiles={tiles!r} must be an integer that divides height {h} and width {w}.")
    parts = image.reshape(tiles, h // tiles, tiles, w // tiles, c)
    return parts.mean(axis=(1, 3)).reshape(tiles * tiles, c)


@dataclass(frozen=True)
class Sample:
    """Means and standard errors of m quantities over several renders.

    Means (m,), their standard errors (m,), the errors' degrees of freedom, and the share of the renders in
    which each quantity is nonzero (m,).
    """

    mean: np.ndarray
    error: np.ndarray
    freedom: float
    nonzero: np.ndarray

    @staticmethod
    def of(values) -> Sample:
        """From ``values`` (renders, m)."""
        values = np.asarray(values, dtype=np.float64)
        error = values.std(0, ddof=1) / np.sqrt(len(values))
        return Sample(values.mean(0), error, len(values) - 1.0, (values != 0).mean(0))

    def joined(self, other: Sample) -> Sample:
        """What `of` gives for the renders of both."""
        a, b = self.freedom + 1, other.freedom + 1
        mean = (a * self.mean + b * other.mean) / (a + b)
        squares = sum((n - 1) * n * s.error**2 for n, s in ((a, self), (b, other)))
        squares = squares + a * b / (a + b) * (self.mean - other.mean) ** 2
        error = np.sqrt(squares / ((a + b) * (a + b - 1)))
        return Sample(mean, error, a + b - 1, (a * self.nonzero + b * other.nonzero) / (a + b))

    @staticmethod
    def known(mean, error=0.0) -> Sample:
        """Values (m,) whose standard errors are known rather than estimated."""
        mean = np.asarray(mean, dtype=np.float64)
        return Sample(mean, np.broadcast_to(error, mean.shape), np.inf, np.ones_like(mean))


def satterthwaite(variance_a, freedom_a, variance_b, freedom_b):
    """Degrees of freedom of a sum of two estimated variances, by Welch and Satterthwaite.

    1 / (c^2 / n_a + (1 - c)^2 / n_b) with c = a / (a + b), and 1 where both are 0. Source: B. L. Welch,
    Biometrika 34, 1947.
    """
    total = np.asarray(variance_a + variance_b, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = variance_a / total
        freedom = 1 / (share**2 / freedom_a + (1 - share) ** 2 / freedom_b)
    return np.where(total > 0, freedom, 1.0)


class Difference(NamedTuple):
    """Differences of the means of m quantities, and how significant they are, each (m,).

    Mean a - mean b, its standard error and degrees of freedom, the p-value, and whether that one is uniform
    if nothing differs (not where rounding or a few lumps decide).
    """

    value: np.ndarray
    error: np.ndarray
    freedom: np.ndarray
    p: np.ndarray
    continuous: np.ndarray


def welch(a: Sample, b: Sample) -> Difference:
    """Welch's unequal-variances t-test of each quantity; Student's where one side is known exactly.

    Two-sided: t = |a - b| / hypot(error_a, error_b). Differences within `ROUNDING` of the larger mean count
    as none. Where both sides are nonzero in less than `NONZERO_SHARE` of the renders it does not apply, and
    p is 1.
    """
    error = np.hypot(a.error, b.error)
    gap = np.abs(a.mean - b.mean)
    floor = ROUNDING * np.maximum(np.abs(a.mean), np.abs(b.mean))
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(error > 0, np.maximum(gap - floor, 0) / error, np.where(gap > floor, np.inf, 0))
    freedom = satterthwaite(a.error**2, a.freedom, b.error**2, b.freedom)
    applies = np.maximum(a.nonzero, b.nonzero) >= NONZERO_SHARE
    p = np.where(applies, 2 * stats.t.sf(t, freedom), 1.0)
    return Difference(a.mean - b.mean, error, freedom, p, applies & (error > 10 * floor))


def sidak(p) -> float:
    """Chance that the smallest of so many independent p-values is as small as it is."""
    p = np.asarray(p, dtype=np.float64)
    return float(-np.expm1(len(p) * np.log1p(-min(p.min(), 1 - 1e-16))))


def _each(significance: float, count: int) -> float:
    """The p-value below which one of ``count`` comparisons fails the whole check: `sidak` the other way."""
    return float(-np.expm1(np.log1p(-significance) / count))


@dataclass(frozen=True)
class BiasCheck:
    """What `bias_check` finds.

    ``passed``: no difference at the significance asked for; ``p``: the smallest p-value; ``family_p``: the
    same after Sidak's correction for all ``comparisons``; ``tile``: (row, column) of the worst tile, None
    for the image as a whole; ``channel`` of it; ``difference``: image - reference there, in radiance, with
    an interval that holds the differences of all comparisons at once with confidence 1 - significance;
    ``missing``: the share of the energy that is missing, 1 - mean(image) / mean(reference) over the whole
    image, with its 95 % interval.
    """

    passed: bool
    p: float
    family_p: float
    comparisons: int
    tile: tuple[int, int] | None
    channel: int
    difference: Estimate
    missing: Estimate


def tile_columns(image, tiles=TILES) -> np.ndarray:
    """What a bias check compares, (3 tiles^2 + 3,): means of tiles and of the whole image.

    `tile_means` by row, column and channel, then the mean of the whole image by channel.
    """
    return np.concatenate([tile_means(image, tiles).ravel(), tile_means(image, 1).ravel()])


@dataclass(frozen=True)
class Means:
    """`tile_columns` of renders as a sample, and the mean of the whole image over its channels as another.

    All that `compare_means` needs of a set of renders; small enough to keep beside a reference or in a table.
    """

    columns: Sample
    whole: Sample

    @staticmethod
    def of(columns, name="columns") -> Means:
        """From ``columns`` (renders, 3 tiles^2 + 3), renders with seeds of their own."""
        columns = np.asarray(columns, dtype=np.float64)
        if len(columns) < FEWEST_RUNS:
            raise CommandError(
                f"{name} has {len(columns)} renders, too few for the test's level; give {FEWEST_RUNS} or "
                "more."
            )
        return Means(Sample.of(columns), Sample.of(columns[:, -3:].mean(1, keepdims=True)))

    def joined(self, other: Means) -> Means:
        """What `of` gives for the renders of both."""
        return Means(self.columns.joined(other.columns), self.whole.joined(other.whole))

    @staticmethod
    def known(image, tiles=TILES) -> Means:
        """Of an image without error."""
        columns = tile_columns(image, tiles)
        return Means(Sample.known(columns), Sample.known(columns[-3:].mean(keepdims=True)))

    @property
    def tiles(self) -> int:
        """Tiles along an edge of the image."""
        return math.isqrt(len(self.columns.mean) // 3 - 1)


def _means_of_runs(name, runs, tiles):
    """`Means` of ``runs`` (seeds, height, width, 3), and the shape of one."""
    runs = floats(name, runs, ("seeds", "height", "width", "3"))
    return Means.of([tile_columns(run, tiles) for run in runs], name), runs.shape[1:]


def _means_of_reference(reference, standard_error, tiles):
    """As `_means_of_runs`, from one image and the standard error of its values (height, width, 3).

    Pixels are taken for independent, the channels of a pixel for fully correlated.
    """
    reference = image_of("references", reference)
    standard_error = image_of("standard_error", standard_error)
    if standard_error.shape != reference.shape or standard_error.min() < 0:
        raise CommandError(
            f"standard_error has shape {standard_error.shape} and values from {standard_error.min():g}; it "
            f"must have the reference's shape {reference.shape} and no negative values."
        )
    pixels = reference.shape[0] * reference.shape[1]
    area = np.full(3 * tiles * tiles + 3, pixels / tiles**2)
    area[-3:] = pixels
    errors = np.sqrt(tile_columns(standard_error**2, tiles) / area)
    columns = tile_columns(reference, tiles)
    whole = Sample.known(columns[-3:].mean(keepdims=True), errors[-3:].mean(keepdims=True))
    return Means(Sample.known(columns, errors), whole), reference.shape


def _student(value, error, freedom, confidence) -> Estimate:
    """``value`` with Student's interval for its standard error."""
    half = stats.t.isf((1 - confidence) / 2, freedom) * error
    return Estimate(float(value), float(value - half), float(value + half))


def missing_energy(image: Sample, reference: Sample) -> Estimate:
    """1 - mean(image) / mean(reference) with its 95 % interval, from samples of both means (m = 1).

    Variance of the ratio to first order: v_x / r^2 + x^2 v_r / r^4, Student's t with the degrees of freedom
    of `satterthwaite`.
    """
    x, r = float(image.mean[0]), float(reference.mean[0])
    if not r > 0:
        raise CommandError(f"references have mean {r:g}; no share of it can be missing.")
    parts = float(image.error[0] / r) ** 2, float(x * reference.error[0] / r**2) ** 2
    freedom = satterthwaite(parts[0], image.freedom, parts[1], reference.freedom)
    return _student(1 - x / r, math.sqrt(sum(parts)), freedom, CONFIDENCE)


def bias_check(images, references, tiles=TILES, significance=SIGNIFICANCE, standard_error=None) -> BiasCheck:
    """Whether the renders agree with the reference within their noise.

    `welch` over the means of ``tiles`` x ``tiles`` tiles and of the whole image, channel by channel, with
    Sidak's correction: with no bias it fails with a chance of ``significance``, up to 2.5 times that for 12
    seeds and 9 times for 8 (see `FEWEST_RUNS`); take 16.

    ``images`` (seeds, height, width, 3), seeds all different; ``references`` either the same, or one image
    (height, width, 3) with ``standard_error`` of the same shape. The latter takes pixels for independent,
    which they are not under filters wider than a pixel or when light paths are shared: then give runs.

    It finds bias of a few standard errors of a tile; what it does not find may be hidden by noise (see the
    width of the intervals). An integrator whose energy sits in events rarer than the samples fails too:
    what it misses in practice and what it can never find look the same.
    """
    ours, shape = _means_of_runs("images", images, tiles)
    if np.ndim(references) == 3:
        if standard_error is None:
            raise CommandError("standard_error=None: with one reference, give it as an image of its shape.")
        theirs, their_shape = _means_of_reference(references, standard_error, tiles)
    else:
        if standard_error is not None:
            raise CommandError("standard_error must be None with several references: their spread gives it.")
        theirs, their_shape = _means_of_runs("references", references, tiles)
    if shape != their_shape:
        raise CommandError(
            f"images have shape {shape} and references {their_shape}; render both at one size."
        )
    return compare_means(ours, theirs, significance)


def compare_means(ours: Means, theirs: Means, significance=SIGNIFICANCE) -> BiasCheck:
    """`bias_check` of what was kept of the renders on both sides."""
    significance = number_of("significance", significance, 0, 1)
    if ours.tiles != theirs.tiles:
        raise CommandError(
            f"ours has {ours.tiles} tiles along an edge and theirs {theirs.tiles}; take the same."
        )
    tiles = ours.tiles
    found = welch(ours.columns, theirs.columns)
    worst = int(np.lexsort((-np.abs(found.value), found.p))[0])
    tile, channel = divmod(worst, 3)
    family = sidak(found.p)
    return BiasCheck(
        passed=family >= significance,
        p=float(found.p[worst]),
        family_p=family,
        comparisons=len(found.p),
        tile=divmod(tile, tiles) if tile < tiles**2 else None,
        channel=channel,
        difference=_student(
            found.value[worst],
            found.error[worst],
            found.freedom[worst],
            1 - _each(significance, len(found.p)),
        ),
        missing=missing_energy(ours.whole, theirs.whole),
    )


class Apart(NamedTuple):
    """A ``tile`` (row, column), None for the whole image, and the ``share`` by which the first is brighter.

    The share is of the second's mean, in the most significant channel; infinite where that is black.
    """

    tile: tuple[int, int] | None
    share: float


def apart(ours: Means, theirs: Means, significance=SIGNIFICANCE) -> list[Apart]:
    """Where the renders differ, row by row, the whole image at last: nowhere if `compare_means` passes."""
    significance = number_of("significance", significance, 0, 1)
    found, tiles = welch(ours.columns, theirs.columns), ours.tiles
    p = found.p.reshape(-1, 3)
    channels = p.argmin(axis=1)
    places = []
    for index in np.flatnonzero(p.min(axis=1) < _each(significance, found.p.size)):
        column = 3 * int(index) + int(channels[index])
        mean, gap = float(theirs.columns.mean[column]), float(found.value[column])
        share = gap / mean if mean > 0 else math.copysign(math.inf, gap)
        tile = (int(index) // tiles, int(index) % tiles) if index < tiles**2 else None
        places.append(Apart(tile, share))
    return places
