"""Hooks of the strategies that sample SDS or hard paths: vertex merging, and photon-guided BSDF sampling.

An edge is *connectible* if a strategy in use connects its ends: neither end is a delta event, and the
strategy's class has a coefficient (next-event estimation for the edge to the emitter, t = 1 for the edge to
the sensor, inner connections for the others). An *SDS path* (specular-diffuse-specular) has no connectible
edge: emitter, glass, wall, glass, camera. Of the classes of `Plan` only s = 0 and t = 0 sample it. The kernel
has at most one further strategy for such paths, `Kernel.sds`; a walk carries its `State`, and it is called at
fixed points. In scenes with near-specular lobes it samples *hard* paths instead, see `mis`: connectible, but
too rarely. Which these are is decided by densities, without a `State`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mitsuba as mi

from . import mis


@dataclass
class State:
    """What a walk knows of an SDS path; None where it is not needed.

    ``isolated``: no edge is connectible; ``only_delta``, on light subpaths with guiding: all events were
    delta; ``guided``, on camera subpaths with guiding: the other density of the last non-delta direction
    (s = 0 by the guide, or by the BSDF) over its own; ``survived``, on photon subpaths of hard paths: the
    probability with which `SdsStrategy.survival` let it go on.
    """

    isolated: mi.Bool | None = None
    only_delta: mi.Bool | None = None
    guided: mi.Float | None = None
    survived: mi.Float | None = None


@dataclass
class Advice:
    """The guide at a vertex: ``active`` where s = 0 can be guided.

    ``found``: index of its photons; ``other``: density of the walk's own direction by the guide (solid angle,
    times the number of guided samples).
    """

    active: mi.Bool
    found: mi.UInt32
    other: mi.Float


class SdsStrategy:
    """A further strategy for SDS paths. Each method is a hook; here it adds nothing.

    ``counters``: names of the `Counters` that `visit` changes; ``wavelengths``: `WavelengthSets` that all
    subpaths use, or None; ``hard``: it samples hard paths, and `weighed`, `may_merge`, `kept` and `survival`
    are defined.
    """

    counters: tuple[str, ...] = ()
    wavelengths = None
    hard = False

    def weighed(self, p: mi.Point3f) -> mi.Float:
        """Partial sum of a merge at ``p``, see `mis.Merge`."""
        raise NotImplementedError(f"{type(self).__name__} does not merge hard paths")

    def may_merge(self, kernel, vertex, connection: mis.PartialSum) -> mi.Bool:
        """Mask: a merge at ``vertex`` may count, as far as its side knows.

        ``connection``: ``d_vcm`` times the coefficient of the connection of the edge to it.
        """
        raise NotImplementedError(f"{type(self).__name__} does not merge hard paths")

    def kept(self, kernel, vertex, survived: mi.Float | float) -> mi.Float:
        """Probability with which merges at ``vertex`` are sampled; given that its subpath ``survived``."""
        raise NotImplementedError(f"{type(self).__name__} does not merge hard paths")

    def survival(self, state: State, partial: mis.Partial, p: mi.Point3f) -> tuple[mi.Float, State]:
        """Probability with which a photon subpath goes on, and its new ``state``.

        ``partial`` after the event at ``p``.
        """
        raise NotImplementedError(f"{type(self).__name__} does not merge hard paths")

    def begin_light(self, kernel, walk):
        """The light subpath ``walk`` with its `State`, on its first edge."""
        return walk

    def begin_camera(self, kernel, walk):
        """The camera subpath ``walk`` with its `State`, on its first edge."""
        return walk

    def advise(self, kernel, adjoint: bool, vertex, walk, step) -> Advice | None:
        """The guide at ``vertex``; ``walk`` as before its arrival, ``step`` from there."""
        return None

    def merge(self, kernel, vertex, isolated: mi.Bool | None) -> mis.Merge:
        """What samples a path at ``vertex``; ``isolated``: `State.isolated` after its event, or None."""
        raise NotImplementedError(f"{type(self).__name__} has no merge")

    def visit(self, kernel, z, walk, stream, shared, add, state):
        """Contributions at the camera vertex ``z``.

        ``state``: total and `Counters`; ``add(c, total, lost)`` adds a contribution and counts it if
        non-finite. Returns the new state.
        """
        return state

    def hit(self, kernel, z, connectible: mi.Bool, densities, sides, active: mi.Bool):
        """Alternatives of s = 0 at the emitter point ``z``.

        ``densities`` of emission (`Emitters.hit_densities`); ``sides``: light and camera side. Returns new
        sides and mask.
        """
        return sides, active

    def arrive(self, kernel, merges: mis.PartialSum, emission) -> mis.PartialSum:
        """Alternatives of t = 0; ``merges``: ``d_vm`` times the density from the sensor."""
        return merges


def begun(walk, state: State | None, d_vm: mis.PartialSum = 0, d_vn: mis.PartialSum = 0):
    """``walk`` with ``state``; ``d_vm``, ``d_vn``: its partial sums of merges, 0 if there are none."""
    return replace(walk, sds=state, partial=replace(walk.partial, d_vm=d_vm, d_vn=d_vn))
