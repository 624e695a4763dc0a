"""Interface of a group of emitters."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..geometry import rays, rounding
from ..geometry.shape_facts import ShapeFacts
from ..host.introspection import named
from .records import Chosen, Direct, Emission, EmissionGuide, Factor, Hit, Place


@dataclass(frozen=True)
class Context:
    """Arguments common to all groups of a scene's emitters.

    ``by_shapes``: points are sampled by the shapes, since emitters' `sample_position` cannot be called.
    """

    scene: mi.Scene
    facts: ShapeFacts
    by_shapes: bool

    @property
    def shape_errors(self) -> rounding.ShapeErrors:
        return self.facts.errors


class Group:
    """The emitters of a scene that share formulas; made for each render.

    Constructed from ``emitters``, in the order of `order.in_order` with None for those of other groups, and a
    `Context`.
    Methods without support are never called; results of lanes that are not ``active`` are undefined.

    * ``hittable``: camera subpaths can hit its emitters (`is_hittable`: each one).
    * ``supports_next_event``, ``supports_emission``: next-event estimation, light subpaths can choose one.
    * ``connectible_to_sensor``: y_0 of emission can be connected to a sensor.
    * ``at_infinity``: light subpaths start at infinity, on its ``disks``.
    * ``guidable``, ``guide``: tables can guide its emission; those that do, or None.
    * ``redraws``: per emitter of the scene, whether next-event points are sampled here, not by Mitsuba.
    * ``limits``: why it does not support all.
    """

    hittable = False
    supports_next_event = True
    supports_emission = True
    connectible_to_sensor = True
    at_infinity = False
    guidable = False
    redraws: Sequence[bool] = ()
    limits = ""
    guide: EmissionGuide | None = None

    @classmethod
    def of(cls, emitter) -> type[Group]:
        """Return the group of an ``emitter`` whose class `kinds.KINDS` maps to this one.

        Raises ``UsageError`` for one that Mitsuba renders inconsistently, and ``UnsupportedError`` for one
        that it cannot sample.
        """
        return cls

    @classmethod
    def is_hittable(cls, emitter) -> bool:
        return cls.hittable

    @classmethod
    def left_out(cls, emitter) -> list[tuple[str, str]]:
        """Return the strategies that this emitter lacks, with the reason."""
        names = ["s=1"] * (not cls.supports_next_event) + ["light subpaths"] * (not cls.supports_emission)
        return [(f"{name} of emitter {named(emitter)}", cls.limits) for name in names]

    @classmethod
    def tables(cls, emitter) -> int:
        """Number of squares of primary numbers of this emitter, see `place`; 0: not guidable."""
        return 0

    def with_guide(self, guide: EmissionGuide | None) -> Group:
        """Return a copy that has `place`, guided by ``guide`` (None: unguided)."""
        other = copy(self)
        other.guide = guide
        return other

    def place(self, index: mi.UInt32, p, d, active) -> Place:
        """Primary numbers of emissions of ``index`` that pass ``p`` along ``d``.

        Only for copies made by `with_guide`.
        """
        raise NotImplementedError(f"{type(self).__name__} has no place")

    def factor(self, index: mi.UInt32, p, d, cos, side: int, active) -> Factor:
        """Effect of a guide on the density of such emissions; ``cos``: geometric normal's.

        ``side``: cells per side of the guide's tables.
        """
        return Factor.whole()

    # -- emission ---------------------------------------------------------------------------

    def sample_emission(self, chosen: Chosen, u_point, u_direction, shared, active) -> Emission:
        """Sample y_0 and the direction to y_1, given the emitter (selection not included)."""
        raise NotImplementedError(f"{type(self).__name__} has no sample_emission")

    def direction_density(self, chosen: Chosen, emission: Emission, p, d, active):
        """Density of emission from y_0 along ``d`` to ``p``, in ``pdf_second``'s measure."""
        raise NotImplementedError(f"{type(self).__name__} has no direction_density")

    def connection_density(self, chosen: Chosen, emission: Emission, si, active):
        """Density of sampling y_0 of ``emission`` by next-event estimation at ``si``.

        From the first hit ``si``. Selection included; in the measure of ``pdf_first``, times the squared
        length of the edge (1 at infinity).
        """
        raise NotImplementedError(f"{type(self).__name__} has no connection_density")

    def radiance_towards(self, chosen: Chosen, emission: Emission, d, active):
        """Radiance (intensity, irradiance) that y_0 emits along ``d``."""
        raise NotImplementedError(f"{type(self).__name__} has no radiance_towards")

    # -- next-event estimation and hits -----------------------------------------------------

    def complete_direct(self, chosen: Chosen, ds, weight, si, u, active) -> Direct:
        """Complete a sample of next-event estimation at the camera vertex ``si``.

        ``ds``, ``weight``: result of ``sample_direction``, one call for all groups, not to be changed (0
        where the group ``redraws``). Densities of the result include the selection; ``met`` stays None.
        """
        raise NotImplementedError(f"{type(self).__name__} has no complete_direct")

    def hit_densities(self, chosen: Chosen, hit: Hit, active):
        """Densities of light-side strategies; see `Emitters.hit_densities`."""
        raise NotImplementedError(f"{type(self).__name__} has no hit_densities")


class HitOnlyEmitters(Group):
    """Area lights that camera subpaths can hit, and no other strategy.

    They are on shapes of which Mitsuba samples no points, or their radiance needs a hit (mesh attributes).
    Emission and next-event estimation may select them, by their sampling weight: the sample is black.
    """

    hittable = True
    supports_next_event = supports_emission = connectible_to_sensor = False
    limits = "no points of it with a known radiance can be sampled; it can only be hit"

    def __init__(self, emitters, context: Context):
        pass

    def hit_densities(self, chosen: Chosen, hit: Hit, active):
        return mi.Float(0), mi.Float(0), mi.Float(0)


def emitting_point(p, shared):
    """Interaction at the point ``p`` off surfaces; time and wavelengths of ``shared``."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.p, si.time, si.wavelengths = p, shared.time, shared.wavelengths
    return si


def free_emission(index, weight, d, pdf_first, pdf_second, delta, si) -> Emission:
    """Return the `Emission` of an emitter without surface, at a point."""
    return Emission(
        weight=weight,
        d=d,
        anchor=rays.free_anchor(si.p),
        cos=mi.Float(1),
        pdf_first=pdf_first,
        pdf_second=pdf_second,
        infinite=mi.Bool(False),
        delta=delta,
        beam=mi.Bool(False),
        index=index,
        si=si,
    )


def weight_over(pmf, weight, pdf):
    """Weight of next-event estimation over ``pmf``; NaN for non-finite densities."""
    weight = dr.select(pdf == 0, 0, weight / pmf)
    return dr.select(dr.isfinite(pdf), weight, dr.nan)
