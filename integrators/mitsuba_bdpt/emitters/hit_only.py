"""Area lights whose points cannot be sampled, or have unknown radiance."""

from __future__ import annotations

import mitsuba as mi

from .group import Context, Group
from .records import Chosen, Hit


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
