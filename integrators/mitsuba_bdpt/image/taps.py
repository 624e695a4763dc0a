"""Pixels that receive a splat, with the film's filter: the inner ones, and some drawn of the others.

A splat at a film position adds its value times f(x) f(y) to every pixel of the filter's support: 16 pixels
for a radius of 2, 36 for 3, each an atomic addition per channel. Most of the weight is on few pixels. Here
the inner two by two pixels receive their value. Of them the farthest from the position and all outer pixels
form a set of which a pixel is drawn, in proportion to |f(x) f(y)|; it receives the set's sum of |f(x) f(y)|
with the sign of its own weight. The expectation is that of adding to every pixel. Wide filters add to all.
See experiments, "Reconstruction filters".
"""

from __future__ import annotations

from itertools import accumulate
from math import ceil

import drjit as dr
import mitsuba as mi

_GOLDEN = (5**0.5 - 1) / 2  # of the lattice of draws

SIDE = 2  # of the square of inner pixels


def is_wide(rfilter) -> bool:
    """Whether splats are added to all pixels of the support (radius above 3)."""
    return rfilter.radius() > 3


class Taps:
    """Pixels and weights of a splat.

    ``at``: position, in which integers are pixel centres; ``u``: uniform in [0, 1)^2; ``count``: number of
    pixels.
    """

    def __init__(self, rfilter, at: mi.Point2f, u: mi.Point2f):
        self._rfilter, self._at = rfilter, at
        self._radius = ceil(rfilter.radius())
        below = mi.Point2i(dr.floor(at))
        # Pixels of an axis are counted from the inner end that is nearer to the position.
        forward = at - mi.Point2f(below) < 0.5
        self._step = dr.select(forward, mi.Point2i(1), mi.Point2i(-1))
        self._start = dr.select(forward, below, below + 1)
        self._drawn = self._draw(u)
        self.count = SIDE**2 - 1 + len(self._drawn)

    def tap(self, number: mi.Int32) -> tuple[mi.Point2i, mi.Float]:
        """Return pixel ``number`` and the weight that it receives."""
        inner = mi.Point2i(number % SIDE, number // SIDE)
        pixel = self._start + self._step * inner
        distance = mi.Point2f(pixel) - self._at
        weight = self._rfilter.eval(distance.x) * self._rfilter.eval(distance.y)
        for k, (other, received) in enumerate(self._drawn, SIDE**2 - 1):
            pixel = dr.select(number == k, other, pixel)
            weight = dr.select(number == k, received, weight)
        return pixel, weight

    def _draw(self, u: mi.Point2f) -> list[tuple[mi.Point2i, mi.Float]]:
        """Draw pixels of the set: n squared for n outer pixels on each side of an axis, at least one.

        A column first, then a row of those that the column has in the set. With the outer rows first, then
        the corner's, then the others, these are the first ones.
        """
        outside = self._radius - 1
        order = [*range(-outside, 0), *range(SIDE, SIDE + outside), 1, 0]
        columns, rows = (
            [self._rfilter.eval(mi.Float(start + step * k) - at) for k in order]
            for start, step, at in zip(self._start, self._step, self._at, strict=True)
        )
        rows_below = list(accumulate((dr.abs(w) for w in rows), initial=mi.Float(0)))
        in_set = [2 * self._radius] * (2 * outside) + [2 * outside + 1] + [2 * outside]
        ends = [rows_below[n] for n in in_set]
        below = list(accumulate(dr.abs(w) * end for w, end in zip(columns, ends, strict=True)))
        found, draws = [], max(1, outside**2)
        for k in range(draws):  # a lattice
            v = u + mi.Point2f(k / draws, k * _GOLDEN % 1)
            v = dr.select(v >= 1, v - 1, v)
            x, weight_x, end = _chosen(v.x * below[-1], below, order, columns, ends)
            y, weight_y = _chosen(v.y * end, rows_below[1:], order, rows)
            received = dr.mulsign(dr.mulsign(below[-1] / draws, weight_x), weight_y)
            found.append((self._start + self._step * mi.Point2i(x, y), received))
        return found


def _chosen(level: mi.Float, below: list[mi.Float], order: list[int], *columns) -> list:
    """Return the entries of ``order`` and ``columns`` whose interval (upper end ``below``) has ``level``."""
    found = [mi.Int32(order[0]), *(column[0] for column in columns)]
    for k, end in enumerate(below[:-1], 1):
        entry = [mi.Int32(order[k]), *(column[k] for column in columns)]
        found = [dr.select(level >= end, new, old) for new, old in zip(entry, found, strict=True)]
    return found
