"""Multiple importance sampling of all strategies (s, t) by recursive partial sums.

Source: Iliyan Georgiev, "Implementing Vertex Connection and Merging", technical report, Saarland University,
2012; equation numbers are the report's. Each subpath carries two numbers, ``d_vcm`` and ``d_vc``, from which
the weight of any strategy follows:

* ``d_vcm``: the *newest* alternative strategy, which samples the subpath's last vertex from the other side,
  over the density of doing so;
* ``d_vc``: all older alternatives, over that density and the reverse density (solid angle) of the vertex
  before the last.

With vertex merging ``d_vm`` and ``d_vm_newest`` stand for the merges at older vertices and at the newest
(eqs. 36, 55, times eta). A path is merged where V, the sum of kappa p of its merges, is at least B times S,
that of all other strategies. With photon guiding ``d_vm`` of light subpaths stands for guided s = 0. Symbols
as in docs/method/sds_paths.md.

Differences from the report: (1) Each strategy class has a coefficient kappa in every weight,
w_i = kappa_i p_i / sum_j kappa_j p_j. A vertex does not know the class of its newest alternative, so kappa is
applied when a strategy is evaluated or the term is folded into ``d_vc``, never when it is stored. (2) Sums
are kept in linear units and combined by the heuristic (``a + b`` or ``hypot``); squares are never stored, so
that ratios of densities over 60 orders of magnitude stay finite. (3) The density of next-event estimation may
depend on the illuminated vertex; see ``emitters``.

All functions are arithmetic on floats of any width, without a scene. The Python number 0 as a coefficient or
partial sum marks classes that are not in use: nothing is computed for them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi

from .bsdf import Step

if TYPE_CHECKING:
    # One number, with `ByClass` one per class; the Python number 0 for classes that are not in use. Records
    # carried by loops write it out: Dr.Jit evaluates their annotations.
    PartialSum = mi.Float | mi.Vector4f | int
    Coefficient = PartialSum

# Classes of strategies with a coefficient: s = 0, s = 1 (t >= 2), t <= 1, s and t >= 2.
CLASSES = ("hit", "direct", "light", "inner")

# Bound of ratios: weights beyond are below 1e-37, about the least normal float32. Without it infinity times a
# reverse density of zero would be NaN.
SATURATION = 1e37

# B: how many times as likely merges have to be as all other strategies. 0 merges all paths.
MERGE_DOMINATED = 1.0


@dataclass
class Partial:
    """Partial sums of one subpath; see the module's description."""

    d_vcm: mi.Float | mi.Vector4f | int
    d_vc: mi.Float | mi.Vector4f | int
    d_vm: mi.Float | mi.Vector4f | int = 0
    d_vm_newest: mi.Float | mi.Vector4f | int = 0


def is_connectible(partial: Partial, coefficient: Coefficient):
    """Mask: a strategy with this ``coefficient`` connects the edge to the vertex."""
    return mi.Bool(False) if is_absent(coefficient) else (partial.d_vcm > 0) & is_used(coefficient)


def is_used(coefficient: Coefficient):
    """Mask: this ``coefficient``, or partial sum, is not 0 in any class."""
    if is_absent(coefficient):
        return mi.Bool(False)
    return (dr.max(coefficient) if isinstance(coefficient, mi.Vector4f) else coefficient) > 0


def is_absent(x: PartialSum) -> bool:
    """Whether ``x`` is the Python number 0, of classes of strategies that are not in use."""
    return isinstance(x, (int, float)) and x == 0


def choose(mask: mi.Bool, a: Any, b: Any) -> Any:
    """``dr.select`` of two coefficients, partial sums or `Partial`; 0 if neither class is in use."""
    if isinstance(a, Partial):
        return Partial(*(choose(mask, x, vars(b)[name]) for name, x in vars(a).items()))
    return 0 if is_absent(a) and is_absent(b) else dr.select(mask, a, b)


