"""Which medium light subpaths start in.

Scenes seldom say it: an area light on a shape without exterior medium may stand in a ball of milk. It is
found by rays of emission: the near side of the first boundary that they meet, or what surrounds the scene.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..emitters.emitters import Emitters
from ..host.introspection import is_instance, named
from ..media import boundaries
from ..media.media import Space
from ..transport.inputs import Shared
from ..transport.phase import asymmetry

# Rays by which a sensor is asked for its medium; an emitter by so many, fewer where there are many emitters.
# A part of an emitter that is a thousandth of it and lies in another medium is missed by one in sixty.
_PROBES, _OF_EMITTER, _OF_EMITTERS = 64, 4096, 1 << 20

# Random lines by which boundaries are looked at, and the share of crossings that may disagree (rounding;
# edges): lines through the scene, and so many through each shape that bounds a medium.
_LINES, _TOLERATED = 1024, 0.01
_OF_SHAPE, _TOLERATED_OF_SHAPE, _MOST_SHAPES = 32, 0.05, 1024

# Relative difference of sigma_t rho and its reverse, on average, that rounding leaves.
_SYMMETRIC = 1e-3


class LightMedia:
    """The medium of every emitter; made anew for each render.

    ``outside`` is the number of the medium that surrounds the scene, see `_outside`;
    ``contradiction`` why light and camera subpaths would not agree on the media, empty if they do;
    ``hides_infinity``: light from infinity does not arrive. ``far`` see `medium_at_far_plane`.
    """

    def __init__(self, space: Space, emitters: Emitters, sensor: mi.Sensor, far: int):
        self._space, self._emitters = space, emitters
        number, found = _around(space, sensor)
        self.outside = _outside(space, found)
        self._outside = dr.opaque(mi.UInt32, self.outside)
        self.contradiction = (
            _contradiction_of_shapes(space, self.outside)
            or _contradiction_of_sensor(space, sensor, number[found])
            or _contradiction_of_phases(space)
            or (_contradiction_at_infinity(space, self.outside) if emitters.at_infinity else "")
            or _contradiction_at_far_plane(space, sensor, 0 if far == self.outside else far)
        )
        # Nothing arrives from infinity through a homogeneous medium without end.
        endless = space.media.objects[self.outside - 1] if self.outside else None
        self.hides_infinity = (
            endless is not None and endless.is_homogeneous() and space.media.looks[self.outside - 1].least > 0
        )
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
        each = min(max(_OF_EMITTERS // max(count, 1), _PROBES), _OF_EMITTER)
        n = each * count
        u = rng.random((3, n))
        u_point = mi.Point2f((np.arange(n) + rng.random(n)) / n, u[0])
        zeros = dr.zeros(mi.UnpolarizedSpectrum if mi.is_spectral else mi.Color0f, n)
        if mi.is_spectral:
            zeros += 550
        shared = Shared(mi.Float(0), zeros, mi.UnpolarizedSpectrum(1), mi.Float(0.5))
        e = self._emitters.sample_emission(u_point, mi.Point2f(u[1], u[2]), shared, mi.Bool(True))
        number = np.array(self._near_side(e, mi.Bool(True)) + dr.zeros(mi.UInt32, n))
        index = np.array(e.index + dr.zeros(mi.UInt32, n))
        order = np.argsort(index, kind="stable")
        parts = np.split(number[order], np.searchsorted(index[order], np.arange(1, count)))
        probed, mixed = [], []
        for emitter, of_this in zip(self._emitters.scene.emitters(), parts, strict=True):
            probed.append(int(of_this[0]) if len(of_this) else 0)
            # One that is seldom chosen is not known well enough.
            unknown = len(of_this) < _PROBES // 2 and emitter.sampling_weight() > 0
            mixed.append(unknown or bool((of_this != probed[-1]).any()))
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


def _outside(space: Space, found: np.ndarray) -> int:
    """The number of the medium that surrounds the scene; ``found`` see `_around`.

    The sensor's if some of its rays meet no boundary, else what boundaries say that are met from outside.
    """
    if not found.all():
        return space.media.sensor
    rays, _ = _lines(space, 0)
    number, met = (np.array(x) for x in boundaries.near_side(space, rays, mi.Bool(True)))
    return int(np.bincount(number[met]).argmax()) if met.any() else 0


def _around(space: Space, sensor: mi.Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the media before the first boundaries around the sensor, and whether there are any."""
    own, u = _camera_rays(sensor, _PROBES, 0)
    at_one_point = sensor.class_name() in _AT_ONE_POINT
    d = mi.warp.square_to_uniform_sphere(mi.Point2f(u[0], u[1])) if at_one_point else own.d
    rays = mi.Ray3f(own.o + dr.zeros(mi.Point3f, _PROBES), d)
    number, found = boundaries.near_side(space, rays, mi.Bool(True))
    return np.array(number), np.array(found)


def _camera_rays(sensor: mi.Sensor, count: int, seed: int):
    """So many random rays of a sensor, and the random numbers that they were made of, (5, count)."""
    u = np.random.default_rng(seed).random((5, count))
    film, aperture = mi.Point2f(u[2], u[3]), mi.Point2f(u[0], u[1])
    ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), mi.Float(u[4]), film, aperture)
    return ray, u


# Sensors whose rays start near to one point, around which everything is looked at.
_AT_ONE_POINT = frozenset("PerspectiveCamera ThinLensCamera RadianceMeter".split())


def _contradiction_of_sensor(space: Space, sensor: mi.Sensor, around: np.ndarray) -> str:
    """Why the sensor is not in the medium ``around`` it (numbers, one for each ray); empty if it is."""
    declared = space.media.sensor
    if not len(around) or (around != declared).mean() <= _TOLERATED:
        return ""
    says = _called(space, declared)
    there = _called(space, int(np.bincount(around[around != declared]).argmax()))
    return (
        f"sensor {named(sensor)} declares {says}, but the boundaries around it say that it is in {there}: "
        "let it refer to that (name medium), or mend the media of the shapes around it"
    )


