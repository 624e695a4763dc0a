"""Where a kernel puts its contributions: into the image. (A pilot has another sink, see `pilot`.)

A sink has ``alpha``, whether the last event of a camera subpath matters, and the methods of `Image`:
``begin`` and ``add`` for what a camera subpath finds, ``connect`` for its inner connections, ``end`` when it
is done, ``splat`` for contributions with t <= 1. The last three return `Counters`.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..geometry import polarization
from ..transport import connections
from ..transport.contribution import Counters, one


class Image:
    """Adds contributions to a film's raw sums (an `Accumulator`).

    What a camera subpath finds goes through a running ``total``, which begins as `begin` says; splats go to
    the film at once.
    """

    def __init__(self, film):
        self._film = film
        self.alpha = film.alpha

    def begin(self):
        """Nothing found yet."""
        return dr.zeros(mi.Spectrum)

    def add(self, kernel, c, total, start, shared):
        """Add a contribution with t >= 2 to the ``total`` of a camera subpath."""
        if kernel.strategy_images:
            self._put_strategy(c, start.counted, shared)
        return total + c.weighted()

    def connect(self, kernel, z, lane, stream, total, start):
        """Join the camera vertex ``z`` with the light vertices of its lane: the ``total``, and `Counters`."""
        if kernel.plan.connections == "all":

            def add(_, seen, total):
                return self.add(kernel, seen, total, start, lane.shared)

            return connections.connect_all(kernel, z, lane.path, stream, total, add)
        found, counted = connections.connect_one(kernel, z, lane.path, stream)
        return total + found, counted

    def splat(self, kernel, c, shared) -> Counters:
        """Add a contribution with t <= 1.

        Colours that are not finite (`contribution.drop_non_finite` has seen the contribution, not what the
        film makes of it) count as zero.
        """
        whole = polarization.scaled(c.weighted(), shared.weight)
        value = self._film.colour(whole, shared.wavelengths)
        polarized = self._polarized(whole, shared, c.towards)
        finite = dr.all(dr.isfinite(value)) & _all_finite(polarized)
        self._film.put_light(c.position, value, polarized, c.active & finite)
        if kernel.strategy_images:
            self._put_strategy(c, c.position, shared)
        return Counters(non_finite=one(c.active & ~finite))

    def end(self, kernel, lane, sample, total, seen) -> Counters:
        """Add a camera sample; colours that are not finite, sums of finite ones, count as zero."""
        film, shared, start = self._film, lane.shared, sample.start
        features, finite = [], mi.Bool(True)
        if film.features is not None:
            features, finite = film.features.sample(
                kernel.points, sample.stream, start.position, sample.u_lens, shared.time, sample.covered
            )
        whole = polarization.scaled(total, shared.weight)
        colours = film.colour(whole, shared.wavelengths)
        polarized = self._polarized(whole, shared, -start.ray.d)
        shown = dr.all(dr.isfinite(colours)) & _all_finite(polarized)
        alpha = _alpha(kernel, seen)
        polarized = [dr.select(shown, value, 0) for value in polarized]
        values = dr.select(shown, colours, 0), alpha, features, polarized
        film.put_camera(start.counted, values, sample.covered)
        return Counters(non_finite=one(sample.covered & ~finite) + one(sample.covered & ~shown))

    def _polarized(self, value, shared, towards) -> list:
        """What the film keeps of a Stokes vector besides the intensity, of light that travels ``towards``."""
        stokes = self._film.stokes
        return [] if stokes is None else stokes(value, shared.wavelengths, towards)

    def _put_strategy(self, c, position, shared):
        weighted = self._film.colour(polarization.scaled(c.weighted(), shared.weight), shared.wavelengths)
        unweighted = self._film.colour(polarization.scaled(c.value, shared.weight), shared.wavelengths)
        finite = dr.all(dr.isfinite(weighted)) & dr.all(dr.isfinite(unweighted))
        self._film.put_strategy(position, weighted, unweighted, c, c.active & finite)


def _all_finite(values):
    """Whether all are; recorded where there are some."""
    return dr.isfinite(sum(values)) if values else True


def _alpha(kernel, seen):
    """Alpha of a camera sample, as in `path`: a visible environment covers the image."""
    opaque = seen
    if not kernel.plan.hide_emitters and kernel.scene.environment() is not None:
        opaque = kernel.max_depth >= 1
    return dr.select(opaque, mi.Float(1), mi.Float(0))
