"""Which medium light subpaths start in.

Scenes seldom say it: an area light on a shape without exterior medium may stand in a ball of milk. It is found by
rays of emission: the near side of the first boundary that they meet, or what surrounds the scene.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..emitters.emitters import Emitters
from ..media import boundaries
from ..media.media import Space
from ..transport.inputs import Shared

# Rays by which an emitter, or a sensor, is asked for its medium.
_PROBES = 64


class LightMedia:
    """The medium of every emitter; made anew for each render.

    ``outside`` is the number of the medium that surrounds the scene: the sensor's, unless it is bounded.
    """

    def __init__(self, space: Space, emitters: Emitters, sensor: mi.Sensor):
        self._space, self._emitters = space, emitters
        self.outside = space.media.sensor if _is_unbounded(space, sensor) else 0
        self._outside = dr.opaque(mi.UInt32, self.outside)
        front, back = _declared(space, emitters)
        probed, mixed = self._probed() if emitters.traced else ([0] * emitters.count, [False] * emitters.count)
        self._front = mi.UInt32([p if f is None else f for f, p in zip(front, probed, strict=True)] or [0])
        self._back = mi.UInt32([p if b is None else b for b, p in zip(back, probed, strict=True)] or [0])
        # Of emitters that stand partly in a medium, each ray is asked.
        mixed = [m and f is None for m, f in zip(mixed, front, strict=True)]
        self.mixed = any(mixed)
        self._mixed = mi.Bool(mixed or [False])
        dr.make_opaque(self._front, self._back, self._mixed)

    def at(self, e) -> mi.UInt32:
        """The number of the medium in which the first ray of an `emitters.Emission` starts."""
        outwards = dr.dot(e.anchor.n, e.d) >= 0
        number = dr.select(
            outwards, dr.gather(mi.UInt32, self._front, e.index), dr.gather(mi.UInt32, self._back, e.index)
        )
        number = dr.select(e.infinite, self._outside, number)
        if not self.mixed:
            return number
        asked = dr.gather(mi.Bool, self._mixed, e.index) & ~e.infinite
        return dr.select(asked, self._near_side(e, asked), number)

    def _near_side(self, e, active) -> mi.UInt32:
        ray = mi.Ray3f(e.anchor.towards(e.d), e.d)
        number, found = boundaries.near_side(self._space, ray, active)
        return dr.select(found, number, self._outside)

    def _probed(self) -> tuple[list[int], list[bool]]:
        """By emitter: the medium that its rays start in, and whether they do not all start in the same."""
        count = self._emitters.count
        rng = np.random.default_rng(0)
        n = _PROBES * count
        u = rng.random((3, n))
        u_point = mi.Point2f((np.arange(n) + rng.random(n)) / n, u[0])
        zeros = dr.zeros(mi.Spectrum if mi.is_spectral else mi.Color0f, n)
        if mi.is_spectral:
            zeros += 550
        shared = Shared(mi.Float(0), zeros, mi.Spectrum(1), mi.Float(0.5))
        e = self._emitters.sample_emission(u_point, mi.Point2f(u[1], u[2]), shared, mi.Bool(True))
        number = np.array(self._near_side(e, mi.Bool(True)) + dr.zeros(mi.UInt32, n))
        index = np.array(e.index + dr.zeros(mi.UInt32, n))
        probed, mixed = [], []
        for emitter in range(count):
            of_this = number[index == emitter]
            probed.append(int(of_this[0]) if len(of_this) else 0)
            mixed.append(len(set(of_this)) != 1)
        return probed, mixed


def _declared(space: Space, emitters: Emitters) -> tuple[list, list]:
    """By emitter: the media in front of and behind a shape that bounds media, else None."""
    front, back = [], []
    for emitter in emitters.scene.emitters():
        shape = emitter.get_shape()
        bounds = shape is not None and shape.is_medium_transition()
        front.append(space.media.number_of(shape.exterior_medium()) if bounds else None)
        back.append(space.media.number_of(shape.interior_medium()) if bounds else None)
    return front, back


def _is_unbounded(space: Space, sensor: mi.Sensor) -> bool:
    """Whether some ray from the sensor, which declares a medium, meets no boundary."""
    if not space.media.sensor:
        return False
    rng = np.random.default_rng(0)
    u = rng.random((2, _PROBES))
    d = mi.warp.square_to_uniform_sphere(mi.Point2f(u[0], u[1]))
    origin = sensor.world_transform() @ mi.Point3f(0)
    _, found = boundaries.near_side(space, mi.Ray3f(origin, d), mi.Bool(True))
    return not bool(dr.all(found)[0]) if dr.width(found) > 1 else not bool(found[0])
