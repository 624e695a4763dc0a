"""The other strategies that sample a path up to a vertex: coefficients of the newest alternative, merges.

Each vertex's newest alternative connects the edge to it, see `mis`.
"""

from __future__ import annotations

import mitsuba as mi

from . import mis
from .inputs import Kernel


def direct_coefficient(kernel: Kernel, vertex) -> mis.Coefficient:
    """kappa of next-event estimation at ``vertex``, 0 where a medium does not allow it."""
    return where_lit(kernel, kernel.space.allows_next_event(vertex))


def where_lit(kernel: Kernel, lit: mi.Bool | None) -> mis.Coefficient:
    """kappa of next-event estimation where ``lit`` (None: everywhere), else 0."""
    direct = kernel.kappa.direct
    return direct if lit is None else mis.choose(lit, direct, 0)


def newest_coefficient(kernel: Kernel, first: mis.Coefficient, edges: mi.UInt32) -> mis.Coefficient:
    """kappa of the newest alternative's class at vertex ``edges``, for s >= 1.

    s = 0 differs, see `techniques.hit_emitter`. ``first``: kappa at vertex 1, see `Side`.
    """
    return mis.choose(edges == 1, first, kernel.kappa.inner)


def newest_connection(kernel: Kernel, first: mis.Coefficient, vertex) -> mis.PartialSum:
    """The newest alternative at ``vertex``: ``d_vcm`` times `newest_coefficient`."""
    newest = newest_coefficient(kernel, first, vertex.edges)
    return kernel.heuristic.scale(vertex.partial.d_vcm, newest)


def has_lobe(kernel: Kernel, vertex) -> mi.Bool:
    """Mask: a ``vertex`` on a surface whose event is not always delta; the path may have a further edge."""
    return vertex.hit & vertex.connectible() & (vertex.edges < kernel.max_depth) & ~vertex.volume


def is_sds_vertex(kernel: Kernel, first: mis.Coefficient, walk, vertex) -> mi.Bool:
    """Mask: the diffuse ``vertex`` of an SDS path, if the other subpath matches.

    No edge up to it is connected by a strategy in use, its event is not delta, it lies on a surface, and the
    path may have a further edge. ``first`` as in `newest_coefficient`; ``walk`` as before its arrival.
    """
    newest = newest_coefficient(kernel, first, vertex.edges)
    if vertex.sds is not None:
        return has_lobe(kernel, vertex) & vertex.sds.isolated & ~vertex.sds.is_connectible(False, newest)
    connectible = mis.is_connectible(vertex.partial, newest)
    possible = has_lobe(kernel, vertex) & ~connectible
    isolated = None if walk.sds is None else walk.sds.isolated
    return possible if isolated is None else possible & isolated


def merges_up_to(
    kernel: Kernel, vertex, first: mis.Coefficient, pdf_rev_w, pdf_a, own: mis.Coefficient
) -> mis.PartialSum:
    """Merges at the vertices up to ``vertex``, which a strategy connects; see `mis.merges`.

    ``first``: as in `newest_coefficient`, of the rival of merges. The number 0 without merging.
    """
    if kernel.sds is None or not kernel.sds.merges:
        return 0
    h, ratio = kernel.heuristic, kernel.sds.ratio(kernel, vertex.si.p)
    coefficient = newest_coefficient(kernel, first, vertex.edges)
    return mis.merges(h, vertex.partial, coefficient, pdf_rev_w, pdf_a, own, ratio)


def merges_before_end(
    kernel: Kernel, partial: mis.Partial, coefficient: mis.Coefficient, pdf: mi.Float
) -> mis.PartialSum:
    """The same before the end of a subpath, on an emitter or the sensor.

    ``pdf``: density of the end and of the direction from there; ``coefficient``: that of the rival that
    connects the last edge, times the density of the end if ``pdf`` contains it.
    """
    if not kernel.merges:
        return 0
    connection = kernel.heuristic.scale(partial.d_vcm, coefficient)
    return mis.older_merges(kernel.heuristic, partial, connection, pdf)
