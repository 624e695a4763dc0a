"""Evaluates and samples Mitsuba's BSDFs on both subpaths, with the adjoint factor.

Directions point away from the surface: ``c`` to the camera's side of a vertex, ``l`` to the light's side. On
camera subpaths ``si.wi`` is ``c``. On light subpaths ``si.wi`` is ``l``, and the BSDF is evaluated in
*radiance* mode with the two swapped, times |n.c| / |n.l|, see docs/method/method.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..geometry import polarization
from ..host.introspection import registry_id
from ..host.molds import molds
from . import draws
from .draws import needs_full_pdf, nested
from .near_specular import spread_interactions
from .spectra import brightest, is_finite, is_zero

_LEAST_COS = 1e-18  # two points of one plane are connected under a cosine that is rounding


@dataclass
class Evaluation:
    """``value`` f |cos| (light side: with adjoint factor); ``volume``: mask, scattering in a medium.

    Densities in solid angle: ``pdf_fwd_w`` of the new direction, ``pdf_rev_w`` of the reverse (0 without
    `Traits.reverse`).
    """

    value: mi.Spectrum
    pdf_fwd_w: mi.Float
    pdf_rev_w: mi.Float
    volume: mi.Bool = field(default_factory=lambda: mi.Bool(False))


@dataclass
class Step:
    """A sampled event; ``cos_out``: geometric cosine of ``wo``.

    ``pdf_*`` as in `Evaluation`, unset where ``delta``.
    """

    wo: mi.Vector3f
    weight: mi.Spectrum
    pdf_fwd_w: mi.Float
    pdf_rev_w: mi.Float
    cos_out: mi.Float
    delta: mi.Bool
    null: mi.Bool
    eta: mi.Float
    volume: mi.Bool = field(default_factory=lambda: mi.Bool(False))


@dataclass(frozen=True)
class Traits:
    """Properties of the BSDFs that rays can hit.

    ``full_pdf``: see `draws.needs_full_pdf`; ``one_way``: an event may exist from one end only, with maps:
    Mitsuba's reject sampled directions (not incident ones) on different sides of the surface and of the
    perturbed normal, and flip the normal towards the incident direction; ``round_trip``: a delta one;
    ``glossy``: one has a glossy lobe; ``transmits``: one has a non-delta lobe on the other side; ``parts``:
    one is sampled by its parts, see `draws`; ``reverse``: weights need reverse densities; ``only_delta``:
    only delta lobes are sampled.
    """

    full_pdf: bool
    round_trip: bool
    dispatch: BSDFDispatch
    glossy: bool = False
    transmits: bool = False
    parts: bool = False
    reverse: bool = True
    one_way: bool = False
    only_delta: bool = False

    def from_one_side(self) -> Traits:
        """The traits without reverse densities."""
        return replace(self, round_trip=False, reverse=False)

    def of_delta_lobes(self) -> Traits:
        """The traits for sampling delta lobes only, without reverse densities."""
        return replace(self.from_one_side(), full_pdf=False, parts=False, only_delta=True)

    def null_transmission(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Null transmission of the surface at ``si``, for all polarizations."""

        def ask(self, si, active):
            return mi.UnpolarizedSpectrum(mi.unpolarized_spectrum(self.eval_null_transmission(si, active)))

        return self.dispatch(si.bsdf(), ask, si, active)

    @staticmethod
    def of(bsdfs: Iterable[mi.BSDF], unhit: int = 0, family: Sequence[mi.BSDF] = ()) -> Traits:
        """Traits of the BSDFs that rays can hit; ``unhit``: number of the scene's others, see `BSDFDispatch`.

        BSDFs nested in ``bsdfs`` do not count as ``unhit``. ``family``: `nested` of them, if known.
        """
        hit = {id(bsdf): bsdf for bsdf in bsdfs}
        inner = {id(bsdf): bsdf for bsdf in family or nested(hit.values())}
        maps = [bsdf for bsdf in inner.values() if bsdf.class_name() in draws.MAPS]
        flags, f = [int(bsdf.flags()) for bsdf in hit.values()], mi.BSDFFlags
        parts = any(draws.by_parts(b) for b in hit.values())
        full_pdf = needs_full_pdf(inner.values())
        unhit += len(inner.keys() - hit.keys())
        return Traits(
            full_pdf=full_pdf,
            round_trip=any(mi.has_flag(b.flags(), f.Delta) for b in maps),
            dispatch=BSDFDispatch(hit.values(), None if full_pdf or parts else unhit),
            glossy=any(has & int(f.Glossy) for has in flags),
            transmits=any(has & (int(f.DiffuseTransmission) | int(f.GlossyTransmission)) for has in flags),
            parts=parts,
            one_way=bool(maps),
        )


