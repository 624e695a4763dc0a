"""Finds the medium in which light subpaths start.

Scenes seldom declare it: an area light on a shape without exterior medium may stand in a ball of milk. Rays
of emission find it: the near side of the first boundary that they meet, or the medium that surrounds the
scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..emitters.emitters import Emitters
from ..geometry.boxes import box_of, corners, points_in, scene_box
from ..geometry.directions import random_directions
from ..host.introspection import is_instance, named
from ..transport.inputs import Shared
from . import boundaries
from .phase import asymmetry
from .space import Space

# Rays for a sensor's medium; for an emitter's (fewer if there are many); of all emitters. A part of 1/1000 of
# an emitter in another medium is missed in one of sixty cases.
_PROBES, _OF_EMITTER, _OF_EMITTERS = 64, 4096, 1 << 20

# Random lines that compare boundaries, and the tolerated share of disagreements (rounding, edges): through
# the scene; through each shape that bounds a medium. Half of both start at the sensor.
_LINES, _TOLERATED = 2048, 0.01
_OF_SHAPE, _TOLERATED_OF_SHAPE, _MOST_SHAPES = 64, 0.05, 1024

# Hits on a shape lie in its box up to this share of its size (its square, of coordinates: rounding).
_SLACK = 1e-3

# Rays that leave boundaries: of all shapes, and most of one.
_LEAVING, _LEAVING_ONE = 1 << 16, 1024

# Largest mean relative difference of sigma_t rho and its reverse due to rounding.
_SYMMETRIC = 1e-3


class LightMedia:
    """The medium of every emitter; made for each render.

    ``outside``: number of the medium that surrounds the scene, see `_outside`; ``contradiction``: why light
    and camera subpaths would disagree on the media, or empty; ``hides_infinity``: light from infinity does
    not arrive; ``far``: see `medium_at_far_plane`.
    """

    def __init__(self, space: Space, emitters: Emitters, sensor: mi.Sensor, far: int):
        self._space, self._emitters = space, emitters
        rays = _rays_around(sensor, _PROBES, 0)
        around = _NearSides.of(boundaries.near_side(space, rays, mi.Bool(True)), _PROBES)
        bounds = _bounding_shapes(space.scene)
        leaving = _Leaving.of(space, bounds) if bounds else None
        self.outside = _outside(space, around, leaving)
        self._outside = dr.opaque(mi.UInt32, self.outside)
        # An endless homogeneous medium absorbs all light from infinity.
        endless = space.media.objects[self.outside - 1] if self.outside else None
        self.hides_infinity = (
            endless is not None and endless.is_homogeneous() and space.media.looks[self.outside - 1].least > 0
        )
        front, back = _declared(space, emitters)
        found = self._probed(leaving) if emitters.traced else [_Probed(0, False, "")] * emitters.count
        self.contradiction = (
            _contradiction_of_media(space, sensor, around, self.outside, bounds)
            or (_contradiction_of_surroundings(space, leaving, self, emitters.at_infinity) if leaving else "")
            or _contradiction_of_phases(space)
            or (_contradiction_at_infinity(space, self.outside) if emitters.at_infinity else "")
            or _contradiction_at_far_plane(space, sensor, 0 if far == self.outside else far)
            or next((p.unknown for f, p in zip(front, found, strict=True) if f is None and p.unknown), "")
        )
        pairs = zip(front, back, found, strict=True)
        numbers = [(p.number if f is None else f, p.number if b is None else b) for f, b, p in pairs]
        self._front, self._back = (mi.UInt32([pair[i] for pair in numbers] or [0]) for i in (0, 1))
        # Emitters in several media: the medium is determined per ray.
        mixed = [p.mixed and f is None for p, f in zip(found, front, strict=True)]
        self.mixed = any(mixed)
        self._mixed = mi.Bool(mixed or [False])
        dr.make_opaque(self._front, self._back, self._mixed)

    def at(self, e) -> mi.UInt32:
        """Number of the medium in which the first ray of an `emitters.Emission` starts."""
        outwards = dr.dot(e.anchor.n, e.d) >= 0
        number = dr.select(
            outwards, dr.gather(mi.UInt32, self._front, e.index), dr.gather(mi.UInt32, self._back, e.index)
        )
        number = dr.select(e.infinite, self._outside, number)
        if not self.mixed:
            return number
        traced = dr.gather(mi.Bool, self._mixed, e.index) & ~e.infinite
        found = self._near_side(e, traced)
        number = dr.select(found.escaped, self._outside, number)
        return dr.select(found.found, found.number, number)

    def _near_side(self, e, active, target=None) -> boundaries.NearSide:
        return boundaries.near_side(self._space, mi.Ray3f(e.anchor.towards(e.d), e.d), active, target)

    def _probed(self, leaving: _Leaving | None) -> list[_Probed]:
        """Media of rays of each emitter; also towards boundaries, however small."""
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
        target = leaving.points(n, rng) if leaving else None
        sides = _NearSides.of(self._near_side(e, mi.Bool(True), target), n)
        number = np.where(sides.found, sides.number, self.outside)
        known = sides.found | sides.escaped
        index = np.array(e.index + dr.zeros(mi.UInt32, n))
        order = np.argsort(index, kind="stable")
        parts = np.split(order, np.searchsorted(index[order], np.arange(1, count)))
        probed = []
        for emitter, part in zip(self._emitters.objects, parts, strict=True):
            of_this = number[part[known[part]]]
            most = int(np.bincount(of_this).argmax()) if len(of_this) else self.outside
            # Emitters with few samples are determined per ray.
            seldom = len(part) < _PROBES // 2 and emitter.sampling_weight() > 0
            finite = not mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)
            lost = finite and target is not None and len(part) >= _PROBES // 2 and not len(of_this)
            why = (
                f"no ray of emitter {named(emitter)} meets a boundary or leaves the scene, so that the "
                "medium in which it is stays unknown: give the shapes around it their media"
            )
            mixed = finite and (seldom or bool((of_this != most).any()))
            probed.append(_Probed(most, mixed, why if lost else ""))
        return probed


@dataclass(frozen=True)
class _Probed:
    """Media of an emitter's rays: the ``number`` that most start in.

    ``mixed``: not all start in the same one; ``unknown``: why it is unknown, or empty.
    """

    number: int
    mixed: bool
    unknown: str


def _declared(space: Space, emitters: Emitters) -> tuple[list, list]:
    """By emitter: media in front of and behind a shape that bounds media, else None."""
    front, back = [], []
    for emitter in emitters.objects:
        shape = emitter.get_shape()
        bounds = shape is not None and shape.is_medium_transition()
        front.append(space.media.number_of(shape.exterior_medium()) if bounds else None)
        back.append(space.media.number_of(shape.interior_medium()) if bounds else None)
    return front, back


@dataclass(frozen=True)
class _NearSides:
    """A `boundaries.NearSide` as NumPy arrays."""

    number: np.ndarray
    found: np.ndarray
    escaped: np.ndarray

    @classmethod
    def of(cls, side: boundaries.NearSide, count: int) -> _NearSides:
        dr.eval(side)  # one kernel
        return cls(*(np.broadcast_to(np.array(x), count) for x in (side.number, side.found, side.escaped)))

    @property
    def numbers(self) -> np.ndarray:
        return self.number[self.found]


def _bounding_shapes(scene: mi.Scene) -> list[tuple[mi.Shape, mi.ScalarBoundingBox3f]]:
    """Shapes of a scene that bound media, including instances, with their boxes."""
    bounds = [s for s in scene.shapes() if s.is_medium_transition() or is_instance(s)]
    return [(s, box) for s in bounds if (box := box_of(s)) is not None][:_MOST_SHAPES]


@dataclass(frozen=True)
class _Leaving:
    """Rays that leave boundaries, (shapes, rays of each): starting media and ends.

    Masks: ``escaped``, they leave the scene without meeting another boundary; ``lost``, they stay among
    opaque surfaces. ``p``: origins of rays of known medium, (3, n).
    """

    shapes: list[mi.Shape]
    number: np.ndarray
    known: np.ndarray
    escaped: np.ndarray
    lost: np.ndarray
    p: np.ndarray

    @classmethod
    def of(cls, space: Space, bounds: list) -> _Leaving | None:
        """Trace rays to both sides of the shapes ``bounds``; None if no boundary is met."""
        each = min(max(_LEAVING // len(bounds), _OF_SHAPE), _LEAVING_ONE)
        count = each * len(bounds)
        rng = np.random.default_rng(4)
        which = np.repeat(np.arange(len(bounds)), each)
        through = points_in([box for _, box in bounds], which, rng.random((count, 3)))
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(rng.random((2, count))))
        local.z = dr.select(dr.arange(mi.UInt32, count) % 2 == 0, local.z, -local.z)
        sides = boundaries.leaving(space, _through_scene(space, through, rng), through, local)
        dr.eval(sides)
        met = _NearSides.of(boundaries.near_side(space, sides.ray, sides.known), count)
        number, known = (np.broadcast_to(np.array(x), count) for x in (sides.number, sides.known))
        if not known.any():
            return None
        p = np.array(sides.ray.o)[:, known]
        arrays = (number, known, known & met.escaped, known & ~met.escaped & ~met.found)
        return cls([s for s, _ in bounds], *(x.reshape(len(bounds), each) for x in arrays), p)

    def points(self, count: int, rng) -> mi.Point3f:
        """Random points of boundaries from which light may leave."""
        return mi.Point3f(self.p[:, rng.integers(self.p.shape[1], size=count)])


def _outside(space: Space, around: _NearSides, leaving: _Leaving | None) -> int:
    """The medium of most rays that leave the scene; the sensor's if none does."""
    numbers = np.full(around.escaped.sum(), space.media.sensor)
    if leaving is not None:
        numbers = np.concatenate([numbers, leaving.number[leaving.escaped]])
    return int(np.bincount(numbers).argmax()) if len(numbers) else space.media.sensor


