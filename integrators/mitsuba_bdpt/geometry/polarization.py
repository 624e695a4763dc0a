"""Mueller matrices along subpaths; unpolarized variants record nothing here.

In polarized variants a spectrum is a Mueller matrix. The frame of a Stokes vector follows from the light's
direction (``mi.mueller.stokes_basis``). Matrices of BSDFs are in local coordinates, and are rotated to the
world's by the directions in which light arrives and leaves.

Incident light is multiplied from the right: the throughput of a camera subpath, traced against the light,
grows on the right, and that of a light subpath on the left. The first column of the product along a path,

    (W_e M(z_1) ... M(z_t-1)) (M(y_s-1) ... M(y_1) L_e),

is the Stokes vector that reaches the sensor, since emitted light is unpolarized or given by its own first
column. Weights, roulette and draws use the upper left entry, the intensity (``mi.unpolarized_spectrum``),
which equals the unpolarized variant's where no event polarizes light.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

_ROUNDING = 1e-6  # bound of the rounding error of unit directions, times ten


def in_world(si: mi.SurfaceInteraction3f, value: mi.Spectrum, arriving, leaving) -> mi.Spectrum:
    """Rotate a BSDF's ``value`` to world frames (`basis`); ``arriving``, ``leaving``: local light paths."""
    if not mi.is_polarized:
        return value
    ends = []
    for local in (arriving, leaving):
        d = si.to_world(local)
        ends += [d, si.to_world(mi.mueller.stokes_basis(local)), basis(d)]
    return mi.mueller.rotate_mueller_basis(value, *ends)


def basis(d: mi.Vector3f) -> mi.Vector3f:
    """Axis x of Stokes vectors of light along ``d`` (world), a stable choice.

    Mitsuba's ``stokes_basis`` flips, and with it S1 and S2, where z changes sign, which rounding decides for
    directions across the z axis. Here z within rounding of 0 counts as 0.
    """
    level = dr.abs(d.z) < _ROUNDING
    return mi.mueller.stokes_basis(mi.Vector3f(d.x, d.y, dr.select(level, 0, d.z)))


def extended(throughput: mi.Spectrum, event: mi.Spectrum, adjoint: bool) -> mi.Spectrum:
    """Return the ``throughput`` after an ``event``; ``adjoint``: light subpath."""
    return event * throughput if adjoint and mi.is_polarized else throughput * event


def scaled(value: mi.Spectrum, by) -> mi.Spectrum:
    """Scale ``value`` by a number or an unpolarized spectrum."""
    # A matrix times an unpolarized spectrum would be a matrix-vector product.
    return value * (mi.Spectrum(by) if mi.is_polarized else by)


def darkened(value: mi.Spectrum, dark) -> mi.Spectrum:
    """Set ``value`` to 0 at the wavelengths in the mask ``dark``."""
    if mi.is_polarized:
        return scaled(value, mi.UnpolarizedSpectrum(dr.select(dark, 0, 1)))
    return type(value)(dr.select(dark, 0, value))


def stokes_types() -> list[type]:
    return [mi.UnpolarizedSpectrum] * 4 if mi.is_polarized else [mi.Spectrum]


def stokes(value: mi.Spectrum) -> list:
    """Return the part of an emitted throughput to store: its first column, or itself."""
    return [value[i, 0] for i in range(4)] if mi.is_polarized else [value]


def of_stokes(entries: list) -> mi.Spectrum:
    if not mi.is_polarized:
        return entries[0]
    value = dr.zeros(mi.Spectrum)
    for i, entry in enumerate(entries):
        value[i, 0] = entry
    return value