class Heuristic:
    """Combination of alternatives by ``name``: ``balance`` or ``power`` (exponent 2), see `settings`."""

    def __init__(self, name: str = "balance"):
        self.name = name

    def scale(self, x: PartialSum, factor: PartialSum) -> PartialSum:
        """Partial sum ``x`` times a density, a ratio of densities or a coefficient."""
        if is_absent(x) or is_absent(factor):
            return 0
        # Also bounds the factor: 0 times an infinite product of densities would be NaN.
        return dr.minimum(x * dr.minimum(factor, SATURATION), SATURATION)

    def combine(self, a: PartialSum, b: PartialSum) -> PartialSum:
        """Add two partial sums in linear units (``hypot`` for the power heuristic)."""
        if is_absent(a) or is_absent(b):
            return b if is_absent(a) else a
        total = dr.hypot(a, b) if self.name == "power" else a + b
        return dr.minimum(total, SATURATION)

    def zero(self) -> mi.Float | mi.Vector4f:
        """An empty partial sum."""
        return mi.Float(0)

    def present(self, x: PartialSum) -> PartialSum:
        """A partial sum to which classes in use can be added."""
        return self.zero() if is_absent(x) else x

    def start(self, inverse_pdf: mi.Float):
        """Partial sum of one strategy of ratio ``inverse_pdf``, 1 / density (any measure)."""
        return dr.minimum(inverse_pdf, SATURATION)

    def equal_weight(self, ratio: mi.Float) -> mi.Float:
        """r^(beta - 1): factor of an estimate f / p of density r p (r: ``ratio``) with the weight of p."""
        return ratio if self.name == "power" else mi.Float(1)

    def weigh(
        self,
        coefficient: Coefficient,
        light_side: PartialSum,
        camera_side: PartialSum,
        merges: tuple = (),
        kappa_prime: Coefficient = 0,
        tr: mi.Float | None = None,
    ) -> tuple[mi.Float, mi.Vector4f | None]:
        """`weight`, and the shares of the classes (only `ByClass`, else None).

        ``merges``: for each subpath the pair that `merges` returns; their sum V counts where V >= B S.
        ``kappa_prime`` of the connected edge, with which merges at its ends are compared. ``tr``: T~ of that
        edge, which the other strategies sample; None without media.
        """
        if tr is not None:
            light_side, camera_side = self.scale(light_side, tr), self.scale(camera_side, tr)
        v = 0
        for at_end, older in merges:
            if tr is not None:
                at_end, older = self.scale(at_end, tr), self.scale(older, tr)
            if not is_absent(at_end):
                at_end = dr.select(exceeds(at_end, kappa_prime), at_end, 0)
            v = self.combine(v, self.combine(at_end, older))
        if not is_absent(v):
            others = self.combine(self.combine(light_side, camera_side), coefficient)
            camera_side = self.combine(camera_side, dr.select(exceeds(v, others), v, 0))
        return self._weigh(coefficient, light_side, camera_side)

    def _weigh(self, coefficient: Coefficient, light_side: PartialSum, camera_side: PartialSum) -> tuple:
        return self.weight(coefficient, light_side, camera_side), None

    def weight(self, coefficient: Coefficient, light_side: PartialSum, camera_side: PartialSum):
        """Weight in [0, 1] of a strategy with a positive ``coefficient``.

        ``light_side`` and ``camera_side``: combined ratios kappa_j p_j / p of all alternatives with fewer and
        with more light vertices (eq. 37).
        """
        others = self.combine(light_side, camera_side)
        if is_absent(others):
            return mi.Float(1)
        ratio = others / coefficient
        return dr.rcp(1 + (dr.square(ratio) if self.name == "power" else ratio))


class ByClass(Heuristic):
    """The balance heuristic with partial sums split by class, one entry per `CLASSES`.

    Coefficients are one-hot vectors, which assign every term to its class.
    """

    def zero(self) -> mi.Vector4f:
        return mi.Vector4f(0)

    def _weigh(self, coefficient: Coefficient, light_side: PartialSum, camera_side: PartialSum) -> tuple:
        # The strategy's weight, and the share of each class in the sum of all strategies.
        total = self.combine(self.combine(light_side, camera_side), coefficient)
        shares = total / dr.sum(total)
        return dr.sum(coefficient) / dr.sum(total), shares


def to_area(
    h: Heuristic, partial: Partial, dist2: mi.Float, cos: mi.Float, tr: mi.Float | None = None
) -> Partial:
    """Convert to the area measure at a new vertex (known part of eqs. 31, 32, 34, 35).

    ``dist2``: squared length of the edge; 1 on the first edge of a light subpath, whose ``d_vcm`` contains
    it, and of a parallel sensor; ``cos``: absolute geometric cosine at the new vertex; ``tr``: T~ of the
    edge, None without media.
    """
    newest = h.scale(partial.d_vcm, dist2 / (cos if tr is None else cos * tr))
    older = partial.d_vc, partial.d_vm, partial.d_vm_newest
    return Partial(newest, *(h.scale(x, dr.rcp(cos)) for x in older))


def scatter(h: Heuristic, partial: Partial, coefficient: Coefficient, step: Step) -> Partial:
    """Fold the newest alternative and sample a direction (eqs. 34, 35; delta: 53, 54).

    ``coefficient`` of the newest alternative's class; ``step`` with ``pdf_fwd_w`` and ``pdf_rev_w`` (solid
    angle), ``cos_out`` (geometric) and the mask ``delta``.
    """
    older = alternatives(h, partial, coefficient, step.pdf_rev_w)
    newest = dr.select(step.delta, 0.0, h.start(dr.rcp(step.pdf_fwd_w)))
    return Partial(newest, _folded(h, step, partial.d_vc, older))


def _folded(h: Heuristic, step: Step, before: PartialSum, older: PartialSum):
    """A partial sum after an event: ``older`` alternatives; ``before`` the event if that is delta."""
    # A delta event cannot be made by a connection at this vertex (eqs. 53, 54); its probabilities from either
    # side are equal for Mitsuba's BSDFs and left out. So is the ratio of the solid angles on the two sides of
    # a refraction, (eta_l/eta_c)^2 cos_l/cos_c: all strategies leave it out, so that weights sum to 1. They
    # are the balance heuristic's for reflections and where these ratios multiply to 1.
    passed = h.scale(before, step.cos_out)
    return choose(step.delta, passed, h.scale(older, step.cos_out / step.pdf_fwd_w))


