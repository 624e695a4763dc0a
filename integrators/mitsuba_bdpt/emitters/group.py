"""Interface of a group of emitters."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..geometry.shape_facts import ShapeFacts
from ..host.introspection import named
from .records import Chosen


@dataclass(frozen=True)
class Context:
    """Arguments of all groups; ``by_shapes``: shapes sample points, as emitters' `sample_position` fails."""

    scene: mi.Scene
    facts: ShapeFacts
    by_shapes: bool


class Group:
    """The emitters of a scene that share formulas; made for each render.

    Constructed from ``emitters``, ordered by `tables.in_order`, with None for those of other groups, and a
    `Context`. A group has the methods of the strategies that its emitters support:

    * ``hit_densities(chosen, si, previous, ds)``: camera subpaths hit them (`is_hittable`: each one). ``ds``:
      the hit ``si`` as a sample of next-event estimation at ``previous``, not to be changed.
    * ``complete_direct(chosen, ds, weight, si, u)``: next-event estimation. Completes ``ds``, ``weight``, the
      result of ``sample_direction``, one call for all groups, not to be changed (0 where the group
      ``redraws``). Densities of the `Direct` include the selection; ``met`` stays None.
    * ``sample_emission(chosen, u_point, u_direction, shared)``, ``connection_density(chosen, emission, si)``:
      light subpaths. The selection is included in the second alone.
    * ``direction_density(chosen, emission, p, d)``, ``radiance_towards(chosen, emission, d)``: connections of
      y_0 with a sensor.
    * ``place(index, p, d)``: `Place` of emissions that pass ``p`` along ``d``, for copies made by
      `with_guide`; ``factor(index, p, d, cos, side)``: the `Factor` of a guide with tables of ``side`` cells
      per side on their density (``cos``: geometric normal's).

    See `Emitters` for their results. The last argument is the mask ``active``; other lanes are undefined.

    * ``at_infinity``: light subpaths start at infinity, on its ``disks``.
    * ``guide``: a `guided_emission.tables.EmissionGuide` of its emission, or None.
    * ``redraws``: per emitter of the scene, whether next-event points are sampled here, not by Mitsuba.
    * ``limits``: why it does not support all.
    """

    at_infinity = False
    redraws: Sequence[bool] = ()
    limits = ""
    guide: Any = None

    @classmethod
    def of(cls, emitter) -> type[Group]:
        """Return the group of an ``emitter`` whose class `kinds.KINDS` maps to this one.

        Raises ``UsageError`` for one that Mitsuba renders inconsistently, and ``UnsupportedError`` for one
        that it cannot sample.
        """
        return cls

    @classmethod
    def is_hittable(cls, emitter) -> bool:
        return hasattr(cls, "hit_densities")

    @classmethod
    def left_out(cls, emitter) -> list[tuple[str, str]]:
        """Return the strategies that this emitter lacks, with the reason."""
        methods = {"s=1": "complete_direct", "light subpaths": "sample_emission"}
        names = [name for name, method in methods.items() if not hasattr(cls, method)]
        return [(f"{name} of emitter {named(emitter)}", cls.limits) for name in names]

    @classmethod
    def tables(cls, emitter) -> int:
        """Number of squares of primary numbers of this emitter (`Place`); 0: not guidable."""
        return 0

    def with_guide(self, guide) -> Group:
        """Return a copy that has ``place``, guided by ``guide`` (None: unguided)."""
        other = copy(self)
        other.guide = guide
        return other


class HitOnlyEmitters(Group):
    """Area lights that camera subpaths can hit, and no other strategy.

    They are on shapes of which Mitsuba samples no points, or their radiance needs a hit (mesh attributes).
    Emission and next-event estimation may select them, by their sampling weight: the sample is black.
    """

    limits = "no points of it with a known radiance can be sampled; it can only be hit"

    def __init__(self, emitters, context: Context):
        pass

    def hit_densities(self, chosen: Chosen, si, previous, ds, active):
        return mi.Float(0), mi.Float(0), mi.Float(0)


def emitting_point(p, shared):
    """Interaction at the point ``p`` off surfaces; time and wavelengths of ``shared``."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.p, si.time, si.wavelengths = p, shared.time, shared.wavelengths
    return si


def weight_over(pmf, weight, pdf):
    """Weight of next-event estimation over ``pmf``; NaN for non-finite densities."""
    weight = dr.select(pdf == 0, 0, weight / pmf)
    return dr.select(dr.isfinite(pdf), weight, dr.nan)


def to_area(si, ds):
    """Factor that converts the density of ``ds``, the hit ``si``, from solid angle to area."""
    return dr.abs(dr.dot(si.n, ds.d)) / dr.square(ds.dist)
