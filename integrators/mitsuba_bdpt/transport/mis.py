"""Multiple importance sampling of all strategies (s, t) by recursive partial sums.

Source: Iliyan Georgiev, "Implementing Vertex Connection and Merging", technical report, Saarland
University, 2012; equation numbers below are the report's. Each subpath carries
two floats, ``d_vcm`` and ``d_vc``, from which the weight of any strategy follows at once:

* ``d_vcm`` stands for the *newest* alternative strategy: the one that makes the subpath's last
  vertex from the other side. It has to be multiplied by the density with which that happens.
* ``d_vc`` stands for all older alternatives. It has to be multiplied by that same density and by
  the reverse density (solid angle) of the vertex before the last.

Where vertices of isolated paths are merged (see `merging`) a third float, ``d_vm``, stands for the merges at
older vertices, and is used like ``d_vc``. It is the report's (eqs. 38, 39) times eta, so that all strategies
share one scale. ``d_vc`` has no eta in it: paths that are not isolated weigh what they weigh without merging.

What differs from the report: (1) each strategy class has a coefficient kappa with which it enters
every weight, w_i = kappa_i p_i / sum_j kappa_j p_j. A vertex does not know yet which class its
newest alternative will belong to, so the coefficient joins when a strategy is evaluated or when
the term is folded into ``d_vc``, never when it is stored. (2) Sums are kept in linear units and
combined by the heuristic (``a + b`` or ``hypot``); squares are never stored, so
ratios of densities over 60 orders of magnitude stay finite. (3) The density of next-event
estimation may depend on the vertex that is lit; see ``emitters``.

Everything here is arithmetic on floats of any width; it knows no scene. A coefficient or partial sum that
is the Python number 0 belongs to classes that are not in use: nothing is computed for them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..errors import UsageError
from ..settings import HEURISTICS
from .bsdf import Step

if TYPE_CHECKING:
    # One number, under `ByClass` one for each class; the Python number 0 for classes that are not in use.
    # (Records that loops carry write it out: Dr.Jit evaluates their annotations.)
    PartialSum = mi.Float | mi.Vector4f | int
    Coefficient = PartialSum

# Classes whose coefficients a render may choose: s = 0, s = 1 (t >= 2), t <= 1, s and t >= 2.
CLASSES = ("hit", "direct", "light", "inner")

# A strategy beyond this ratio has a weight below 1e-37, the smallest that float32 tells from zero;
# without the bound, infinity times a following reverse density of zero would be NaN.
SATURATION = 1e37


@dataclass
class Partial:
    """Partial sums of one subpath; see the module's description."""

    d_vcm: mi.Float | mi.Vector4f | int
    d_vc: mi.Float | mi.Vector4f | int
    d_vm: mi.Float | mi.Vector4f | int = 0


@dataclass
class Merge:
    """A merge at a vertex, or what else makes isolated paths there.

    ``ratio``: the partial sum of it, kappa times the number of photons' subpaths times the area of the disc;
    ``isolated``: the path up to the event there has no edge that a strategy in use joins.
    """

    ratio: mi.Float | mi.Vector4f
    isolated: mi.Bool


def is_joined(partial: Partial, coefficient: Coefficient):
    """Mask: a strategy in use, of this ``coefficient``, joins the edge to the vertex of ``partial``."""
    if is_absent(coefficient):
        return mi.Bool(False)
    used = dr.max(coefficient) if isinstance(coefficient, mi.Vector4f) else coefficient
    return (partial.d_vcm > 0) & (used > 0)


def is_absent(x: PartialSum) -> bool:
    """Whether ``x`` stands for classes of strategies that are not in use."""
    return isinstance(x, (int, float)) and x == 0


def choose(mask: mi.Bool, a: PartialSum, b: PartialSum) -> PartialSum:
    """``dr.select`` of two coefficients or partial sums; 0 where both classes are not in use."""
    return 0 if is_absent(a) and is_absent(b) else dr.select(mask, a, b)


