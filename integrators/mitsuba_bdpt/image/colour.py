"""Conversion of spectra to the film's colours: linear sRGB or bands; Stokes vectors.

An object of these classes belongs to one render. It is called with a spectrum (multiplied by the weight of
its wavelengths) and the wavelengths that the sensor sampled.
"""

from __future__ import annotations

from math import inf

import drjit as dr
import mitsuba as mi

from ..errors import UnsupportedError
from ..geometry.polarization import basis
from ..host.introspection import children, named

RESPONSE_SAMPLES = 4096  # wavelengths at which a film's response to a spectrum of 1 is evaluated


def film_colours(sensor, stokes: bool = False):
    """Return the colours of a sensor's film; ``UnsupportedError`` for films other than Mitsuba's."""
    film = sensor.film()
    if not mi.has_flag(film.flags(), mi.FilmFlags.Special):
        return Rgb(film, Stokes(sensor, srgb) if stokes else None)
    if film.class_name() != "SpecFilm":
        raise UnsupportedError(
            f"film {named(film)} of class {film.class_name()} is not supported; use hdrfilm or specfilm"
        )
    return Bands(film, sensor)


def srgb(value: mi.UnpolarizedSpectrum, wavelengths) -> mi.Color3f:
    """Convert a spectrum to linear sRGB."""
    if mi.is_spectral:
        return mi.spectrum_to_srgb(value, wavelengths)
    if mi.is_monochromatic:
        return mi.Color3f(value.x)
    return mi.Color3f(value)


class Rgb:
    """Linear sRGB, as ``hdrfilm`` stores; ``names`` and ``unit`` of the colours, and `Stokes` or None."""

    names = ("R", "G", "B")
    unit = (1.0, 1.0, 1.0)

    def __init__(self, film, stokes: Stokes | None):
        self._film, self.stokes = film, stokes

    def __call__(self, value, wavelengths):
        """Convert the intensity of a spectrum to linear sRGB."""
        return srgb(mi.unpolarized_spectrum(value), wavelengths)

    def prepare(self, layers):
        """Prepare the film for its colours and ``layers``."""
        self._film.prepare(layers)

    def stored(self, colours, weight, layers) -> list:
        """Return the channels of the film's storage in order; alpha counts as a colour."""
        return [*colours, weight, *layers]


class Bands:
    """Bands of ``specfilm``: integrals of radiance times a sensor response, see `Rgb`."""

    stokes = None

    def __init__(self, film, sensor):
        self._film, self._sensor = film, sensor
        bands = children(film).items()
        self.names = tuple(name for name, value in bands if isinstance(value, mi.Texture))
        self._channels, self.unit = None, None  # set by `prepare`

    def __call__(self, value, wavelengths):
        """Return the contribution of a spectrum to each band."""
        value = mi.unpolarized_spectrum(value)
        channels = self._film.prepare_sample(value, wavelengths, self._channels)
        return mi.ArrayXf(channels[: len(self.names)])

    def prepare(self, layers):
        """Prepare the film for its colours and ``layers``."""
        self._channels = self._film.prepare(layers)
        u = (dr.arange(mi.Float, RESPONSE_SAMPLES) + 0.5) / RESPONSE_SAMPLES
        wavelengths, weight = self._sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), u)
        response = self(weight, wavelengths)
        # A band without response stays black.
        self.unit = tuple(float(dr.slice(dr.mean(band))) or inf for band in response)

    def stored(self, colours, weight, layers) -> list:
        """Return the channels of the film's storage in order; the weight is last."""
        return [*colours, *layers, weight]


STOKES_NAMES = tuple(f"S{i}.{channel}" for i in range(4) for channel in "RGB")  # of the layers

POLARIZED = 9
"""Numbers of a sample besides its colours, which are the intensity S0: S1, S2 and S3 in linear sRGB."""


class Stokes:
    """Stokes vectors of samples, in the frame of a ``sensor`` with horizontal x axis.

    S1 > 0: horizontal; S2 > 0: +45 degrees; S3 > 0: right circular polarization.
    """

    def __init__(self, sensor: mi.Sensor, rgb):
        self._vertical = sensor.world_transform() @ mi.Vector3f(0, 1, 0)
        dr.make_opaque(self._vertical)
        self._rgb = rgb

    def __call__(self, value: mi.Spectrum, wavelengths, towards: mi.Vector3f) -> list[mi.Float]:
        """Return S1, S2 and S3 of light that travels along ``towards`` to the sensor.

        The first column of the Mueller matrix ``value`` is the Stokes vector in the frame
        `polarization.basis`.
        """
        target = dr.cross(-towards, self._vertical)
        turned = mi.mueller.rotate_stokes_basis(towards, basis(towards), target)
        vector = [sum(turned[i, j] * value[j, 0] for j in range(1, 4)) for i in range(1, 4)]
        return [number for entry in vector for number in self._rgb(entry, wavelengths)]
