"""Evaluation of Mitsuba's BSDFs in both directions, and the one home of the adjoint factor.

Directions: ``c`` points towards the camera's side of a vertex, ``l`` towards the light's side, both
away from the surface. On camera subpaths Mitsuba's ``si.wi`` is ``c``. On light subpaths ``si.wi``
is ``l``, and the BSDF is evaluated in *radiance* mode with the two swapped, times the ratio of
geometric cosines |n.c| / |n.l|: exact for bump and normal maps, interpolated normals and hair,
where Mitsuba's importance mode with Veach's correction (thesis, eq. 5.19) is not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from ..geometry import polarization
from . import draws
from .draws import needs_full_pdf, nested
from .spectra import brightest, is_finite, is_zero

# Two points of one plane see each other under a cosine that is rounding; its square leaves single precision.
_LEAST_COS = 1e-18


@dataclass
class Evaluation:
    """``value`` f |cos| (light subpaths: adjoint factor included), densities in solid angle.

    ``pdf_fwd_w`` of leaving into the new direction, ``pdf_rev_w`` of the reverse (0 where `Traits.reverse`
    does not hold).
    """

    value: mi.Spectrum
    pdf_fwd_w: mi.Float
    pdf_rev_w: mi.Float


@dataclass
class Step:
    """A sampled direction. Densities as in `Evaluation`; ``pdf_*`` are unset where ``delta``."""

    wo: mi.Vector3f
    weight: mi.Spectrum
    pdf_fwd_w: mi.Float
    pdf_rev_w: mi.Float
    cos_out: mi.Float
    delta: mi.Bool
    null: mi.Bool
    eta: mi.Float


@dataclass(frozen=True)
class Traits:
    """What the BSDFs that rays may meet demand: `needs_full_pdf`, `needs_round_trip`, and who is `Asked`.

    ``glossy``: whether one has a glossy lobe; ``transmits``: whether one has a lobe, not delta, that scatters
    to the other side; ``mapped``: whether one has a bump or normal map; ``parts``: whether one is drawn by
    its parts, see `draws`; ``reverse``: whether some strategy in use starts from the other side, so that
    weights ask for the densities of the reverse directions.
    """

    full_pdf: bool
    round_trip: bool
    asked: Asked
    glossy: bool = False
    transmits: bool = False
    mapped: bool = False
    parts: bool = False
    reverse: bool = True

    def from_one_side(self) -> Traits:
        """Of the same BSDFs where no subpath starts from the other side."""
        return replace(self, round_trip=False, reverse=False)

    def null_transmission(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """What the surface ``si`` lets pass straight on, of every polarization."""

        def ask(self, si, active):
            return mi.UnpolarizedSpectrum(mi.unpolarized_spectrum(self.eval_null_transmission(si, active)))

        return self.asked(si.bsdf(), ask, si, active)

    @staticmethod
    def of(bsdfs: Sequence[mi.BSDF]) -> Traits:
        """Of BSDFs that one virtual call may visit."""
        through = int(mi.BSDFFlags.DiffuseTransmission) | int(mi.BSDFFlags.GlossyTransmission)
        glossy = any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy) for bsdf in bsdfs)
        transmits = any(bsdf.flags() & through for bsdf in bsdfs)
        mapped = any(b.class_name() in draws.MAPS for b in nested(bsdfs))
        parts = any(draws.by_parts(b) for b in bsdfs)
        return Traits(
            needs_full_pdf(bsdfs), needs_round_trip(bsdfs), Asked(bsdfs), glossy, transmits, mapped, parts
        )


# From so many BSDFs on, virtual calls ask few questions each. A call of all that is asked at a vertex hands
# over the interaction once, which saves 6 % of the time in a Cornell box; but each place that makes one has
# functions of its own, one per BSDF, where the same few questions, asked anywhere, are compiled once. (Rooms
# of 10 and of 27 materials take the same time either way. What diverging lanes cost in a decision is another
# matter, see `planning.choice.MANY_KINDS`.)
MANY = 10

# Points at which surfaces are asked what they let pass.
_ASKED = 4096


class Asked:
    """Virtual calls of these ``bsdfs`` alone, which are `MANY` or not.

    Mitsuba's visit all of the process, and a kernel holds a function for each of them: those inside of
    others, which no ray meets, and those of other scenes.
    """

    def __init__(self, bsdfs: Iterable[mi.BSDF]):
        by_id = {_registry_id(b): b for b in {id(b): b for b in bsdfs}.values()}
        self.bsdfs = list(by_id.values())
        self.many = len(by_id) >= MANY
        numbers = [0] * (max(by_id, default=0) + 1)
        for number, index in enumerate(by_id):
            numbers[index] = number
        self._numbers = mi.UInt32(numbers)

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.bsdfs)

    @property
    def kinds(self) -> int:
        """Number of distinct BSDF structures. BSDFs of one structure share the functions of a kernel."""
        return len({draws.structure(bsdf) for bsdf in self.bsdfs})

    def __call__(self, bsdf, question, *args):
        """Answers of ``question(bsdf, *args)``, the last of ``args`` being the call's mask.

        A BSDF itself, in place of a pointer, answers without a call.
        """
        # Run step by step, calls of functions of ours fail for `plastic`; its own methods do not.
        if isinstance(bsdf, mi.BSDF) or not dr.flag(dr.JitFlag.SymbolicCalls):
            return question(bsdf, *args)
        number = dr.gather(mi.UInt32, self._numbers, dr.reinterpret_array(mi.UInt32, bsdf), args[-1])
        return dr.switch(number, [partial(question, b) for b in self.bsdfs], *args)

    def together(self, bsdf, questions, *args):
        """Answers of ``questions(bsdf, *args)``, which asks through this object.

        In one call, or where there are `MANY` BSDFs in one for each question.
        """
        return questions(bsdf, *args) if self.many else self(bsdf, questions, *args)


def _registry_id(bsdf) -> int:
    return int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0])


@dataclass
class Target:
    """A local direction ``wo`` in which a BSDF is evaluated where ``active``.

    ``cos_ratio``, for light vertices: |n.wo| / |n.wi| with the geometric normal.
    """

    wo: mi.Vector3f
    active: mi.Bool
    cos_ratio: mi.Float | None = None


def with_wi(si: mi.SurfaceInteraction3f, wi: mi.Vector3f) -> mi.SurfaceInteraction3f:
    """A copy of ``si`` that is seen from ``wi``. (Assigning to ``si.wi`` changes aliases.)"""
    other = mi.SurfaceInteraction3f(si)
    other.wi = wi
    return other


def connectible(bsdf: mi.BSDFPtr):
    """Mask: the BSDF has a lobe that is not delta."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)