def times(coefficient: Coefficient, pdf: mi.Float) -> PartialSum:
    """A coefficient times a density (in any measure) that enter a partial sum together."""
    return 0 if is_absent(coefficient) else coefficient * pdf


class Heuristic:
    """How alternatives are combined: ``balance`` or ``power`` (exponent 2).

    Raises ``UsageError`` for any other name.
    """

    def __init__(self, name: str):
        if name not in HEURISTICS:
            raise UsageError(f"heuristic={name!r} is not known; use one of {', '.join(HEURISTICS)}")
        self.name = name

    def scale(self, x: PartialSum, factor: PartialSum) -> PartialSum:
        """Partial sum ``x`` times a density, a ratio of densities or a coefficient."""
        if is_absent(x) or is_absent(factor):
            return 0
        # The factor as well: 0 times an infinite product of densities would be NaN.
        return dr.minimum(x * dr.minimum(factor, SATURATION), SATURATION)

    def combine(self, a: PartialSum, b: PartialSum) -> PartialSum:
        """Join two partial sums in linear units (``hypot`` for the power heuristic)."""
        if is_absent(a) or is_absent(b):
            return b if is_absent(a) else a
        total = dr.hypot(a, b) if self.name == "power" else a + b
        return dr.minimum(total, SATURATION)

    def zero(self) -> mi.Float | mi.Vector4f:
        """An empty partial sum."""
        return mi.Float(0)

    def present(self, x: PartialSum) -> PartialSum:
        """A partial sum to which classes in use may be added."""
        return self.zero() if is_absent(x) else x

    def start(self, inverse_pdf: mi.Float):
        """Partial sum of one strategy whose ratio is ``inverse_pdf`` so far: 1 / a density in any measure."""
        return dr.minimum(inverse_pdf, SATURATION)

    def weigh(
        self,
        coefficient: Coefficient,
        light_side: PartialSum,
        camera_side: PartialSum,
        tr: mi.Float | None = None,
    ) -> tuple[mi.Float, mi.Vector4f | None]:
        """`weight`, and the classes' shares of it, which only `ByClass` knows.

        ``tr``: T~ of the edge that the strategy joins, which the others sample; None without media.
        """
        if tr is not None:
            light_side, camera_side = self.scale(light_side, tr), self.scale(camera_side, tr)
        return self._weigh(coefficient, light_side, camera_side)

    def _weigh(
        self, coefficient: Coefficient, light_side: PartialSum, camera_side: PartialSum
    ) -> tuple[mi.Float, mi.Vector4f | None]:
        # The stubs take numbers and sums of entries for something else.
        return self.weight(coefficient, light_side, camera_side), None  # pyright: ignore[reportReturnType]

    def weight(self, coefficient: Coefficient, light_side: PartialSum, camera_side: PartialSum):
        """Weight of the strategy at hand, in [0, 1]; its own coefficient must be positive.

        ``light_side`` and ``camera_side`` are the combined ratios kappa_j p_j / p of all
        alternatives with fewer and with more light vertices (eq. 37).
        """
        others = self.combine(light_side, camera_side)
        if is_absent(others):
            return mi.Float(1)
        ratio = others / coefficient
        return dr.rcp(1 + (dr.square(ratio) if self.name == "power" else ratio))


class ByClass(Heuristic):
    """The balance heuristic with partial sums split by classes of strategies: `CLASSES`, one entry each.

    Coefficients are vectors with one entry that is not 0, so that every term finds its place.
    """

    def __init__(self):
        super().__init__("balance")

    def zero(self) -> mi.Vector4f:
        return mi.Vector4f(0)

    def _weigh(
        self, coefficient: Coefficient, light_side: PartialSum, camera_side: PartialSum
    ) -> tuple[mi.Float, mi.Vector4f | None]:
        # The weight of the strategy at hand, and the share of each class in the sum of all strategies.
        total = self.combine(self.combine(light_side, camera_side), coefficient)
        shares = total / dr.sum(total)
        return dr.sum(coefficient) / dr.sum(total), shares  # pyright: ignore[reportReturnType]


