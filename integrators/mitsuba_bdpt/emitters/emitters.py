"""The scene's emitters: selection, and dispatch to their groups.

See the subpackage's docstring for densities, `group.Group` for the methods of a group.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from functools import cached_property, partial
from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import UsageError
from ..geometry import rounding
from ..geometry.shape_facts import ShapeFacts
from ..host.introspection import named, number
from ..host.jit import make_parameters_opaque, registered_emitters
from .group import Context, Group
from .infinite import contrast
from .kinds import GROUPS, MITSUBAS, group_of
from .radiance import BlackEmitters
from .records import Chosen, Direct, Emission, Factor, Place
from .tables import Mask, in_order, inverse_table


class Emitters:
    """The scene's emitters as tables that a kernel can index.

    Built for each render. Raises ``UsageError`` and ``UnsupportedError`` for emitters for which Mitsuba's own
    sampling and evaluation disagree.

    Properties of the scene's ``count`` emitters, ``objects`` by index (see `tables.in_order`):

    * ``hittable``, ``unhittable``: camera subpaths can hit one; cannot hit one.
    * ``direct``, ``traced``: next-event estimation, light subpaths can choose one.
    * ``connectible_to_sensor``: y_0 of one can be connected to a sensor; ``connectible_nearby``: of one that
      is not at infinity; ``unhittable_connectible``, ``finite_hittable``: of one that cannot be hit; that
      can be hit and is not at infinity.
    * ``on_shapes``: one is on a shape; ``at_infinity``: light subpaths can start at infinity; ``beams``: only
      its own light subpaths reach one; ``black``: none of them emits light.
    * ``evaluated``: an emitter in the process, even of another scene, requires evaluated loops and calls.
    * ``left_out``: strategies that single emitters lack, with reasons.
    * ``groups`` of the scene; ``disks``: where light subpaths from infinity start, or None; ``shape_errors``.
    * ``tables``: squares of primary numbers of each emitter, see `place`.
    * ``indexed``: samples of next-event estimation have the index of their emitter.
    """

    def __init__(self, scene: mi.Scene, facts: ShapeFacts | None = None):
        self.scene = scene
        facts = facts or ShapeFacts(scene)
        self.shape_errors = facts.errors
        self.objects = emitters = in_order(scene)
        types = [group_of(emitter) for emitter in emitters]
        weights = [_sampling_weight(emitter) for emitter in emitters]
        registered = registered_emitters()
        self._summarize(emitters, types)
        # It evaluates a mask, which cannot be recorded.
        self.evaluated = "TimedSunskyEmitter" in registered
        self.groups, self.disks, self.indexed = (), None, False
        if not emitters:
            return
        _make_opaque(emitters, facts)
        self._pointers = mi.EmitterPtr(emitters)
        sampling_weight = mi.Float(weights)
        self._pmf, self._inverse = sampling_weight / dr.sum(sampling_weight), inverse_table(self._pointers)
        self._choice = mi.DiscreteDistribution(sampling_weight) if len(set(weights)) > 1 else None
        dr.schedule(self._pmf)  # one kernel with the groups' tables
        context = Context(scene, facts, self._lacks_sample_position(registered))
        present = [group for group in GROUPS if group in types]
        self.groups = tuple(
            group([e if t is group else None for e, t in zip(emitters, types, strict=True)], context)
            for group in present
        )
        self._of_groups = [[i for i, t in enumerate(types) if t is group] for group in present]
        self._group = mi.UInt32([present.index(t) for t in types])
        redrawn = [group.redraws for group in self.groups if group.redraws]
        self._drawn_by_mitsuba = Mask([not any(of[i] for of in redrawn) for i in range(self.count)])
        self.disks = next((group.disks for group in self.groups if group.at_infinity), None)
        dr.make_opaque(self._group, self._pmf, self._inverse, self._pointers)

    def _summarize(self, emitters, types):
        """Set the properties that depend on all emitters; ``types``: their groups."""
        pairs = list(zip(emitters, types, strict=True))
        hittable = [t.is_hittable(e) for e, t in pairs]
        connectible = [hasattr(t, "direction_density") for t in types]
        nearby = [c and not t.at_infinity for c, t in zip(connectible, types, strict=True)]
        traced = [hasattr(t, "sample_emission") for t in types]
        direct = [hasattr(t, "complete_direct") for t in types]
        self._hittable_types = {t for t, h in zip(types, hittable, strict=True) if h}
        self._starts, self._lights = Mask(traced), Mask(direct)
        self.count = len(emitters)
        self.black = all(t is BlackEmitters for t in types)
        self.hittable, self.unhittable = any(hittable), not all(hittable)
        self.direct, self.traced = any(direct), any(traced)
        self.connectible_to_sensor, self.connectible_nearby = any(connectible), any(nearby)
        self.unhittable_connectible = any(c and not h for c, h in zip(connectible, hittable, strict=True))
        self.finite_hittable = any(c and h for c, h in zip(nearby, hittable, strict=True))
        self.on_shapes = any(emitter.get_shape() is not None for emitter in emitters)
        self.beams = any(t and not c for t, c in zip(traced, connectible, strict=True))
        self.at_infinity = any(t.at_infinity for t in types)
        self.tables = [t.tables(e) for e, t in pairs]
        self.left_out: list[tuple[str, str]] = [text for e, t in pairs for text in t.left_out(e)]

    def _lacks_sample_position(self, registered: list[str]) -> bool:
        """Whether `sample_position` fails: classes in the process may lack it."""
        if MITSUBAS.issuperset(registered):
            return False
        try:
            self._pointers.sample_position(mi.Float(0), mi.Point2f(0.5), mi.Bool(True))
        except RuntimeError:
            return True
        return False

    @cached_property
    def contrast(self) -> float:
        """Largest `infinite.contrast`; infinite unless all light comes from environments."""
        return max((contrast(emitter) for emitter in self.objects), default=math.inf)

    def with_guide(self, guide=None, is_guided: Sequence[bool] = ()) -> Emitters:
        """Return a copy that has `place`; ``guide`` guides the emitters where ``is_guided``."""
        other = self.with_indices()
        other.groups = tuple(
            group.with_guide(guide if guide is not None and any(is_guided[i] for i in own) else None)
            for group, own in zip(self.groups, self._of_groups, strict=True)
        )
        return other

    def place(self, index: mi.UInt32, p, d, cos, side: int, active: mi.Bool) -> tuple[Place, Factor]:
        """``place`` and ``factor`` of a `Group`; only for copies made by `with_guide`."""
        place = self._query("place", index, active, index, p, d)
        return place, self._query("factor", index, active, index, p, d, cos, side)

    def _select(self, u, active: mi.Bool):
        """Choose an emitter; also returns the reused part of ``u``."""
        index = mi.UInt32(0)
        if self._choice is not None:
            index, u = self._choice.sample_reuse(u, active)
        elif self.count > 1:
            scaled = u * self.count
            index = dr.minimum(mi.UInt32(scaled), self.count - 1)
            u = scaled - mi.Float(index)
        return self._chosen(index, active), u

    def _chosen(self, index, active) -> Chosen:
        emitter = dr.gather(mi.EmitterPtr, self._pointers, index, active)
        pmf = dr.gather(mi.Float, self._pmf, index, active) if self.count > 1 else mi.Float(1)
        return Chosen(emitter, index, pmf)

    def _query(self, method: str, index: mi.UInt32, active: mi.Bool, *arguments, among=None) -> Any:
        """Return ``method(*arguments, mask)`` of each lane's group; undefined where it has no such method.

        ``among``: groups that ``index`` may refer to (default: all). A single group is recorded without a
        branch. Raises ``ValueError`` if no group has the method.
        """
        among = self.groups if among is None else among

        def lanes_of(group: Group) -> mi.Bool:
            mask = mi.Bool(active)
            if len(among) > 1:
                mask &= dr.gather(mi.UInt32, self._group, index, active) == self.groups.index(group)
            return mask

        first, *others = (group for group in among if hasattr(group, method))
        found = getattr(first, method)(*arguments, lanes_of(first))
        for group in others:
            mask = lanes_of(group)
            found = dr.select(mask, getattr(group, method)(*arguments, mask), found)
        return found

    def covers(self, p, d):
        """`Disks.covers`; true where no light subpath starts at infinity."""
        return self.disks.covers(p, d) if self.disks is not None else mi.Bool(True)

    def sample_emission(self, u_point, u_direction, shared, active) -> Emission:
        """Sample y_0 (``u_point``) and the direction to y_1; ``shared``: time and wavelengths."""
        chosen, u_x = self._select(u_point.x, active)
        u_point = mi.Point2f(u_x, u_point.y)
        arguments = chosen, u_point, u_direction, shared
        e = self._query("sample_emission", chosen.index, active, *arguments)
        e.pdf_first *= chosen.pmf
        e.weight = dr.select(chosen.pmf > 0, e.weight / chosen.pmf, 0)
        if not self._starts.all:  # selected with next-event estimation's probability, but emits nothing
            e.weight = dr.select(self._starts.at(chosen.index, active), e.weight, 0)
        return e

    def traces(self, index: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Mask: light subpaths start from the emitter ``index``."""
        return self._starts.at(index, active)

    def connection_density(self, emission: Emission, si, active):
        """Density of sampling y_0 of ``emission`` by next-event estimation at ``si``.

        From the first hit ``si``, in the measure of ``pdf_first``, times the squared length of the edge (1 at
        infinity): on surfaces the solid-angle density at the hit times the geometric cosine at y_0.
        """
        chosen = self._chosen(emission.index, active)
        return self._query("connection_density", emission.index, active, chosen, emission, si)

    def direction_density(self, emission: Emission, p, d, active):
        """Density of emission from y_0 along ``d`` to ``p``, in ``pdf_second``'s measure."""
        chosen = self._chosen(emission.index, active)
        return self._query("direction_density", emission.index, active, chosen, emission, p, d)

    def radiance_towards(self, emission: Emission, d, active):
        """Radiance, intensity (point) or irradiance (delta direction) of y_0 along ``d``."""
        chosen = self._chosen(emission.index, active)
        return self._query("radiance_towards", emission.index, active, chosen, emission, d)

    def sample_direct(self, si, u, active) -> Direct:
        """Sample y_0 for the camera vertex ``si``; ``u`` in [0, 1)^2 also selects."""
        chosen, u_x = self._select(u.x, active)
        u = mi.Point2f(u_x, u.y)
        sampled = active if self._drawn_by_mitsuba.all else self._drawn_by_mitsuba.at(chosen.index, active)
        ds, weight = chosen.emitter.sample_direction(si, u, sampled)
        direct = self._query("complete_direct", chosen.index, active, chosen, ds, weight, si, u)
        if not self._lights.all:
            direct.weight = dr.select(self._lights.at(chosen.index, active), direct.weight, 0)
        if self.indexed:  # only then: branches would carry it along
            direct.index = chosen.index
        if self.shape_errors.small:
            direct.met = rounding.met(chosen.emitter.get_shape())
        return direct

    def emitted(self, si, active):
        """Radiance of the emitter hit (or missed into) at ``si`` towards ``si.wi``."""
        return si.emitter(self.scene).eval(si, active)

    def with_indices(self) -> Emitters:
        """Return a copy whose samples of next-event estimation have the index of their emitter."""
        other = copy(self)
        other.indexed = True
        return other

    def index_of_hit(self, si, active):
        """Index of the emitter hit (or missed into) at ``si``."""
        return self._index_of(si.emitter(self.scene), active)

    def _index_of(self, emitter, active):
        return dr.gather(mi.UInt32, self._inverse, dr.reinterpret_array(mi.UInt32, emitter), active)

    def emission_of_hit(self, si, previous, active):
        """Emitter, point, direction and cosine of the emission from a hit to ``previous``."""
        emitter = si.emitter(self.scene)
        active = active & (emitter != dr.zeros(mi.EmitterPtr))
        d = dr.select(si.is_valid(), dr.normalize(previous - si.p), mi.Vector3f(si.wi))
        return self._index_of(emitter, active), previous, d, dr.abs(dr.dot(si.n, d)), active

    def hit_densities(self, si, previous, active):
        """Densities of the light-side strategies at the emitter point hit.

        ``previous``: position of the camera vertex before. Returns, selection included, those of next-event
        estimation from ``previous`` and ``pdf_first`` of emission (area measure on surfaces, solid angle at
        infinity), and ``pdf_second`` towards ``previous`` (solid angle on surfaces, area across the direction
        at infinity).
        """
        emitter = si.emitter(self.scene)
        active = active & (emitter != dr.zeros(mi.EmitterPtr))
        index = self._index_of(emitter, active)
        chosen = self._chosen(index, active)
        chosen.emitter = emitter
        before = dr.zeros(mi.Interaction3f)
        before.p, before.time, before.wavelengths = previous, si.time, si.wavelengths
        ds = mi.DirectionSample3f(self.scene, si, before)
        ds.time = mi.Float(si.time)
        hittable = [group for group in self.groups if type(group) in self._hittable_types]
        return self._query("hit_densities", index, active, chosen, si, before, ds, among=hittable)


def _make_opaque(emitters, facts: ShapeFacts):
    """Make parameters of emitters, or of their shapes unless known to be so since the last edit, opaque."""
    fresh = []
    for emitter in emitters:
        shape = emitter.get_shape()
        if shape is None:
            fresh.append(emitter)
        else:
            facts.about("opaque", partial(fresh.append, shape), shape)
    make_parameters_opaque(fresh)


def _sampling_weight(emitter: mi.Emitter) -> float:
    weight = number(emitter.sampling_weight())
    if not 0 <= weight < math.inf:
        raise UsageError(
            f"emitter {named(emitter)} has sampling_weight={weight:g}; set a finite number of 0 or more"
        )
    return weight
