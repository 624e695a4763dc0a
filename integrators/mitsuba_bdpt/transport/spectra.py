"""Reductions of spectra, Mueller matrices in polarized variants."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def brightest(value: mi.Spectrum):
    """Largest magnitude of a spectrum's entries; NaN only if all are NaN."""
    return dr.max(dr.abs(mi.unpolarized_spectrum(value)))


def is_zero(value: mi.Spectrum):
    """Mask: all entries of a spectrum are 0."""
    return dr.all(mi.unpolarized_spectrum(value) == 0)


def is_finite(value: mi.Spectrum):
    """Mask: all entries of a spectrum (Mueller matrix: first column) are finite."""
    finite = dr.isfinite(mi.unpolarized_spectrum(value))
    if mi.is_polarized:
        for i in range(1, 4):
            finite &= dr.isfinite(value[i, 0])
    return dr.all(finite)