def evaluate(
    bsdf: mi.BSDFPtr, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool, traits: Traits
) -> Evaluation:
    """BSDF of a camera vertex towards the local direction ``wo``, and both densities."""
    return _evaluation(*_evaluated(bsdf, si, wo, active, traits))


def _evaluated(bsdf, si, wo, active, traits: Traits):
    """Value, and densities of ``wo`` and of the reverse, the other direction being ``si.wi``."""

    def ask(self, si, wo, active):
        ctx = mi.BSDFContext()
        if traits.mapped:  # Mitsuba's shadowing of bumps squares the cosine: 0 by infinity on one plane
            active = active & (dr.abs(mi.Frame3f.cos_theta(wo)) > _LEAST_COS)
        value, pdf = self.eval_pdf(ctx, si, wo, active)
        value = polarization.in_world(si, value, -wo, si.wi)
        return value, pdf, self.pdf(ctx, with_wi(si, wo), si.wi, active) if traits.reverse else mi.Float(0)

    return traits.asked(bsdf, ask, si, wo, active)


def _evaluation(value, pdf_fwd_w, pdf_rev_w) -> Evaluation:
    """The `Evaluation` of a BSDF; its value is NaN also where a density is not finite.

    NaN, so that whoever uses it counts it: no weight follows from such a density. (Where the value is 0 it
    does not matter.)
    """
    finite = dr.isfinite(pdf_fwd_w + pdf_rev_w)
    return Evaluation(dr.select(finite | is_zero(value), value, dr.nan), pdf_fwd_w, pdf_rev_w)


