"""How far independent images of one scene lie apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Spread:
    """Mean and squared deviations of ``count`` independent images, weighted by their samples.

    With n_b samples per pixel in image x_b, N = ``spp`` in all, and B images, ``squares`` are
    sum_b n_b (x_b - mean)^2, and the variance of the weighted mean is estimated by squares / (N (B - 1)).
    That is exact for images of one size; of several, if variance falls as 1 / n. (Where points let it fall as
    n^-1.2, and each eight images have as many samples as all before, it is too large: by 7 % at 256 samples
    per pixel, 23 % at 1024, 69 % at 16384.)
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
        """Both: squares about the common mean.

        T. Chan, G. Golub, R. LeVeque, "Updating formulae and a pairwise algorithm for computing sample
        variances", 1979, eq. 2.1.
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
        """Of the mean; there must be two images."""
        return self.squares / (self.spp * (self.count - 1))