def _contradiction_of_surroundings(
    space: Space, leaving: _Leaving, media: LightMedia, at_infinity: bool
) -> str:
    """Why the medium that surrounds the scene is uncertain; empty if it is not."""
    wrong = leaving.escaped & (leaving.number != media.outside)
    number = wrong.sum(1)
    share = np.where(number > 2, number / np.maximum(leaving.known.sum(1), 1), 0)
    if share.max() > _TOLERATED_OF_SHAPE or (at_infinity and media.hides_infinity and wrong.any()):
        worst = int(np.argmax(share if share.max() > 0 else number))
        inside = _called(space, int(leaving.number[worst][wrong[worst]][0]))
        return (
            f"rays from shape {named(leaving.shapes[worst])} leave the scene in {inside}, others in "
            f"{_called(space, media.outside)}, which therefore disagree: close the boundary between them"
        )
    elsewhere = leaving.lost & (leaving.number != space.media.sensor)
    if at_infinity and not leaving.escaped.any() and elsewhere.any():
        return (
            "no ray from the boundaries of media leaves the scene, so that the medium in which light from "
            "infinity starts stays unknown: take out the emitters at infinity if they light nothing"
        )
    return ""


def _rays_around(sensor: mi.Sensor, count: int, seed: int) -> mi.Ray3f:
    """Rays from the sensor's origins; in all directions if these are near one point."""
    own, u = _camera_rays(sensor, count, seed)
    at_one_point = sensor.class_name() in _AT_ONE_POINT
    d = mi.warp.square_to_uniform_sphere(mi.Point2f(u[0], u[1])) if at_one_point else own.d
    return mi.Ray3f(own.o + dr.zeros(mi.Point3f, count), d)