def to_area(
    heuristic: Heuristic, partial: Partial, dist2: mi.Float, cos: mi.Float, tr: mi.Float | None = None
) -> Partial:
    """Convert to the area measure at a new vertex (the part of eqs. 31, 32, 34, 35 that is known there).

    ``dist2`` squared length of the edge; 1 on the first edge of a light subpath, where ``d_vcm`` contains it
    (from infinity there is none), and of a parallel sensor, whose density is one across the edge;
    ``cos`` absolute geometric cosine at the new vertex; ``tr`` T~ of the edge, which this subpath sampled and
    the newest alternative joins (None without media).
    """
    return Partial(
        d_vcm=heuristic.scale(partial.d_vcm, dist2 / (cos if tr is None else cos * tr)),
        d_vc=heuristic.scale(partial.d_vc, dr.rcp(cos)),
        d_vm=heuristic.scale(partial.d_vm, dr.rcp(cos)),
    )


def scatter(
    heuristic: Heuristic, partial: Partial, coefficient: Coefficient, step: Step, merge: Merge | None = None
) -> Partial:
    """Fold the newest alternative and take a sampled direction (eqs. 34, 35; delta events 53, 54).

    ``coefficient`` of the class to which the newest alternative belongs; ``step`` holds
    ``pdf_fwd_w`` and ``pdf_rev_w`` (solid angle), ``cos_out`` (geometric) and the mask ``delta``; ``merge``
    the one at this vertex, None where there are none.
    """
    older = heuristic.combine(
        heuristic.scale(partial.d_vcm, coefficient),
        heuristic.scale(partial.d_vc, step.pdf_rev_w),
    )
    # A delta event cannot be made by a connection at this vertex (eqs. 53, 54); its probabilities from either
    # side are the same for Mitsuba's BSDFs and left out. So is the ratio of the solid angles on the two sides
    # of a refraction, (eta_l/eta_c)^2 cos_l/cos_c: weights are those of densities that leave it out, the same
    # ones whichever strategy asks, so they sum to 1 and nothing is biased; they are exactly the balance
    # heuristic's for reflections and where these ratios multiply to 1.
    kept = 0
    if not is_absent(older):
        kept = dr.select(
            step.delta,
            heuristic.scale(partial.d_vc, step.cos_out),
            heuristic.scale(older, step.cos_out / step.pdf_fwd_w),
        )
    return Partial(
        d_vcm=dr.select(step.delta, 0.0, heuristic.start(dr.rcp(step.pdf_fwd_w))),
        d_vc=kept,
        d_vm=0 if merge is None else _scattered_merges(heuristic, partial, step, merge),
    )


def _scattered_merges(heuristic: Heuristic, partial: Partial, step: Step, merge: Merge) -> PartialSum:
    """``d_vm`` after an event: the merges before it, and that at this vertex, which joins no delta event."""
    merges = heuristic.combine(
        heuristic.scale(partial.d_vm, step.pdf_rev_w),
        merge.ratio,
    )
    kept = dr.select(
        step.delta,
        heuristic.scale(partial.d_vm, step.cos_out),
        heuristic.scale(merges, step.cos_out / step.pdf_fwd_w),
    )
    return dr.select(merge.isolated, kept, 0)


def alternatives(
    heuristic: Heuristic, partial: Partial, coefficient: Coefficient, pdf_rev_w: mi.Float, pdf_a: mi.Float
) -> PartialSum:
    """Combined ratios of all strategies that take vertices away from this subpath (eqs. 40, 41, 44-47).

    ``coefficient`` of the newest alternative's class; ``pdf_rev_w`` solid-angle density of sampling
    the vertex before the last from the last; ``pdf_a`` density of making the last vertex from the other
    side, in the measure in which ``d_vcm`` is stored (area; solid angle at infinity).
    """
    total = heuristic.combine(
        heuristic.scale(partial.d_vcm, coefficient),
        heuristic.scale(partial.d_vc, pdf_rev_w),
    )
    return heuristic.scale(total, pdf_a)
