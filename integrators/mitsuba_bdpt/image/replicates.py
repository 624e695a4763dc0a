"""Independent replicates of one image, and the error estimated from them."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import mitsuba as mi
import numpy as np


@dataclass(frozen=True)
class Spread:
    """Weighted mean and squared deviations of ``count`` independent images.

    With weights n_b, the samples per pixel of image x_b, N = ``spp`` in all, and B images, ``squares`` is
    sum_b n_b (x_b - mean)^2. squares / (N (B - 1)) estimates the variance of the weighted mean. It is exact
    for images of equal size, and for others if variance falls as 1 / n; it is too large where Sobol' points
    converge faster.
    """

    count: int = 0
    spp: int = 0
    mean: np.ndarray | float = 0.0
    squares: np.ndarray | float = 0.0

    @staticmethod
    def of(image: np.ndarray, spp: int) -> Spread:
        """A single image."""
        return Spread(1, spp, image, np.zeros_like(image))

    def joined(self, other: Spread) -> Spread:
        """Merge two sets: squares about the common mean.

        Source: T. Chan, G. Golub, R. LeVeque, "Updating formulae and a pairwise algorithm for computing
        sample variances", 1979, eq. 2.1.
        """
        if not (self.count and other.count):
            return self if self.count else other
        spp, apart = self.spp + other.spp, other.mean - self.mean
        return Spread(
            self.count + other.count,
            spp,
            self.mean + apart * (other.spp / spp),
            self.squares + other.squares + apart**2 * (self.spp * other.spp / spp),
        )

    def variance(self) -> np.ndarray | float:
        """Variance of the mean; needs two images."""
        return self.squares / (self.spp * (self.count - 1))


LAST = "replicates.last."  # prefix of the names of the sums after the last image, in a snapshot


def stored(halves: tuple[Spread, ...]) -> dict[str, np.ndarray]:
    """Return the arrays of ``halves``, by name in a snapshot."""
    parts = [(f"replicates.{i}", half) for i, half in enumerate(halves)]
    return {f"{part}.{n}": np.asarray(v, np.float64) for part, half in parts for n, v in vars(half).items()}


def halves_of(arrays: dict) -> tuple[Spread, ...]:
    """Inverse of `stored`; none in the ``arrays`` of a snapshot without the variance."""
    parts = [part for part in ("replicates.0", "replicates.1") if f"{part}.spp" in arrays]
    found = ([arrays[f"{part}.{name}"] for name in Spread.__annotations__] for part in parts)
    return tuple(Spread(int(count), int(spp), *rest) for count, spp, *rest in found)


class Replicates:
    """Independent images, alternately in two `Spread`: one estimates the error, the other the image."""

    def __init__(self):
        self.halves: tuple[Spread, Spread] = (Spread(), Spread())
        self._sums: list[mi.Float64] | None = None

    @property
    def count(self) -> int:
        """Number of images."""
        return sum(half.count for half in self.halves)

    @property
    def spp(self) -> int:
        """Samples per pixel of all images."""
        return sum(half.spp for half in self.halves)

    def add(self, sums, spp: int, develop):
        """Add an image, the difference of ``sums`` over ``spp`` from the last, by ``develop(*sums, spp)``."""
        new = sums if self._sums is None else [a - b for a, b in zip(sums, self._sums, strict=True)]
        n = spp - self.spp
        image = Spread.of(develop(*new, n), n)
        first, second = self.halves
        even = self.count % 2 == 0
        self.halves = (first.joined(image), second) if even else (first, second.joined(image))
        self._sums = sums

    def store(self) -> dict:
        """Return the arrays of the halves, and the sums after the last image."""
        return stored(self.halves) | {f"{LAST}{i}": sums for i, sums in enumerate(self._sums or ())}

    def restore(self, arrays: dict):
        """Restore the state that `store` returned."""
        first, second = halves_of(arrays)
        self.halves = first, second
        if self.count:
            self._sums = [mi.Float64(arrays[name]) for name in sorted(arrays) if name.startswith(LAST)]

    def variance(self, spp: int, shape=()):
        """Variance of the mean of ``spp`` samples per pixel; infinite with fewer than two replicates."""
        if self.count < 2:
            return np.full(shape, np.inf)
        first, second = self.halves
        both = first.joined(second)
        return both.variance() * (both.spp / spp)

    def error(self, spp: int, unit) -> float:
        """Return the estimated relMSE of ``spp`` samples per pixel, colours in ``unit``.

        Infinite with fewer than two replicates in a half.

        The variance from one half is divided by r^2 + e, r the mean of the other half and e = 0.01
        mean(image)^2: with a mean of the same half, a firefly could not count for more than 1. The noise of r
        alone adds a factor 1 + V max(3 r^2 - e, 0) / (r^2 + e)^2 to the expectation (V the variance of r,
        second order, clamped at 1); the result is divided by it.
        """
        first, second = self.halves
        if min(first.count, second.count) < 2:
            return inf
        epsilon = 0.01 * (first.joined(second).mean / unit).mean() ** 2 + 1e-150  # keeps its square above 0
        found = 0.0
        for own, other in ((first, second), (second, first)):
            variance = own.variance() / unit**2 * (own.spp / spp)
            square, noise = (other.mean / unit) ** 2, other.variance() / unit**2
            below = square + epsilon
            surplus = 1 + noise * np.maximum(3 * square - epsilon, 0) / below**2
            found += float((variance / (below * surplus)).mean()) / 2
        return found