def _camera_rays(sensor: mi.Sensor, count: int, seed: int):
    """``count`` random rays of a sensor, and their random numbers, (5, count)."""
    u = np.random.default_rng(seed).random((5, count))
    film, aperture = mi.Point2f(u[2], u[3]), mi.Point2f(u[0], u[1])
    ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), mi.Float(u[4]), film, aperture)
    return ray, u


# Sensors whose rays start near one point, around which all directions are probed.
_AT_ONE_POINT = frozenset("PerspectiveCamera ThinLensCamera RadianceMeter".split())


def _contradiction_of_media(
    space: Space, sensor: mi.Sensor, around: _NearSides, outside: int, bounds: list
) -> str:
    """Why sensor and boundaries disagree on the media between them; or empty.

    ``around``: the boundaries around the sensor. If these are found in all directions, and none is in the
    sensor's medium, the sensor is at fault.
    """
    if not space.scene.shapes():
        return ""
    of_sensor = _contradiction_of_sensor(space, sensor, around.numbers)
    if of_sensor and around.found.all() and (around.numbers != space.media.sensor).all():
        return of_sensor
    return _contradiction_of_shapes(space, sensor, outside, bounds) or of_sensor


def _contradiction_of_sensor(space: Space, sensor: mi.Sensor, around: np.ndarray) -> str:
    """Why the sensor is not in the medium ``around`` it (numbers, per ray); or empty."""
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


