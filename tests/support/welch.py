"""Statistics for tests of images: which test, which level, and how many comparisons it serves.

Samples are tile means: one number per tile and render, renders with different seeds. Tiles of many
pixels and samples are near normal, which Welch's test needs; single pixels are not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mitsuba_bdpt.measure.agreement import (  # noqa: F401  (tile_means for the tests)
    SIGNIFICANCE,
    Sample,
    sidak,
    tile_means,
)
from mitsuba_bdpt.measure.agreement import welch as difference
from scipy import stats

# Level of a whole family of comparisons, after Sidak's correction. Seeds are fixed, so a test
# passes or fails for good; a change of the random numbers draws anew, with this chance per family
# of a false alarm.
LEVEL = SIGNIFICANCE

# That of `agree`, which many tests call several times each.
OF_AGREE = 1e-4


@dataclass
class Comparisons:
    """p-values of a family of comparisons.

    ``p`` (m,); ``labels`` what was compared; ``continuous``: which p-values take part in the test
    of uniformity (not those of tiles where rounding or a few lumps decide).
    """

    p: np.ndarray
    continuous: np.ndarray
    labels: list

    @staticmethod
    def join(parts):
        """One family out of several."""
        labels = [label for x in parts for label in x.labels]
        return Comparisons(
            *(np.concatenate([getattr(x, k) for x in parts]) for k in ("p", "continuous")), labels
        )


def welch(a, b, label="", labels=None) -> Comparisons:
    """Welch's unequal-variances t-test of each column of ``a`` (renders, m) against ``b``'s, by
    `agreement.welch`: a column in which both sides are often zero is left to the image's mean."""
    return _comparisons(Sample.of(a), Sample.of(b), label, labels)


def one_sample(a, expected, label="", labels=None) -> Comparisons:
    """Student's t-test of each column of ``a`` (renders, m) against the known value ``expected``."""
    a = Sample.of(a)
    return _comparisons(a, Sample.known(np.broadcast_to(expected, a.mean.shape)), label, labels)


def _comparisons(a: Sample, b: Sample, label, labels):
    found = difference(a, b)
    names = labels or [f"tile {i}" for i in range(len(a.mean))]
    text = [
        f"{label} {name}: {x:.6g} vs {y:.6g} +- {e:.2g}"
        for name, x, y, e in zip(names, a.mean, b.mean, found.error, strict=True)
    ]
    return Comparisons(found.p, found.continuous, text)


def compare_images(a, b, label="") -> Comparisons:
    """`welch` for each tile of ``a`` and ``b`` (renders, tiles) and for the mean of all tiles.

    The mean finds an error common to all tiles at a quarter of the size for 16 of them. It stays out of the
    test of uniformity, for it is no new sample.
    """
    return _with_mean(welch, a, b, np.mean(b, 1, keepdims=True), label)


def compare_known(a, expected, label="") -> Comparisons:
    """As `compare_images`, against a value that is known for every tile."""
    return _with_mean(one_sample, a, expected, np.mean(expected), label)


def _with_mean(compared, a, b, mean, label):
    whole = compared(np.mean(a, 1, keepdims=True), mean, label, ["image"])
    whole.continuous[:] = False
    return Comparisons.join([compared(a, b, label), whole])


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


def tiles(images, size=4):
    """Means of size x size pixels: (seeds, tiles x channels)."""
    n, h, w = images.shape[:3]
    cut = images.reshape(n, h // size, size, w // size, size, -1)
    return cut.mean((2, 4)).reshape(n, -1)


def assert_same_tiles(a, b, at_least=10):
    """`assert_agree` of the `tiles` of two sets of images, (seeds, height, width)."""
    assert_agree(compare_images(tiles(a), tiles(b)), at_least=at_least)


def _reach(error, freedom):
    """Half-widths of the intervals of a family of means."""
    return stats.t.isf((1 - (1 - OF_AGREE) ** (1 / len(error))) / 2, freedom) * error


def _check(mean, expected, reach, used=True):
    bad = (np.abs(mean - expected) > reach) & used
    assert not bad.any(), "\n".join(
        f"value {i}: {mean[i]:.6f} against {expected[i]:.6f}, allowed {reach[i]:.6f}"
        for i in np.flatnonzero(bad)[-20:]
    )


def agree(a, b, relative, rounding):
    """Welch's t-test of the columns of ``a`` and ``b`` (seeds first) with Sidak's correction, and of
    their means. Faint columns that are zero in a tenth of the renders are left to the mean: a few
    lumps are not normal. The confidence interval of the mean must be narrower than ``relative``;
    ``rounding``: what single precision makes of the two sides, relative."""
    share = np.minimum((a != 0).mean(0), (b != 0).mean(0))
    lumpy = np.append((share < 0.9) & (b.mean(0) < 0.05 * b.mean(0).max()), False)
    a, b = (Sample.of(np.concatenate([x, x.mean(1, keepdims=True)], axis=1)) for x in (a, b))
    found = difference(a, b)
    scale = np.maximum(np.abs(a.mean), np.abs(b.mean))
    reach = _reach(found.error, found.freedom) + rounding * scale
    _check(a.mean, b.mean, reach, ~lumpy)
    assert scale[-1] > 0
    assert reach[-1] < relative * scale[-1], f"{relative} is not seen: {reach[-1] / scale[-1]:.2e}"


def check_known(samples, expected, relative, rounding):
    """t-test of ``samples`` (seeds first, then any shape of values) against ``expected``.

    Passes where the confidence interval of the mean, to which the relative error ``rounding`` of float32 is
    added, holds the expected value. It must reach no further than ``relative``: else the test could not see
    an error of that size.
    """
    found = Sample.of(np.reshape(samples, (len(samples), -1)))
    expected = np.broadcast_to(np.asarray(expected, dtype=np.float64).ravel(), found.mean.shape)
    reach = _reach(found.error, found.freedom) + rounding * np.abs(expected)
    _check(found.mean, expected, reach)
    blind = reach > relative * np.abs(expected)
    assert not blind.any(), f"{relative} is not seen: {reach[blind]} of {expected[blind]}"