# From this number of BSDFs on virtual calls are small: each call site compiles its own functions, one per
# BSDF, equal ones once. One call of all that a vertex needs is 6 % faster in a Cornell box.
MANY = 10

# Largest number of the scene's BSDFs that no ray hits, relative to the others, up to which Mitsuba's virtual
# calls are used. Recorded in C++, a call of a simple BSDF costs a quarter of one through Python.
_UNHIT = 0.25

_MOLDS = 0.25  # largest number of kinds (`molds`), relative to the BSDFs, up to which one is called for each


class BSDFDispatch:
    """Virtual calls of ``bsdfs``, which are distinct.

    Mitsuba's visit all BSDFs of the process, each with a function in the kernel: also nested ones, which no
    ray hits, and those of other scenes. They are used for `MANY` BSDFs beside few that no ray hits
    (``unhit``; None: some of ``bsdfs`` need a correction), whatever other scenes hold. Else calls go through
    Python to ``bsdfs`` alone; of `MANY` that have few kinds to one of each (`Mold`). ``apart``: a vertex
    makes several calls; ``kinds``: number of BSDF structures if `MANY`, else 0: BSDFs of one share the
    functions of a kernel.
    """

    def __init__(self, bsdfs: Iterable[mi.BSDF], unhit: int | None = None):
        by_id = {registry_id(b): b for b in bsdfs}
        self.bsdfs, self.count = list(by_id.values()), len(by_id)
        self.many = len(by_id) >= MANY
        found, self.kinds = molds(self.bsdfs) if self.many else ([], 0)
        self._molds = found if len(found) <= _MOLDS * self.count else []
        self.apart = self.many and not 0 < len(self._molds) < MANY
        self.by_mitsuba = self.many and not self._molds and unhit is not None and unhit <= _UNHIT * self.count
        # Samples and evaluations are separate calls, whose functions all places share: less to compile.
        self.shared = self.apart and not self.by_mitsuba
        index_of = {id(b): index for index, b in by_id.items()}
        numbers, rows = ([0] * (max(by_id, default=0) + 1) for _ in range(2))
        groups = [mold.bsdfs for mold in self._molds] or [[b] for b in self.bsdfs]
        for number, group in enumerate(groups):
            for row, index in enumerate(index_of[id(b)] for b in group):
                numbers[index], rows[index] = number, row
        self._numbers, self._rows = mi.UInt32(numbers), mi.UInt32(rows)

    def __call__(self, bsdf, question, *args):
        """Return ``question(bsdf, *args)``; the last of ``args`` is the call's mask.

        A BSDF instead of a pointer needs no virtual call.
        """
        # In evaluated mode calls of Python functions fail for `plastic`; its own methods do not.
        if self.by_mitsuba or isinstance(bsdf, mi.BSDF) or not dr.flag(dr.JitFlag.SymbolicCalls):
            return question(bsdf, *args)
        index, calls = dr.reinterpret_array(mi.UInt32, bsdf), [partial(question, b) for b in self.bsdfs]
        if self._molds:
            calls = [partial(mold, question) for mold in self._molds]
            args = dr.gather(mi.UInt32, self._rows, index, args[-1]), *args
        return dr.switch(dr.gather(mi.UInt32, self._numbers, index, args[-1]), calls, *args)


@dataclass
class Target:
    """A local direction ``wo`` in which a BSDF is evaluated where ``active``.

    ``cos_ratio``, for light vertices: |n.wo| / |n.wi| with the geometric normal.
    """

    wo: mi.Vector3f
    active: mi.Bool
    cos_ratio: mi.Float | None = None


def with_wi(si: mi.SurfaceInteraction3f, wi: mi.Vector3f) -> mi.SurfaceInteraction3f:
    """A copy of ``si`` with ``wi``. (Assigning to ``si.wi`` changes aliases.)"""
    other = mi.SurfaceInteraction3f(si)
    other.wi = wi
    return other


