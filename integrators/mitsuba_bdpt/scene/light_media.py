"""Which medium light subpaths start in.

Scenes seldom say it: an area light on a shape without exterior medium may stand in a ball of milk. It is
found by rays of emission: the near side of the first boundary that they meet, or what surrounds the scene.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..emitters.emitters import Emitters
from ..host.introspection import named
from ..media import boundaries
from ..media.media import Space
from ..transport.inputs import Shared

# Rays by which an emitter, or a sensor, is asked for its medium.
_PROBES = 64

# Random lines by which boundaries are looked at, and the share of crossings that may disagree (rounding;
# edges).
_LINES = 1024
_TOLERATED = 0.01


class LightMedia:
    """The medium of every emitter; made anew for each render.

    ``outside`` is the number of the medium that surrounds the scene: the sensor's, unless it is bounded;
    ``contradiction`` why light and camera subpaths would not agree on the media, empty if they do;
    ``hides_infinity``: light from infinity does not arrive.
    """

    def __init__(self, space: Space, emitters: Emitters, sensor: mi.Sensor):
        self._space, self._emitters = space, emitters
        # The sensor's medium has no end if some ray from it meets no boundary.
        number, found = _around(space, sensor)
        self.outside = 0 if found.all() else space.media.sensor
        self.contradiction = _contradiction_of_sensor(
            space, sensor, number[found]
        ) or _contradiction_of_shapes(space, self.outside)
        self._outside = dr.opaque(mi.UInt32, self.outside)
        # Nothing arrives from infinity through a homogeneous medium without end.
        endless = space.media.objects[self.outside - 1] if self.outside else None
        self.hides_infinity = endless is not None and endless.is_homogeneous()
        front, back = _declared(space, emitters)
        probed, mixed = (
            self._probed() if emitters.traced else ([0] * emitters.count, [False] * emitters.count)
        )
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


def _around(space: Space, sensor: mi.Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the media before the first boundaries around the sensor, and whether there are any."""
    u = np.random.default_rng(0).random((2, _PROBES))
    d = mi.warp.square_to_uniform_sphere(mi.Point2f(u[0], u[1]))
    origin = sensor.world_transform() @ mi.Point3f(0)
    number, found = boundaries.near_side(
        space, mi.Ray3f(origin + dr.zeros(mi.Point3f, _PROBES), d), mi.Bool(True)
    )
    return np.array(number), np.array(found)


def _contradiction_of_sensor(space: Space, sensor: mi.Sensor, around: np.ndarray) -> str:
    """Why the sensor is not in the medium ``around`` it (numbers, one for each ray); empty if it is."""
    declared = space.media.sensor
    if not len(around) or (around != declared).mean() <= _TOLERATED:
        return ""
    says = "no medium"
    if declared:
        says = f"the medium {named(space.media.objects[declared - 1])}"
    return f"sensor {named(sensor)} declares {says}, but the boundaries around it say otherwise"


def _contradiction_of_shapes(space: Space, outside: int) -> str:
    """Why boundaries do not agree on the medium between them; empty if they do."""
    if not space.scene.shapes():
        return ""
    crossings, wrong = boundaries.disagreements(space, *_lines(space, outside))
    crossings, wrong = int(np.array(crossings).sum()), int(np.array(wrong).sum())
    if wrong > _TOLERATED * crossings:
        return (
            f"the shapes disagree about the medium between them at {100 * wrong / crossings:.0f} % of the "
            "boundaries that random lines cross: give each the interior and exterior medium that is there"
        )
    return ""


def _lines(space: Space, outside: int) -> tuple[mi.Ray3f, mi.UInt32]:
    """Random lines through the scene, from outside, and the medium that they start in."""
    box = space.scene.bbox()
    low, high = np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)
    u = np.random.default_rng(1).random((5, _LINES))
    d = mi.warp.square_to_uniform_sphere(mi.Point2f(u[0], u[1]))
    through = low[:, None] + u[2:] * (high - low)[:, None]
    away = float(np.linalg.norm(high - low)) * 1.1
    return mi.Ray3f(mi.Point3f(through) - d * away, d), dr.opaque(mi.UInt32, outside)