def evaluate_adjoint(bsdf, si, wo, active, traits: Traits, cos_ratio=None) -> Evaluation:
    """BSDF of a light vertex towards the local direction ``wo`` (to the camera's side).

    ``value`` includes the adjoint factor ``cos_ratio``, |n.wo| / |n.wi| with the geometric normal,
    which is computed unless given.
    """
    if cos_ratio is None:
        cos_ratio = geometric_cos(si, wo) / geometric_cos(si, si.wi)
    return _adjoint(cos_ratio, *_evaluated_adjoint(bsdf, si, wo, active, traits))


def _evaluated_adjoint(bsdf, si, wo, active, traits: Traits):
    """As `_evaluated`, with the directions swapped."""
    value, pdf_rev_w, pdf_fwd_w = _evaluated(bsdf, with_wi(si, wo), si.wi, active, traits)
    return value, pdf_fwd_w, pdf_rev_w


def _adjoint(cos_ratio, value, pdf_fwd_w, pdf_rev_w) -> Evaluation:
    return _evaluation(value * cos_ratio, pdf_fwd_w, pdf_rev_w)


def geometric_cos(si: mi.SurfaceInteraction3f, w: mi.Vector3f) -> mi.Float:
    """Absolute cosine between the local direction ``w`` and the geometric normal."""
    return dr.abs(dr.dot(si.n, si.to_world(w)))


def sample(
    bsdf, si, u1, u2, active, traits: Traits, target: Target | None = None
) -> tuple[Step, Evaluation | None]:
    """Continue a camera subpath where ``active``: the `Step`. ``u1`` picks the lobe, ``u2`` the direction.

    With a ``target`` also its `Evaluation`. Returns both, None for the latter without a target.
    """

    def questions(bsdf, si, u1, u2, sampled, *joined):
        drawn = _drawn(bsdf, si, u1, u2, sampled, traits, adjoint=False)
        return drawn, _evaluated(bsdf, si, *joined, traits) if target else None

    drawn, evaluated = _answers(questions, traits.asked, target, bsdf, si, u1, u2, active)
    step = _step(si, drawn, drawn.weight)
    if traits.round_trip:  # no alternative that would have to make this event from the other side
        step.cos_out = dr.select(~step.delta | (brightest(drawn.back) > 0), step.cos_out, 0)
    return step, _evaluation(*evaluated) if target else None


def sample_adjoint(
    bsdf, si, u1, u2, active, traits: Traits, target: Target | None = None
) -> tuple[Step, Evaluation | None]:
    """Continue a light subpath; arguments and results as of `sample`.

    The adjoint factor is part of ``weight``, and of the evaluation's ``value``.
    """

    def questions(bsdf, si, u1, u2, sampled, *joined):
        drawn = _drawn(bsdf, si, u1, u2, sampled, traits, adjoint=True)
        weight = _adjoint_weight(bsdf, si, drawn, sampled, traits)
        return drawn, weight, _evaluated_adjoint(bsdf, si, *joined, traits) if target else None

    drawn, weight, evaluated = _answers(questions, traits.asked, target, bsdf, si, u1, u2, active)
    cos_ratio = geometric_cos(si, drawn.bs.wo) / geometric_cos(si, si.wi)
    step = _step(si, drawn, dr.select(is_zero(weight), 0, weight * cos_ratio))
    return step, _adjoint(target.cos_ratio, *evaluated) if target else None


