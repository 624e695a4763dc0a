"""Statistics for tests of images: which test, which level, and how many comparisons it serves.

Samples are tile means: one number per tile and render, renders with different seeds. Tiles of many
pixels and samples are near normal, which Welch's test needs; single pixels are not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

# Level of a whole family of comparisons, after Sidak's correction. Seeds are fixed, so a test
# passes or fails for good; a change of the random numbers draws anew, with this chance per family
# of a false alarm.
LEVEL = 1e-3

# What float32 arithmetic alone may do to a tile's mean, relative: differences below are no finding.
ROUNDING = 2e-5


def tile_means(image, tiles: int) -> np.ndarray:
    """Means over ``tiles`` x ``tiles`` tiles of an image (height, width, channels), flattened to
    (tiles * tiles, channels). The size must be divisible by ``tiles``."""
    image = np.asarray(image, dtype=np.float64)
    h, w, c = image.shape
    parts = image.reshape(tiles, h // tiles, tiles, w // tiles, c)
    return parts.mean(axis=(1, 3)).reshape(tiles * tiles, c)


@dataclass
class Comparisons:
    """p-values of a family of comparisons.

    ``p`` (m,); ``labels`` what was compared; ``continuous``: which p-values take part in the test
    of uniformity (not those of tiles where rounding or a few lumps decide).
    """

    p: np.ndarray
    labels: list
    continuous: np.ndarray

    @staticmethod
    def join(parts):
        """One family out of several."""
        return Comparisons(
            np.concatenate([x.p for x in parts]),
            [label for x in parts for label in x.labels],
            np.concatenate([x.continuous for x in parts]),
        )


def welch(a, b, label="", labels=None) -> Comparisons:
    """Welch's unequal-variances t-test of each column of ``a`` (renders, m) against ``b``'s.

    Two-sided. Differences within `ROUNDING` of the larger mean count as none. A column in which
    both sides are nonzero in less than 9 of 10 renders is left to the image's mean: a few lumps
    are not normal.
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    mean_a, mean_b = a.mean(0), b.mean(0)
    var_a, var_b = a.var(0, ddof=1) / len(a), b.var(0, ddof=1) / len(b)
    floor = ROUNDING * np.maximum(np.abs(mean_a), np.abs(mean_b))
    error = np.sqrt(var_a + var_b)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.maximum(np.abs(mean_a - mean_b) - floor, 0) / error
        dof = (var_a + var_b) ** 2 / (var_a**2 / (len(a) - 1) + var_b**2 / (len(b) - 1))
        t, dof = (
            np.where(error > 0, t, np.where(floor < np.abs(mean_a - mean_b), np.inf, 0)),
            (np.where(np.isfinite(dof), dof, 1)),
        )
    return _comparisons(a, b, t, dof, error > 10 * floor, label, labels, mean_a, mean_b, error)


def one_sample(a, expected, label="", labels=None) -> Comparisons:
    """Student's t-test of each column of ``a`` (renders, m) against the known value ``expected``."""
    a = np.asarray(a, dtype=np.float64)
    expected = np.broadcast_to(np.asarray(expected, dtype=np.float64), a.shape[1:])
    mean, error = a.mean(0), a.std(0, ddof=1) / np.sqrt(len(a))
    floor = ROUNDING * np.abs(expected)
    gap = np.abs(mean - expected)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(error > 0, np.maximum(gap - floor, 0) / error, np.where(gap > floor, np.inf, 0))
    always = np.ones_like(a)
    return _comparisons(a, always, t, len(a) - 1.0, error > 10 * floor, label, labels, mean, expected, error)


def _comparisons(a, b, t, dof, noisy, label, labels, mean_a, mean_b, error):
    p = 2 * stats.t.sf(t, dof)
    common = np.maximum((a != 0).mean(0), (b != 0).mean(0)) >= 0.9
    names = labels or [f"tile {i}" for i in range(a.shape[1])]
    text = [
        f"{label} {name}: {x:.6g} vs {y:.6g} +- {e:.2g}"
        for name, x, y, e in zip(names, mean_a, mean_b, error, strict=True)
    ]
    return Comparisons(np.where(common, p, 1.0), text, noisy & common)


def compare_images(a, b, label="") -> Comparisons:
    """`welch` for each tile of ``a`` and ``b`` (renders, tiles) and for the mean of all tiles.

    The mean is a comparison of its own: it finds an error common to all tiles at a quarter of the
    size for 16 of them. It stays out of the test of uniformity, for it is no new sample.
    """
    tiles = welch(a, b, label)
    whole = welch(np.mean(a, 1, keepdims=True), np.mean(b, 1, keepdims=True), label, ["image"])
    whole.continuous[:] = False
    return Comparisons.join([tiles, whole])


def compare_known(a, expected, label="") -> Comparisons:
    """As `compare_images`, against a value that is known for every tile."""
    tiles = one_sample(a, expected, label)
    whole = one_sample(np.mean(a, 1, keepdims=True), np.mean(expected), label, ["image"])
    whole.continuous[:] = False
    return Comparisons.join([tiles, whole])


def sidak(p) -> float:
    """Chance that the smallest of so many independent p-values is as small as it is."""
    p = np.asarray(p, dtype=np.float64)
    return float(-np.expm1(len(p) * np.log1p(-min(p.min(), 1 - 1e-16))))


def uniformity(p) -> float:
    """p-value of the Kolmogorov-Smirnov test that ``p`` is uniform on [0, 1]."""
    return float(stats.kstest(np.asarray(p), "uniform").pvalue)


def assert_agree(comparisons: Comparisons, level: float = LEVEL, at_least: int = 1):
    """Fail unless the family passes Sidak and, with 16 p-values or more, Kolmogorov-Smirnov.

    ``at_least``: how many noisy comparisons there must be, so that a family of empty images does
    not pass for one that agrees.
    """
    p, used = comparisons.p, comparisons.continuous
    order = np.argsort(p)[:8]
    worst = "\n".join(f"  p={p[i]:.2e}  {comparisons.labels[i]}" for i in order)
    assert used.sum() >= at_least, f"only {used.sum()} comparisons have noise:\n{worst}"
    family = sidak(p)
    assert family >= level, f"Welch with Sidak over {len(p)}: p={family:.2e}\n{worst}"
    if used.sum() >= 16:
        ks = uniformity(p[used])
        assert ks >= level, f"p-values of {used.sum()} comparisons not uniform: KS p={ks:.2e}\n{worst}"
