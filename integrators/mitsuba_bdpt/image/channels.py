"""Where the sums of a pixel lie."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi


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