def _answers(questions, asked: Asked, target, bsdf, *args):
    """Answers of ``questions(bsdf, *args)``, the last of ``args`` a mask.

    Direction and mask of a ``target`` follow.
    """
    joined = (target.wo, target.active) if target else ()
    mask = args[-1] | target.active if target else args[-1]
    # The last argument is the call's mask.
    return asked.together(bsdf, lambda bsdf, *args: questions(bsdf, *args[:-1]), *args, *joined, mask)


def _adjoint_weight(bsdf, si, drawn: _Drawn, active, traits: Traits):
    """Weight of a sample of a light subpath without the ratio of geometric cosines."""
    bs, delta = drawn.bs, mi.has_flag(drawn.bs.sampled_type, mi.BSDFFlags.Delta)
    f = _evaluation(*_evaluated_adjoint(bsdf, si, bs.wo, active & ~delta, traits))
    # The radiance that a camera subpath carries, without its factor eta^-2.
    eta2 = dr.square(bs.eta)
    delta_weight = drawn.back / eta2 if _asks_back(traits, adjoint=True) else drawn.weight * eta2
    weight = dr.select(delta, delta_weight * _event_cos_ratio(si, bs), f.value / drawn.density)
    # Whatever the density says of a direction that Mitsuba rejects. NaN is kept, to be counted.
    return dr.select((drawn.pdf_fwd_w == 0) | drawn.rejected, 0, weight)


@dataclass
class _Drawn:
    """What a BSDF draws (`draws.draw`), ``bs`` in radiance mode.

    Its ``weight``, densities (where it is delta ``pdf_fwd_w`` is the probability of the event, and there is
    no ``pdf_rev_w``), if `_asks_back` the weight ``back`` of a delta event made from its other end, 0 if it
    does not lead back; ``of_parts``, in scenes with BSDFs that are drawn so: density and rejection, as in
    `draws.Draw`, which are ``pdf_fwd_w`` and a weight of 0 elsewhere.
    """

    bs: mi.BSDFSample3f
    weight: mi.Spectrum
    pdf_fwd_w: mi.Float
    pdf_rev_w: mi.Float
    back: mi.Spectrum
    of_parts: tuple[mi.Float, mi.Bool] | None = None

    @property
    def density(self):
        return self.pdf_fwd_w if self.of_parts is None else self.of_parts[0]

    @property
    def rejected(self):
        return is_zero(self.weight) if self.of_parts is None else self.of_parts[1]


def _drawn(bsdf, si, u1, u2, active, traits: Traits, adjoint: bool) -> _Drawn:
    """A direction that a BSDF draws, with its densities both ways, in one virtual call."""

    def ask(self, si, u1, u2, active):
        ctx, found = mi.BSDFContext(), draws.draw(self, si, u1, u2, active)
        bs = found.bs
        weight = polarization.in_world(si, found.weight, -bs.wo, si.wi)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        smooth = active & ~delta
        pdf_fwd_w = bs.pdf
        if traits.full_pdf:
            meant = [self] if isinstance(self, mi.BSDF) else traits.asked.bsdfs  # a pointer may be any
            behind = draws.none_from_behind(meant, si, bs)
            weight, found.rejected = dr.select(behind, 0, weight), found.rejected | behind
            full = smooth & ~(bs.pdf == 0)
            pdf_fwd_w = dr.select(full, self.pdf(ctx, si, bs.wo, full), bs.pdf)
        density = found.density if draws.by_parts(self) else pdf_fwd_w
        pdf_rev_w = self.pdf(ctx, with_wi(si, bs.wo), si.wi, smooth) if traits.reverse else mi.Float(0)
        asks = _asks_back(traits, adjoint)
        back = _back(self, si, bs, u1, u2, active & delta) if asks else mi.Spectrum(0)
        answers = bs, weight, pdf_fwd_w, pdf_rev_w, back
        return (*answers, (density, found.rejected)) if traits.parts else answers

    return _Drawn(*traits.asked(bsdf, ask, si, u1, u2, active))


