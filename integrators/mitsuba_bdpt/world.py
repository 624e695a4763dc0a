"""What a render knows of its scene and sensor before it decides anything."""

from __future__ import annotations

import mitsuba as mi

from . import bsdf
from .emitters import Emitters
from .objects import all_shapes, is_instance
from .sensors import prepare


class World:
    """A scene seen by one of its sensors; lives for one render.

    ``emitters`` and ``camera`` are the two kinds of endpoints, ``smooth``, ``delta`` and ``refracts``:
    whether some BSDF has such a lobe; ``traits`` see `bsdf.Traits`.
    """

    def __init__(self, scene, sensor):
        self.scene = scene
        self.surfaces = bool(scene.shapes())
        self.emitters = Emitters(scene)
        self.camera = prepare(sensor, self.emitters.shape_errors, self.surfaces)
        found = bsdfs(scene)
        self.smooth = any(mi.has_flag(b.flags(), mi.BSDFFlags.Smooth) for b in found)
        self.delta = any(mi.has_flag(b.flags(), mi.BSDFFlags.Delta) for b in found)
        self.refracts = any(mi.has_flag(b.flags(), mi.BSDFFlags.Transmission) for b in found)
        self.traits = bsdf.Traits.of(found)


def bsdfs(scene):
    """The BSDFs of all shapes, those of shape groups included; that of an instance is never met."""
    found = [s.bsdf() for s in all_shapes(scene) if not is_instance(s)]
    return [b for b in found if b is not None]
