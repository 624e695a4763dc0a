"""The kernel's further strategy for SDS paths: vertex merging, or photon-guided BSDF sampling.

An edge is *connectible* if a strategy in use connects its ends; an *SDS path* (specular-diffuse-specular) has
no connectible edge. See docs/method/sds_paths.md, and docs/method/near_specular.md for the paths that photons
guide through near-specular events, on which all strategies but s = 0 and s = 1 are left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from . import mis
from .near_specular import SPECULAR, is_narrow

FEWEST_EDGES = 3  # edges of the shortest guided path: no photon directly from the emitter guides

# Largest densities (1 / sr) of diffuse reflection and isotropic scattering, with their rounding error.
_DIFFUSE, _ISOTROPIC = 1.001 / math.pi, 1.001 / (4 * math.pi)


@dataclass
class State:
    """State of a subpath that may be part of an SDS path; fields that are not needed are None.

    ``isolated``: no edge is connectible; ``only_delta``, with guiding: all events were delta; ``guided``, on
    camera subpaths with guiding: r, the guide's densities over the BSDF's; ``survived``, on photon
    subpaths with merging: product of `PhotonStrategy.survival`; ``behind_diffuse``, on camera subpaths with
    merging: an event `is_diffuse`. Where near-specular events count as specular: ``specular``, the last event
    was; on camera subpaths ``diffuse``, an event was not; ``newest``, the term of the last vertex, not in
    ``guided``: that vertex does not guide if the next one is the end.
    """

    isolated: Any = None
    only_delta: Any = None
    guided: mi.Float | None = None
    survived: mi.Float | None = None
    specular: Any = None
    diffuse: Any = None
    newest: Any = None
    behind_diffuse: Any = None

    def scattered(self, specular: mi.Bool, coefficient: mis.Coefficient) -> State:
        """The state after an event; ``coefficient`` of the connection of the edge to it."""
        isolated = ~self.is_connectible(specular, coefficient) & self.isolated
        return replace(self, isolated=isolated, specular=specular)

    def after(self, heuristic: mis.Heuristic, vertex, coefficient: mis.Coefficient, step) -> State:
        """The state after the sampled ``step`` at ``vertex``; ``coefficient`` as in `scattered`."""
        only_delta = None if self.only_delta is None else self.only_delta & step.delta
        if self.specular is None:
            isolated = self.isolated & (step.delta | ~mis.is_connectible(vertex.partial, coefficient))
            guided = self.guided
            # Without advice it is kept as well: guided subpaths end at events that are not delta.
            if guided is not None and vertex.advice is not None:
                guided = dr.select(step.delta, guided, heuristic.start(vertex.advice.ratio(step)))
            return State(isolated, only_delta, guided)
        specular = step.delta | is_specular(step)
        state = replace(self.scattered(specular, coefficient), only_delta=only_delta)
        if self.guided is None:
            return state
        # A diffuse vertex guides alone: guided subpaths end at others.
        guides = ~step.delta & ~(specular & self.diffuse)
        guided = dr.select(specular, self.guided_before_last(heuristic), 0)
        newest = heuristic.start(vertex.advice.ratio(step, guides))
        return replace(state, diffuse=self.diffuse | ~specular, guided=guided, newest=newest)

    def guided_before_last(self, heuristic: mis.Heuristic) -> Any:
        """The densities of the guide, over those of the path, at all vertices before the next one."""
        return heuristic.combine(self.guided, self.newest)

    def is_connectible(self, specular: mi.Bool | bool, coefficient: mis.Coefficient) -> mi.Bool:
        """Mask: a strategy connects the edge to the next vertex, whose event is ``specular``."""
        return ~(self.specular | specular) & mis.is_used(coefficient)

    def is_sds_path(self, edges: mi.UInt32, coefficient: mis.Coefficient) -> mi.Bool:
        """Mask: a path that ends at the next vertex, after ``edges`` edges, is a guided SDS path.

        ``coefficient`` of the class that connects the last edge.
        """
        possible = self.isolated & ~self.only_delta & (edges >= FEWEST_EDGES)
        return possible & ~self.is_connectible(False, coefficient)


def connects_sds_path(edges: mi.UInt32, *ends: tuple) -> mi.Bool:
    """Mask: the connection of a path of ``edges`` edges, by a strategy in use, makes a guided SDS path.

    ``ends`` that scatter: `State`, BSDF, and coefficient of the connection of the edge to the vertex (any for
    a single one, which must be specular).
    """
    possible, specular = edges >= FEWEST_EDGES, mi.Bool(False)
    for state, f, coefficient in ends:
        event = is_specular(f)
        possible, specular = possible & state.scattered(event, coefficient).isolated, specular | event
    return possible & specular


def is_specular(f) -> mi.Bool:
    """Mask: a near-specular event, which photons guide through; ``f`` as in `near_specular.is_narrow`."""
    return is_narrow(f, SPECULAR)


def is_diffuse(kernel, f) -> mi.Bool:
    """Mask: neither density of an event exceeds that of diffuse reflection; in volumes isotropic scattering.

    Camera subpaths merge at it, not after it (docs/method/sds_paths.md). ``f`` as in `is_specular`. No event
    is diffuse with `bsdf.Traits.one_way`: photons cannot follow each.
    """
    if kernel.traits.one_way:
        return mi.Bool(False)
    return dr.maximum(f.pdf_fwd_w, f.pdf_rev_w) <= dr.select(f.volume, _ISOTROPIC, _DIFFUSE)


@dataclass
class Advice:
    """The guide at a vertex: ``active`` where s = 0 can be guided.

    ``found``: index of its photons; ``other``: density of the walk's own direction by the guide (solid angle,
    times the number of guided samples).
    """

    active: mi.Bool
    found: mi.UInt32
    other: mi.Float

    def ratio(self, step, guides: mi.Bool | bool = True) -> mi.Float:
        """`other` over the density of the BSDF, where the vertex ``guides``; else 0."""
        return dr.select(guides & (self.other > 0), self.other / step.pdf_fwd_w, 0)


class PhotonStrategy:
    """A further strategy for SDS paths: hooks of the kernel, which add nothing here.

    ``counters``: names of the `Counters` that `visit` changes; ``wavelengths``: `WavelengthSets` that all
    subpaths use, or None; ``merges``: it merges vertices, and `kappa_eta` and `survival` are defined;
    ``near_specular``: near-specular events count as specular.
    """

    counters: tuple[str, ...] = ()
    wavelengths: Any = None
    merges = False
    near_specular = False

    def kappa_eta(self, vertex) -> mi.Float:
        """Partial sum of a merge at ``vertex``, see `mis.scattered_merges`."""
        raise NotImplementedError

    def survival(self, state: State, partial: mis.Partial, vertex) -> tuple[mi.Float, State]:
        """Probability with which a photon subpath goes on, and its new ``state``.

        ``partial`` after the event at ``vertex``.
        """
        raise NotImplementedError

    def begin_light(self, kernel, walk):
        """The light subpath ``walk`` with its `State`, on its first edge."""
        return walk

    def begin_camera(self, kernel, walk):
        """The camera subpath ``walk`` with its `State`, on its first edge."""
        return walk

    def advise(self, kernel, adjoint: bool, vertex, walk, step) -> Advice | None:
        """The guide at ``vertex``; ``walk`` as before its arrival, ``step`` from there."""
        return None

    def visit(self, kernel, z, walk, stream, shared, add, state):
        """Contributions at the camera vertex ``z``.

        ``state``: total and `Counters`; ``add(c, total, lost)`` adds a contribution and counts it if
        non-finite. Returns the new state.
        """
        return state

    def counts(self, active: mi.Bool, on_sds_path: mi.Bool) -> mi.Bool:
        """Mask: contributions of s = 0 and s = 1 that count."""
        return active


def begun_near_specular(walk, light: bool, guided: mi.Float | None = None):
    """``walk`` with the `State` of a subpath along which near-specular events count as specular."""
    # On the light side s = 0 is the only alternative so far.
    possible = mis.is_used(walk.partial.d_vc) if light else mi.Bool(True)
    no, diffuse = mi.Bool(False), None if guided is None else mi.Bool(False)
    return replace(walk, sds=State(possible, possible, guided, None, no, diffuse, newest=guided))