def _asks_back(traits: Traits, adjoint: bool) -> bool:
    """Whether delta events are also made from their other end.

    On light subpaths of polarized variants for their matrices: that of light which travels the other way does
    not follow from it. (Mitsuba's importance mode is another answer, but turns retarders the wrong way.)
    """
    return traits.round_trip or (adjoint and bool(mi.is_polarized))


def _back(bsdf, si, bs, u1, u2, active):
    """The weight of a delta event sampled from its other end, 0 if it does not lead back.

    The event is taken to have the same probability from either end, as those of Mitsuba's BSDFs.
    """
    back = draws.draw(bsdf, with_wi(si, bs.wo), u1, u2, active)
    weight = polarization.in_world(si, back.weight, -si.wi, bs.wo)
    return dr.select(dr.squared_norm(back.bs.wo - si.wi) < 1e-4, weight, 0)


def _event_cos_ratio(si, bs):
    """|m.l| / |m.c| about the normal m of a delta event.

    Under a bump or normal map m is not the shading frame's. Reflection and null: 1. Refraction: m along eta_c
    c + eta_l l.
    """
    m = bs.eta * bs.wo + si.wi  # bs.eta = eta_c / eta_l when sampling from l
    ratio = dr.abs(dr.dot(m, si.wi) / dr.dot(m, bs.wo))
    refracted = mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaTransmission)
    refracted &= dr.abs(bs.eta - 1) > 1e-5  # equal indices: straight on, and m is zero
    return dr.select(refracted, ratio, 1)


def _step(si, drawn: _Drawn, weight) -> Step:
    """The step that a sample stands for, of this ``weight``."""
    bs = drawn.bs
    delta, cos_out = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), geometric_cos(si, bs.wo)
    # A direction that is NaN hits nothing, and nobody would know.
    finite = dr.isfinite(dr.select(delta, cos_out, cos_out + drawn.pdf_fwd_w + drawn.pdf_rev_w))
    finite &= is_finite(drawn.weight) & dr.isfinite(bs.eta)  # roulette asks for eta
    return Step(
        wo=bs.wo,
        weight=dr.select(finite | drawn.rejected, weight, dr.nan),
        pdf_fwd_w=drawn.pdf_fwd_w,
        pdf_rev_w=drawn.pdf_rev_w,
        cos_out=cos_out,
        delta=delta,
        null=mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null),
        eta=bs.eta,
    )


def polarizing(bsdfs: Iterable[mi.BSDF]) -> list[mi.BSDF]:
    """Those of ``bsdfs``, and of what is in them, that polarize what they let pass straight on.

    They are asked at points all over their textures, from both sides.
    """
    if not mi.is_polarized:
        return []
    rng = np.random.default_rng(0)
    si = dr.zeros(mi.SurfaceInteraction3f, _ASKED)
    si.uv = mi.Point2f(rng.random((2, _ASKED)).astype(np.float32))
    directions = rng.standard_normal((3, _ASKED)).astype(np.float32)
    si.wi = dr.normalize(mi.Vector3f(directions))
    found = [b for b in nested(bsdfs) if mi.has_flag(b.flags(), mi.BSDFFlags.Null)]
    return [b for b in found if not _is_scalar(mi.Spectrum(b.eval_null_transmission(si)))]


def _is_scalar(matrix: mi.Spectrum) -> bool:
    """Whether Mueller matrices are numbers for each wavelength times the identity."""
    rows = [[np.array(matrix[i, j]) for j in range(4)] for i in range(4)]
    first = rows[0][0]
    return all(np.abs(rows[i][j] - (i == j) * first).max() < 1e-6 for i in range(4) for j in range(4))


def needs_round_trip(bsdfs: Iterable[mi.BSDF]) -> bool:
    """Whether a delta event may exist from one end only: under a bump or normal map.

    Mitsuba's maps drop sampled directions (not incident ones) on different sides of the surface and
    of the perturbed normal, and turn the normal towards the incident direction.
    """
    return any(
        b.class_name() in draws.MAPS and mi.has_flag(b.flags(), mi.BSDFFlags.Delta) for b in nested(bsdfs)
    )
