"""Mueller matrices along subpaths; in variants that are not polarized nothing is recorded here.

In polarized variants a spectrum is a Mueller matrix. Mitsuba keeps no frame of a Stokes vector: that of light
which travels along a direction follows from the direction (``mi.mueller.stokes_basis``). Matrices of BSDFs
are in local coordinates, and go over to the world's with the directions in which light arrives and leaves.

Light that arrives is multiplied from the right. A camera subpath walks against the light, and its throughput
grows on the right; that of a light subpath grows on the left. Of a path of both,

    (W_e M(z_1) ... M(z_t-1)) (M(y_s-1) ... M(y_1) L_e),

the first column is the Stokes vector that reaches the sensor: emitted light is not polarized, or if so by its
own first column. The upper left entry, the intensity, is what weights' densities, roulette and draws see, and
is the same as in a variant that is not polarized where no event polarizes light
(``mi.unpolarized_spectrum``).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

# Of directions, times ten.
_ROUNDING = 1e-6


def in_world(si: mi.SurfaceInteraction3f, value: mi.Spectrum, arriving, leaving) -> mi.Spectrum:
    """The ``value`` of a BSDF at ``si`` in the world's frames.

    ``arriving``, ``leaving``: local directions in which the light travels. As ``si.to_world_mueller``, but
    for `basis`.
    """
    if not mi.is_polarized:
        return value
    ends = []
    for local in (arriving, leaving):
        d = si.to_world(local)
        ends += [d, si.to_world(mi.mueller.stokes_basis(local)), basis(d)]
    return mi.mueller.rotate_mueller_basis(value, *ends)


def basis(d: mi.Vector3f) -> mi.Vector3f:
    """The x axis of Stokes vectors of light that travels along ``d`` (world): Mitsuba's ``stokes_basis``.

    That flips where z changes its sign, which rounding decides for directions across the z axis, and with it
    S1 and S2. Here z is 0 where it is within rounding of it.
    """
    level = dr.abs(d.z) < _ROUNDING
    return mi.mueller.stokes_basis(mi.Vector3f(d.x, d.y, dr.select(level, 0, d.z)))


def extended(throughput: mi.Spectrum, event: mi.Spectrum, adjoint: bool) -> mi.Spectrum:
    """The ``throughput`` of a subpath after an ``event``; ``adjoint``: light travels with the walk."""
    return event * throughput if adjoint and mi.is_polarized else throughput * event


def scaled(value: mi.Spectrum, by) -> mi.Spectrum:
    """``value`` times ``by``, which does not polarize: a number, or one for each wavelength."""
    # A matrix times numbers of wavelengths is taken for a matrix times a vector.
    return value * (mi.Spectrum(by) if mi.is_polarized else by)


def darkened(value: mi.Spectrum, dark) -> mi.Spectrum:
    """``value``, 0 at the wavelengths in the mask ``dark``."""
    if mi.is_polarized:
        return scaled(value, mi.UnpolarizedSpectrum(dr.select(dark, 0, 1)))
    return type(value)(dr.select(dark, 0, value))


def stokes_types() -> list[type]:
    """Types of what `stokes` returns."""
    return [mi.UnpolarizedSpectrum] * 4 if mi.is_polarized else [mi.Spectrum]


def stokes(value: mi.Spectrum) -> list:
    """What a throughput of light that was emitted has to keep: its first column, or itself."""
    return [value[i, 0] for i in range(4)] if mi.is_polarized else [value]


def of_stokes(entries: list) -> mi.Spectrum:
    """A throughput of which `stokes` kept these ``entries``."""
    if not mi.is_polarized:
        return entries[0]
    value = dr.zeros(mi.Spectrum)
    for i, entry in enumerate(entries):
        value[i, 0] = entry
    return value