def _called(space: Space, number: int) -> str:
    return f"the medium {named(space.media.objects[number - 1])}" if number else "no medium"


def _contradiction_of_shapes(space: Space, outside: int) -> str:
    """Why boundaries do not agree on the medium between them; empty if they do."""
    if not space.scene.shapes():
        return ""
    remedy = (
        "disagree about the medium between them: give each the interior and exterior medium that is there, "
        "and leave a gap where faces coincide"
    )
    bounds = [s for s in space.scene.shapes() if s.is_medium_transition() or is_instance(s)][:_MOST_SHAPES]
    if bounds:
        crossings, wrong = boundaries.disagreements(space, *_lines_through(space, bounds, outside))
        crossings, wrong = (np.array(x).reshape(len(bounds), _OF_SHAPE).sum(1) for x in (crossings, wrong))
        share = np.where(wrong > 2, wrong / np.maximum(crossings, 1), 0)  # of few crossings one tells nothing
        if share.max() > _TOLERATED_OF_SHAPE:
            return f"shape {named(bounds[int(share.argmax())])} and those around it {remedy}"
    crossings, wrong = boundaries.disagreements(space, *_lines(space, outside))
    crossings, wrong = int(np.array(crossings).sum()), int(np.array(wrong).sum())
    if wrong <= _TOLERATED * crossings:
        return ""
    return f"at {100 * wrong / crossings:.0f} % of the boundaries that random lines cross shapes {remedy}"


def _contradiction_of_phases(space: Space) -> str:
    """Why light does not scatter alike in both directions; empty if it does."""
    for medium in space.media.objects:
        if asymmetry(medium) > _SYMMETRIC:
            return (
                f"the phase function of medium {named(medium)} ({medium.phase_function().class_name()}) "
                "times the extinction along the direction of arrival is not symmetric"
            )
    return ""


def _contradiction_at_infinity(space: Space, outside: int) -> str:
    """Why light from infinity is not that of the camera's side through the medium ``outside``."""
    if not outside:
        return ""
    medium, look = space.media.objects[outside - 1], space.media.looks[outside - 1]
    if not medium.is_homogeneous():
        return (
            f"the grid of medium {named(medium)} has no boundary, so that light from infinity starts within "
            "it: put a shape with a null BSDF around it"
        )
    if look.least == 0 and look.majorant.max() > 0:
        return (
            f"medium {named(medium)} has no end and lets some wavelengths of light from infinity through, "
            "but not others: put a shape with a null BSDF around it"
        )
    return ""


def medium_at_far_plane(space: Space, sensor: mi.Sensor) -> int:
    """The number of the medium in which most camera rays end at the far plane, of those that end in one.

    0 if none does, where nothing shines behind, and for sensors without far plane.
    """
    infinite = any(mi.has_flag(e.flags(), mi.EmitterFlags.Infinite) for e in space.scene.emitters())
    if not infinite or not isinstance(sensor, mi.ProjectiveCamera):
        return 0
    ray, _ = _camera_rays(sensor, _OF_EMITTER, 3)
    number, arrived = (
        np.array(x) for x in boundaries.behind(space, mi.Ray3f(ray), mi.UInt32(space.media.sensor))
    )
    clipped = arrived & (number > 0)
    return int(np.bincount(number[clipped]).argmax()) if clipped.any() else 0


def _contradiction_at_far_plane(space: Space, sensor: mi.Sensor, far: int) -> str:
    """Why camera rays that end in the medium ``far`` are not light's ways from infinity; empty if it is 0."""
    if not far:
        return ""
    return (
        f"the far plane of sensor {named(sensor)} lies in the medium {named(space.media.objects[far - 1])}, "
        "through the rest of which light from infinity has to come: raise far_clip"
    )


def _lines(space: Space, outside: int) -> tuple[mi.Ray3f, mi.UInt32]:
    """Random lines through the scene, from outside, and the medium that they start in."""
    box = space.scene.bbox()
    low, high = (np.array(x, dtype=np.float64)[:, None] for x in (box.min, box.max))
    return _through(space, low, high, _LINES, 1), dr.opaque(mi.UInt32, outside)


def _lines_through(space: Space, shapes: list[mi.Shape], outside: int) -> tuple[mi.Ray3f, mi.UInt32]:
    """As `_lines`, `_OF_SHAPE` through the box of each shape, one shape after the other."""
    boxes = [shape.bbox() for shape in shapes]
    low, high = (
        np.repeat(np.array([np.array(x, dtype=np.float64).ravel() for x in corner]), _OF_SHAPE, axis=0).T
        for corner in ([box.min for box in boxes], [box.max for box in boxes])
    )
    return _through(space, low, high, _OF_SHAPE * len(shapes), 2), dr.opaque(mi.UInt32, outside)


def _through(space: Space, low: np.ndarray, high: np.ndarray, count: int, seed: int) -> mi.Ray3f:
    """So many random lines through random points between ``low`` and ``high``, from outside of the scene."""
    scene = space.scene.bbox()
    diagonal = np.array(scene.max, dtype=np.float64) - np.array(scene.min, dtype=np.float64)
    u = np.random.default_rng(seed).random((5, count))
    d = mi.warp.square_to_uniform_sphere(mi.Point2f(u[0], u[1]))
    through = low + u[2:] * (high - low)
    return mi.Ray3f(mi.Point3f(through) - d * (float(np.linalg.norm(diagonal)) * 1.1), d)