def _contradiction_of_shapes(space: Space, sensor: mi.Sensor, outside: int, boxes: list) -> str:
    """Why boundaries disagree on the medium between them; empty if they do not."""
    remedy = (
        "disagree about the medium between them: give each the interior and exterior medium that is there, "
        "and leave a gap where faces coincide"
    )
    if boxes:
        lines = _lines(space, sensor, [box for _, box in boxes], _OF_SHAPE, outside)
        compared, wrong = _counted(space, lines, len(boxes))
        # A few disagreements are not significant.
        share = np.where(wrong > 2, wrong / np.maximum(compared, 1), 0)
        if share.max() > _TOLERATED_OF_SHAPE:
            return f"shape {named(boxes[int(share.argmax())][0])} and those around it {remedy}"
    (compared,), (wrong,) = _counted(
        space, _lines(space, sensor, [scene_box(space.scene)], _LINES, outside), 1
    )
    if wrong <= _TOLERATED * compared:
        return ""
    return f"at {100 * wrong / compared:.0f} % of the boundaries that random lines cross shapes {remedy}"


def _counted(space: Space, lines: boundaries.Lines, parts: int) -> list[np.ndarray]:
    """Count compared and disagreeing boundaries in each of ``parts`` of ``lines``."""
    found = boundaries.disagreements(space, lines)
    dr.eval(found)  # one kernel
    return [np.array(x).reshape(parts, -1).sum(1) for x in found]


def _contradiction_of_phases(space: Space) -> str:
    """Why scattering is not reciprocal; empty if it is."""
    for medium in space.media.objects:
        if asymmetry(medium) > _SYMMETRIC:
            return (
                f"the phase function of medium {named(medium)} ({medium.phase_function().class_name()}) "
                "times the extinction along the direction of arrival is not symmetric"
            )
    return ""


def _contradiction_at_infinity(space: Space, outside: int) -> str:
    """Why light from infinity differs from the camera's side in ``outside``; or empty."""
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
    """Number of the medium in which most clipped camera rays end at the far plane.

    0 if none ends in a medium, without emitters at infinity, and for sensors without far plane.
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
    """Why camera rays that end in the medium ``far`` disagree with light; or empty."""
    if not far:
        return ""
    return (
        f"the far plane of sensor {named(sensor)} lies in the medium {named(space.media.objects[far - 1])}, "
        "through the rest of which light from infinity has to come: raise far_clip"
    )


def _lines(space: Space, sensor: mi.Sensor, boxes: list, each: int, outside: int) -> boundaries.Lines:
    """Random lines, ``each`` through random points of every box, box by box.

    Every other line goes straight through the scene, from the medium ``outside``. The others start at the
    sensor and are reflected, since straight lines lose the medium behind walls.
    """
    count = each * len(boxes)
    rng = np.random.default_rng(1)
    which = np.repeat(np.arange(len(boxes)), each)
    through = points_in(boxes, which, rng.random((count, 3)))
    straight, (ray, _) = _through_scene(space, through, rng), _camera_rays(sensor, count, 2)
    own = mi.Ray3f(mi.Point3f(ray.o), mi.Vector3f(ray.d))
    lane = dr.arange(mi.UInt32, count)
    if sensor.class_name() in _AT_ONE_POINT:  # every other one goes directly to its point
        own.d = dr.select(lane % 4 == 1, dr.normalize(through - own.o), own.d)
    reflected = lane % 2 == 1
    medium = dr.select(reflected, dr.opaque(mi.UInt32, space.media.sensor), dr.opaque(mi.UInt32, outside))
    low, high = corners(boxes, which)
    slack = _SLACK * (high - low).max(1, keepdims=True) + _SLACK**2 * np.abs([low, high]).max((0, 2))[:, None]
    box = (mi.Point3f(x.T) for x in (low - slack, high + slack))
    return boundaries.Lines(dr.select(reflected, own, straight), medium, reflected, through, *box)


def _through_scene(space: Space, through: mi.Point3f, rng) -> mi.Ray3f:
    """Random lines ``through`` these points of the scene, starting outside of it."""
    box = scene_box(space.scene)
    d = random_directions(rng, dr.width(through))
    return mi.Ray3f(through - d * (float(np.linalg.norm(np.array(box.extents()))) * 1.1), d)
