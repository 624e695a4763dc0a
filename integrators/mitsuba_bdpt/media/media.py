"""The media of a scene as tables and calls that a kernel can index."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cached_property, partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UnsupportedError, UsageError
from ..geometry.boxes import points_in
from ..geometry.directions import random_directions, symmetric_frame
from ..host.introspection import children, named, registry_id
from .equal import representatives

# Optical depth above which T~ is constant, so that ratios of densities stay within single precision;
# connections across such edges contribute next to nothing.
DEEPEST = 32.0

_LEAST = math.exp(-DEEPEST)

_PROBES = 4096  # sample points and directions at which a medium's properties are evaluated


class Media:
    """Media that rays of a scene and sensor may be in, numbered from 1; 0 is vacuum.

    Equal media (`equal.representatives`) share a number (``UInt32``).

    * ``properties``: the `MediumProperties` of each number; ``sensor``: number of the sensor's medium.
    * ``grids``: some medium is heterogeneous; ``coloured_grids``: the extinction of one depends on
      wavelength.
    * ``scatters``: some albedo is not 0.
    * ``gray``: no homogeneous medium's extinction depends on wavelength; optical depths are then ``Float``,
      else ``Spectrum``.
    * ``see_through``: surfaces of plugin ``null`` are passed without a vertex; ``null_lobes``: shadow rays
      have to evaluate surfaces.
    * ``lit``, by number: next-event estimation is allowed in the medium (``sample_emitters``); ``all_lit``:
      in all.
    """

    def __init__(self, found: dict[int, mi.Medium], sensor: mi.Medium | None, bsdfs: Iterable[mi.BSDF]):
        properties = [MediumProperties(medium) for medium in found.values()]
        firsts = representatives(properties)
        distinct = sorted(set(firsts))
        self._number_of = {place: distinct.index(i) + 1 for place, i in zip(found, firsts, strict=True)}
        self.properties = properties = [properties[i] for i in distinct]
        self.sensor = self.number_of(sensor)
        self.grids = not all(p.homogeneous for p in properties)
        self.scatters = any(p.scatters for p in properties)
        self.gray = all(p.gray for p in properties)
        self.coloured_grids = any(p.coloured_grid for p in properties)
        lit = [p.medium.use_emitter_sampling() for p in properties]
        self.all_lit, self.lit = all(lit), mi.Bool([False, *lit])
        # Numbers by Mitsuba's registry index; the others by number. No extinction if more matters to it.
        self._numbers = mi.UInt32([self._number_of.get(place, 0) for place in range(max(found) + 1)])
        self._extinction = None
        if not any(p.directional for p in properties) and (self.gray or not mi.is_spectral):
            table = np.array([np.zeros_like(properties[0].majorant), *(p.majorant for p in properties)])
            self._extinction = mi.Float(table[:, 0]) if self.gray else mi.UnpolarizedSpectrum(table.T)
        self._mean = mi.Float([0.0, *(p.mean for p in properties)])
        self._homogeneous = mi.Bool([False, *(p.homogeneous for p in properties)])
        dr.make_opaque(self._numbers, self._extinction, self._mean, self._homogeneous, self.lit)
        null = [b for b in bsdfs if mi.has_flag(b.flags(), mi.BSDFFlags.Null)]
        only = [b for b in null if not b.flags() & OTHER_LOBES]
        self.null_lobes = bool(null)
        self.see_through = bool(only) and all(b.class_name() == "Null" for b in only)

    def number_of(self, medium: mi.Medium | None) -> int:
        """The number of a medium of the scene or of the sensor, 0 for none."""
        return 0 if medium is None else self._number_of[registry_id(medium)]

    def number(self, medium: mi.MediumPtr) -> mi.UInt32:
        """The number of a medium that the scene's shapes point to."""
        return dr.gather(mi.UInt32, self._numbers, dr.reinterpret_array(mi.UInt32, medium))

    def beyond(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f, number: mi.UInt32) -> mi.UInt32:
        """The medium at the surface ``si`` in direction ``d``; ``number`` where it bounds none."""
        return dr.select(si.is_medium_transition(), self.number(si.target_medium(d)), number)

    def is_homogeneous(self, number: mi.UInt32) -> mi.Bool:
        return dr.gather(mi.Bool, self._homogeneous, number)

    def mean(self, number: mi.UInt32) -> mi.Float:
        """Mean extinction (1 / scene unit), of a grid within its box; 0 in vacuum."""
        return dr.gather(mi.Float, self._mean, number)

    def extinction(self, number: mi.UInt32, ray: mi.Ray3f, active: mi.Bool):
        """Extinction along ``ray`` (1 / scene unit), a grid's majorant; 0 in vacuum.

        ``Float`` if `gray`, else ``Spectrum``, with equal channels in a grid.
        """
        if self._extinction is not None:
            return dr.gather(type(self._extinction), self._extinction, number)

        def majorant(medium: mi.Medium, mei: mi.MediumInteraction3f, active: mi.Bool):
            majorant = mi.UnpolarizedSpectrum(medium.get_majorant(mei, active))
            return majorant[0] if self.gray else majorant

        found = self.query(number, majorant, interaction(mi.Point3f(0), ray.d, ray), active)
        return dr.select(active & (number != 0), found, 0)

    def query(self, number: mi.UInt32, call, *args) -> Any:
        """Evaluate ``call(medium, *args)``, undefined in vacuum; ``args[-1]``: mask."""
        *others, active = args
        active = active & (number != 0)
        calls = [partial(call, p.medium) for p in self.properties]
        if len(calls) == 1:
            return calls[0](*others, active)
        return dr.switch(dr.select(active, number - 1, 0), calls, *others, active)