def connectible(bsdf: mi.BSDFPtr):
    """Mask: the BSDF has a lobe that is not delta."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)


def evaluate(bsdf, si, wo, active, traits: Traits, cos_ratio: mi.Float | None = None) -> Evaluation:
    """Evaluate a camera vertex towards the local ``wo``, with both densities; with ``cos_ratio`` a light one.

    Its ``value`` includes the adjoint factor ``cos_ratio``, see `Target`.
    """
    return _evaluation(*_evaluated(bsdf, si, wo, active, traits, cos_ratio is not None), cos_ratio)


def _evaluated(bsdf, si, wo, active, traits: Traits, adjoint: bool):
    """Value and densities of ``wo`` and the reverse; the other direction is ``si.wi``."""
    if adjoint:
        value, pdf_rev_w, pdf_fwd_w = _evaluated(bsdf, with_wi(si, wo), si.wi, active, traits, False)
        return value, pdf_fwd_w, pdf_rev_w

    def ask(self, si, wo, active):
        value, pdf = _value_and_pdf(self, si, wo, active)
        if not traits.reverse:
            return value, pdf, mi.Float(0)
        return value, pdf, self.pdf(mi.BSDFContext(), with_wi(si, wo), si.wi, active)

    return traits.dispatch(bsdf, ask, si, wo, active)


def _value_and_pdf(bsdf, si, wo, active):
    """Value (in world frames) and density of the local direction ``wo``, in one call."""
    # Mitsuba's bump shadowing squares the cosine: 0 times infinity in one plane.
    active = active & (dr.abs(mi.Frame3f.cos_theta(wo)) > _LEAST_COS)
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, wo, active)
    return polarization.in_world(si, value, -wo, si.wi), pdf


def _evaluation(value, pdf_fwd_w, pdf_rev_w, cos_ratio: mi.Float | None = None) -> Evaluation:
    """Build an `Evaluation`; its nonzero value is NaN, to be counted, where a density is non-finite."""
    value = value if cos_ratio is None else value * cos_ratio
    finite = dr.isfinite(pdf_fwd_w + pdf_rev_w)
    return Evaluation(dr.select(finite | is_zero(value), value, dr.nan), pdf_fwd_w, pdf_rev_w)


def geometric_cos(si: mi.SurfaceInteraction3f, w: mi.Vector3f) -> mi.Float:
    """Absolute cosine between the local direction ``w`` and the geometric normal."""
    return dr.abs(dr.dot(si.n, si.to_world(w)))


def sample(
    bsdf, si, u1, u2, active, traits: Traits, target: Target | None = None, adjoint: bool = False
) -> tuple[Step, Evaluation | None]:
    """Sample the next direction of a subpath; ``u1`` picks the lobe.

    Returns the `Step`, and the `Evaluation` of ``target`` or None, with the adjoint factor on light subpaths.
    """

    def call(bsdf, si, u1, u2, sampled, *connected) -> Any:
        drawn = _drawn(bsdf, si, u1, u2, sampled, traits, adjoint)
        return drawn, _evaluated(bsdf, si, *connected[:2], traits, adjoint) if target else None

    given = si, u1, u2, active
    if target:  # the last argument is the call's mask
        given = *given, target.wo, target.active, active | target.active
    # One virtual call, or with `MANY` BSDFs one per question.
    apart = traits.dispatch.apart
    drawn, evaluated = call(bsdf, *given) if apart else traits.dispatch(bsdf, call, *given)
    return _step(si, drawn, adjoint), _evaluation(*evaluated, target.cos_ratio) if target else None


@dataclass
class _Drawn:
    """A sample of a BSDF in radiance mode; delta: ``pdf_fwd_w`` is the probability of the event.

    ``back``, if needed: weight of the delta event sampled from its other end, see `_back`; ``value``, of
    light subpaths with more than delta lobes: f |cos| of the direction from its other end; ``of_parts``:
    density and rejection as in `draws.Draw` in scenes with BSDFs sampled by parts.
    """

    bs: mi.BSDFSample3f
    weight: mi.Spectrum
    pdf_fwd_w: mi.Float
    pdf_rev_w: mi.Float
    back: mi.Spectrum | None
    value: mi.Spectrum | None
    of_parts: tuple[mi.Float, mi.Bool] | None


def _drawn(bsdf, si, u1, u2, active, traits: Traits, adjoint: bool) -> _Drawn:
    """Sample a direction with densities both ways, in one virtual call (two with `BSDFDispatch.shared`)."""
    valued, shared = adjoint and not traits.only_delta, traits.dispatch.shared
    # A Mueller matrix does not follow from the other end's. (Mitsuba's importance mode errs for retarders.)
    asks_back = traits.round_trip or (adjoint and bool(mi.is_polarized))

    def ask(self, si, u1, u2, active):
        ctx = mi.BSDFContext()
        found = (draws.draw_delta if traits.only_delta else draws.draw)(self, si, u1, u2, active)
        bs = found.bs
        weight = polarization.in_world(si, found.weight, -bs.wo, si.wi)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        smooth = active & ~delta
        pdf_fwd_w = bs.pdf
        if traits.full_pdf:
            # A pointer may refer to any.
            meant = [self] if isinstance(self, mi.BSDF) else traits.dispatch.bsdfs
            behind = draws.none_from_behind(meant, si, bs)
            weight, found.rejected = dr.select(behind, 0, weight), found.rejected | behind
            full = smooth & ~(bs.pdf == 0)
            pdf_fwd_w = dr.select(full, self.pdf(ctx, si, bs.wo, full), bs.pdf)
        density = found.density if draws.by_parts(self) else pdf_fwd_w
        value, pdf_rev_w = None, mi.Float(0)
        if valued and not shared:
            value, pdf = _value_and_pdf(self, with_wi(si, bs.wo), si.wi, smooth)
            value = _evaluation(value, pdf_fwd_w, pdf).value
            pdf_rev_w = pdf if traits.reverse else pdf_rev_w
        elif traits.reverse:
            pdf_rev_w = self.pdf(ctx, with_wi(si, bs.wo), si.wi, smooth)
        back = _back(self, si, bs, u1, u2, active & delta) if asks_back else None
        of_parts = (density, found.rejected) if traits.parts else None
        return _Drawn(bs, weight, pdf_fwd_w, pdf_rev_w, back, value, of_parts)

    drawn = traits.dispatch(bsdf, ask, si, u1, u2, active)
    if valued and shared:
        smooth = active & ~mi.has_flag(drawn.bs.sampled_type, mi.BSDFFlags.Delta)
        drawn.value = _evaluation(*_evaluated(bsdf, si, drawn.bs.wo, smooth, traits, adjoint)).value
    return drawn


def _step(si, drawn: _Drawn, adjoint: bool) -> Step:
    """The `Step` of a sample."""
    bs, weight, cos_out = drawn.bs, drawn.weight, geometric_cos(si, drawn.bs.wo)
    density, rejected = drawn.of_parts or (drawn.pdf_fwd_w, is_zero(weight))
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    # A NaN direction hits nothing and would go unnoticed.
    finite = dr.isfinite(dr.select(delta, cos_out, cos_out + drawn.pdf_fwd_w + drawn.pdf_rev_w))
    finite &= is_finite(weight) & dr.isfinite(bs.eta)  # roulette uses eta
    if adjoint:
        smooth = mi.Spectrum(0) if drawn.value is None else drawn.value / density
        # Removes the factor eta^-2 of radiance on camera subpaths.
        eta2 = dr.square(bs.eta)
        delta_weight = weight * eta2 if drawn.back is None else drawn.back / eta2
        weight = dr.select(delta, delta_weight * _event_cos_ratio(si, bs), smooth)
        # Mitsuba may return a density for a rejected direction. NaN is kept, to be counted.
        weight = dr.select((drawn.pdf_fwd_w == 0) | rejected, 0, weight)
        cos_ratio = cos_out / geometric_cos(si, si.wi)
        weight = dr.select(is_zero(weight), 0, weight * cos_ratio)
    elif drawn.back is not None:  # no alternative has to sample this event from the other side
        cos_out = dr.select(~delta | (brightest(drawn.back) > 0), cos_out, 0)
    return Step(
        wo=bs.wo,
        weight=dr.select(finite | rejected, weight, dr.nan),
        pdf_fwd_w=drawn.pdf_fwd_w,
        pdf_rev_w=drawn.pdf_rev_w,
        cos_out=cos_out,
        delta=delta,
        null=mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null),
        eta=bs.eta,
    )


def _back(bsdf, si, bs, u1, u2, active):
    """Weight of a delta event sampled from its other end, as probably; 0 if it does not lead back."""
    back = draws.draw(bsdf, with_wi(si, bs.wo), u1, u2, active)
    weight = polarization.in_world(si, back.weight, -si.wi, bs.wo)
    return dr.select(dr.squared_norm(back.bs.wo - si.wi) < 1e-4, weight, 0)


def _event_cos_ratio(si, bs):
    """|m.l| / |m.c| about the normal m (of a map) of a delta event; 1 without refraction."""
    m = bs.eta * bs.wo + si.wi  # along eta_c c + eta_l l; bs.eta = eta_c / eta_l when sampling from l
    ratio = dr.abs(dr.dot(m, si.wi) / dr.dot(m, bs.wo))
    refracted = mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaTransmission)
    refracted &= dr.abs(bs.eta - 1) > 1e-5  # equal indices: straight on, and m is zero
    return dr.select(refracted, ratio, 1)


def polarizing(bsdfs: Iterable[mi.BSDF]) -> list[mi.BSDF]:
    """The ``bsdfs``, and nested ones, whose null transmission polarizes at a `spread_interactions` point."""
    if not mi.is_polarized:
        return []
    si = spread_interactions()
    found = [b for b in nested(bsdfs) if mi.has_flag(b.flags(), mi.BSDFFlags.Null)]
    return [b for b in found if not _is_scalar(mi.Spectrum(b.eval_null_transmission(si)))]


def _is_scalar(matrix: mi.Spectrum) -> bool:
    """Whether Mueller matrices are multiples of the identity per wavelength."""
    entries = np.array(matrix)
    return np.abs(entries - np.multiply.outer(np.eye(4), entries[0, 0])).max() < 1e-6
