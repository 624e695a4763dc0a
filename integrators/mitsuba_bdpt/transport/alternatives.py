"""The other strategies that sample a path up to a vertex: coefficients of the newest alternative, merges.

Each vertex's newest alternative connects the edge to it, see `mis`. Vertices are those of light subpaths
where ``adjoint``, else of camera subpaths.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from . import mis
from .inputs import TraceContext
from .sds import is_diffuse


def where_lit(kernel: TraceContext, lit: mi.Bool | None) -> mis.Coefficient:
    """kappa of next-event estimation where ``lit`` (None: everywhere), else 0."""
    direct = kernel.kappa.direct
    return direct if lit is None else mis.choose(lit, direct, 0)


def newest_coefficient(kernel: TraceContext, vertex, adjoint: bool, prime: bool = False) -> mis.Coefficient:
    """kappa of the newest alternative at ``vertex``, for s >= 1; s = 0 differs: `techniques.hit_emitter`.

    ``prime``: kappa' instead, for comparisons with merges (docs/method/sds_paths.md).
    """
    if adjoint:
        first = where_lit(kernel, kernel.space.allows_next_event(vertex))
    else:
        first = kernel.kappa.splat_prime if prime else kernel.kappa.splat
    return mis.choose(vertex.edges == 1, first, kernel.kappa.inner)


def newest_connection(kernel: TraceContext, vertex, adjoint: bool, prime: bool = False) -> mis.PartialSum:
    """The newest alternative at ``vertex``: ``d_vcm`` times `newest_coefficient`."""
    newest = newest_coefficient(kernel, vertex, adjoint, prime)
    return kernel.heuristic.scale(vertex.partial.d_vcm, newest)


def has_lobe(kernel: TraceContext, vertex) -> mi.Bool:
    """Mask: a ``vertex`` whose event is not always delta; the path may have a further edge."""
    return vertex.hit & vertex.connectible() & (vertex.edges < kernel.max_depth)


def is_sds_vertex(kernel: TraceContext, vertex, adjoint: bool) -> mi.Bool:
    """Mask: by its side alone ``vertex`` may be the diffuse one of an SDS path.

    It has a lobe (`has_lobe`), and no strategy in use connects an edge up to it.
    """
    newest, state = newest_coefficient(kernel, vertex, adjoint), vertex.sds
    if state is None or state.specular is None:
        connectible = mis.is_connectible(vertex.partial, newest)
    else:
        connectible = state.is_connectible(False, newest)
    possible = has_lobe(kernel, vertex) & ~connectible
    return possible if state is None else possible & state.isolated


def side_of(kernel: TraceContext, vertex, adjoint: bool, f, pdf_a, behind_diffuse=False) -> tuple:
    """Other strategies on the side of a connected ``vertex``.

    ``f``: its `bsdf.Evaluation`; ``pdf_a`` as in `mis.alternatives`; ``behind_diffuse``, of a light
    vertex: mask, an event of the camera subpath is `sds.is_diffuse`.
    Returns `mis.alternatives`, and a tuple for `Heuristic.weigh`: `mis.merges`, empty without merging.
    """
    h, partial = kernel.heuristic, vertex.partial
    newest = newest_coefficient(kernel, vertex, adjoint)
    found = mis.alternatives(h, partial, newest, f.pdf_rev_w, pdf_a)
    if not kernel.sds.merges:
        return found, ()
    kappa_prime = newest_coefficient(kernel, vertex, adjoint, prime=True)
    kappa_eta = kernel.sds.kappa_eta(vertex)
    there, older = mis.merges(h, partial, kappa_prime, f.pdf_rev_w, pdf_a, kappa_eta)
    if adjoint:
        there = dr.select(behind_diffuse, 0, there)
        older = dr.select(behind_diffuse | is_diffuse(kernel, f), 0, older)
    return found, ((there, older),)


def merges_before_end(
    kernel: TraceContext, partial: mis.Partial, kappa_prime: mis.Coefficient, pdf: mi.Float
) -> mis.PartialSum:
    """Merges before the end of a subpath, on an emitter or the sensor.

    ``pdf``: density of the end and of the direction from there; ``kappa_prime`` of the last edge, times the
    density of the end if ``pdf`` contains it.
    """
    if not kernel.sds.merges:
        return 0
    connection = kernel.heuristic.scale(partial.d_vcm, kappa_prime)
    return mis.older_merges(kernel.heuristic, partial, connection, pdf)
