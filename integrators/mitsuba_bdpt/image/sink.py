"""Sink of the kernel's contributions: the image. (`planning.pilot` has another.)

A sink has ``alpha`` (whether the last event of a camera subpath matters) and the methods of `Image`:
``begin``, ``add`` (a contribution of a camera subpath), ``connect`` (its inner connections), ``end`` (the
camera sample is complete) and ``splat`` (t <= 1). The last three return `Counters`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..geometry import polarization
from ..sampling.points import Purpose, sequential
from ..transport import connections
from ..transport.contribution import Counters, one


class Image:
    """Adds contributions to an `Accumulator`: t >= 2 summed in ``total``, splats at once."""

    def __init__(self, film):
        self._film = film
        self.alpha = film.alpha

    def begin(self):
        """Return the initial ``total``."""
        if not self._film.layers:
            return dr.zeros(mi.Spectrum)
        return _Total.begin(self._film.layers)

    def add(self, kernel, c, total, start, shared):
        """Add a contribution with t >= 2 to the ``total`` of a camera subpath."""
        if kernel.strategy_images:
            self._put_strategy(c, start.counted, shared)
        return self._plus(total, c.weighted(), c.layers, c.active)

    def connect(self, kernel, z, lane, stream, total, start):
        """Connect the camera vertex ``z`` to light vertices of its lane; returns ``total`` and `Counters`."""
        if kernel.plan.connections == "all":

            def add(_, seen, total):
                return self.add(kernel, seen, total, start, lane.shared)

            return connections.connect_all(kernel, z, lane.path, stream, total, add)
        c = connections.connect_one(kernel, z, lane.path, stream)
        return self._plus(total, c.weighted(), c.layers), c.counted

    def _plus(self, total, value: mi.Spectrum, layers, active: mi.Bool | bool = True):
        """Return ``total`` with ``value`` added; ``layers``: see `Contribution`."""
        if not self._film.layers:
            return total + value
        for layer in self._film.indices(layers):
            before = total.layers.read(layer, active)
            total.layers.write(before + mi.unpolarized_spectrum(value), layer, active)
        return replace(total, whole=total.whole + value)

    def splat(self, kernel, c, shared, stream) -> Counters:
        """Add a contribution with t <= 1; ``stream``: of its light subpath.

        Non-finite colours count as zero (`contribution.drop_non_finite` tests the contribution, not its
        colours).
        """
        whole = polarization.scaled(c.weighted(), shared.weight)
        value = self._film.colour(whole, shared.wavelengths)
        polarized = self._polarized(whole, shared, c.towards)
        finite = dr.all(dr.isfinite(value)) & _all_finite(polarized)
        u = _of_filter(kernel, self._film, c, stream)
        self._film.put_light(c, value, polarized, c.active & finite, u)
        if kernel.strategy_images:
            self._put_strategy(c, c.position, shared, u)
        return Counters(non_finite=one(c.active & ~finite))

    def end(self, kernel, lane, sample, total, seen) -> Counters:
        """Add a camera sample; non-finite colours (sums of finite ones) count as zero."""
        film, shared, start = self._film, lane.shared, sample.start
        features, finite = [], mi.Bool(True)
        if film.features is not None:
            features, finite = film.features.sample(
                kernel.points, sample.stream, start.position, sample.u_lens, shared.time, sample.covered
            )
        layers = []
        if film.layers:
            layers = [
                number
                for i in range(film.layers)
                for number in film.colour(total.layers.read(mi.UInt32(i)) * shared.weight, shared.wavelengths)
            ]
            total = total.whole
        whole = polarization.scaled(total, shared.weight)
        colours = film.colour(whole, shared.wavelengths)
        polarized = self._polarized(whole, shared, -start.ray.d)
        shown = dr.all(dr.isfinite(colours)) & _all_finite(polarized)
        alpha = _alpha(kernel, seen)
        polarized, layers = ([dr.select(shown, v, 0) for v in values] for values in (polarized, layers))
        values = dr.select(shown, colours, 0), alpha, features, polarized, layers
        film.put_camera(start.counted, values, sample.covered, sample.strip)
        return Counters(non_finite=one(sample.covered & ~finite) + one(sample.covered & ~shown))

    def _polarized(self, value, shared, towards) -> list:
        """Return the Stokes channels, beside the intensity, of light along ``towards``."""
        stokes = self._film.stokes
        return [] if stokes is None else stokes(value, shared.wavelengths, towards)

    def _put_strategy(self, c, position, shared, u=None):
        weighted = self._film.colour(polarization.scaled(c.weighted(), shared.weight), shared.wavelengths)
        unweighted = self._film.colour(polarization.scaled(c.value, shared.weight), shared.wavelengths)
        finite = dr.all(dr.isfinite(weighted)) & dr.all(dr.isfinite(unweighted))
        self._film.put_strategy(position, weighted, unweighted, c, c.active & finite, u)


@dataclass
class _Total:
    """Sum of a camera subpath: the ``whole``, and the intensity in the ``layers`` of all partitions."""

    whole: mi.Spectrum
    layers: dr.Local

    @staticmethod
    def begin(count: int) -> _Total:
        """Zero, for ``count`` layers."""
        layers = dr.alloc_local(mi.UnpolarizedSpectrum, count)
        for i in range(count):
            layers.write(dr.zeros(mi.UnpolarizedSpectrum), mi.UInt32(i))
        return _Total(dr.zeros(mi.Spectrum), layers)


def _of_filter(kernel, film, c, stream):
    """Return the random numbers of a splat's filter, None with the box filter."""
    if film.rfilter.is_box_filter():
        return None
    # One vertex's splats may share them: what the filter adds depends on nothing else.
    x, word = sequential(kernel.points.series(stream, Purpose.FILM, c.s, mi.UInt32(1)))
    return mi.Point2f(x, sequential(word)[0])


def _all_finite(values):
    """Return whether all are finite; records nothing for an empty list."""
    return dr.isfinite(sum(values)) if values else True


def _alpha(kernel, seen):
    """Return alpha of a camera sample, as in `path`: a visible environment is opaque."""
    opaque = seen
    if not kernel.plan.hide_emitters and kernel.scene.environment() is not None:
        opaque = kernel.max_depth >= 1
    return dr.select(opaque, mi.Float(1), mi.Float(0))
