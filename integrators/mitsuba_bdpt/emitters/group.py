"""What a group of emitters is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..geometry import rays, rounding
from ..geometry.shape_facts import ShapeFacts
from ..host.introspection import named
from .emission_tables import EmissionGuide, Factor, Place
from .records import Chosen, Direct, Emission, Hit


@dataclass(frozen=True)
class Context:
    """What groups of emitters are made in.

    The ``scene``, the `ShapeFacts` of its shapes, and whether points on shapes are asked of the shapes
    (``ask_shapes``) since emitters cannot be asked.
    """

    scene: mi.Scene
    facts: ShapeFacts
    ask_shapes: bool

    @property
    def shape_errors(self) -> rounding.ShapeErrors:
        """The `rounding.ShapeErrors` of the scene's shapes."""
        return self.facts.errors


class Group:
    """The emitters of a scene that share their formulas; made anew for each render, if the scene has some.

    Made of ``emitters``, those of the scene in its order, None where one is of another group, and of a
    `Context`. What a group supports: ``hittable``, camera subpaths can hit its emitters (all, if
    `is_hittable` does not say otherwise); ``supports_next_event``, next-event estimation can choose it;
    ``supports_emission``, light subpaths can start from it; ``connectible_to_sensor``, a point that emission
    has chosen can be joined with a sensor; ``at_infinity``, its light subpaths start there, on its ``disks``.
    ``guidable``, tables can guide its emission, by a ``guide`` where one does. ``redraws``: for each
    emitter of the scene, whether its points of next-event estimation are chosen here and not by Mitsuba
    (empty: of none).
    ``limits`` says why it does not support all. Methods of what a group does not support are never called.
    Lanes that are not ``active`` are of other groups: what is returned for them has no meaning.
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
        """The group of an ``emitter`` whose class `kinds.KINDS` has in this one.

        Raises ``UsageError`` for one that Mitsuba itself renders inconsistently, and ``UnsupportedError`` for
        one that it cannot sample.
        """
        return cls

    @classmethod
    def is_hittable(cls, emitter) -> bool:
        """Whether camera subpaths can hit this one."""
        return cls.hittable

    @classmethod
    def left_out(cls, emitter) -> list[tuple[str, str]]:
        """What this one cannot take part in, and why."""
        names = ["s=1"] * (not cls.supports_next_event) + ["light subpaths"] * (not cls.supports_emission)
        return [(f"{name} of emitter {named(emitter)}", cls.limits) for name in names]

    @classmethod
    def tables(cls, emitter) -> int:
        """How many tables guide the emission of this one, see `emission_tables`."""
        return 0

    def placed(self, guide: EmissionGuide | None) -> Group:
        """A copy that knows the `place` of an emission, guided by ``guide`` (None: by none)."""
        other = copy(self)
        other.guide = guide
        return other

    def place(self, index: mi.UInt32, p, d, active) -> Place:
        """Where in their tables emissions of the emitters ``index`` lie that pass ``p`` along ``d``.

        Asked of copies that `placed` has made.
        """
        raise NotImplementedError(f"{type(self).__name__} has no place")

    def factor(self, index: mi.UInt32, p, d, cos, side: int, active) -> Factor:
        """What tables of ``side`` x ``side`` cells change of the density of such emissions.

        ``cos`` with the geometric normal.
        """
        return Factor.whole()

    # -- emission ---------------------------------------------------------------------------

    def sample_emission(self, chosen: Chosen, u_point, u_direction, shared, active) -> Emission:
        """Sample y_0 and the direction to y_1, given the emitter: `Emitters` adds the selection."""
        raise NotImplementedError(f"{type(self).__name__} has no sample_emission")

    def direction_density(self, chosen: Chosen, emission: Emission, p, d, active):
        """Density with which emission from y_0 goes along ``d`` to ``p``, in ``pdf_second``'s measure."""
        raise NotImplementedError(f"{type(self).__name__} has no direction_density")

    def connection_density(self, chosen: Chosen, emission: Emission, si, active):
        """Density of next-event estimation making y_0 of ``emission`` from its first hit ``si``.

        Selection included; in the measure of ``pdf_first``, times the squared length of the edge (1 at
        infinity).
        """
        raise NotImplementedError(f"{type(self).__name__} has no connection_density")

    def radiance_towards(self, chosen: Chosen, emission: Emission, d, active):
        """Radiance (intensity, irradiance) that y_0 sends along ``d``."""
        raise NotImplementedError(f"{type(self).__name__} has no radiance_towards")

    # -- next-event estimation and hits -----------------------------------------------------

    def complete_direct(self, chosen: Chosen, ds, weight, si, u, active) -> Direct:
        """A sample of next-event estimation for the camera vertex ``si``, from ``u``.

        ``ds``, ``weight``: what Mitsuba's ``sample_direction`` returned, one call for all groups:
        they must not be changed (0 where the group ``redraws``). Densities of the result include the
        selection; ``met`` stays None.
        """
        raise NotImplementedError(f"{type(self).__name__} has no complete_direct")

    def hit_densities(self, chosen: Chosen, hit: Hit, active):
        """Densities with which light-side strategies make the point that was hit.

        Selection included; as `Emitters.hit_densities` returns them.
        """
        raise NotImplementedError(f"{type(self).__name__} has no hit_densities")


def emitting_point(p, shared):
    """The point ``p`` off surfaces for Mitsuba's calls, with the time and wavelengths of ``shared``."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.p, si.time, si.wavelengths = p, shared.time, shared.wavelengths
    return si


def free_emission(index, weight, d, pdf_first, pdf_second, delta, si) -> Emission:
    """The emission of an emitter without surface, at a point; see `Emission`."""
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
    """The ``weight`` of a sample of next-event estimation over the selection's probability ``pmf``.

    NaN, to be counted, where its density ``pdf`` is not finite: no weight of strategies follows from it.
    """
    weight = dr.select(pdf == 0, 0, weight / pmf)
    return dr.select(dr.isfinite(pdf), weight, dr.nan)