# Lobes other than null.
OTHER_LOBES = int(
    mi.BSDFFlags.Smooth | mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.Delta1D
)


def interaction(p: mi.Point3f, d: mi.Vector3f, shared) -> mi.MediumInteraction3f:
    """Interaction at ``p`` in a medium, reached along unit ``d``, for Mitsuba's calls."""
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.p, mei.wi, mei.sh_frame = p, -d, symmetric_frame(-d)
    mei.time, mei.wavelengths = shared.time, shared.wavelengths
    return mei


def coefficients(medium: mi.Medium, mei: mi.MediumInteraction3f, active: mi.Bool):
    """sigma_s and sigma_t of a medium (1 / scene unit), for `Media.query`."""
    sigma_s, _, sigma_t = medium.get_scattering_coefficients(mei, active)
    return mi.UnpolarizedSpectrum(sigma_s), mi.UnpolarizedSpectrum(sigma_t)


def depth_of(sigma: mi.Float | mi.UnpolarizedSpectrum, length: mi.Float) -> mi.Float | mi.UnpolarizedSpectrum:
    """Optical depth of a ``length``, which may be infinite, at extinction ``sigma``."""
    # (In spectral variants `select` by entries returns no `Spectrum`.)
    return type(sigma)(dr.select(sigma > 0, sigma * length, 0))


def of_depth(depth: mi.Float | mi.UnpolarizedSpectrum):
    """T~ of an optical depth: mean over channels of exp(-depth), bounded by `DEEPEST`."""
    transmittance = dr.exp(-depth)
    if isinstance(depth, mi.UnpolarizedSpectrum):
        transmittance = dr.mean(transmittance)
    return dr.maximum(transmittance, _LEAST)


def _check(medium: mi.Medium, mei: mi.MediumInteraction3f, majorant: np.ndarray):
    """Raise ``UnsupportedError`` if the extinction of a homogeneous ``medium`` varies in space."""
    extinction = children(medium).get("sigma_t")
    if extinction is not None and extinction.class_name() != "ConstVolume":
        raise UnsupportedError(
            f"medium {named(medium)} of type homogeneous has a sigma_t of class {extinction.class_name()}, "
            "of which Mitsuba takes the value at the origin for flights; use a constant, or a medium of type "
            "heterogeneous"
        )
    at_origin = mi.MediumInteraction3f(mei)
    at_origin.p = mi.Point3f(0)
    if not np.allclose(majorant, *rows(medium.get_majorant(at_origin)), rtol=1e-5, equal_nan=True):
        raise UnsupportedError(
            f"medium {named(medium)} of type homogeneous has microflakes that vary in space, of which "
            "Mitsuba takes those at the origin for flights; use a constant S, or a medium of type "
            "heterogeneous"
        )


def rows(*spectra) -> list[np.ndarray]:
    """``spectra`` at `probes`, (channels, probes); one kernel."""
    wide = [mi.UnpolarizedSpectrum(part) + dr.zeros(mi.UnpolarizedSpectrum, _PROBES) for part in spectra]
    dr.eval(wide)
    return [np.array(part) for part in wide]