def scattered_guided(h: Heuristic, partial: Partial, step: Step, guided: PartialSum, isolated: mi.Bool):
    """``d_vm`` of a light subpath after an event: guided s = 0 at earlier vertices, and at this one.

    ``guided``: n p_g d_vc, 0 where this vertex does not guide; ``isolated``: no edge up to the event is
    connected by a strategy in use.
    """
    total = h.combine(h.scale(partial.d_vm, step.pdf_rev_w), guided)
    return dr.select(isolated, _folded(h, step, partial.d_vm, total), 0)


def exceeds(merges: PartialSum, others: PartialSum):
    """Mask: V >= B S, or kappa eta >= B c for the connection of an edge at the merged vertex."""
    return merges >= MERGE_DOMINATED * others


def older_merges(h: Heuristic, partial: Partial, connection: PartialSum, pdf_rev_w: mi.Float) -> PartialSum:
    """O: merges at vertices before the last.

    ``connection``: c of the edge to the last vertex, its ``d_vcm`` times kappa'.
    """
    newest = h.scale(partial.d_vm_newest, pdf_rev_w)
    older = h.scale(partial.d_vm, pdf_rev_w)
    return h.combine(older, dr.select(exceeds(newest, connection), newest, 0))


def scattered_merges(
    h: Heuristic, partial: Partial, step: Step, kappa_eta: mi.Float, kappa_prime: Coefficient
):
    """``d_vm`` and ``d_vm_newest`` after an event (eqs. 36, 55).

    ``kappa_eta`` of a merge at the vertex (`Merging.eta`); ``kappa_prime`` of the edge to it. Next to a delta
    event no edge is connected: the newest merge counts.
    """
    connection, before = h.scale(partial.d_vcm, kappa_prime), h.combine(partial.d_vm, partial.d_vm_newest)
    older = older_merges(h, partial, connection, step.pdf_rev_w)
    newest = dr.select(exceeds(kappa_eta, connection), kappa_eta, 0)
    return _folded(h, step, before, older), _folded(h, step, 0, newest)


def merges(
    h: Heuristic,
    partial: Partial,
    kappa_prime: Coefficient,
    pdf_rev_w: mi.Float,
    pdf_a: mi.Float,
    kappa_eta: mi.Float,
) -> tuple[PartialSum, PartialSum]:
    """Merges at the last vertex of a subpath, which is connected, and at older ones: terms of V.

    ``kappa_prime`` of the edge to that vertex; ``pdf_rev_w``, ``pdf_a``: as in `alternatives`; ``kappa_eta``
    of a merge at it. The first is still to be compared with the connection, see `Heuristic.weigh`.
    """
    connection = h.scale(partial.d_vcm, kappa_prime)
    there = h.scale(kappa_eta, pdf_a)
    there = dr.select(exceeds(kappa_eta, connection), there, 0)
    return there, h.scale(older_merges(h, partial, connection, pdf_rev_w), pdf_a)


def alternatives(
    h: Heuristic, partial: Partial, coefficient: Coefficient, pdf_rev_w: mi.Float, pdf_a: mi.Float | float = 1
) -> PartialSum:
    """Combined ratios of all strategies that shorten this subpath (eqs. 40-47).

    ``coefficient`` of the newest alternative's class; ``pdf_rev_w``: solid-angle density of sampling the
    vertex before the last from the last; ``pdf_a``: density of sampling the last vertex from the other side,
    in the measure of ``d_vcm`` (area; solid angle at infinity).
    """
    total = h.combine(h.scale(partial.d_vcm, coefficient), h.scale(partial.d_vc, pdf_rev_w))
    return h.scale(total, pdf_a)


def weigh_merge(
    h: Heuristic, kappa_eta: mi.Float, light: tuple, camera: tuple, connections: PartialSum
) -> mi.Float:
    """Weight of a merge with this ``kappa_eta`` (eqs. 37-39); 0 where merges do not dominate.

    ``light`` and ``camera`` subpath: `Partial`, c and ``pdf_rev_w`` of its last edge; ``connections``: sum of
    ``d_vcm`` times kappa of both last edges.
    """
    older, v = 0, kappa_eta
    for partial, connection, pdf_rev_w in (light, camera):
        older = h.combine(older, h.scale(partial.d_vc, pdf_rev_w))
        v = h.combine(v, older_merges(h, partial, connection, pdf_rev_w))
    possible = exceeds(kappa_eta, light[1]) & exceeds(kappa_eta, camera[1])
    others = h.present(h.combine(connections, older))
    possible &= exceeds(v, others)
    # v contains the merge itself.
    weight = kappa_eta / h.combine(v, others)
    return dr.select(possible, dr.square(weight) if h.name == "power" else weight, 0)
