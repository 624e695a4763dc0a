"""What a film keeps of a spectrum, and where: linear sRGB, or the bands of a spectral film.

An object of these classes is made for one render. It is called with a spectrum and its wavelengths
(drawn by the sensor, and multiplied by the weight that they came with) and returns the film's colours.
"""

from __future__ import annotations

from math import inf

import drjit as dr
import mitsuba as mi

from ..errors import UnsupportedError
from ..host.introspection import children, named
from .stokes import Stokes

# Wavelengths at which a film is asked for its response to a spectrum of 1.
RESPONSE_SAMPLES = 4096


def film_colours(sensor, stokes: bool = False):
    """Return the kind of colours that the film of ``sensor`` keeps; ``stokes``: and Stokes vectors.

    Raises ``UnsupportedError`` for films other than Mitsuba's.
    """
    film = sensor.film()
    if not mi.has_flag(film.flags(), mi.FilmFlags.Special):
        return Rgb(film, Stokes(sensor, srgb) if stokes else None)
    if film.class_name() != "SpecFilm":
        raise UnsupportedError(
            f"film {named(film)} of class {film.class_name()} is not supported; use hdrfilm or specfilm"
        )
    return Bands(film, sensor)


def srgb(value: mi.UnpolarizedSpectrum, wavelengths) -> mi.Color3f:
    """Linear sRGB of a spectrum."""
    if mi.is_spectral:
        return mi.spectrum_to_srgb(value, wavelengths)
    if mi.is_monochromatic:
        return mi.Color3f(value.x)
    return mi.Color3f(value)


class Rgb:
    """Linear sRGB, which ``hdrfilm`` keeps in every pixel format.

    ``names`` of the colours; ``unit`` what a spectrum of 1 gives, roughly: the scale of a colour; ``stokes``
    the `Stokes` that are kept besides, or None.
    """

    names = ("R", "G", "B")
    unit = (1.0, 1.0, 1.0)

    def __init__(self, film, stokes: Stokes | None):
        self._film, self.stokes = film, stokes

    def __call__(self, value, wavelengths):
        """Linear sRGB of a spectrum's intensity."""
        return srgb(mi.unpolarized_spectrum(value), wavelengths)

    def prepare(self, layers):
        """Make the film ready for its colours and these layers."""
        self._film.prepare(layers)

    def stored(self, colours, weight, layers) -> list:
        """Parts of the film's storage in its order; alpha counts as a colour."""
        return [colours, weight, *layers]


class Bands:
    """The bands of a ``specfilm``, each the integral of radiance times a sensor response, see `Rgb`."""

    stokes = None

    def __init__(self, film, sensor):
        self._film, self._sensor = film, sensor
        self.names = tuple(_band_names(film))
        self._channels, self.unit = None, None  # known from `prepare` on

    def __call__(self, value, wavelengths):
        """The bands' shares of a spectrum."""
        value = mi.unpolarized_spectrum(value)
        channels = self._film.prepare_sample(value, wavelengths, self._channels)
        return mi.ArrayXf(channels[: len(self.names)])

    def prepare(self, layers):
        """Make the film ready for its colours and these layers."""
        self._channels = self._film.prepare(layers)
        u = (dr.arange(mi.Float, RESPONSE_SAMPLES) + 0.5) / RESPONSE_SAMPLES
        wavelengths, weight = self._sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), u)
        response = self(weight, wavelengths)
        # A band without any response stays black, whatever it is divided by.
        self.unit = tuple(float(dr.slice(dr.mean(band))) or inf for band in response)

    def stored(self, colours, weight, layers) -> list:
        """Parts of the film's storage in its order: the weight comes last."""
        return [colours, *layers, weight]


def _band_names(film) -> list[str]:
    """Names of the bands in the order in which the film keeps them."""
    return [name for name, value in children(film).items() if isinstance(value, mi.Texture)]