def probes(medium: mi.Medium) -> mi.MediumInteraction3f:
    """Random points in the varying volumes of a medium (the origin without any), directions, wavelengths."""
    rng = np.random.default_rng(0)
    mei = dr.zeros(mi.MediumInteraction3f, _PROBES)
    wi = random_directions(rng, _PROBES)
    mei.wi, mei.sh_frame = wi, symmetric_frame(wi)
    if mi.is_spectral:
        low, high = mi.MI_CIE_MIN, mi.MI_CIE_MAX
        mei.wavelengths = mi.UnpolarizedSpectrum(
            rng.uniform(low, high, (len(mi.UnpolarizedSpectrum(0)), _PROBES))
        )
    extinction, volumes = children(medium).get("sigma_t"), _volumes(medium)
    if not medium.is_homogeneous() and isinstance(extinction, mi.Volume):
        volumes = [extinction]
    if boxes := [volume.bbox() for volume in volumes]:
        mei.p = points_in(boxes, np.arange(_PROBES) % len(boxes), rng.random((_PROBES, 3)))
    return mei


def _volumes(owner) -> list[mi.Volume]:
    """Volumes of a medium that vary in space, including its phase function's."""
    found = []
    for held in children(owner).values():
        if isinstance(held, mi.PhaseFunction):
            found += _volumes(held)
        elif isinstance(held, mi.Volume) and held.class_name() != "ConstVolume":
            found.append(held)
    return found


def _strange(medium: mi.Medium, sigma_s: np.ndarray, sigma_t: np.ndarray) -> str:
    """Describe invalid extinctions or albedos of a medium; empty if there are none.

    Raises ``UsageError`` for invalid values of a homogeneous medium.
    """
    with np.errstate(all="ignore"):
        albedo = np.where(sigma_t != 0, sigma_s / sigma_t, 0)
    if medium.is_homogeneous() and (np.isnan(sigma_t).any() or np.isnan(albedo).any()):
        raise UsageError(f"medium {named(medium)} has a sigma_t, scale or albedo that is NaN; use numbers")
    for what, value in (("sigma_t", sigma_t), ("albedo", albedo)):
        least = np.nanmin(value, initial=0)
        if least >= 0:
            continue
        text = f"medium {named(medium)} has {what} down to {least:.4g}"
        if medium.is_homogeneous():
            raise UsageError(f"{text}; use 0 or more")
        return f"{text}: light and camera subpaths do not agree about it; use 0 or more"
    most = np.nanmax(albedo, initial=0)
    if most > 1 + 1e-3:  # by more than rounding
        return (
            f"medium {named(medium)} has albedo up to {most:.4g}: more light is scattered than arrives, and "
            "the image may have no limit as max_depth grows; use 1 or less"
        )
    return ""


class MediumProperties:
    """Properties of a medium, from its values at `probes`.

    ``majorant`` (channels,): maximum over directions; ``gray``, ``coloured_grid``, ``scatters``: see `Media`;
    ``directional``: extinction depends on direction (microflakes); ``mean`` extinction, ``least`` majorant of
    all channels; ``strange``: `_strange`. Raises ``UnsupportedError`` where Mitsuba's own calls disagree,
    ``UsageError`` for invalid coefficients.
    """

    def __init__(self, medium: mi.Medium):
        self.medium, self._probes = medium, probes(medium)
        self.homogeneous = homogeneous = medium.is_homogeneous()
        sigma_s, _, sigma_t = medium.get_scattering_coefficients(self._probes)
        self._rows = majorant, sigma_s, sigma_t = rows(medium.get_majorant(self._probes), sigma_s, sigma_t)
        if homogeneous:
            _check(medium, self._probes, majorant)
        self.strange = _strange(medium, sigma_s, sigma_t)
        self.majorant, self.least = majorant.max(1), float(majorant.min())
        # A grid's flights are sampled with one majorant for all channels.
        self.gray = not homogeneous or bool((majorant == majorant[:1]).all())
        self.coloured_grid = not homogeneous and not (sigma_t == sigma_t[:1]).all()
        same = majorant == majorant[:, :1]
        self.directional = homogeneous and not same.all() and (self.gray or not mi.is_spectral)
        self.scatters = bool((sigma_s > 0).any()) or not homogeneous
        self.mean = float((majorant if homogeneous else sigma_t).mean())

    @cached_property
    def values(self) -> np.ndarray:
        """Majorant, sigma_s, sigma_t, phase function, one row per channel."""
        wo, context = random_directions(np.random.default_rng(1), _PROBES), mi.PhaseFunctionContext(None)
        value, _ = self.medium.phase_function().eval_pdf(context, self._probes, wo)
        return np.concatenate([*self._rows, *rows(mi.unpolarized_spectrum(mi.Spectrum(value)))])
