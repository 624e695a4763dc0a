"""Maps the ``class_name()`` of an emitter to its group; the group of user-defined classes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..geometry import rays
from .area import AreaEmitters
from .directional_area import DirectionalAreaEmitters
from .group import Context, Group, HitOnlyEmitters, to_area, weight_over
from .infinite import InfiniteEmitters
from .position import PositionEmitters
from .radiance import BlackEmitters, is_black
from .records import Chosen, Direct


class ThirdPartyEmitters(Group):
    """User-defined classes: only calls of camera subpaths; densities get the sample's normal."""

    limits = "its class is not Mitsuba's: only the calls that camera subpaths need are used"

    @classmethod
    def left_out(cls, emitter) -> list[tuple[str, str]]:
        return [(what, f"{why} ({emitter.class_name()})") for what, why in super().left_out(emitter)]

    @classmethod
    def is_hittable(cls, emitter) -> bool:
        return not mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)

    def __init__(self, emitters, context: Context):
        on_shapes = any(emitter.get_shape() is not None for emitter in filter(None, emitters))
        self._shape_errors = context.facts.errors if on_shapes else None

    def complete_direct(self, chosen: Chosen, ds, weight, si, u, active) -> Direct:
        flags = chosen.emitter.flags()
        delta = mi.has_flag(flags, mi.EmitterFlags.Delta) | ds.delta
        n = dr.select(mi.has_flag(flags, mi.EmitterFlags.Surface), ds.n, 0)
        errors = None
        if self._shape_errors is not None:
            errors = self._shape_errors.at(chosen.emitter.get_shape(), active)
        return Direct(
            weight=weight_over(chosen.pmf, weight, ds.pdf),
            pdf_w=dr.select(delta, 1, ds.pdf) * chosen.pmf,
            d=ds.d,
            anchor=rays.sampled_anchor(ds.p, n, errors),
            infinite=mi.has_flag(flags, mi.EmitterFlags.Infinite),
            delta=delta,
            emission_ratio=mi.Float(0),
        )

    def hit_densities(self, chosen: Chosen, si, previous, ds, active):
        pdf_w = chosen.pmf * chosen.emitter.pdf_direction(previous, ds, active)
        connect = dr.select(si.is_valid(), pdf_w * to_area(si, ds), pdf_w)
        return connect, mi.Float(0), mi.Float(0)


KINDS: dict[str, type[Group]] = {
    "AreaLight": AreaEmitters,
    "DirectionalArea": DirectionalAreaEmitters,
    "PointLight": PositionEmitters,
    "SpotLight": PositionEmitters,
    "Projector": PositionEmitters,
    "DirectionalEmitter": InfiniteEmitters,
    "ConstantBackgroundEmitter": InfiniteEmitters,
    "EnvironmentMapEmitter": InfiniteEmitters,
    "SunskyEmitter": InfiniteEmitters,
    "TimedSunskyEmitter": InfiniteEmitters,
}

# Mitsuba's own classes, which have all calls; others may lack ``sample_position``.
MITSUBAS = frozenset(KINDS)

# In the order of dispatch in a kernel.
GROUPS: tuple[type[Group], ...] = (
    *dict.fromkeys(KINDS.values()),
    HitOnlyEmitters,
    BlackEmitters,
    ThirdPartyEmitters,
)


def group_of(emitter) -> type[Group]:
    """Return the group of an emitter; raises as `Group.of` does."""
    kind = KINDS.get(emitter.class_name(), ThirdPartyEmitters)
    group = kind.of(emitter)
    return BlackEmitters if kind is not ThirdPartyEmitters and is_black(emitter) else group
